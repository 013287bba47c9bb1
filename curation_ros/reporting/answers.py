"""The answer in a few sentences, composed from the values in `results.json`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from curation_ros.core.types import JsonObject
from curation_ros.reporting.cells import number, percent, place, points, probability
from curation_ros.reporting.rows import (
    groups,
    has_scorers,
    is_resolved,
    kept_by_scorers,
    main_keep,
    row_named,
    stages_of_kind,
)


def answers(results: JsonObject) -> list[str]:
    """The answer in a few sentences; they report missing data."""
    return [
        _completeness(results),
        *_harm(results),
        *_curator(results),
        *_detection(results),
        *_contrasts(results),
        *_rivals(results),
    ]


def _completeness(results: JsonObject) -> str:
    """How many rollouts were done, and how many are missing."""
    budget = results["budget"]
    missing = {s["name"]: s["missing"] for s in results["stages"] if s["missing"]}
    text = f"{budget['rollouts']} rollouts of {budget['policies']} policies are done"
    if not missing:
        return f"{text}, and none that were planned are missing."
    parts = ", ".join(f"{n} in stage {name}" for name, n in missing.items())
    return (
        f"{text}; outcomes are MISSING: {parts} (counted once for each row). What follows is of "
        "those that are there."
    )


def _harm(results: JsonObject) -> Iterator[str]:
    """Whether the defective demonstrations hurt at all."""
    for stage in (
        *stages_of_kind(results, "confirm"),
        *stages_of_kind(results, "protocol", "screen"),
    ):
        pairs = []
        for _, _, rows in groups(stage):
            base, best = row_named(rows, "everything"), row_named(rows, "oracle")
            if base and best and base["rate"] is not None and best["rate"] is not None:
                pairs.append((base["rate"], best["rate"]))
        if pairs:
            yield (
                f"Stage {stage['name']}: trained on everything, policies succeed in "
                f"{_range([a for a, _ in pairs])} of rollouts, trained on the good demonstrations "
                f"alone (oracle) in {_range([b for _, b in pairs])} ({_places(len(pairs))})."
            )
            return
    yield "There are no outcomes yet of both everything and oracle: whether it hurts is open."


def _curator(results: JsonObject) -> Iterator[str]:
    """What the curator decided without a reference, in studies that use its decisions."""
    pools = [pool for pool in results["pools"].values() if "curator" in pool]
    decided = [pool["curator"]["verdicts"] for pool in pools]
    if not decided:
        return

    def total(verdict: str, label: str) -> int:
        return sum(int(verdicts[verdict][label]) for verdicts in decided)

    n_good, n_defective = (
        sum(total(verdict, label) for verdict in decided[0]) for label in ("good", "defective")
    )
    yield (
        f"Without a reference the curator keeps {total('keep', 'good')} of {n_good} good "
        f"demonstrations and {total('keep', 'defective')} of {n_defective} defective ones, and "
        f"salvages a beginning of {total('salvage', 'good')} and {total('salvage', 'defective')}."
    )


def _detection(results: JsonObject) -> Iterator[str]:
    """Whether a scorer that detects better makes a better policy."""
    for stage in stages_of_kind(results, "protocol", "screen"):
        rhos, best, worst, n = [], 0, 0, 0
        for pool, _, rows in groups(stage):
            keep = main_keep(results, pool, rows)
            done = [
                r
                for r in kept_by_scorers(rows, keep)
                if r["rate"] is not None and r["auroc"] is not None and r["scorer"] != "length"
            ]
            if len(done) < 3:
                continue
            n += 1
            top = [r for r in done if r["auroc"] == max(r["auroc"] for r in done)]
            rates = [r["rate"] for r in done]
            best += any(r["rate"] == max(rates) for r in top)
            worst += any(r["rate"] == min(rates) for r in top)
            rhos += [
                c
                for c in stage["correlations"]
                if c["against"] == "auroc"
                and (c["pool"], c["variant"], c["keep"]) == (pool, rows[0]["variant"], keep)
                and c["rho"] is not None
            ]
        if n:
            yield (
                f"Stage {stage['name']}{_caveat(stage)}: the scorer of the highest AUROC gives "
                f"the best policy of all scorers in {best} of {n} and the worst in {worst} of {n} "
                f"({_places(n)}, ties count)" + _rhos(rhos) + "."
            )
            return
    if next(stages_of_kind(results, "protocol", "screen"), None) and has_scorers(results):
        yield "Too few scorers have outcomes to compare detection with success."


def _rhos(correlations: Sequence[JsonObject]) -> str:
    """End of the sentence on detection: the rank correlations."""
    if not correlations:
        return "; no rank correlation can be computed"
    values = sorted(c["rho"] for c in correlations)
    intervals = [c["interval"] for c in correlations if c["interval"]]
    n_clear = sum(low > 0 or high < 0 for low, high in intervals)
    low, high = number(values[0], 2), number(values[-1], 2)
    spread = low if low == high else f"{low} to {high}"
    return (
        f"; Spearman's rho of AUROC and success is {spread}, with an interval that excludes 0 in "
        f"{n_clear} of {len(correlations)}"
    )


def _contrasts(results: JsonObject) -> Iterator[str]:
    """Which planned contrasts are resolved."""
    for stage in stages_of_kind(results, "confirm"):
        planned = stage["contrasts"]
        made = [c for c in planned if c.get("value") is not None]
        clear = [c for c in made if is_resolved(c)]
        worst = max((c["p_holm"] for c in clear), default=None)
        yield (
            f"Of {len(planned)} planned contrasts {len(clear)} are resolved"
            + (f" (adjusted p at most {probability(worst)})" if clear else "")
            + f"; {len(made) - len(clear)} are not, {len(planned) - len(made)} have no data."
        )
        where: dict[str, list[str]] = {}
        for c in clear:
            difference = f"{c['a']} minus {c['b']} {points(c['value'])}"
            where.setdefault(place(c), []).append(difference)
        for there, differences in where.items():
            yield f"Resolved in {there}, in percentage points: {', '.join(differences)}."


def _rivals(results: JsonObject) -> Iterator[str]:
    """How many scorers beat the best row that needs no more than they do."""
    for stage in stages_of_kind(results, "protocol", "screen"):
        judged = [r for r in stage["rows"] if r["rival"] is not None]
        if not judged and not has_scorers(results):
            continue
        if not judged:
            yield f"Stage {stage['name']} has no outcomes of scorers yet."
            continue
        ahead = [r for r in judged if r["rival"]["difference"] > 0]
        text = (
            f"Stage {stage['name']}{_caveat(stage)}: {len(ahead)} of {len(judged)} rows with a "
            "scorer succeed more often than the best row that needs no more"
        )
        if ahead:
            top = max(ahead, key=lambda r: r["rival"]["difference"])
            text += (
                f"; furthest ahead is {top['row']}, {percent(top['rate'])} against "
                f"{percent(top['rival']['rate'])} of {top['rival']['row']}"
            )
        yield text + "."


def _caveat(stage: JsonObject) -> str:
    """What limits a sentence about a stage that confirms nothing."""
    if stage["kind"] == "screen":
        return " (a look, not a claim)"
    return f" ({len(stage['seeds'])} training seeds)"


def _places(n: int) -> str:
    return f"{n} combination{'s' if n > 1 else ''} of pool and observations"


def _range(rates: Sequence[float]) -> str:
    low, high = percent(min(rates)), percent(max(rates))
    return low if low == high else f"{low.removesuffix(' %')} to {high}"
