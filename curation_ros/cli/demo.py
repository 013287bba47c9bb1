"""`curation demo`: record, score, decide, train and drive, live on a ROS 2 graph."""

from __future__ import annotations

import argparse
import json
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
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

from curation_ros.cli.output import VERDICT_STYLE, console, percent, print_json
from curation_ros.core.errors import CurationError
from curation_ros.core.status import Status
from curation_ros.dataset import Dataset
from curation_ros.evaluating import evaluate_on_graph, summary
from curation_ros.processes import Domain, Nodes
from curation_ros.selecting import save_selection

# The reference has starts of its own, and none of these is an official one.
_REFERENCE_SEED, _DEMONSTRATION_SEED, _TRAINING_SEED = 101, 7, 0
_MAX_STEPS_DEFECTIVE = 350
# Chosen on generated starts; without it a dozen demonstrations give a poor policy either way.
_START_JITTER_M = 0.004
_START_UP_S = 120.0
_CONDITIONS = ("everything", "kept")
_SIGNIFICANT = 0.05


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument("--out", type=Path, default=Path("demo"), help="a run gets a folder in it")
    parser.add_argument("--references", type=int, default=6, help="clean reference demonstrations")
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
        "a curator decides on each while the robot is still at the table; two policies then show "
        "whether that was worth it."
    )
    try:
        demo.record_reference()
        demo.record_demonstrations()
        manifests = demo.select()
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
        self.reference = folder / "reference"
        self.dataset = folder / "demonstrations"
        self.logs = folder / "logs"

    def say(self, text: str) -> None:
        if not self.args.json:
            console.print(f"\n{text}")

    # --- recording --------------------------------------------------------------------------

    def record_reference(self) -> None:
        n = self.args.references
        self.say(
            f"[bold]1. Reference.[/] The scorer needs a few demonstrations that somebody trusts: "
            f"{n} clean ones, never trained on."
        )
        parameters = {"episodes": n, "seed": _REFERENCE_SEED, "task": "reference"}
        with self._graph("reference", self.reference) as (nodes, watcher):
            self._record(nodes, watcher, self.reference, parameters, "reference", [])

    def record_demonstrations(self) -> None:
        n = self.args.demonstrations
        self.say(
            f"[bold]2. Demonstrations.[/] {n}, shuffled; the curator knows only the stream. "
            "Its rule: gripper timing, with a threshold fitted on the reference."
        )
        parameters = {
            "episodes": n,
            "seed": _DEMONSTRATION_SEED,
            "contamination": 0.5,
            "defect": "early_release",
            "max_steps_defective": _MAX_STEPS_DEFECTIVE,
            "task": "demo",
        }
        with self._graph("demonstrations", self.dataset) as (nodes, watcher):
            nodes.start("curator", {"dataset": self.dataset, "reference": [self.reference]})
            self._record(nodes, watcher, self.dataset, parameters, "demonstrations", ["curator"])

    @contextmanager
    def _graph(self, name: str, dataset: Path) -> Iterator[tuple[Nodes, Any]]:
        from curation_ros.nodes.watching import Watcher

        domain = Domain()
        try:
            with (
                Nodes(domain, self.logs / name) as nodes,
                Watcher(domain.environment) as watcher,
            ):
                nodes.start("recorder", {"dataset": dataset})
                yield nodes, watcher
        finally:
            domain.close()

    def _record(
        self,
        nodes: Nodes,
        watcher: Any,
        dataset: Path,
        parameters: dict[str, Any],
        what: str,
        also: list[str],
    ) -> None:
        n = parameters["episodes"]
        wait_for = ["recorder", *also, "watcher"]
        nodes.start("sim_node", {**parameters, "dataset": dataset, "wait_for": wait_for})
        ended = 0
        decided: set[str] = set()
        with self._progress() as bar:
            task = bar.add_task(f"{what}: starting the nodes", total=n)
            while ended < n or (also and len(decided) < n):
                nodes.check()
                watcher.look(0.1)
                while watcher.events:
                    event = watcher.events.popleft()
                    ended += event.event != "started"
                    bar.update(task, completed=ended, description=f"recording {event.name}")
                while watcher.decisions:
                    decision = watcher.decisions.popleft()
                    decided.add(decision.hardware_id)
                    self._show(bar, decision)
            bar.update(task, description="recorded")
            nodes.wait("sim_node", _START_UP_S)

    def _show(self, bar: Progress, decision: Status) -> None:
        """One row of the live table, as the decision falls."""
        if self.args.json:
            print_json({"episode": decision.hardware_id, "name": decision.name, **decision.values})
            return
        row = Table.grid(Column(width=10), Column(width=8), Column(ratio=1), padding=(0, 2, 0, 0))
        style = VERDICT_STYLE.get(decision.message, "")
        row.add_row(
            decision.name, Text(decision.message, style), Text(decision.values.get("reason", ""))
        )
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
        dataset = Dataset(self.dataset)
        manifests = {}
        sizes = {}
        for name, rule in zip(_CONDITIONS, ("all", "decisions"), strict=True):
            manifest, manifests[name] = save_selection(dataset, rule=rule, name=name)
            sizes[name] = (len(manifest.entries), manifest.kept_of)
        kept, total = sizes["kept"]
        self.say(
            f"[bold]3. Selection.[/] {kept} of {total} demonstrations are kept. Scorer: "
            f"gripper_timing; it needs a trusted reference ({self.args.references} "
            "demonstrations), no labels."
        )
        if not kept:
            raise CurationError("the curator kept nothing, so there is nothing to train on")
        return manifests

    def train(self, manifests: dict[str, Path]) -> dict[str, Path]:
        steps = self.args.train_steps
        self.say(
            f"[bold]4. Training.[/] The same behaviour cloning on each: {steps} gradient steps; "
            f"bowl and plate blurred by {1e3 * _START_JITTER_M:g} mm, so that a dozen is enough."
        )
        jobs: dict[str, subprocess.Popen[str]] = {}
        logs = {name: self.logs / f"train-{name}.log" for name in manifests}
        with self._progress() as bar:
            tasks = {name: bar.add_task(f"training on {name}", total=steps) for name in manifests}
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
            f"[bold]5. Test.[/] Each policy drives the robot over the graph, from the same {n} "
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
            tasks = {name: bar.add_task(f"trained on {name}", total=n) for name in policies}
            try:
                for thread in threads:
                    thread.start()
                while any(thread.is_alive() for thread in threads) and not failures:
                    for name, task in tasks.items():
                        wins = sum(row["success"] for row in rows[name])
                        text = f"trained on {name}: {wins} succeeded"
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
            return
        self.say("[bold]What came out[/]")
        table = Table(box=None, pad_edge=False, show_header=False)
        for name, result in results.items():
            interval = (result["ci95"][0], result["ci95"][1])
            shown = percent(result["successes"], result["rollouts"], interval)
            table.add_row(f"trained on {name}", shown)
        console.print(table)
        everything, kept = (results[name] for name in _CONDITIONS)
        console.print(_verdict(everything, kept))
        console.print(
            f"\nbags       {self.dataset}/episodes\nindex      {self.dataset}/index.sqlite\n"
            f"decisions  {self.dataset}/decisions\nnode logs  {self.logs}\n"
            f"took       {seconds / 60:.1f} minutes\n\n"
            "Next:\n"
            f"  .venv/bin/curation index {self.dataset}\n"
            f"  .venv/bin/curation score {self.dataset} --reference {self.reference}\n"
            f"  .venv/bin/curation override {self.dataset} demo-0001 keep --reason 'looks fine'",
            markup=False,
            soft_wrap=True,
        )


def _verdict(everything: dict[str, Any], kept: dict[str, Any]) -> str:
    """What two counts say, in words that claim no more than they can."""
    counts = [[r["successes"], r["rollouts"] - r["successes"]] for r in (kept, everything)]
    p = float(fisher_exact(counts).pvalue)
    chance = f"p = {p:.2g}, Fisher's exact test; one training seed each"
    if p < _SIGNIFICANT:
        better = kept["rate"] > everything["rate"]
        which = "better" if better else "WORSE: curation did harm here"
        return f"The policy trained on the kept demonstrations is {which} ({chance})."
    return f"No difference is shown: so few rollouts can fall out like this by chance ({chance})."


def _last_step(log: Path) -> int:
    """The step that a training has written last."""
    try:
        lines = log.read_text().split()
    except OSError:
        return 0
    return int(lines[-1]) if lines else 0
