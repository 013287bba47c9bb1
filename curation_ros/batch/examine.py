"""Many bags to examinations: spread over workers, kept in the index, taken up where it stopped.

An examination is a function of a bag and of the fitted scorers; it is computed once and kept in
the index of the dataset (or, for a folder of bags that is none, in the user's cache) under the
hash of both. What rules and decisions make of it costs next to nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from curation_ros.batch.workers import WorkerDiedError, check_workers, spread
from curation_ros.core.decision.curation import Curation
from curation_ros.core.decision.decision import Decision, untrustworthy
from curation_ros.core.decision.examination import Examination
from curation_ros.core.decision.examining import examine
from curation_ros.core.decision.fitted_rule import FittedRule
from curation_ros.core.decision.fitted_scorers import FittedScorers
from curation_ros.core.decision.ties import TieKey
from curation_ros.core.episode.episode import Episode
from curation_ros.core.episode.findings import Finding
from curation_ros.core.episode.topic_map import TopicMap
from curation_ros.core.errors import CurationError
from curation_ros.dataset.episodes import read_episode, stamp_of
from curation_ros.dataset.index import Index
from curation_ros.dataset.layout import home_of
from curation_ros.version import __version__

# Bags that a worker gets at once: a fitted curation of some 100 kB goes with them.
_BATCH = 16


@dataclass(frozen=True)
class Examined:
    """A bag and what was seen in it.

    Attributes:
        path: the bag.
        result: what was seen, or why it could not be read.
        is_known: whether it was in the index already.
    """

    path: Path
    result: Examination | CurationError
    is_known: bool


class Examiner:
    """Examines bags with one fitted curation; may be asked for the same bags again.

    Attributes:
        problem: why results could not be kept in the index; empty if they could.
    """

    def __init__(
        self,
        fitted: FittedScorers,
        topic_map: TopicMap | None = None,
        *,
        jobs: int = 1,
        backend: str = "loky",
        fresh: bool = False,
    ) -> None:
        """Store how to work.

        Args:
            fitted: the scorers to ask.
            topic_map: how episodes are built; None: by the map in each bag.
            jobs: workers; 1 works in this process, -1 takes all cores.
            backend: one of BACKENDS, where there are several workers.
            fresh: examine again what the index has; only once each.

        Raises:
            ConfigError: for a backend that does not exist, or is not installed.
        """
        check_workers(jobs, backend)
        self._task = _Task(fitted, topic_map, _key(fitted, topic_map))
        self._jobs = jobs
        self._backend = backend
        self._fresh = fresh
        self._done: set[Path] = set()
        self.problem = ""

    def run(self, bags: Sequence[Path]) -> Iterator[Examined]:
        """Examine bags, in their order; each result is kept as soon as it is there.

        Memory does not grow with their number: workers are given a few batches ahead.

        Raises:
            CurationError: if a worker died; what was examined before is kept.
        """
        batches = [bags[k : k + _BATCH] for k in range(0, len(bags), _BATCH)]
        # What this examiner has examined afresh is not examined afresh again.
        jobs = ((b, self._fresh and not self._done.issuperset(b)) for b in batches)
        for batch, stamps in self._spread(jobs):
            self._keep(batch, stamps)
            if self._fresh:
                self._done.update(e.path for e in batch)
            yield from batch

    def _spread(
        self, jobs: Iterable[tuple[Sequence[Path], bool]]
    ) -> Iterator[tuple[list[Examined], dict[Path, str]]]:
        try:
            yield from spread(self._task, jobs, jobs=self._jobs, backend=self._backend)
        except WorkerDiedError as err:
            raise CurationError(
                f"{err}: what was examined is kept, run the same command again to go on"
            ) from err

    def _keep(self, batch: Sequence[Examined], stamps: Mapping[Path, str]) -> None:
        fresh = {
            e.path: e.result for e in batch if not e.is_known and isinstance(e.result, Examination)
        }
        for some in _by_folder(fresh):
            found = {bag: fresh[bag] for bag in some}
            try:
                Index.covering(some[0]).keep_examinations(self._task.key, found, stamps)
            except CurationError as err:
                self.problem = str(err)


@dataclass(frozen=True)
class _Task:
    """What a worker does with a batch of bags; goes to it as a whole."""

    fitted: FittedScorers
    topic_map: TopicMap | None
    key: str

    def __call__(
        self, bags: Sequence[Path], fresh: bool
    ) -> tuple[list[Examined], dict[Path, str]]:
        """Results in the order of the bags, and stamps of their files before they were read."""
        stamps = {bag: stamp_of(bag) for bag in bags}
        known: dict[Path, Examination] = {}
        if not fresh:
            for some in _by_folder(bags):
                with suppress(CurationError):  # no index, or a busy one: work it out again
                    index = Index.covering(some[0])
                    known |= index.examinations(self.key, {bag: stamps[bag] for bag in some})
        results = []
        for bag in bags:
            if bag in known:
                results.append(Examined(bag, known[bag], is_known=True))
                continue
            try:
                found = examine(self.fitted, read_episode(bag, self.topic_map))
                results.append(Examined(bag, found, is_known=False))
            except CurationError as err:
                results.append(Examined(bag, err, is_known=False))
        return results, stamps


def _by_folder(bags: Iterable[Path]) -> list[list[Path]]:
    """Bags side by side that one index covers."""
    grouped: dict[Path, list[Path]] = {}
    for bag in bags:
        grouped.setdefault(home_of(bag)[0], []).append(bag)
    return list(grouped.values())


def _key(fitted: FittedScorers, topic_map: TopicMap | None) -> str:
    """Under which an examination is kept: another version of ours may see other things."""
    by = "" if topic_map is None else f"+{topic_map.hash}"
    return f"{__version__}+{fitted.scoring_hash}{by}"


class EpisodesOf:
    """The readable episodes of bags, read again each time: for `FittedScorers.fit_dataset`."""

    def __init__(self, bags: Sequence[Path], topic_map: TopicMap | None) -> None:
        """Name the bags."""
        self._bags = bags
        self._topic_map = topic_map

    def __iter__(self) -> Iterator[Episode]:
        seen = set()
        for bag in self._bags:
            try:
                episode = read_episode(bag, self._topic_map)
            except CurationError:  # reported when it is examined
                continue
            if episode.id not in seen:
                seen.add(episode.id)
                yield episode


class Copies:
    """Finds episodes with the content of another one, in the order in which they come."""

    def __init__(self) -> None:
        """Nothing has been seen yet."""
        self._first: dict[bytes, tuple[str, str]] = {}

    def note(self, seen: Examination) -> Examination:
        """The examination, with a finding if an earlier one has the same content."""
        if not seen.content or not seen.steps:
            return seen
        # Eight bytes: some ten thousand episodes are to fit into little memory.
        key = bytes.fromhex(seen.content[:16])
        original = self._first.get(key)
        if original is not None:
            return with_copy(seen, original)
        if not untrustworthy(seen.findings):  # a bad copy does not make the good one a copy
            self._first[key] = (seen.episode, seen.name)
        return seen


def with_copy(seen: Examination, original: tuple[str, str]) -> Examination:
    """An examination with the finding that another episode (id, name) has the same content."""
    # Its id alone: whether its name is known already depends on when one asks.
    message = (
        "the same episode is there more than once"
        if original[0] == seen.episode
        else f"same content as episode {original[0]}"
    )
    return replace(seen, findings=(*seen.findings, Finding("duplicate", message, seen.span)))


def judge_bags(
    examiner: Examiner,
    curation: Curation,
    bags: Sequence[Path],
    *,
    tie: TieKey | None = None,
    progress: Callable[[Iterable[Examined]], Iterable[Examined]] = iter,
) -> Iterator[tuple[Examined, Decision | None]]:
    """Decide on bags, finally: a rule that looks at the dataset sees all of them first.

    Args:
        examiner: with that curation.
        curation: fitted.
        bags: in the order of their ids, so that of two copies the older one is the original.
        tie: see `Rule.fit_dataset`.
        progress: wraps the longest loop, for a bar.

    Yields:
        What was seen of each bag, and the decision; None where it could not be read.
    """
    rule: FittedRule | None = None
    if curation.rule_needs_dataset:
        scores: dict[str, float | None] = {}
        copies = Copies()
        for one in progress(examiner.run(bags)):
            if isinstance(one.result, Examination):
                seen = copies.note(one.result)
                if seen.is_trusted:
                    scores[seen.episode] = seen.scores.get(curation.settings.rule_scorer)
        rule = curation.rule_over(scores, final=True, tie=tie)
        results: Iterable[Examined] = examiner.run(bags)
    else:
        results = progress(examiner.run(bags))
    copies = Copies()
    for one in results:
        if isinstance(one.result, Examination):
            seen = copies.note(one.result)
            yield replace(one, result=seen), curation.decide(seen, rule)
        else:
            yield one, None
