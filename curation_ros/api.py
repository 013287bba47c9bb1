"""The front door for Python: open recordings, score them, look at tables, select.

`import curation_ros as cr` hands these names on; nothing of ours imports them from here.
"""

from __future__ import annotations

import importlib.util
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias, overload

from curation_ros.batch.score import score_episodes, score_recordings
from curation_ros.batch.scored import Scored, ScoringResult, Unreadable
from curation_ros.configuration import read_reference, settings_of
from curation_ros.core.decision.decision import VERDICTS, Decision
from curation_ros.core.decision.manifest import Manifest
from curation_ros.core.episode.episode import Episode
from curation_ros.core.episode.topic_map import TopicMap
from curation_ros.core.errors import ConfigError, CurationError
from curation_ros.core.types import NS_PER_S
from curation_ros.dataset.dataset import Dataset
from curation_ros.dataset.episodes import find_episodes
from curation_ros.dataset.episodes import read_episode as _read_episode
from curation_ros.dataset.layout import is_dataset
from curation_ros.dataset.manifests import save_selection

AnyPath: TypeAlias = "str | PathLike[str]"
#: A table: a pandas DataFrame if pandas is installed, otherwise a list of one dict per row.
Frame: TypeAlias = Any


class Selected(NamedTuple):
    """A selection that was written.

    Attributes:
        manifest: what it holds: all that training reads.
        path: its file, for `curation train --selection` and `curation export --selection`.
    """

    manifest: Manifest
    path: Path


class Episodes(Sequence[Episode]):
    """The episodes of a collection; each is read from disk when it is asked for."""

    def __init__(self, paths: Sequence[Path], topic_map: TopicMap | None) -> None:
        self._paths = paths
        self._topic_map = topic_map

    def __len__(self) -> int:
        return len(self._paths)

    @overload
    def __getitem__(self, index: int) -> Episode: ...

    @overload
    def __getitem__(self, index: slice) -> Episodes: ...

    def __getitem__(self, index: int | slice) -> Episode | Episodes:
        if isinstance(index, slice):
            return Episodes(self._paths[index], self._topic_map)
        return _read_episode(self._paths[index], self._topic_map)

    def __repr__(self) -> str:
        return f"Episodes({len(self)})"


class Collection:
    """Recordings on disk: a dataset, a folder of bags, single bags, or several of these.

    Attributes:
        paths: as they were given.
        episodes: a sequence of `Episode`, each read when it is asked for.
    """

    def __init__(self, paths: Sequence[Path], topic_map: TopicMap | None = None) -> None:
        """Find the recordings; use `open`.

        Raises:
            CurationError: naming a path that does not exist or has no recording in it.
        """
        self.paths = tuple(paths)
        self.topic_map = topic_map
        self.episodes = Episodes(find_episodes(paths), topic_map)

    def __repr__(self) -> str:
        n = len(self.episodes)
        shown = ", ".join(repr(str(p)) for p in self.paths)
        return f"Collection({shown}, {n} episode{'' if n == 1 else 's'})"

    @property
    def is_dataset(self) -> bool:
        """Whether this is one dataset, which has logged decisions and takes selections."""
        return len(self.paths) == 1 and is_dataset(self.paths[0])

    def scores(self, **settings: Any) -> Frame:
        """Score the episodes; one row per episode.

        Args:
            settings: keywords of `score`.

        Returns:
            As `ScoredEpisodes.scores`.
        """
        return score(self, **settings).scores()

    def decisions(self) -> Frame:
        """The logged decisions in force; one row per decided episode.

        Returns:
            Columns episode, name, verdict, reason, by, revision, start_s and end_s of the part
            that is kept, and findings (their ids).

        Raises:
            CurationError: if this is not one dataset. `score` decides without a log.
        """
        decided = self._dataset().latest_decisions()
        return _frame([_decision_row(d) for d in decided.values()])

    def select(
        self,
        *,
        rule: str = "",
        scorer: str = "",
        value: float | None = None,
        method: str = "",
        name: str = "",
        seed: int = 0,
    ) -> Selected:
        """Choose episodes to train on and write the selection, as `curation select` does.

        Args:
            rule: name of a rule; by default `gap` if a scorer is named, otherwise `decisions`.
            scorer: ranks the episodes, for rules that read scores.
            value: the threshold, share or number of the rule.
            method: how `gap` separates groups.
            name: of the selection; by default made of rule and time.
            seed: of the order of equal scores.

        Raises:
            CurationError: if this is not one dataset, the name is taken, nothing was scored by
                that scorer, or the scores give the rule no basis.
        """
        manifest, path = save_selection(
            self._dataset(),
            rule=rule,
            scorer=scorer,
            value=value,
            method=method,
            name=name,
            seed=seed,
        )
        return Selected(manifest, path)

    def _dataset(self) -> Dataset:
        if not self.is_dataset:
            shown = ", ".join(map(str, self.paths))
            raise CurationError(
                f"{shown}: expected one dataset (a folder with 'episodes' in it), whose "
                "decisions are logged; cr.score(...) decides without a log"
            )
        return Dataset(self.paths[0])


class ScoredEpisodes(Sequence[Scored]):
    """What `score` found, in the order of the episodes.

    Attributes:
        unreadable: recordings that could not be read, with `path` and `error`.
    """

    def __init__(self, results: Iterable[ScoringResult]) -> None:
        """Take all results of a run."""
        self.unreadable: list[Unreadable] = []
        self._scored: list[Scored] = []
        for result in results:
            if isinstance(result, Unreadable):
                self.unreadable.append(result)
            else:
                self._scored.append(result)

    def __len__(self) -> int:
        return len(self._scored)

    @overload
    def __getitem__(self, index: int) -> Scored: ...

    @overload
    def __getitem__(self, index: slice) -> list[Scored]: ...

    def __getitem__(self, index: int | slice) -> Scored | list[Scored]:
        return self._scored[index]

    def __iter__(self) -> Iterator[Scored]:
        return iter(self._scored)

    def __repr__(self) -> str:
        counts = Counter(one.verdict for one in self)
        verdicts = ", ".join(f"{counts[v]} {v}" for v in VERDICTS if counts[v])
        lost = f", {len(self.unreadable)} unreadable" if self.unreadable else ""
        return f"ScoredEpisodes({verdicts or 'none'}{lost})"

    def scores(self) -> Frame:
        """One row per episode and one column per scorer; higher is better.

        Returns:
            Columns episode, name, steps, and each scorer; a scorer that abstained has None (NaN
            in a pandas frame).
        """
        rows = [
            {
                "episode": one.decision.episode,
                "name": one.decision.name,
                "steps": one.examination.steps,
                **one.scores,
            }
            for one in self
        ]
        return _frame(rows, numbers=self[0].scores if rows else ())

    def decisions(self) -> Frame:
        """One row per episode: what becomes of it, and why.

        Returns:
            Columns as of `Collection.decisions`.
        """
        return _frame([_decision_row(one.decision) for one in self])


def open(path: AnyPath | Iterable[AnyPath], *, topic_map: TopicMap | None = None) -> Collection:
    """Open recordings without reading them.

    Args:
        path: a dataset, a bag, a folder of bags, or several of these.
        topic_map: how episodes are built; by default by the map in each bag. `read_topic_map`
            reads one.

    Raises:
        CurationError: naming a path that does not exist or has no recording in it.

    Example:
        >>> import curation_ros as cr
        >>> cr.open("bags/sample").episodes[0]
        Episode(demo-0002, T=223, ...)
    """
    return Collection(_paths(path), topic_map)


def read_episode(path: AnyPath, *, topic_map: TopicMap | None = None) -> Episode:
    """Read one episode.

    Args:
        path: a bag: its folder, or its file.
        topic_map: how the episode is built; by default by the map in the bag.

    Raises:
        CurationError: naming the file, what was found and what was expected.

    Example:
        >>> import curation_ros as cr
        >>> cr.read_episode("bags/sample").rate_hz
        20.0
    """
    return _read_episode(Path(path), topic_map)


def score(
    recordings: AnyPath | Collection | Episode | Iterable[AnyPath | Episode],
    *,
    reference: AnyPath | Collection | Iterable[AnyPath | Episode] = (),
    scorers: Iterable[str] = (),
    rule: str = "",
    rule_scorer: str = "",
    value: float | None = None,
    method: str = "",
    config: AnyPath = "",
    topic_map: TopicMap | None = None,
    write: bool = False,
    jobs: int = 1,
) -> ScoredEpisodes:
    """Score episodes and decide on them: the same numbers and verdicts as `curation score`.

    Args:
        recordings: paths as `open` takes them, a collection, or episodes in memory.
        reference: trusted demonstrations: paths, a collection, or episodes. Without any, scorers
            that need them abstain.
        scorers: names, in addition to the one that decides; by default those of the configuration.
        rule: name of the rule that decides; by default that of the configuration.
        rule_scorer: the scorer that the rule decides by.
        value: the threshold, share or number of `rule`.
        method: how the rule `gap` separates groups.
        config: a file like `config/curation.yaml`, which is the default.
        topic_map: how episodes are built; by default by the map in each bag.
        write: log the decisions in the dataset, which is then the only recording.
        jobs: workers; -1 takes all cores. Episodes in memory are scored in this process.

    Returns:
        A sequence of `Scored`, each with scores, decision and examination.

    Raises:
        CurationError: if a setting makes no sense, a path does not exist, or the reference
            cannot be trusted. A recording that cannot be read is listed in `unreadable`.

    Example:
        >>> import curation_ros as cr
        >>> cr.score("bags/sample", scorers=["smoothness", "object_coupling"])
        ScoredEpisodes(1 keep)
    """
    file = Path(config) if config else None
    settings = settings_of(
        file, scorers=scorers, rule=rule, rule_scorer=rule_scorer, value=value, method=method
    )
    paths, episodes = _split(recordings)
    trusted = _reference(reference, topic_map)
    if isinstance(recordings, Collection):
        topic_map = topic_map or recordings.topic_map
    if episodes:
        if write:
            raise ConfigError("write: only a dataset has a log, found episodes in memory")
        return ScoredEpisodes(score_episodes(episodes, settings, trusted))
    find_episodes(paths)  # a path with nothing in it is a mistake in the call
    return ScoredEpisodes(
        score_recordings(paths, settings, trusted, topic_map=topic_map, write=write, jobs=jobs)
    )


def _frame(rows: Sequence[dict[str, Any]], numbers: Iterable[str] = ()) -> Frame:
    """Rows as a pandas frame if pandas is installed, otherwise as they are.

    Args:
        rows: all with the same keys.
        numbers: columns that are numbers, even if every row has None there.
    """
    if importlib.util.find_spec("pandas") is None:
        return list(rows)
    import pandas as pd

    frame = pd.DataFrame.from_records(list(rows))
    return frame.astype({name: float for name in numbers if name in frame})


def _paths(path: AnyPath | Iterable[AnyPath]) -> list[Path]:
    several = [path] if isinstance(path, (str, PathLike)) else path
    return [Path(p) for p in several]


def _split(
    given: AnyPath | Collection | Episode | Iterable[AnyPath | Episode],
) -> tuple[list[Path], list[Episode]]:
    """Paths, or episodes.

    Raises:
        ConfigError: for both at once.
    """
    if isinstance(given, Collection):
        return list(given.paths), []
    if isinstance(given, (Episode, str, PathLike)):
        given = [given]
    paths: list[Path] = []
    episodes: list[Episode] = []
    for one in given:
        if isinstance(one, Episode):
            episodes.append(one)
        else:
            paths.append(Path(one))
    if paths and episodes:
        raise ConfigError("expected paths or episodes, found both in one list")
    return paths, episodes


def _reference(
    given: AnyPath | Collection | Iterable[AnyPath | Episode], topic_map: TopicMap | None
) -> list[Episode]:
    paths, episodes = _split(given)
    if isinstance(given, Collection):
        topic_map = topic_map or given.topic_map
    return [*episodes, *(read_reference(paths, topic_map) if paths else [])]


def _decision_row(decision: Decision) -> dict[str, Any]:
    first_ns, last_ns = decision.span
    return {
        "episode": decision.episode,
        "name": decision.name,
        "verdict": decision.verdict,
        "reason": decision.reason,
        "by": decision.by,
        "revision": decision.revision,
        "start_s": first_ns / NS_PER_S,
        "end_s": last_ns / NS_PER_S,
        "findings": [f.id for f in decision.findings],
    }
