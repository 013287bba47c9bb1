"""The whole path, live on a graph: record, decide, select, train, drive.

`run_demo` does it and yields what happens. Whoever runs it shows that to people.
"""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Generator, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from scipy.stats import fisher_exact

from curation_ros.core.errors import CurationError
from curation_ros.core.types import NS_PER_S
from curation_ros.dataset.dataset import Dataset
from curation_ros.dataset.episodes import read_episode
from curation_ros.dataset.manifests import save_selection
from curation_ros.demo.events import (
    EVERYTHING,
    KEPT,
    KEPT_AND_SALVAGED,
    Alerted,
    Decided,
    DemoEvent,
    DemoSettings,
    Drawn,
    Driving,
    Finished,
    Recording,
    Selected,
    Training,
)
from curation_ros.nodes.processes import Domain, Nodes
from curation_ros.study.graph_rollouts import evaluate_on_graph, summary

if TYPE_CHECKING:
    from curation_ros.core.episode.status import EpisodeEvent, Status
    from curation_ros.nodes.watcher import Watcher

#: Standard deviation of the noise on the start positions in training. It was chosen on generated
#: starts. Without it, a dozen demonstrations give a poor policy in any case.
START_JITTER_M = 0.004
# None of the starts that this seed generates is an official one.
_DEMONSTRATION_SEED, _TRAINING_SEED = 7, 0
_MAX_STEPS_DEFECTIVE = 350
_SIM_ENDS_WITHIN_S = 120.0
_POLL_S = 0.1
#: The comparisons of the result, which share the level of significance (Bonferroni).
_COMPARISONS = ((KEPT, EVERYTHING), (KEPT_AND_SALVAGED, KEPT))
_SIGNIFICANT = 0.05 / len(_COMPARISONS)


# --- the steps ------------------------------------------------------------------------------


def run_demo(folder: Path, settings: DemoSettings) -> Generator[DemoEvent, None, None]:
    """Run the demo.

    Args:
        folder: gets `demonstrations`, a dataset, and `logs`.
        settings: its size.

    Yields:
        What happens. Each step begins with an event before it does anything.

    Raises:
        CurationError: if a node or a training fails, or nothing is kept.
    """
    dataset, logs = folder / "demonstrations", folder / "logs"
    yield from _record(dataset, settings.demonstrations, logs / "demonstrations")
    selected = select(dataset)
    yield selected
    yield draw(dataset, folder)
    policies = yield from _train(selected.manifests, settings.train_steps, logs)
    results = yield from _drive(policies, settings.rollouts, logs)
    yield Finished(results)


def _record(dataset: Path, n: int, logs: Path) -> Iterator[DemoEvent]:
    from curation_ros.nodes.watcher import Watcher

    yield Recording("", 0)
    domain = Domain()
    try:
        with Nodes(domain, logs) as nodes, Watcher(domain.environment) as watcher:
            nodes.start("recorder", {"dataset": dataset})
            nodes.start("curator", {"dataset": dataset})
            nodes.start(
                "sim_node",
                {
                    "episodes": n,
                    "seed": _DEMONSTRATION_SEED,
                    "contamination": 0.5,
                    "defect": "early_release",
                    "max_steps_defective": _MAX_STEPS_DEFECTIVE,
                    "task": "demo",
                    "dataset": dataset,
                    "wait_for": ["recorder", "curator", "watcher"],
                },
            )
            yield from _watch(nodes, watcher, n)
            nodes.wait("sim_node", _SIM_ENDS_WITHIN_S)
    finally:
        domain.close()


def _watch(nodes: Nodes, watcher: Watcher, n: int) -> Iterator[DemoEvent]:
    """Watch until n episodes are decided."""
    ended: dict[str, EpisodeEvent] = {}
    alerts: dict[str, tuple[float, Status]] = {}
    decided: set[str] = set()
    while len(decided) < n:
        nodes.check()
        watcher.look(_POLL_S)
        now_s = time.monotonic()
        while watcher.events:
            event = watcher.events.popleft()
            if event.event != "started":
                ended[event.id] = event
            yield Recording(event.name, len(ended))
        while watcher.alerts:
            alert = watcher.alerts.popleft()
            alerts[alert.hardware_id] = now_s, alert
            yield Alerted(alert)
        while watcher.decisions:
            decision = watcher.decisions.popleft()
            episode_id, lead_s = decision.hardware_id, {}
            if episode_id in alerts and episode_id not in decided:
                alerted_s, alert = alerts[episode_id]
                lead_s = lead_of(alert, now_s - alerted_s, ended.get(episode_id))
            decided.add(episode_id)
            yield Decided(decision, lead_s)


def lead_of(alert: Status, alert_before_s: float, end: EpisodeEvent | None) -> dict[str, float]:
    """The lead of an alert, as `Decided` has it.

    Args:
        alert: the alert.
        alert_before_s: time from the alert to the decision, in s.
        end: the end of the episode, if it was seen.
    """
    lead_s = {"alert_before_s": alert_before_s}
    if end is not None and end.end_ns is not None:
        sure_ns = end.start_ns + int(alert.values["span_end"])
        lead_s["alert_before_end_s"] = (end.end_ns - sure_ns) / NS_PER_S
    return lead_s


def select(path: Path) -> Selected:
    """Write the manifests of the selections.

    Args:
        path: the dataset of the demonstrations, decided.

    Raises:
        CurationError: if nothing is kept.
    """
    dataset = Dataset(path)
    everything, everything_path = save_selection(dataset, rule="all", name=EVERYTHING)
    both, both_path = save_selection(dataset, rule="decisions", name=KEPT_AND_SALVAGED)
    kept = replace(
        both,
        name=KEPT,
        entries=tuple(e for e in both.entries if e.span is None),
        rule_params={**both.rule_params, "salvaged": False},
    )
    if not kept.entries:
        raise CurationError("the curator kept nothing, so there is nothing to train on")
    manifests = {EVERYTHING: everything_path, KEPT: dataset.save_manifest(kept)}
    spans = [entry.span for entry in both.entries if entry.span is not None]
    if spans:
        manifests[KEPT_AND_SALVAGED] = both_path
    decisions = dataset.latest_decisions().values()
    decided_by = Counter(str(d.evidence.get("decided_by", "nothing")) for d in decisions)
    return Selected(
        manifests,
        len(kept.entries),
        everything.kept_of,
        tuple((end_ns - start_ns) / NS_PER_S for start_ns, end_ns in spans),
        dict(decided_by.most_common()),
    )


def draw(path: Path, folder: Path) -> Drawn:
    """Draw the first salvaged demonstration.

    Args:
        path: the dataset of the demonstrations, decided.
        folder: gets the picture.
    """
    dataset = Dataset(path)
    decisions = sorted(dataset.latest_decisions().values(), key=lambda d: d.name)
    salvaged = next((d for d in decisions if d.verdict == "salvage"), None)
    if salvaged is None:
        return Drawn(())
    try:
        from curation_ros.reporting.salvage_picture import save_salvage_figure
    except ModuleNotFoundError as err:
        return Drawn((), missing=str(err.name))
    episode = read_episode(dataset.bag_path(salvaged.episode))
    return Drawn(save_salvage_figure(episode, salvaged, folder))


def _train(
    manifests: Mapping[str, Path], steps: int, logs: Path
) -> Generator[DemoEvent, None, dict[str, Path]]:
    """Train one policy per selection, all at once in processes of their own."""
    yield Training(dict.fromkeys(manifests, 0))
    step_logs = {name: logs / f"train-{name}.log" for name in manifests}
    jobs: dict[str, subprocess.Popen[str]] = {}
    try:
        for name, manifest in manifests.items():
            command = [sys.executable, "-m", "curation_ros.cli.main", "train", "--json"]
            command += ["--selection", str(manifest), "--seed", str(_TRAINING_SEED)]
            command += ["--steps", str(steps), "--report", str(step_logs[name])]
            command += ["--start-jitter-m", str(START_JITTER_M)]
            jobs[name] = subprocess.Popen(
                command, stdout=subprocess.PIPE, text=True, start_new_session=True
            )
        while any(job.poll() is None for job in jobs.values()):
            yield Training({name: _last_step(log) for name, log in step_logs.items()})
            time.sleep(_POLL_S)
    finally:
        for job in jobs.values():
            if job.poll() is None:
                job.kill()
                job.wait()
    yield Training(dict.fromkeys(manifests, steps))
    policies = {}
    for name, job in jobs.items():
        out, _ = job.communicate()
        if job.returncode:
            raise CurationError(f"training on {name} ended with code {job.returncode}")
        policies[name] = Path(json.loads(out)["policy"])
    return policies


def _last_step(log: Path) -> int:
    """The last step that a training has written to its log."""
    try:
        lines = log.read_text().split()
    except OSError:
        return 0
    return int(lines[-1]) if lines else 0


def _drive(
    policies: Mapping[str, Path], n: int, logs: Path
) -> Generator[DemoEvent, None, dict[str, dict[str, Any]]]:
    """Drive all policies at once from the first n official starts, each on a domain of its own."""
    rows: dict[str, list[dict[str, Any]]] = {name: [] for name in policies}
    failures: list[CurationError] = []
    stop = threading.Event()

    def work(name: str, policy: Path) -> None:
        folder = logs / f"drive-{name}"
        try:
            starts = f"official:0:{n}"
            for row in evaluate_on_graph(
                policy, policy.name, starts, log_folder=folder, stop=stop
            ):
                rows[name].append(row)
        except CurationError as err:
            failures.append(err)

    def progress() -> Driving:
        return Driving(
            {name: tuple(bool(row["success"]) for row in one) for name, one in rows.items()}
        )

    yield progress()
    threads = [threading.Thread(target=work, args=pair) for pair in policies.items()]
    try:
        for thread in threads:
            thread.start()
        while any(thread.is_alive() for thread in threads) and not failures:
            yield progress()
            time.sleep(_POLL_S)
    finally:
        stop.set()
        for thread in threads:
            thread.join()
    if failures:
        raise failures[0]
    yield progress()
    return {name: summary(policies[name].name, rows[name]) for name in policies}


# --- what follows from it -------------------------------------------------------------------


@dataclass(frozen=True)
class Comparison:
    """The policies of two selections, compared by Fisher's exact test.

    Attributes:
        p_value: of the test, two-sided.
        is_shown: whether a difference is shown, given the number of comparisons.
        is_better: whether the first policy succeeds more often.
    """

    first: str
    second: str
    p_value: float
    is_shown: bool
    is_better: bool


def comparisons(results: Mapping[str, Mapping[str, Any]]) -> list[Comparison]:
    """Compare the policies: kept with everything, kept and salvaged with kept.

    Args:
        results: selection -> summary with `successes`, `rollouts` and `rate`. Selections without
            a policy may be missing.
    """
    compared = []
    for first, second in _COMPARISONS:
        if first in results and second in results:
            one, other = results[first], results[second]
            table = [[r["successes"], r["rollouts"] - r["successes"]] for r in (one, other)]
            p_value = float(fisher_exact(table).pvalue)
            compared.append(
                Comparison(
                    first, second, p_value, p_value < _SIGNIFICANT, one["rate"] > other["rate"]
                )
            )
    return compared
