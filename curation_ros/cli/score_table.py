"""The table of `curation score`: one row per episode, for people."""

from __future__ import annotations

from collections.abc import Sequence

from rich.table import Table
from rich.text import Text

from curation_ros.batch.scored import Scored
from curation_ros.cli.output import VERDICT_STYLE, console, progress_console
from curation_ros.core.decision.decision import CURATOR, Decision
from curation_ros.core.types import NS_PER_S

#: Characters that the other columns take, and those of one score.
_FIXED_WIDTH, _SCORE_WIDTH = 64, 12
#: A salvaged part that begins later than this does not begin with the episode.
_LATE_S = 0.1


def score_table(results: Sequence[Scored]) -> Table:
    """All scores if the terminal is wide enough, else the score that decided.

    Args:
        results: at least one, all with the same scorers.
    """
    scorers = list(results[0].examination.scores)
    is_wide = console.width >= _FIXED_WIDTH + _SCORE_WIDTH * len(scorers)
    if not is_wide:
        scorers = []
        progress_console.print("a wider terminal, or --json, shows all scores", style="dim")
    table = Table(box=None, pad_edge=False)
    table.add_column("episode", no_wrap=True)
    table.add_column("decision", no_wrap=True)
    for heading in ("steps", *(s.replace("_", " ") for s in scorers)):
        table.add_column(heading, justify="right")
    if not is_wide:
        table.add_column("decided by", no_wrap=True)
    table.add_column("reason", ratio=1)
    for result in results:
        decision = result.decision
        cells = [
            Text(decision.name or decision.episode[:8]),
            Text(decision.verdict + _kept(result), VERDICT_STYLE[decision.verdict]),
            Text(str(result.examination.steps)),
            *(Text(_number(decision.scores.get(s))) for s in scorers),
        ]
        if not is_wide:
            cells += [Text(_decided_by(decision))]
        table.add_row(*cells, Text(decision.reason))
    return table


def _kept(result: Scored) -> str:
    """The part that is kept of a salvaged episode; empty for other verdicts."""
    if result.decision.verdict != "salvage":
        return ""
    span = result.decision.span
    first_s, last_s = (ns / NS_PER_S for ns in span)
    begins = f"from {first_s:.2f} s\n" if first_s >= _LATE_S else ""
    whole_s = max(result.examination.span[1], span[1]) / NS_PER_S
    return f"\n{begins}until {last_s:.2f} s\nof {whole_s:.2f} s"


def _decided_by(decision: Decision) -> str:
    """The scorer that decided, and its score; or the person."""
    if decision.by != CURATOR:
        return decision.by
    scorer = decision.evidence.get("decided_by", "")
    if not scorer:
        return "-"
    return f"{scorer.replace('_', ' ')}\n{_number(decision.scores.get(scorer))}"


def _number(score: float | None) -> str:
    return "-" if score is None else f"{score:.3g}"
