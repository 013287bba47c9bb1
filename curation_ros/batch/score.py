"""Score bags and decide on them: what `curation score`, `~/curate` and `self-check` do."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeAlias

from curation_ros.batch.copies import Copies
from curation_ros.batch.examine import EpisodesOf, Examined, Examiner
from curation_ros.batch.workers import check_workers
from curation_ros.core.decision.curation import Curation
from curation_ros.core.decision.decision import CURATOR, Decision, Verdict, in_force
from curation_ros.core.decision.examination import Examination, Scores
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


@dataclass(frozen=True)
class Scored:
    """A bag that was scored and decided on.

    Attributes:
        path: the bag; for an episode in memory, its id.
        examination: what was found in it.
        decision: what becomes of it. With logging it is the decision in force, which may be a
            person's; scores and findings are those of now in any case.
        is_known: whether the examination was kept from an earlier run.
        is_logged: whether a line was added to its decision log.
        replaced: verdict that was in force before, if logging has changed it.
        overridden_by: without logging, the decision of a person that is in force in the dataset
            and has another verdict.
        warning: why the decision was not logged, although it should have been; empty otherwise.
    """

    path: Path
    examination: Examination
    decision: Decision
    is_known: bool = False
    is_logged: bool = False
    replaced: Verdict | None = None
    overridden_by: Decision | None = None
    warning: str = ""

    @property
    def scores(self) -> Scores:
        """Scorer -> score, None where it abstained."""
        return self.examination.scores

    @property
    def verdict(self) -> Verdict:
        """Verdict of the decision."""
        return self.decision.verdict

    def to_json(self) -> dict[str, Any]:
        """As `curation score --json` prints it."""
        decision = self.decision
        return {
            "episode": decision.episode,
            "name": decision.name,
            "path": str(self.path),
            "length": self.examination.steps,
            "scores": dict(decision.scores),
            "decision": decision.verdict,
            "reason": decision.reason,
            "span": list(decision.span),
            "findings": [f.to_json() for f in decision.findings],
        }


@dataclass(frozen=True)
class Unreadable:
    """A path without a bag, or a bag that cannot be read.

    Attributes:
        path: as given, or the bag.
        error: what is wrong with it.
    """

    path: Path
    error: CurationError

    def to_json(self) -> dict[str, Any]:
        """As `curation score --json` prints it."""
        finding = getattr(self.error, "finding", "")
        return {"path": str(self.path), "error": str(self.error), "finding": finding}


ScoringResult: TypeAlias = Scored | Unreadable
Progress: TypeAlias = Callable[[Iterable[Examined]], Iterable[Examined]]


@dataclass
class ScoringCounts:
    """Counts over the results of a run.

    Attributes:
        verdicts: verdict -> bags with that decision.
        n_known: bags whose examination was kept from an earlier run.
        n_unreadable: paths without a bag, and bags that could not be read.
        n_in_reference: scored episodes that are in the reference, too.
        n_with_findings: bags with a finding.
        replaced: (verdict before, verdict now) -> decisions that logging has changed.
        overridden: results whose verdict a person has overridden.
    """

    verdicts: Counter[Verdict] = field(default_factory=Counter)
    n_known: int = 0
    n_unreadable: int = 0
    n_in_reference: int = 0
    n_with_findings: int = 0
    replaced: Counter[tuple[Verdict, Verdict]] = field(default_factory=Counter)
    overridden: list[Scored] = field(default_factory=list)

    @property
    def n_scored(self) -> int:
        """Bags that were scored."""
        return self.verdicts.total()

    def add(self, result: ScoringResult, reference_ids: Sequence[str]) -> None:
        """Count one more result."""
        if isinstance(result, Unreadable):
            self.n_unreadable += 1
            return
        decision = result.decision
        self.verdicts[decision.verdict] += 1
        self.n_known += result.is_known
        self.n_in_reference += decision.episode in reference_ids
        self.n_with_findings += bool(decision.findings)
        if result.replaced is not None:
            self.replaced[result.replaced, decision.verdict] += 1
        if result.overridden_by is not None:
            self.overridden.append(result)


class Scoring:
    """A run over bags: iterate it for the results, then read the counts.

    Results come in the order of the bags, paths without a bag first. Each result is logged and
    kept before the next one is computed, so that a stopped run loses nothing.

    Attributes:
        bags: the bags to score.
        curation: what scores and decides. During the run it is fitted on the dataset, if one of
            its scorers needs that.
        counts: over the results so far.
        problem: why examinations could not be kept for the next run; empty if they could.
    """

    def __init__(
        self,
        bags: Sequence[Path],
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
            bags: in the order of their ids, so that of two copies the older one is the original.
            curation: fitted on the reference.
            topic_map: how episodes are built; None: by the map in each bag.
            log: dataset of the bags, to log the decisions in; None: nothing is logged.
            unreadable: paths without a bag.
            fresh: examine bags whose examinations were kept, too.
            jobs: workers; 1 works in this process, -1 takes all cores.
            backend: one of BACKENDS; it matters with several workers.

        Raises:
            ConfigError: for a backend that does not exist, or is not installed.
        """
        check_workers(jobs, backend)
        self.bags = bags
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
            episodes = EpisodesOf(self.bags, self._topic_map)
            self.curation = self.curation.fit_dataset(episodes)
        examiner = Examiner(
            self.curation.scorers,
            self._topic_map,
            jobs=self._jobs,
            backend=self._backend,
            fresh=self._fresh,
        )
        for result in _decided(self.curation, examiner, self.bags, progress):
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


def score_bags(
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
    """Score bags and decide on them.

    The reference is fitted at once; bags are read as the returned run is iterated.

    Args:
        paths: datasets, bags, folders of bags, .mcap files.
        settings: what scores and what decides; by default those of `CurationSettings`.
        reference: trusted demonstrations; may be empty.
        topic_map: how episodes are built; None: by the map in each bag.
        write: log the decisions in the dataset, which is then the only path.
        fresh: examine bags whose examinations were kept, too.
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
    bags, unreadable = _find(given)
    return Scoring(
        bags,
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
    for result in _decided(curation, _InMemory(curation, given), (), iter):
        if isinstance(result, Scored):
            yield result


class _InMemory:
    """Examines episodes that were read already; the id of each stands for its path."""

    def __init__(self, curation: Curation, episodes: Sequence[Episode]) -> None:
        self._examined = [
            Examined(Path(e.id), curation.examine(e), is_known=False) for e in episodes
        ]

    def run(self, bags: Sequence[Path]) -> Iterator[Examined]:
        """All of them, whatever bags are named."""
        return iter(self._examined)


def decide_dataset(
    dataset: Dataset, curation: Curation, topic_map: TopicMap | None = None
) -> tuple[Curation, list[Decision]]:
    """Decide on every bag of a dataset, with all of them in view, and log what is new.

    Args:
        dataset: its bags. Those whose examinations were kept are not read again.
        curation: fitted on the reference. Scorers that learn from the dataset learn anew.
        topic_map: how episodes are built; None: by the map in each bag.

    Returns:
        The curation, fitted on the dataset, and the decisions in force that are new. Bags that
        cannot be read are left out.
    """
    scoring = Scoring(list(dataset.bags()), curation, topic_map=topic_map, log=dataset)
    new = [r.decision for r in scoring if isinstance(r, Scored) and r.is_logged]
    return scoring.curation, new


def _find(paths: Iterable[Path]) -> tuple[list[Path], list[Unreadable]]:
    """Bags at paths, each once, and the paths without a bag."""
    bags: dict[Path, Path] = {}
    missing = []
    for path in paths:
        try:
            for bag in find_episodes([path]):
                bags.setdefault(bag.resolve(), bag)
        except CurationError as err:
            missing.append(Unreadable(path, err))
    return list(bags.values()), missing


def _decided(
    curation: Curation, examiner: Examiner | _InMemory, bags: Sequence[Path], progress: Progress
) -> Iterator[ScoringResult]:
    """Results before anything is logged.

    A rule that needs the dataset is fitted on all examinations first. The second pass finds them
    kept, unless there is no place to keep them.
    """
    rule: FittedRule | None = None
    known: dict[Path, bool] = {}
    if curation.rule_needs_dataset:
        scores: dict[str, float | None] = {}
        copies = Copies()
        for one in progress(examiner.run(bags)):
            known[one.path] = one.is_known
            if isinstance(one.result, Examination):
                found = copies.note(one.result)
                if found.is_trusted:
                    scores[found.episode] = found.scores.get(curation.settings.rule_scorer)
        rule = curation.rule_over(scores, final=True, tie=_tie_of(bags))
        results: Iterable[Examined] = examiner.run(bags)
    else:
        results = progress(examiner.run(bags))
    copies = Copies()
    for one in results:
        if isinstance(one.result, Examination):
            found = copies.note(one.result)
            decision = curation.decide(found, rule)
            yield Scored(one.path, found, decision, known.get(one.path, one.is_known))
        else:
            yield Unreadable(one.path, one.result)


def _tie_of(bags: Sequence[Path]) -> TieKey | None:
    """The tie key of the dataset that all bags are in; None if there is no such dataset."""
    homes = {home_of(bag)[0] for bag in bags}
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
    """What people have decided, in the datasets that bags are in; each is opened once."""

    def __init__(self) -> None:
        self._datasets: dict[Path, Dataset | None] = {}

    def decision_on(self, path: Path, episode_id: str) -> Decision | None:
        """The decision in force on a bag of a dataset, if it is a person's."""
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
