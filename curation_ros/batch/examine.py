"""Many episodes to examinations: spread over workers, and kept, so that a stopped run resumes.

An examination is a function of a recording and of the fitted scorers. It is computed once and kept
under the hash of both: in the index of the dataset, or in the user's cache for recordings outside
of datasets. Rules and decisions cost next to nothing in comparison.
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

# Episodes that a worker gets at once. Fitted scorers of about 100 kB go with them.
_BATCH = 16


@dataclass(frozen=True)
class Examined:
    """An episode on disk and what was found in it.

    Attributes:
        path: of the episode, as `find_episodes` gives it.
        result: its examination, or why it could not be read.
        is_known: whether the examination was kept from an earlier run.
    """

    path: Path
    result: Examination | CurationError
    is_known: bool


class Examiner:
    """Examines episodes with the same fitted scorers; an episode may be examined again.

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
            topic_map: how episodes are built; None: by the map in each recording.
            jobs: workers; 1 works in this process, -1 takes all cores.
            backend: one of BACKENDS; it matters with several workers.
            fresh: examine episodes whose examinations were kept, too, but each only once.

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

    def run(self, paths: Sequence[Path]) -> Iterator[Examined]:
        """Examine episodes, in their order; each result is kept at once.

        Memory does not grow with their number: workers get only a few batches ahead.

        Raises:
            CurationError: if a worker died. The examinations before that are kept.
        """
        batches = [paths[k : k + _BATCH] for k in range(0, len(paths), _BATCH)]
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
                f"{err}: finished examinations are kept, run the same command again to resume"
            ) from err

    def _keep(self, batch: Sequence[Examined], stamps: Mapping[Path, str]) -> None:
        fresh = {
            e.path: e.result for e in batch if not e.is_known and isinstance(e.result, Examination)
        }
        for some in _by_folder(fresh):
            found = {path: fresh[path] for path in some}
            try:
                Index.covering(some[0]).keep_examinations(self._task.key, found, stamps)
            except CurationError as err:
                self.problem = str(err)


@dataclass(frozen=True)
class _Task:
    """What a worker does with a batch of episodes; it is sent to the worker as a whole."""

    fitted: FittedScorers
    topic_map: TopicMap | None
    key: str

    def __call__(
        self, paths: Sequence[Path], fresh: bool
    ) -> tuple[list[Examined], dict[Path, str]]:
        """Results in the order of the paths, and their stamps from before they were read."""
        stamps = {path: stamp_of(path) for path in paths}
        known: dict[Path, Examination] = {}
        if not fresh:
            for some in _by_folder(paths):
                with suppress(CurationError):  # no index, or a busy one: examine them again
                    index = Index.covering(some[0])
                    known |= index.examinations(self.key, {path: stamps[path] for path in some})
        results = []
        for path in paths:
            if path in known:
                results.append(Examined(path, known[path], is_known=True))
                continue
            try:
                found = examine(self.fitted, read_episode(path, self.topic_map))
                results.append(Examined(path, found, is_known=False))
            except CurationError as err:
                results.append(Examined(path, err, is_known=False))
        return results, stamps


def _by_folder(paths: Iterable[Path]) -> list[list[Path]]:
    """Paths grouped by the index that covers them."""
    grouped: dict[Path, list[Path]] = {}
    for path in paths:
        grouped.setdefault(home_of(path)[0], []).append(path)
    return list(grouped.values())


def _key(fitted: FittedScorers, topic_map: TopicMap | None) -> str:
    """Key of an examination; another version of this package may find other things."""
    by = "" if topic_map is None else f"+{topic_map.hash}"
    return f"{__version__}+{fitted.scoring_hash}{by}"


class ReadableEpisodes:
    """The episodes at some paths that can be read, each once; each iteration reads them again."""

    def __init__(self, paths: Sequence[Path], topic_map: TopicMap | None) -> None:
        """Store what to read.

        Args:
            paths: of the episodes.
            topic_map: how episodes are built; None: by the map in each recording.
        """
        self._paths = paths
        self._topic_map = topic_map

    def __iter__(self) -> Iterator[Episode]:
        ids = set()
        for path in self._paths:
            try:
                episode = read_episode(path, self._topic_map)
            except CurationError:  # reported when it is examined
                continue
            if episode.id not in ids:
                ids.add(episode.id)
                yield episode
