"""The section of a report on how a study was done."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from curation_ros.core.types import JsonObject
from curation_ros.reporting.blocks import Block, Points, Table, Text, missing
from curation_ros.reporting.cells import NOTHING, names
from curation_ros.reporting.tables import mapping, wall_times

_PHASES = (
    "Who supplies the phase: the simulator's phase tracker publishes it, to the recorder and to "
    "the policy alike. It is a script that reads the end-effector, the fingers, the start "
    "positions and a counter; it never reads the live pose of the object or the success."
)
_VARIANTS = {
    "relative": "effector position, start positions of object and goal, their offsets from the "
    "effector, phase; no fingers",
    "fingers": "the same and the finger positions, as the paper has them",
}


def method_blocks(results: JsonObject) -> Iterator[Block]:
    """Everything that somebody needs to judge or to repeat the study."""
    if results["problems"]:
        yield missing(f"{len(results['problems'])} problems:")
        yield Points(tuple(str(p) for p in results["problems"]))
    else:
        yield Text("The last run reported no problem.")
    if results.get("stages_left_out"):
        yield missing(
            f"the last run was not asked for stages {', '.join(results['stages_left_out'])}."
        )
    yield Text(
        "Every figure here, the paper's excepted, stands in results.json, with the outcome of "
        "every rollout and the plan."
    )
    yield Text(_PHASES)
    yield Table(
        "Observations of the policies.",
        ("variant", "what a policy sees"),
        tuple(
            (v, _VARIANTS.get(v, NOTHING))
            for v in dict.fromkeys(v for s in results["stages"] for v in s["variants"])
        ),
        text=(0, 1),
    )
    yield _stages(results)
    yield _demonstrations(results)
    yield _scorer_needs(results)
    yield from _official_looks(results)
    yield _budget(results)
    yield mapping("Versions.", {**results["versions"], **results["machine"]})
    times = wall_times(results)
    yield times if times else missing("wall times.")


def _stages(results: JsonObject) -> Table:
    return Table(
        "Stages. The same training seeds and starts for every training set of a stage; the "
        "training seed is the unit of every interval and p-value.",
        ("stage", "kind", "pools", "observations", "training seeds", "starts", "missing"),
        tuple(
            (
                s["name"],
                s["kind"],
                ", ".join(s["pools"]),
                ", ".join(s["variants"]),
                ", ".join(str(seed) for seed in s["seeds"]),
                _starts(s["starts"]),
                str(s["missing"]),
            )
            for s in results["stages"]
        ),
        text=(0, 1, 2, 3, 4, 5),
    )


def _official_looks(results: JsonObject) -> Iterator[Block]:
    """How often anybody has looked at results on the official start states."""
    looks = results["official_looks"]
    n_looks = len(looks["before"]) + len(looks["here"])
    yield Text(f"Looks at the official starts: {n_looks}" + (", namely" if n_looks else "."))
    if n_looks:
        here = [f"stage {name} of this study" for name in looks["here"]]
        yield Points((*(f"before: {text}" for text in looks["before"]), *here))


def _demonstrations(results: JsonObject) -> Table:
    plan = results["plan"]
    more = {"more": plan["more"]} if plan.get("more") else {}
    collected = {"reference": plan.get("reference", {}), **more, **plan.get("pools", {})}
    rows = []
    for name, settings in collected.items():
        pool = results["pools"].get(name, {})
        n = pool.get("n", NOTHING)
        if name == "reference":
            n = results["reference"].get("n", NOTHING)
        steps, released = pool.get("steps"), pool.get("release_steps")
        rows.append(
            (
                name,
                ", ".join(f"{key} {value}" for key, value in settings.items()),
                str(n),
                str(pool.get("n_good", NOTHING)),
                f"{min(steps)} to {max(steps)}" if steps else NOTHING,
                f"{min(released)} to {max(released)}" if released else NOTHING,
            )
        )
    return Table(
        "Demonstrations of the scripted expert.",
        ("dataset", "collected with", "n", "good", "steps", "release at step"),
        tuple(rows),
        text=(0, 1),
    )


def _scorer_needs(results: JsonObject) -> Table:
    scorers = dict.fromkeys(s for pool in results["pools"].values() for s in pool["needs"])
    return Table(
        "What each scorer needed, its length control included.",
        ("scorer", *results["pools"]),
        tuple(
            (
                scorer,
                *(
                    names(pool["needs"].get(scorer, [NOTHING]))
                    for pool in results["pools"].values()
                ),
            )
            for scorer in scorers
        ),
        text=tuple(range(1 + len(results["pools"]))),
    )


def _budget(results: JsonObject) -> Table:
    budget, plan = results["budget"], results["plan"]
    gives_up = (
        "yes: the object lost, or too long in one phase; such a rollout counts as failed"
        if budget.get("gives_up")
        else "no"
    )
    return mapping(
        "Budget and settings.",
        {
            "simulation steps declared": budget["declared_steps"],
            "simulation steps used": budget["used_steps"],
            "steps of a rollout, at most": budget["max_steps"],
            "ended early when as good as lost": gives_up,
            "rollouts": budget["rollouts"],
            "policies": budget["policies"],
            "gradient steps of a training": plan.get("gradient_steps", NOTHING),
            "selection seed": plan.get("selection_seed", NOTHING),
            "hash of the plan": results["plan_hash"],
            "written": results["created_at"],
        },
    )


def _starts(names: Sequence[str]) -> str:
    if len(names) < 3:
        return ", ".join(names)
    return f"{len(names)}: {names[0]} to {names[-1]}"
