"""What goes into the decision logs of a dataset: the curator's decisions, and people's."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from curation_ros.core.decision import decision as decisions
from curation_ros.core.decision.decision import VERDICTS, Decision, in_force, own_decisions
from curation_ros.core.decision.salvage import LEAST_PREFIX_S
from curation_ros.core.errors import EpisodeError
from curation_ros.core.types import NS_PER_S
from curation_ros.dataset.dataset import Dataset


@dataclass(frozen=True)
class Logged:
    """What became of a decision of the curator.

    Attributes:
        in_force: the decision that counts now: a person's, where a person has decided.
        previous: the one that counted before; None where there was none.
        is_new: whether a line was added to the log.
    """

    in_force: Decision
    previous: Decision | None
    is_new: bool


def log_decision(dataset: Dataset, decision: Decision) -> Logged:
    """Log a decision of the curator, unless it says nothing new.

    A decision that differs from the curator's last one gets the next revision. One that differs
    in its evidence alone amends that revision.

    Raises:
        CurationError: if the log cannot be read or written.
    """
    episode_id = decision.episode
    known: list[Decision] = []

    def says_nothing_new(logged: Sequence[Decision]) -> bool:
        known[:] = logged
        last = own_decisions(logged).get(episode_id)
        return last is not None and _differ_in_evidence_alone(last, decision)

    # Another process may decide on the same episode at the same time.
    added = dataset.append_decision(decision, unless=says_nothing_new)
    if added is None:
        last = own_decisions(known).get(episode_id)
        if last is not None and not decision.evidence.items() <= last.evidence.items():
            amended = replace(decision, revision=last.revision)
            added = dataset.append_decision(amended, amend=True)
    now = [*known, added] if added is not None else known
    return Logged(
        in_force=in_force(now)[episode_id],
        previous=in_force(known).get(episode_id),
        is_new=added is not None,
    )


def log_override(
    dataset: Dataset,
    prefix: str,
    verdict: str,
    reason: str,
    by: str,
    *,
    state_hash: str = "",
    until_s: float | None = None,
) -> Decision:
    """Log a person's decision on an episode as a new revision.

    Args:
        dataset: it has the episode.
        prefix: id, beginning of an id, or short name.
        verdict: one of VERDICTS.
        reason: in the person's words; may be empty.
        by: name of the person.
        state_hash: of the curation in use, for an episode that was not decided on before.
        until_s: for `salvage`, where the part that is kept ends, seconds from the start of the
            episode; None for the other verdicts.

    Raises:
        EpisodeError: if the episode is not known, the verdict does not exist, or `until_s` does
            not fit the verdict or the episode.
    """
    what = f"override {verdict!r} of {prefix!r}"
    known_verdict = next((v for v in VERDICTS if v == verdict), None)
    if known_verdict is None:
        raise EpisodeError(f"{what}: expected {', '.join(VERDICTS)}")
    if verdict == "salvage" and until_s is None:
        raise EpisodeError(f"{what}: name its end (curation override ... --until SECONDS)")
    if verdict != "salvage" and until_s is not None:
        raise EpisodeError(f"{what}: until {until_s} s belongs to salvage")
    episode_id = dataset.find(prefix)
    known = dataset.decisions(episode_id)
    previous = known[-1] if known else _undecided(dataset, episode_id, state_hash)
    text = f"{by}: {reason}" if reason else f"{by} decided"
    span = whole = (0, _duration_ns(dataset, previous, known))
    if until_s is not None:
        whole_s = whole[1] / NS_PER_S
        if not LEAST_PREFIX_S <= until_s < whole_s:  # NaN is refused, too
            raise EpisodeError(
                f"{what}: until {until_s} s: expected from {LEAST_PREFIX_S:g} s to less than "
                f"{whole_s:.2f} s, the whole episode"
            )
        span = (0, round(until_s * NS_PER_S))
        text += f"; kept until {until_s:.2f} s of {whole_s:.2f} s"
    decision = decisions.override(previous, known_verdict, text, by=by, span=span)
    logged = dataset.append_decision(decision)
    assert logged is not None, "nothing can refuse it"
    return logged


def _differ_in_evidence_alone(a: Decision, b: Decision) -> bool:
    return replace(a, revision=0, evidence={}) == replace(b, revision=0, evidence={})


def _duration_ns(dataset: Dataset, previous: Decision, known: Sequence[Decision]) -> int:
    """Length of an episode: as its bag has it, or as long as any decision on it."""
    indexed = dataset.index.episode(previous.episode)
    ends_ns = [*(d.span[1] for d in known), previous.span[1]]
    return max(ends_ns if indexed is None else [*ends_ns, indexed.duration_ns])


def _undecided(dataset: Dataset, episode_id: str, state_hash: str) -> Decision:
    """A first decision on an episode that the curator has not decided on."""
    indexed = dataset.index.episode(episode_id)
    if indexed is None:
        raise EpisodeError(f"episode {episode_id}: no bag in {dataset.path}")
    return Decision(
        episode=episode_id,
        name=indexed.name,
        verdict="review",
        reason="not decided",
        span=(0, indexed.duration_ns),
        state_hash=state_hash,
    )
