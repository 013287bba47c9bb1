"""Score episodes and decide on them: what `curation score`, `~/curate` and `self-check` do."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TypeAlias

from curation_ros.batch.copies import Copies
from curation_ros.batch.examine import Examined, Examiner, ReadableEpisodes
from curation_ros.batch.scored import Scored, ScoringCounts, ScoringResult, Unreadable
from curation_ros.batch.workers import check_workers
from curation_ros.core.decision.curation import Curation
from curation_ros.core.decision.decision import CURATOR, Decision, in_force
from curation_ros.core.decision.examination import Examination
from curation_ros.core.decision.fitted_rule import FittedRule
from curation_ros.core.decision.settings import CurationSettings
from curation_ros.core.decision.ties import TieKey
from curation_ros.core.episode.episode import Episode
from curation_ros.core.episode.topic_map import TopicMap
from curation_ros.core.errors import ConfigError, CurationError
from curation_ros.dataset.dataset import Dataset
from curation_ros.dataset.decision_log import log_decision
from curation_ros.dataset.episodes import find_episodes
from curation_ros.dataset.layout import home_of, is_dataset

Progress: TypeAlias = Callable[[Iterable[Examined]], Iterable[Examined]]


class Scoring:
    """A run over recordings: iterate it for the results, then read the counts.

    Results come in the order of the recordings, paths without one first. Each result is kept and
    logged before it is given, so that a stopped run loses nothing.

    Attributes:
        paths: of the recordings.
        curation: what scores and decides. During the run it is fitted on the dataset, if one of
            its scorers needs that.
        counts: over the results so far.
        problem: why examinations could not be kept for the next run; empty if they could.
    """

    def __init__(
        self,
        paths: Sequence[Path],
        curation: Curation,
        *,
        topic_map: TopicMap | None = None,
        log: Dataset | None = None,
        unreadable: Sequence[Unreadable] = (),
        fresh: bool = False,
        jobs: int = 1,
        backend: str = "loky",
    ) -> None:
        """Store what to score; nothing is read yet.

        Args:
            paths: of the recordings, in the order of their ids. Then the older one of two copies
                counts as the original.
            curation: fitted on the reference.
            topic_map: how episodes are built; None: by the map in each recording.
            log: dataset of the recordings, to log the decisions in; None: nothing is logged.
            unreadable: paths without a recording.
            fresh: examine recordings with an examination that was kept, too.
            jobs: workers; 1 works in this process, -1 takes all cores.
            backend: one of BACKENDS; it matters with several workers.

        Raises:
            ConfigError: for a backend that does not exist, or is not installed.
        """
        check_workers(jobs, backend)
        self.paths = paths
        self.curation = curation
        self.counts = ScoringCounts()
        self.problem = ""
        self._topic_map = topic_map
        self._log = log
        self._unreadable = unreadable
        self._fresh, self._jobs, self._backend = fresh, jobs, backend
        self._people = _People()

    def __iter__(self) -> Iterator[ScoringResult]:
        return self.run()

    def run(self, progress: Progress = iter) -> Iterator[ScoringResult]:
        """Score and decide.

        Args:
            progress: wraps the longest loop, for a progress bar.

        Raises:
            CurationError: if a worker died, or a decision cannot be logged. The results before
                that are kept.
        """
        for result in self._results(progress):
            self.counts.add(result, self.curation.scorers.reference_ids)
            yield result

    def _results(self, progress: Progress) -> Iterator[ScoringResult]:
        yield from self._unreadable
        if self.curation.scorers.needs_dataset:
            episodes = ReadableEpisodes(self.paths, self._topic_map)
            self.curation = self.curation.fit_dataset(episodes)
        examiner = Examiner(
            self.curation.scorers,
            self._topic_map,
            jobs=self._jobs,
            backend=self._backend,
            fresh=self._fresh,
        )
        tie = _tie_of(self.paths) if self.curation.rule_needs_dataset else None
        decided = _decided(self.curation, lambda: examiner.run(self.paths), tie, progress)
        for result in decided:
            self.problem = examiner.problem
            if isinstance(result, Unreadable):
                yield result
            elif self._log is None:
                yield self._compared(result)
            else:
                yield _logged(result, self._log)

    def _compared(self, scored: Scored) -> Scored:
        """With the person's decision, if it has another verdict."""
        held = self._people.decision_on(scored.path, scored.decision.episode)
        if held is None or held.verdict == scored.decision.verdict:
            return scored
        return replace(scored, overridden_by=held)


def score_recordings(
    paths: Iterable[Path],
    settings: CurationSettings | None = None,
    reference: Iterable[Episode] = (),
    *,
    topic_map: TopicMap | None = None,
    write: bool = False,
    fresh: bool = False,
    jobs: int = 1,
    backend: str = "loky",
) -> Scoring:
    """Score recordings and decide on them.

    The scorers are fitted on the reference at once. Recordings are read as the run is iterated.

    Args:
        paths: datasets, recordings, and files or folders of recordings (see `find_episodes`).
        settings: what scores and what decides; by default those of `CurationSettings`.
        reference: trusted demonstrations; may be empty.
        topic_map: how episodes are built; None: by the map in each recording.
        write: log the decisions in the dataset, which is then the only path.
        fresh: examine recordings with an examination that was kept, too.
        jobs: workers; 1 works in this process, -1 takes all cores.
        backend: one of BACKENDS; it matters with several workers.

    Raises:
        ConfigError: if `write` is asked for several paths, or a backend does not exist.
        EpisodeError: if the reference cannot be trusted.
        CurationError: if `write` is asked for a path that is no dataset.
    """
    given = list(paths)
    if write and len(given) != 1:
        raise ConfigError(f"decisions are written into one dataset, found {len(given)} paths")
    log = Dataset(given[0]) if write else None
    curation = Curation.fit(settings, reference)
    found, unreadable = _find(given)
    return Scoring(
        found,
        curation,
        topic_map=topic_map,
        log=log,
        unreadable=unreadable,
        fresh=fresh,
        jobs=jobs,
        backend=backend,
    )


def score_episodes(
    episodes: Iterable[Episode],
    settings: CurationSettings | None = None,
    reference: Iterable[Episode] = (),
) -> Iterator[Scored]:
    """Score episodes that are in memory and decide on them; nothing is kept or logged.

    Args:
        episodes: in any order; of two copies the first is the original.
        settings: what scores and what decides; by default those of `CurationSettings`.
        reference: trusted demonstrations; may be empty.

    Raises:
        EpisodeError: if the reference cannot be trusted.
    """
    given = list(episodes)
    curation = Curation.fit(settings, reference)
    if curation.scorers.needs_dataset:
        curation = curation.fit_dataset(given)
    examined = [Examined(Path(e.id), curation.examine(e), is_known=False) for e in given]
    for result in _decided(curation, lambda: examined, None, iter):
        if isinstance(result, Scored):
            yield result


def decide_dataset(
    dataset: Dataset, curation: Curation, topic_map: TopicMap | None = None
) -> tuple[Curation, list[Decision]]:
    """Decide on every bag of a dataset, with all of them in view, and log what is new.

    Args:
        dataset: its bags. Those with an examination that was kept are not read again.
        curation: fitted on the reference. Scorers that learn from the dataset learn anew.
        topic_map: how episodes are built; None: by the map in each recording.

    Returns:
        The curation, fitted on the dataset, and the decisions in force that are new. Bags that
        cannot be read are left out.
    """
    scoring = Scoring(list(dataset.bags()), curation, topic_map=topic_map, log=dataset)
    new = [r.decision for r in scoring if isinstance(r, Scored) and r.is_logged]
    return scoring.curation, new


def _find(paths: Iterable[Path]) -> tuple[list[Path], list[Unreadable]]:
    """Paths of the recordings, each once, and the paths without one."""
    found: dict[Path, Path] = {}
    missing = []
    for path in paths:
        try:
            for recording in find_episodes([path]):
                found.setdefault(recording.resolve(), recording)
        except CurationError as err:
            missing.append(Unreadable(path, err))
    return list(found.values()), missing


def _decided(
    curation: Curation,
    examine: Callable[[], Iterable[Examined]],
    tie: TieKey | None,
    progress: Progress,
) -> Iterator[ScoringResult]:
    """Results before anything is logged.

    Args:
        curation: fitted on the dataset, if a scorer needs that.
        examine: gives all examinations. It is called twice if the rule looks at the dataset, and
            the second time most examinations have been kept.
        tie: orders equal scores.
        progress: wraps the longest loop.
    """
    rule: FittedRule | None = None
    known: dict[Path, bool] = {}
    if curation.rule_needs_dataset:
        scores: dict[str, float | None] = {}
        copies = Copies()
        for one in progress(examine()):
            known[one.path] = one.is_known
            if isinstance(one.result, Examination):
                found = copies.note(one.result)
                if found.is_trusted:
                    scores[found.episode] = found.scores.get(curation.settings.rule_scorer)
        rule = curation.rule_over(scores, final=True, tie=tie)
        results = examine()
    else:
        results = progress(examine())
    copies = Copies()
    for one in results:
        if isinstance(one.result, Examination):
            found = copies.note(one.result)
            decision = curation.decide(found, rule)
            yield Scored(one.path, found, decision, known.get(one.path, one.is_known))
        else:
            yield Unreadable(one.path, one.result)


def _tie_of(paths: Sequence[Path]) -> TieKey | None:
    """The tie key of the dataset that has all recordings; None if there is no such dataset."""
    homes = {home_of(path)[0] for path in paths}
    if len(homes) != 1:
        return None
    [home] = homes
    return Dataset(home).tie(0) if is_dataset(home) else None


def _logged(scored: Scored, dataset: Dataset) -> Scored:
    """With the decision logged; a person's stays in force, with scores and findings of now."""
    decision = scored.decision
    if scored.path.name != decision.episode:
        warning = (
            f"{scored.path}: not logged: its folder is not named after its episode; "
            f"rename it to {decision.episode}"
        )
        return replace(scored, warning=warning)
    logged = log_decision(dataset, decision)
    now, before = logged.in_force, logged.previous
    return replace(
        scored,
        decision=replace(now, scores=decision.scores, findings=decision.findings),
        is_logged=logged.is_new,
        replaced=before.verdict if before is not None and before.verdict != now.verdict else None,
    )


class _People:
    """Decisions of people, in the datasets of the recordings; each dataset is opened once."""

    def __init__(self) -> None:
        self._datasets: dict[Path, Dataset | None] = {}

    def decision_on(self, path: Path, episode_id: str) -> Decision | None:
        """The decision in force on a recording in a dataset, if it is a person's."""
        folder, _ = home_of(path)
        if folder not in self._datasets:
            self._datasets[folder] = Dataset(folder) if is_dataset(folder) else None
        dataset = self._datasets[folder]
        if dataset is None or path.name != episode_id:
            return None
        with suppress(CurationError):
            held = in_force(dataset.decisions(episode_id)).get(episode_id)
            if held is not None and held.by != CURATOR:
                return held
        return None
