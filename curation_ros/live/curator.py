"""Live curation without ROS: samples and episode events in, logged decisions out."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from curation_ros.batch.examine import EpisodesOf, Examiner, judge_bags, with_copy
from curation_ros.core.decision import decision as decisions
from curation_ros.core.decision.curation import Curation
from curation_ros.core.decision.decision import CURATOR, Decision, in_force
from curation_ros.core.decision.fitted_rule import FittedRule
from curation_ros.core.decision.salvage import LEAST_PREFIX_S
from curation_ros.core.episode.builder import EpisodeBuilder
from curation_ros.core.episode.episode import Episode
from curation_ros.core.episode.findings import Finding
from curation_ros.core.episode.gate import Closed, EpisodeGate
from curation_ros.core.episode.status import EpisodeEvent, owner_findings
from curation_ros.core.episode.stream import Decoder, Sample
from curation_ros.core.episode.topic_map import TopicMap
from curation_ros.core.errors import CurationError, EpisodeError
from curation_ros.core.evidence.alerts import AlertWatch
from curation_ros.core.types import NS_PER_S
from curation_ros.dataset.dataset import Dataset
from curation_ros.dataset.episodes import read_episode

#: An episode that runs is looked at for alerts this often, by its own clock.
ALERT_PERIOD_S = 0.1
#: Verdicts that a person may give; to salvage, a person must say until when.
OVERRIDES = ("keep", "salvage", "discard", "review")
#: Episodes whose live form is kept until their bags close.
_REMEMBERED = 8


@dataclass
class _Live:
    builder: EpisodeBuilder
    event: EpisodeEvent
    watch: AlertWatch
    looked_ns: int = 0


@dataclass(frozen=True)
class Decided:
    """A decision with how long it took.

    Attributes:
        decision: as logged.
        latency_s: from the gate's closing to the decision on disk; None for that of a bag.
    """

    decision: Decision
    latency_s: float | None = None


@dataclass(frozen=True)
class Alert:
    """What has gone wrong with an episode that still runs.

    Attributes:
        episode, name: identity of the episode.
        finding: what, where and when; its span from the episode's start.
        seen_ns: stamp of the newest sample by which it was seen.
    """

    episode: str
    name: str
    finding: Finding
    seen_ns: int


class LiveCuration:
    """Builds episodes from live samples, and decides when their gates close.

    Decisions are logged before they are returned. A person outranks the curator: once a person
    has decided, a later revision changes the scores but not the verdict.
    """

    def __init__(
        self,
        dataset: Dataset,
        topic_map: TopicMap,
        decoder: Decoder,
        curation: Curation,
        *,
        drain_timeout_s: float = 3.0,
    ) -> None:
        """Make a live curation.

        Args:
            dataset: where decisions are logged, and where the recorder's bags appear.
            topic_map: how episodes are built.
            decoder: turns CDR bytes into columns.
            curation: fitted.
            drain_timeout_s: patience for late samples after an episode ended.
        """
        self.dataset = dataset
        self.topic_map = topic_map
        self.curation = curation
        self.gate = EpisodeGate(
            topic_map.topics, max_gap_s=topic_map.max_gap_s, drain_timeout_s=drain_timeout_s
        )
        self._decoder = decoder
        self._scores = _known_scores(dataset, curation) if curation.rule_needs_dataset else {}
        self._live: dict[str, _Live] = {}
        self._seen: dict[str, Episode] = {}
        self._read: deque[str] = deque(maxlen=_REMEMBERED)
        self._unread: set[str] = set()
        self._alerts: list[Alert] = []

    def event(self, event: EpisodeEvent, now_s: float) -> list[Decided]:
        """Take an event of the episode's owner."""
        known = self.gate.open_ids
        early = self.gate.event(event, now_s)
        if event.event == "started" and event.id in self.gate.open_ids and event.id not in known:
            builder = EpisodeBuilder(
                self.topic_map,
                self._decoder,
                episode_id=event.id,
                name=event.name,
                start_ns=event.start_ns,
            )
            watch = AlertWatch(self.topic_map, usual=self.curation.scorers.baseline.usual_)
            self._live[event.id] = _Live(builder, event, watch)
            for sample in early:
                builder.push(sample)
        return self.tick(now_s)

    def sample(self, sample: Sample, now_s: float) -> list[Decided]:
        """Take a sample."""
        episode_id = self.gate.push(sample)
        if episode_id is None:
            return self.tick(now_s)
        self._live[episode_id].builder.push(sample)
        self._look(episode_id)
        window = self.gate.window(episode_id)
        return self.tick(now_s) if window is not None and window.ended is not None else []

    def tick(self, now_s: float) -> list[Decided]:
        """Decide on every episode whose gate has closed."""
        decided = []
        for closed in self.gate.close_ready(now_s):
            decided.append(self._decide_live(closed))
            if closed.event.id in self._unread:
                self._unread.remove(closed.event.id)
                decided.append(self._decide_bag(closed.event.id))
        return [d for d in decided if d is not None]

    def take_alerts(self) -> list[Alert]:
        """Alerts since the last call, oldest first."""
        alerts, self._alerts = self._alerts, []
        return alerts

    def _look(self, episode_id: str) -> None:
        """Look for an alert, where all topics have moved on for long enough."""
        live = self._live[episode_id]
        now_ns = live.builder.settled_ns
        if live.watch.has_alerted or now_ns < live.looked_ns + int(ALERT_PERIOD_S * NS_PER_S):
            return
        live.looked_ns = now_ns
        finding = live.watch.take(live.builder.settled())
        if finding is not None:
            self._alerts.append(Alert(episode_id, live.event.name, finding, now_ns))

    @property
    def running(self) -> str:
        """Id of the episode that runs, empty if none does."""
        return self.gate.open_ids[-1] if self.gate.open_ids else ""

    def counts(self) -> dict[str, int]:
        """Samples by topic that the running episode has so far."""
        window = self.gate.window(self.running)
        counts = window.counts() if window is not None else {}
        return {topic: counts.get(topic, 0) for topic in self.topic_map.topics}

    def _decide_live(self, closed: Closed) -> Decided | None:
        """The decision on what was seen; None where there is nothing to decide on.

        Nothing was seen of an episode that was over before we came: its owner's latched words
        are all that is left of it. And a bag that was read already has the say.
        """
        began = time.perf_counter()
        live = self._live.pop(closed.event.id)
        is_live = closed.event.source == "live"
        if is_live and (closed.event.id in self._read or not any(closed.counts.values())):
            return None
        end_ns = closed.event.end_ns
        if end_ns is None:
            end_ns = live.builder.partial().end_ns
        event = replace(closed.event, end_ns=end_ns)
        episode = live.builder.finish(end_ns, event.counts, owner_findings(event))
        self._seen[episode.id] = episode
        while len(self._seen) > _REMEMBERED:
            del self._seen[next(iter(self._seen))]
        decision = log_decision(self.dataset, self._judge(episode))
        return Decided(decision, time.perf_counter() - began)

    def _judge(self, episode: Episode) -> Decision:
        """The decision as far as it can be made now: a rule over the dataset sees it so far."""
        seen = self.curation.examine(episode)
        original = self.dataset.with_content(seen.content, other_than=seen.episode)
        if original is not None and seen.steps:
            seen = with_copy(seen, original)
        rule: FittedRule | None = None
        if self.curation.rule_needs_dataset:
            if seen.is_trusted:
                self._scores[seen.episode] = seen.scores.get(self.curation.settings.rule_scorer)
            else:  # its bag may show a fault that was not seen live
                self._scores.pop(seen.episode, None)
            rule = self.curation.rule_over(self._scores, final=False, tie=self.dataset.tie(0))
        return self.curation.decide(seen, rule)

    def bag_closed(self, episode_id: str) -> list[Decided]:
        """Compare a closed bag with what was seen live; where they differ, the bag wins.

        Where our own gate is about to close, that is waited for: `tick` does it then. Where
        nobody has said that the episode ended, its recorder was stopped: the bag is read now.
        """
        window = self.gate.window(episode_id)
        if window is not None and window.ended is not None:
            self._unread.add(episode_id)
            return []
        decided = self._decide_bag(episode_id)
        return [] if decided is None else [decided]

    def _decide_bag(self, episode_id: str) -> Decided | None:
        """The decision on a bag; None where the one before stands."""
        live = self._seen.pop(episode_id, None)
        known = self.dataset.decisions(episode_id)
        try:
            episode = read_episode(self.dataset.bag_path(episode_id), self.topic_map)
        except CurationError as err:
            if known:
                self._amend(known[-1], {"bag": f"not seen: {err}"})
            return None
        self._read.append(episode_id)
        found = "alone"
        if live is not None:
            same = live.digest == episode.digest and live.findings == episode.findings
            found = "equal" if same else "differs"
        if known and found == "equal":
            self._amend(known[-1], {"bag": found})
            return None
        own = in_force(d for d in known if d.by == CURATOR).get(episode_id)
        if found == "alone" and own is not None and self._stands(own, episode):
            return Decided(in_force(known)[episode_id])
        decision = self._judge(episode)
        evidence = {**decision.evidence, "bag": found}
        return Decided(log_decision(self.dataset, replace(decision, evidence=evidence)))

    def _stands(self, own: Decision, episode: Episode) -> bool:
        """Whether our decision on an episode that was not seen again need not be made again.

        A curator that starts anew hears of the last bag once more; that is no reason to forget
        that it was compared with what had been seen, or to make a final decision provisional.
        """
        if own.evidence.get("content") != episode.content_digest:
            return False
        if self.curation.rule_needs_dataset:
            return bool(own.evidence.get("scoring") == self.curation.scorers.scoring_hash)
        return own.state_hash == self.curation.rule.state_hash

    def finish(self) -> list[Decision]:
        """Decide on the whole dataset, finally, where the rule depends on all of it.

        Returns:
            The decisions in force that are new; none where each was final already.

        Raises:
            CurationError: while an episode runs: its samples would be lost.
        """
        if not self.curation.rule_needs_dataset:
            return []
        if self.running:
            raise EpisodeError("an episode is running: decide on the whole dataset after it")
        self.curation, decided = decide_dataset(self.dataset, self.curation, self.topic_map)
        # Scorers may have learned from the dataset anew: their scores of before count no more.
        self._scores = _known_scores(self.dataset, self.curation)
        return decided

    def override(self, prefix: str, verdict: str, reason: str, by: str) -> Decision:
        """Log a person's decision.

        Args:
            prefix: id, beginning of an id, or short name.
            verdict: keep, discard or review; to salvage, see the function `override`.
            reason: in the person's words; may be empty.
            by: who decided.

        Raises:
            EpisodeError: if the episode is not known or the verdict is none of the three.
        """
        return override(self.dataset, prefix, verdict, reason, by, self.curation.rule.state_hash)

    def _amend(self, decision: Decision, evidence: Mapping[str, Any]) -> None:
        merged = {**decision.evidence, **evidence}
        if merged != decision.evidence:
            self.dataset.append_decision(replace(decision, evidence=merged), amend=True)


def decide_dataset(
    dataset: Dataset, curation: Curation, topic_map: TopicMap | None = None
) -> tuple[Curation, list[Decision]]:
    """Decide on every bag of a dataset, with all of them in view, and log what is new.

    Scorers that learn from the dataset learn from it anew; bags that cannot be read are left out.

    Args:
        dataset: its bags; what is in its index already is not read again.
        curation: fitted on the reference.
        topic_map: how episodes are built; None: by the map in each bag.

    Returns:
        The curation, fitted on the dataset, and the decisions in force that are new.
    """
    bags = list(dataset.bags())
    if curation.scorers.needs_dataset:
        curation = curation.fit_dataset(EpisodesOf(bags, topic_map))
    new = []
    judged = judge_bags(Examiner(curation.scorers, topic_map), curation, bags, tie=dataset.tie(0))
    for _, decision in judged:
        if decision is not None:
            known = len(dataset.decisions(decision.episode))
            logged = log_decision(dataset, decision)
            if len(dataset.decisions(decision.episode)) > known:
                new.append(logged)
    return curation, new


def _known_scores(dataset: Dataset, curation: Curation) -> dict[str, float | None]:
    """Deciding scores of the episodes that this curation's scorers have seen before."""
    found = {}
    for episode_id in dataset.decided_ids():
        own = [d for d in dataset.decisions(episode_id) if d.by == CURATOR]
        last = in_force(own).get(episode_id)
        if (
            last is not None
            and last.evidence.get("scoring") == curation.scorers.scoring_hash
            and not decisions.untrustworthy(last.findings)
        ):
            found[episode_id] = last.scores.get(curation.settings.rule_scorer)
    return found


def log_decision(dataset: Dataset, decision: Decision) -> Decision:
    """Log a decision of the curator, unless it says nothing new.

    Returns:
        The decision in force: a person's, where a person has decided.
    """

    def own(known: Sequence[Decision]) -> Decision | None:
        return in_force(d for d in known if d.by == CURATOR).get(decision.episode)

    def is_said(known: Sequence[Decision]) -> bool:
        last = own(known)
        return last is not None and _says_the_same(last, decision)

    # Others may decide on the same episode at the same time.
    if dataset.append_decision(decision, unless=is_said) is None:
        last = own(dataset.decisions(decision.episode))
        if last is not None and not decision.evidence.items() <= last.evidence.items():
            dataset.append_decision(replace(decision, revision=last.revision), amend=True)
    return in_force(dataset.decisions(decision.episode))[decision.episode]


def override(
    dataset: Dataset,
    prefix: str,
    verdict: str,
    reason: str,
    by: str,
    state_hash: str,
    *,
    until_s: float | None = None,
) -> Decision:
    """Log a person's decision on an episode as a new revision.

    Args:
        dataset: it has the episode.
        prefix: id, beginning of an id, or short name.
        verdict: one of OVERRIDES.
        reason: in the person's words; may be empty.
        by: who decided.
        state_hash: of the curation in use, where nothing was decided before.
        until_s: of what is salvaged, where the part that is kept ends, seconds from the start of
            the episode; None for the other verdicts.

    Raises:
        EpisodeError: if the episode is not known, the verdict is none of OVERRIDES, or `until_s`
            does not fit the verdict or the episode.
    """
    what = f"override {verdict!r} of {prefix!r}"
    if verdict not in OVERRIDES:
        raise EpisodeError(f"{what}: expected {', '.join(OVERRIDES)}")
    if verdict == "salvage" and until_s is None:
        raise EpisodeError(f"{what}: until when is not said (curation override ... --until does)")
    if verdict != "salvage" and until_s is not None:
        raise EpisodeError(f"{what}: until {until_s} s: only what is salvaged is kept until then")
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
                f"{whole_s:.2f} s, which is all of it"
            )
        span = (0, round(until_s * NS_PER_S))
        text += f"; kept until {until_s:.2f} s of {whole_s:.2f} s"
    verdict_: Any = verdict
    decision = decisions.override(previous, verdict_, text, by=by, span=span)
    logged = dataset.append_decision(decision)
    assert logged is not None, "nothing was said that would stop it"
    return logged


def _duration_ns(dataset: Dataset, previous: Decision, known: Sequence[Decision]) -> int:
    """How long an episode is: as its bag says, or as far as anybody has decided on it."""
    indexed = dataset.index.episode(previous.episode)
    ends_ns = [*(d.span[1] for d in known), previous.span[1]]
    return max(ends_ns if indexed is None else [*ends_ns, indexed.duration_ns])


def _undecided(dataset: Dataset, episode_id: str, state_hash: str) -> Decision:
    """What stands for an episode that the curator has not seen."""
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


def _says_the_same(a: Decision, b: Decision) -> bool:
    return replace(a, revision=0, evidence={}) == replace(b, revision=0, evidence={})
