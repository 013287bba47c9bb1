"""`curation demo`: record, score, decide, train and drive, live on a ROS 2 graph."""

from __future__ import annotations

import argparse
import json
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from statistics import median
from typing import Any

from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Column, Table
from rich.text import Text
from scipy.stats import fisher_exact

from curation_ros.bags.reader import read_episode
from curation_ros.cli.output import VERDICT_STYLE, console, percent, print_json
from curation_ros.core.decision.manifest import Manifest
from curation_ros.core.episode.status import EpisodeEvent, Status
from curation_ros.core.errors import CurationError
from curation_ros.core.types import NS_PER_S
from curation_ros.dataset.dataset import Dataset
from curation_ros.dataset.manifests import save_selection
from curation_ros.nodes.evaluate import evaluate_on_graph, summary
from curation_ros.nodes.processes import Domain, Nodes

# None of the starts that this seed generates is an official one.
_DEMONSTRATION_SEED, _TRAINING_SEED = 7, 0
_MAX_STEPS_DEFECTIVE = 350
# Chosen on generated starts; without it a dozen demonstrations give a poor policy either way.
_START_JITTER_M = 0.004
_START_UP_S = 120.0
#: Name of the selection -> what people read.
_CONDITIONS = {
    "everything": "everything",
    "kept": "kept",
    "kept-and-salvaged": "kept + salvaged",
}
#: What is compared with what; the level is shared among these comparisons (Bonferroni).
_COMPARISONS = (("kept", "everything"), ("kept-and-salvaged", "kept"))
_SIGNIFICANT = 0.05 / len(_COMPARISONS)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument("--out", type=Path, default=Path("demo"), help="a run gets a folder in it")
    parser.add_argument("--demonstrations", type=int, default=24, help="half of them defective")
    parser.add_argument("--rollouts", type=int, default=10, help="official starts for each policy")
    parser.add_argument("--train-steps", type=int, default=4000, help="gradient steps a policy")


def run(args: argparse.Namespace) -> int:
    """The whole path; what it prints at the end is what came out."""
    began_s = time.monotonic()
    # SIGTERM ends us as Ctrl-C does: through every `with` block.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    signal.signal(signal.SIGHUP, signal.default_int_handler)
    folder = args.out / f"{datetime.now():%Y-%m-%d-%H%M%S}"
    demo = _Demo(args, folder)
    demo.say(
        "A robot puts a bowl onto a plate. We record demonstrations, half of which drop the bowl; "
        "a curator warns as it falls, and decides while the robot is still at the table; policies "
        "then show whether that was worth it."
    )
    try:
        demo.record()
        manifests = demo.select()
        demo.draw()
        policies = demo.train(manifests)
        results = demo.drive(policies)
    except KeyboardInterrupt:
        console.print(f"\nStopped. What was recorded is whole, and stays in {folder}.")
        return 130
    demo.conclude(results, time.monotonic() - began_s)
    return 0


class _Demo:
    def __init__(self, args: argparse.Namespace, folder: Path) -> None:
        self.args = args
        self.folder = folder
        self.dataset = folder / "demonstrations"
        self.logs = folder / "logs"
        self.pictures: tuple[Path, ...] = ()

    def say(self, text: str) -> None:
        if not self.args.json:
            console.print(f"\n{text}")

    # --- recording --------------------------------------------------------------------------

    def record(self) -> None:
        from curation_ros.nodes.watching import Watcher

        n = self.args.demonstrations
        self.say(
            f"[bold]1. Demonstrations.[/] {n}, shuffled; the curator sees what is published, and "
            "nothing else. What decides is the bowl: from LIFT to the end of TRANSPORT it has to "
            "stay with the gripper. That needs no label and no trusted reference. "
            "Of a demonstration that broke, the good beginning is salvaged."
        )
        domain = Domain()
        try:
            with (
                Nodes(domain, self.logs / "demonstrations") as nodes,
                Watcher(domain.environment) as watcher,
            ):
                nodes.start("recorder", {"dataset": self.dataset})
                nodes.start("curator", {"dataset": self.dataset})
                nodes.start(
                    "sim_node",
                    {
                        "episodes": n,
                        "seed": _DEMONSTRATION_SEED,
                        "contamination": 0.5,
                        "defect": "early_release",
                        "max_steps_defective": _MAX_STEPS_DEFECTIVE,
                        "task": "demo",
                        "dataset": self.dataset,
                        "wait_for": ["recorder", "curator", "watcher"],
                    },
                )
                self._watch(nodes, watcher, n)
                nodes.wait("sim_node", _START_UP_S)
        finally:
            domain.close()

    def _watch(self, nodes: Nodes, watcher: Any, n: int) -> None:
        """Show alerts and decisions as they fall, until all episodes are decided."""
        ended: dict[str, EpisodeEvent] = {}
        alerts: dict[str, tuple[float, Status]] = {}
        decided: set[str] = set()
        with self._progress() as bar:
            task = bar.add_task("starting the nodes", total=n)
            while len(decided) < n:
                nodes.check()
                watcher.look(0.1)
                now_s = time.monotonic()
                while watcher.events:
                    event = watcher.events.popleft()
                    if event.event != "started":
                        ended[event.id] = event
                    text = f"recording {event.name}"
                    bar.update(task, completed=len(ended), description=text)
                while watcher.alerts:
                    alert = watcher.alerts.popleft()
                    alerts[alert.hardware_id] = now_s, alert
                    self._show_alert(bar, alert)
                while watcher.decisions:
                    decision = watcher.decisions.popleft()
                    before: dict[str, float] = {}
                    if decision.hardware_id not in decided and decision.hardware_id in alerts:
                        heard_s, alert = alerts[decision.hardware_id]
                        before = _lead(alert, now_s - heard_s, ended.get(decision.hardware_id))
                    decided.add(decision.hardware_id)
                    self._show_decision(bar, decision, before)
            bar.update(task, completed=n, description="recorded")

    def _show_alert(self, bar: Progress, alert: Status) -> None:
        """One row of the live table, while the robot still moves."""
        if self.args.json:
            row = {"alert": alert.message, "episode": alert.hardware_id, "name": alert.name}
            print_json({**row, **alert.values})
            return
        reason = alert.values.get("reason", alert.message)
        self._row(bar, alert.name, Text("ALERT", "bold red"), reason)

    def _show_decision(self, bar: Progress, decision: Status, before: dict[str, float]) -> None:
        """One row of the live table, as the decision falls."""
        if self.args.json:
            row = {"episode": decision.hardware_id, "name": decision.name}
            print_json({**row, **decision.values, **before})
            return
        reason = decision.values.get("reason", "")
        if before:
            reason += f" (alert {before['alert_before_s']:.1f} s ago"
            if "alert_before_end_s" in before:
                reason += f", {before['alert_before_end_s']:.1f} s before the end by robot time"
            reason += ")"
        verdict = Text(decision.message, VERDICT_STYLE.get(decision.message, ""))
        self._row(bar, decision.name, verdict, reason)

    def _row(self, bar: Progress, name: str, what: Text, words: str) -> None:
        row = Table.grid(Column(width=10), Column(width=8), Column(ratio=1), padding=(0, 2, 0, 0))
        row.add_row(name, what, Text(words))
        bar.console.print(row)

    def _progress(self) -> Progress:
        return Progress(
            TextColumn("{task.description}"),
            BarColumn(bar_width=20),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
            console=console,
            disable=self.args.json,
        )

    # --- selecting and training -------------------------------------------------------------

    def select(self) -> dict[str, Path]:
        """Manifests of the conditions; without the last where nothing was salvaged."""
        dataset = Dataset(self.dataset)
        everything, path = save_selection(dataset, rule="all", name="everything")
        manifests = {"everything": path}
        both = save_selection(dataset, rule="decisions", name="kept-and-salvaged")
        kept = _whole_only(both[0], "kept")
        salvaged_s = [
            (e.span[1] - e.span[0]) / NS_PER_S for e in both[0].entries if e.span is not None
        ]
        manifests["kept"] = dataset.save_manifest(kept)
        if salvaged_s:
            manifests["kept-and-salvaged"] = both[1]
        by = Counter(
            str(d.evidence.get("decided_by", "nothing"))
            for d in dataset.latest_decisions().values()
        )
        whose = ", ".join(f"{scorer} ({count})" for scorer, count in by.most_common())
        beginnings = (
            f"of {len(salvaged_s)} more the beginning is salvaged, {median(salvaged_s):.1f} s in "
            "the median"
            if salvaged_s
            else "nothing is salvaged"
        )
        self.say(
            f"[bold]2. Selection.[/] {len(kept.entries)} of {everything.kept_of} demonstrations "
            f"are kept whole; {beginnings}. Decided by {whose}."
        )
        if not kept.entries:
            raise CurationError("the curator kept nothing, so there is nothing to train on")
        return manifests

    def draw(self) -> None:
        """The picture of the first salvaged episode."""
        dataset = Dataset(self.dataset)
        decisions = sorted(dataset.latest_decisions().values(), key=lambda d: d.name)
        salvaged = next((d for d in decisions if d.verdict == "salvage"), None)
        if salvaged is None:
            return
        try:
            from curation_ros.reporting.salvage_picture import save_salvage_figure
        except ImportError:
            self.say("No picture of a salvaged episode: matplotlib is not installed.")
            return
        episode = read_episode(dataset.bag_path(salvaged.episode))
        self.pictures = save_salvage_figure(episode, salvaged, self.folder)

    def train(self, manifests: dict[str, Path]) -> dict[str, Path]:
        steps = self.args.train_steps
        self.say(
            f"[bold]3. Training.[/] The same behaviour cloning on each: {steps} gradient steps; "
            f"bowl and plate blurred by {1e3 * _START_JITTER_M:g} mm, so that a dozen is enough."
        )
        jobs: dict[str, subprocess.Popen[str]] = {}
        logs = {name: self.logs / f"train-{name}.log" for name in manifests}
        with self._progress() as bar:
            tasks = {
                name: bar.add_task(f"training on {_CONDITIONS[name]}", total=steps)
                for name in manifests
            }
            try:
                for name, manifest in manifests.items():
                    command = [sys.executable, "-m", "curation_ros.cli.main", "train", "--json"]
                    command += ["--selection", str(manifest), "--seed", str(_TRAINING_SEED)]
                    command += ["--steps", str(steps), "--report", str(logs[name])]
                    command += ["--start-jitter-m", str(_START_JITTER_M)]
                    jobs[name] = subprocess.Popen(
                        command, stdout=subprocess.PIPE, text=True, start_new_session=True
                    )
                while any(job.poll() is None for job in jobs.values()):
                    for name, task in tasks.items():
                        bar.update(task, completed=_last_step(logs[name]))
                    time.sleep(0.1)
            finally:
                for job in jobs.values():
                    if job.poll() is None:
                        job.kill()
                        job.wait()
            for task in tasks.values():
                bar.update(task, completed=steps)
        policies = {}
        for name, job in jobs.items():
            out, _ = job.communicate()
            if job.returncode:
                raise CurationError(f"training on {name} ended with code {job.returncode}")
            policies[name] = Path(json.loads(out)["policy"])
        return policies

    # --- driving ----------------------------------------------------------------------------

    def drive(self, policies: dict[str, Path]) -> dict[str, dict[str, Any]]:
        n = self.args.rollouts
        self.say(
            f"[bold]4. Test.[/] Each policy drives the robot over the graph, from the same {n} "
            "start states, none of which was demonstrated."
        )
        rows: dict[str, list[dict[str, Any]]] = {name: [] for name in policies}
        failures: list[CurationError] = []

        def work(name: str, policy: Path) -> None:
            try:
                logs = self.logs / f"drive-{name}"
                rollouts = evaluate_on_graph(
                    policy, policy.name, f"official:0:{n}", log_folder=logs, stop=stop
                )
                for row in rollouts:
                    rows[name].append(row)
            except CurationError as err:
                failures.append(err)

        stop = threading.Event()
        threads = [threading.Thread(target=work, args=pair) for pair in policies.items()]
        with self._progress() as bar:
            tasks = {
                name: bar.add_task(f"trained on {_CONDITIONS[name]}", total=n) for name in policies
            }
            try:
                for thread in threads:
                    thread.start()
                while any(thread.is_alive() for thread in threads) and not failures:
                    for name, task in tasks.items():
                        wins = sum(row["success"] for row in rows[name])
                        text = f"trained on {_CONDITIONS[name]}: {wins} succeeded"
                        bar.update(task, completed=len(rows[name]), description=text)
                    time.sleep(0.1)
            finally:
                stop.set()
                for thread in threads:
                    thread.join()
        if failures:
            raise failures[0]
        return {name: summary(policies[name].name, rows[name]) for name in policies}

    # --- the end ----------------------------------------------------------------------------

    def conclude(self, results: dict[str, dict[str, Any]], seconds: float) -> None:
        if self.args.json:
            for name, result in results.items():
                print_json({"condition": name, **result})
            for picture in self.pictures:
                print_json({"picture": str(picture)})
            return
        self.say("[bold]What came out[/]")
        table = Table(box=None, pad_edge=False, show_header=False)
        for name, words in _CONDITIONS.items():
            shown = "nothing was salvaged, so there is no such policy"
            if name in results:
                r = results[name]
                shown = percent(r["successes"], r["rollouts"], (r["ci95"][0], r["ci95"][1]))
            table.add_row(f"trained on {words}", shown)
        console.print(table)
        for first, second in _COMPARISONS:
            if first in results:
                console.print(_compared(first, second, results))
        seen = f"picture    {self.pictures[0]} (and .svg)\n" if self.pictures else ""
        dataset = Dataset(self.dataset)
        console.print(
            f"\n{seen}"
            f"bags       {dataset.episodes_folder}\nindex      {dataset.index.path}\n"
            f"decisions  {dataset.decisions_folder}\nnode logs  {self.logs}\n"
            f"took       {seconds / 60:.1f} minutes\n\n"
            "Next:\n"
            f"  .venv/bin/curation index {self.dataset}\n"
            f"  .venv/bin/curation score {self.dataset}\n"
            f"  .venv/bin/curation override {self.dataset} demo-0001 keep --reason 'looks fine'",
            markup=False,
            soft_wrap=True,
        )


def _lead(alert: Status, heard_s: float, end: EpisodeEvent | None) -> dict[str, float]:
    """How long before a decision its alert came, and before the end on the episode's own clock.

    The simulator may be faster or slower than a robot, so the two differ.
    """
    lead = {"alert_before_s": heard_s}
    if end is not None and end.end_ns is not None:
        sure_ns = end.start_ns + int(alert.values["span_end"])
        lead["alert_before_end_s"] = (end.end_ns - sure_ns) / NS_PER_S
    return lead


def _whole_only(manifest: Manifest, name: str) -> Manifest:
    """The same selection without its spans."""
    return replace(
        manifest,
        name=name,
        entries=tuple(e for e in manifest.entries if e.span is None),
        rule_params={**manifest.rule_params, "salvaged": False},
    )


def _compared(first: str, second: str, results: dict[str, dict[str, Any]]) -> str:
    """What two counts say, in words that claim no more than they can."""
    one, other = results[first], results[second]
    counts = [[r["successes"], r["rollouts"] - r["successes"]] for r in (one, other)]
    p = float(fisher_exact(counts).pvalue)
    which = f"{_CONDITIONS[first]} against {_CONDITIONS[second]}"
    chance = f"p = {p:.2g}, Fisher's exact test, one training seed each"
    if p >= _SIGNIFICANT:
        return f"{which}: no difference is shown, so few rollouts can differ by chance ({chance})."
    better = one["rate"] > other["rate"]
    word = "better" if better else "WORSE, it did harm here"
    return f"{which}: {word} ({chance})."


def _last_step(log: Path) -> int:
    """The step that a training has written last."""
    try:
        lines = log.read_text().split()
    except OSError:
        return 0
    return int(lines[-1]) if lines else 0
