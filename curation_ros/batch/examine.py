"""Many bags to examinations: spread over workers, and kept, so that a stopped run resumes.

An examination is a function of a bag and of the fitted scorers. It is computed once and kept under
the hash of both: in the index of the dataset, or in the user's cache for bags outside of datasets.
Rules and decisions cost next to nothing in comparison.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from curation_ros.batch.workers import WorkerDiedError, check_workers, spread
from curation_ros.core.decision.examination import Examination
from curation_ros.core.decision.examining import examine
from curation_ros.core.decision.fitted_scorers import FittedScorers
from curation_ros.core.episode.episode import Episode
from curation_ros.core.episode.topic_map import TopicMap
from curation_ros.core.errors import CurationError
from curation_ros.dataset.episodes import read_episode, stamp_of
from curation_ros.dataset.index import Index
from curation_ros.dataset.layout import home_of
from curation_ros.version import __version__

# Bags that a worker gets at once. Fitted scorers of about 100 kB go with them.
_BATCH = 16


@dataclass(frozen=True)
class Examined:
    """A bag and what was found in it.

    Attributes:
        path: the bag.
        result: its examination, or why it could not be read.
        is_known: whether the examination was kept from an earlier run.
    """

    path: Path
    result: Examination | CurationError
    is_known: bool


class Examiner:
    """Examines bags with the same fitted scorers; the same bags may be examined again.

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
            backend: one of BACKENDS; it matters with several workers.
            fresh: examine bags whose examinations were kept, too, but each only once.

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
        """Examine bags, in their order; each result is kept at once.

        Memory does not grow with their number: workers get only a few batches ahead.

        Raises:
            CurationError: if a worker died. The examinations before that are kept.
        """
        batches = [bags[k : k + _BATCH] for k in range(0, len(bags), _BATCH)]
        # A bag that this examiner has examined afresh is not examined afresh again.
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
                f"{err}: finished examinations are kept, run the same command again to resume"
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
    """What a worker does with a batch of bags; it is sent to the worker as a whole."""

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
                with suppress(CurationError):  # no index, or a busy one: examine them again
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
    """Bags grouped by the index that covers them."""
    grouped: dict[Path, list[Path]] = {}
    for bag in bags:
        grouped.setdefault(home_of(bag)[0], []).append(bag)
    return list(grouped.values())


def _key(fitted: FittedScorers, topic_map: TopicMap | None) -> str:
    """Key of an examination; another version of this package may find other things."""
    by = "" if topic_map is None else f"+{topic_map.hash}"
    return f"{__version__}+{fitted.scoring_hash}{by}"


class EpisodesOf:
    """The readable episodes of bags, each once; they are read again in each iteration."""

    def __init__(self, bags: Sequence[Path], topic_map: TopicMap | None) -> None:
        """Store which bags to read.

        Args:
            bags: paths for `read_episode`.
            topic_map: how episodes are built; None: by the map in each bag.
        """
        self._bags = bags
        self._topic_map = topic_map

    def __iter__(self) -> Iterator[Episode]:
        ids = set()
        for bag in self._bags:
            try:
                episode = read_episode(bag, self._topic_map)
            except CurationError:  # reported when the bag is examined
                continue
            if episode.id not in ids:
                ids.add(episode.id)
                yield episode
