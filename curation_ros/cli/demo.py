"""`curation demo`: record, score, decide, train and drive, live on a ROS 2 graph."""

from __future__ import annotations

import argparse
import signal
import time
from collections.abc import Mapping
from contextlib import closing
from datetime import datetime
from functools import singledispatchmethod
from pathlib import Path
from statistics import median
from typing import Any

from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Column, Table
from rich.text import Text

from curation_ros.cli.output import VERDICT_STYLE, console, percent, print_json
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
from curation_ros.demo.run import START_JITTER_M, Comparison, comparisons, run_demo
from curation_ros.extras import how_to_install
from policy_node.settings import DEFAULTS

#: Selection -> how people read it.
_SPOKEN = {EVERYTHING: "everything", KEPT: "kept", KEPT_AND_SALVAGED: "kept + salvaged"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    sizes = DemoSettings(DEFAULTS.steps)
    parser.add_argument(
        "--out", type=Path, default=Path("demo"), help="each run gets a folder in it"
    )
    parser.add_argument(
        "--demonstrations",
        type=int,
        default=sizes.demonstrations,
        metavar="N",
        help="how many to record; half of them are defective (default %(default)s)",
    )
    parser.add_argument(
        "--rollouts",
        type=int,
        default=sizes.rollouts,
        metavar="N",
        help="official start states per policy (default %(default)s)",
    )
    parser.add_argument(
        "--train-steps",
        type=int,
        default=sizes.train_steps,
        metavar="N",
        help="gradient steps per policy (default %(default)s)",
    )


def run(args: argparse.Namespace) -> int:
    """Run the demo and show what happens, the results last."""
    # SIGTERM and SIGHUP end us as Ctrl-C does: through every `with` block.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    signal.signal(signal.SIGHUP, signal.default_int_handler)
    folder = args.out / f"{datetime.now():%Y-%m-%d-%H%M%S}"
    settings = DemoSettings(args.train_steps, args.rollouts, args.demonstrations)
    output = JsonLines() if args.json else Screen(folder, settings)
    try:
        with closing(output), closing(run_demo(folder, settings)) as events:
            for event in events:
                output.show(event)
    except KeyboardInterrupt:
        if not args.json:
            console.print(f"\nStopped. The complete recordings stay in {folder}.")
        return 130
    return 0


class JsonLines:
    """Prints one line per alert and decision as they come, then per result and picture."""

    _pictures: tuple[Path, ...] = ()

    def close(self) -> None:
        """Nothing is left open."""

    def show(self, event: DemoEvent) -> None:
        """Print an event, if it is one of those."""
        if isinstance(event, Alerted):
            alert = event.status
            row = {"alert": alert.message, "episode": alert.hardware_id, "name": alert.name}
            print_json({**row, **alert.values})
        elif isinstance(event, Decided):
            decision = event.status
            row = {"episode": decision.hardware_id, "name": decision.name}
            print_json({**row, **decision.values, **event.lead_s})
        elif isinstance(event, Drawn):
            self._pictures = event.pictures
        elif isinstance(event, Finished):
            for name, result in event.results.items():
                print_json({"condition": name, **result})
            for picture in self._pictures:
                print_json({"picture": str(picture)})


class Screen:
    """Shows events to people: a paragraph and progress bars per step, and rows in between."""

    def __init__(self, folder: Path, settings: DemoSettings) -> None:
        """Start the clock.

        Args:
            folder: where the demo leaves its files.
            settings: the size of the demo.
        """
        self._folder = folder
        self._settings = settings
        self._began_s = time.monotonic()
        self._bar: Progress | None = None
        self._tasks: dict[str, TaskID] = {}
        self._pictures: tuple[Path, ...] = ()

    def close(self) -> None:
        """Stop the bars, which hide the cursor."""
        if self._bar is not None:
            self._bar.stop()
            self._bar = None

    @singledispatchmethod
    def show(self, event: DemoEvent) -> None:
        """Show an event."""
        raise TypeError(f"no way to show {event!r}")

    # --- recording --------------------------------------------------------------------------

    @show.register
    def _(self, event: Recording) -> None:
        n = self._settings.demonstrations
        if not self._tasks:
            self._say(
                "A robot puts a bowl onto a plate. We record demonstrations. Half of them drop "
                "the bowl. A curator alerts you the moment it falls, and decides on each "
                "demonstration as it ends. Then policies show whether that was worth it."
            )
            self._say(
                f"[bold]1. Demonstrations.[/] {n}, in random order. The curator sees only what "
                "is published. It decides by the bowl, which has to stay with the gripper from "
                "LIFT to the end of TRANSPORT. That needs no label and no trusted reference. "
                "If a demonstration breaks, its good beginning is salvaged."
            )
            self._open_bar({"recording": "starting the nodes"}, total=n)
        text = f"recording {event.name}" if event.name else "starting the nodes"
        self._advance("recording", event.n_ended, text)

    @show.register
    def _(self, event: Alerted) -> None:
        alert = event.status
        reason = alert.values.get("reason", alert.message)
        self._row(alert.name, Text("ALERT", "bold red"), reason)

    @show.register
    def _(self, event: Decided) -> None:
        decision, lead_s = event.status, event.lead_s
        reason = decision.values.get("reason", "")
        if lead_s:
            reason += f" (alert {lead_s['alert_before_s']:.1f} s ago"
            if "alert_before_end_s" in lead_s:
                reason += f", {lead_s['alert_before_end_s']:.1f} s before the end by robot time"
            reason += ")"
        style = VERDICT_STYLE.get(decision.message, "")
        self._row(decision.name, Text(decision.message, style), reason)

    # --- selecting and training -------------------------------------------------------------

    @show.register
    def _(self, event: Selected) -> None:
        self.close()
        beginnings = "Nothing is salvaged"
        if event.salvaged_s:
            beginnings = (
                f"The beginning of {len(event.salvaged_s)} more is salvaged, "
                f"{median(event.salvaged_s):.1f} s in the median"
            )
        by = ", ".join(f"{scorer} ({count})" for scorer, count in event.decided_by.items())
        self._say(
            f"[bold]2. Selection.[/] {event.n_kept} of {event.n_all} demonstrations are kept "
            f"whole. {beginnings}. Decided by {by}."
        )

    @show.register
    def _(self, event: Drawn) -> None:
        self._pictures = event.pictures
        if event.missing:
            console.print(
                f"No picture of a salvaged demonstration: it needs {event.missing}: "
                f"{how_to_install(event.missing)}",
                markup=False,
            )

    @show.register
    def _(self, event: Training) -> None:
        steps = self._settings.train_steps
        if self._tasks.keys() != {f"training {name}" for name in event.steps}:
            self._say(
                f"[bold]3. Training.[/] Behaviour cloning on each selection, with the same "
                f"{steps} gradient steps. Bowl and plate positions get "
                f"{1e3 * START_JITTER_M:g} mm of noise, so that a dozen demonstrations suffice."
            )
            texts = {f"training {n}": f"training on {_SPOKEN[n]}" for n in event.steps}
            self._open_bar(texts, total=steps)
        for name, step in event.steps.items():
            self._advance(f"training {name}", step)

    # --- driving ----------------------------------------------------------------------------

    @show.register
    def _(self, event: Driving) -> None:
        n = self._settings.rollouts
        if self._tasks.keys() != {f"driving {name}" for name in event.rollouts}:
            self._say(
                f"[bold]4. Test.[/] Each policy drives the robot over the graph, from the same "
                f"{n} start states. None of them was demonstrated."
            )
            texts = {f"driving {name}": f"trained on {_SPOKEN[name]}" for name in event.rollouts}
            self._open_bar(texts, total=n)
        for name, outcomes in event.rollouts.items():
            text = f"trained on {_SPOKEN[name]}: {sum(outcomes)} succeeded"
            self._advance(f"driving {name}", len(outcomes), text)

    # --- the end ----------------------------------------------------------------------------

    @show.register
    def _(self, event: Finished) -> None:
        self.close()
        self._say("[bold]Results[/]")
        console.print(_table(event.results))
        for comparison in comparisons(event.results):
            console.print(compared(comparison))
        dataset = self._folder / "demonstrations"
        picture = f"picture    {self._pictures[0]} (and .svg)\n" if self._pictures else ""
        console.print(
            f"\n{picture}"
            f"dataset    {dataset} (bags, decisions, selections, policies)\n"
            f"node logs  {self._folder}/logs\n"
            f"took       {(time.monotonic() - self._began_s) / 60:.1f} minutes\n\n"
            "Next:\n"
            f"  .venv/bin/curation index {dataset}\n"
            f"  .venv/bin/curation score {dataset}\n"
            f"  .venv/bin/curation override {dataset} demo-0001 keep --reason 'looks fine'",
            markup=False,
            soft_wrap=True,
        )

    # --- on the screen ----------------------------------------------------------------------

    def _say(self, text: str) -> None:
        self.close()
        console.print(f"\n{text}")

    def _row(self, name: str, what: Text, explanation: str) -> None:
        row = Table.grid(Column(width=10), Column(width=8), Column(ratio=1), padding=(0, 2, 0, 0))
        row.add_row(name, what, Text(explanation))
        console.print(row)

    def _open_bar(self, texts: Mapping[str, str], total: int) -> None:
        """Show a bar per task: name of the task -> what stands beside the bar."""
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(bar_width=20),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
            console=console,
        )
        self._tasks = {name: self._bar.add_task(text, total=total) for name, text in texts.items()}
        self._bar.start()

    def _advance(self, task: str, completed: int, text: str | None = None) -> None:
        if self._bar is not None:
            self._bar.update(self._tasks[task], completed=completed, description=text)


def _table(results: Mapping[str, Mapping[str, Any]]) -> Table:
    table = Table(box=None, pad_edge=False, show_header=False)
    for name, spoken in _SPOKEN.items():
        shown = "no policy, because nothing was salvaged"
        if name in results:
            r = results[name]
            shown = percent(r["successes"], r["rollouts"], (r["ci95"][0], r["ci95"][1]))
        table.add_row(f"trained on {spoken}", shown)
    return table


def compared(c: Comparison) -> str:
    """A comparison in words that claim no more than the counts show."""
    which = f"{_SPOKEN[c.first]} against {_SPOKEN[c.second]}"
    test = f"p = {c.p_value:.2g}, Fisher's exact test, one training seed each"
    if not c.is_shown:
        return f"{which}: no difference is shown; so few rollouts can differ by chance ({test})."
    return f"{which}: {'better' if c.is_better else 'WORSE: curation did harm here'} ({test})."
