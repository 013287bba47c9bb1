"""The answer in a few sentences: each holds a figure of `results.json`, and none is prepared."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from curation_ros.reporting.findings import (
    Row,
    at_keep,
    groups,
    has_scorers,
    main_keep,
    named,
    stages,
)
from curation_ros.reporting.tables import number, percent, points, probability

#: Below this an adjusted p counts.
ALPHA = 0.05


def answers(found: Row) -> list[str]:
    """A few sentences; where data are missing they say so."""
    return [
        _done(found),
        *_harm(found),
        *_decided(found),
        *_detection(found),
        *_claims(found),
        *_looks(found),
    ]


def _done(found: Row) -> str:
    budget = found["budget"]
    missing = {s["name"]: s["missing"] for s in found["stages"] if s["missing"]}
    text = f"{budget['rollouts']} rollouts of {budget['policies']} policies are done"
    if not missing:
        return f"{text}, and none that were planned are missing."
    parts = ", ".join(f"{n} in stage {name}" for name, n in missing.items())
    return (
        f"{text}; outcomes are MISSING: {parts} (counted once for each row). What follows is of "
        "those that are there."
    )


def _harm(found: Row) -> Iterator[str]:
    """Whether the contamination hurts at all."""
    for stage in (*stages(found, "confirm"), *stages(found, "protocol", "screen")):
        pairs = []
        for _, _, rows in groups(stage):
            base, best = named(rows, "everything"), named(rows, "oracle")
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


def _decided(found: Row) -> Iterator[str]:
    """What the curator made of the pools by itself, where the study has asked it."""
    asked = [pool["curator"]["verdicts"] for pool in found["pools"].values() if "curator" in pool]
    if not asked:
        return

    def total(verdict: str, label: str) -> int:
        return sum(int(verdicts[verdict][label]) for verdicts in asked)

    n_good, n_defective = (
        sum(total(verdict, label) for verdict in asked[0]) for label in ("good", "defective")
    )
    yield (
        f"Without a reference the curator keeps {total('keep', 'good')} of {n_good} good "
        f"demonstrations and {total('keep', 'defective')} of {n_defective} defective ones, and "
        f"salvages a beginning of {total('salvage', 'good')} and {total('salvage', 'defective')}."
    )


def _detection(found: Row) -> Iterator[str]:
    """Whether a better detector makes a better policy."""
    for stage in stages(found, "protocol", "screen"):
        rhos, best, worst, n = [], 0, 0, 0
        for pool, _, rows in groups(stage):
            keep = main_keep(found, pool, rows)
            done = [
                r
                for r in at_keep(rows, keep)
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
                f"Stage {stage['name']}{_look(stage)}: the scorer of the highest AUROC gives the "
                f"best policy of all scorers in {best} of {n} and the worst in {worst} of {n} "
                f"({_places(n)}, ties count)" + _rhos(rhos) + "."
            )
            return
    if next(stages(found, "protocol", "screen"), None) and has_scorers(found):
        yield "Too few scorers have outcomes to compare detection with success."


def _rhos(found: Sequence[Row]) -> str:
    if not found:
        return "; no rank correlation can be computed"
    values = sorted(c["rho"] for c in found)
    clear = [c for c in found if c["interval"] and (c["interval"][0] > 0 or c["interval"][1] < 0)]
    low, high = number(values[0], 2), number(values[-1], 2)
    spread = low if low == high else f"{low} to {high}"
    return (
        f"; Spearman's rho of AUROC and success is {spread}, with an interval that excludes 0 in "
        f"{len(clear)} of {len(found)}"
    )


def _claims(found: Row) -> Iterator[str]:
    """What the planned contrasts resolve."""
    for stage in stages(found, "confirm"):
        planned = stage["contrasts"]
        made = [c for c in planned if c.get("value") is not None]
        clear = [c for c in made if c["p_holm"] is not None and c["p_holm"] < ALPHA]
        worst = max((c["p_holm"] for c in clear), default=None)
        yield (
            f"Of {len(planned)} planned contrasts {len(clear)} are resolved"
            + (f" (adjusted p at most {probability(worst)})" if clear else "")
            + f"; {len(made) - len(clear)} are not, {len(planned) - len(made)} have no data."
        )
        where: dict[str, list[str]] = {}
        for c in clear:
            said = f"{c['a']} minus {c['b']} {points(c['value'])}"
            where.setdefault(f"{c['pool']}, {c['variant']}", []).append(said)
        for place, differences in where.items():
            yield f"Resolved in {place}, in percentage points: {', '.join(differences)}."


def _looks(found: Row) -> Iterator[str]:
    """How many scorers are of use, by the rows that cost no more."""
    for stage in stages(found, "protocol", "screen"):
        judged = [r for r in stage["rows"] if r["rival"] is not None]
        if not judged and not has_scorers(found):
            continue
        if not judged:
            yield f"Stage {stage['name']} has no outcomes of scorers yet."
            continue
        ahead = [r for r in judged if r["rival"]["difference"] > 0]
        text = (
            f"Stage {stage['name']}{_look(stage)}: {len(ahead)} of {len(judged)} rows with a "
            "scorer succeed more often than the best row that needs no more"
        )
        if ahead:
            top = max(ahead, key=lambda r: r["rival"]["difference"])
            text += (
                f"; furthest ahead is {top['row']}, {percent(top['rate'])} against "
                f"{percent(top['rival']['rate'])} of {top['rival']['row']}"
            )
        yield text + "."


def _look(stage: Row) -> str:
    """What a sentence about a stage that confirms nothing says of itself."""
    if stage["kind"] == "screen":
        return " (a look, not a claim)"
    return f" ({len(stage['seeds'])} training seeds)"


def _places(n: int) -> str:
    return f"{n} combination{'s' if n > 1 else ''} of pool and observations"


def _range(rates: Sequence[float]) -> str:
    low, high = percent(min(rates)), percent(max(rates))
    return low if low == high else f"{low.removesuffix(' %')} to {high}"
