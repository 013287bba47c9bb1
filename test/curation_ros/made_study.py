"""Studies with made-up outcomes, through the functions that make real `results.json`."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scenes import LIFT_AT, RELEASE_AT, scene

from curation_ros.batch.published import TABLE_1
from curation_ros.core.episode.episode import Episode
from curation_ros.core.statistics import detection
from curation_ros.dataset.dataset import Dataset
from curation_ros.study.curated import compare_with_truth, curate, timeline_of
from curation_ros.study.plan import StudyPlan, plan_from
from curation_ros.study.pools import POINTS_PER_PHASE, Pool
from curation_ros.study.results import results
from curation_ros.study.running import Cell, Study
from curation_ros.study.terms import DECIDED
from curation_ros.study.training_sets import training_set
from curation_ros.study.trials import PolicyTrials
from sim_node.tasks import start_names

N_POINTS = 6 * POINTS_PER_PHASE
#: How well each made-up scorer tells good from bad: shift of the good ones' scores.
SKILL = {
    "knn": 9.0, "gripper_timing": 2.5, "ensemble": 2.0, "trajectory_alignment": 0.7,
    "isolation_forest": 0.3, "smoothness": 0.0, "entropy": -9.0,
}  # fmt: skip


def small_plan(**changes: Any) -> StudyPlan:
    """A stage of each kind, few of everything."""
    collected = {"episodes": 20, "contamination": 0.6, "defect": "early_release", "seed": 1}
    stage = {"pools": ["paired"], "variants": ["relative", "fingers"], "seeds": [1, 2, 3]}
    ranked = [f"{name}@{{4,8,12}}" for name in ("knn", "gripper_timing", "entropy")]
    stages = [
        {
            **stage, "name": "paper", "kind": "protocol", "starts": "generated:21:4",
            "rows": ["everything", "oracle", *(f"{name}@12" for name in SKILL)],
        },
        {
            **stage, "name": "screening", "kind": "screen", "starts": "generated:22:4",
            "variants": ["relative"],
            "rows": [
                "everything", "oracle", "reference", "reference+everything", "button%{0,30}",
                *ranked, "oracle@{12,16}", "random@{4,8,12}#{0..2}", "worst@{4,8,12}",
                "shuffled@{4,8,12}", "reference+knn@8", "knn_label_free@{4,8,12}",
            ],
        },
        {
            **stage, "name": "confirmation", "kind": "confirm", "starts": "official:0:4",
            "variants": ["relative"], "seeds": [1, 2, 3, 4, 5, 6, 7, 8],
            "contrasts": [
                {"a": "oracle", "b": "everything", "why": "does <it> hurt?"},
                {"a": "knn@8", "b": "random@8", "why": "is it worth | anything?"},
            ],
        },
    ]  # fmt: skip
    for contrast in stages[2]["contrasts"]:
        contrast |= {"pool": "paired", "variant": "relative"}
    raw = {
        "name": "made",
        "question": "Is <this> & that a question?",
        "reference": collected,
        "pools": {"paired": collected},
        "scorers": [*SKILL, "length", "knn_label_free"],
        "keep_for_audit": 12,
        "looks_before": ["a prototype's"],
        "stages": stages,
    }
    return plan_from({**raw, **changes})


def salvage_plan() -> StudyPlan:
    """What the curator decides, with a sweep of the margin, and contrasts."""
    collected = {"episodes": 6, "contamination": 0.5, "defect": "early_release", "seed": 1}
    stage = {"pools": ["some"], "variants": ["relative"], "seeds": [1, 2, 3]}
    rows = ["decided", "decided+salvaged", "decided+random_cut"]
    contrast = {"a": "decided+salvaged", "b": "decided", "pool": "some", "variant": "relative"}
    stages = [
        {
            **stage, "name": "margins", "kind": "screen", "starts": "generated:22:4",
            "rows": ["oracle", *rows, "decided+salvaged-{0,5,15}"],
        },
        {
            **stage, "name": "sure", "kind": "confirm", "starts": "official:0:4",
            "rows": ["everything", *rows], "contrasts": [contrast],
        },
    ]  # fmt: skip
    return small_plan(
        pools={"some": collected}, scorers=["knn", "length"], keep_for_audit=3, stages=stages
    )


def made_results(
    folder: Path, plan: StudyPlan, *, share: float = 1.0, problems: tuple[str, ...] = ()
) -> dict[str, Any]:
    """What `results.json` would hold, had the rollouts ended as made up here.

    Args:
        folder: of the study.
        plan: of it.
        share: of the rollouts that have an outcome.
        problems: of the run.
    """
    rng = np.random.default_rng(20260608)
    reference = Dataset(folder / "reference", create=True)
    for k in range(3):
        (reference.path / "episodes" / f"trusted-{k}").mkdir()
    pools = {name: _pool(folder, name, plan, rng) for name in plan.pools}
    cells = []
    for stage in plan.stages:
        for pool, variant, row in stage.cells():
            seeds = stage.seeds_of(row)
            sets = {
                seed: training_set(pools[pool], row, reference, 0, stage.seeds.index(seed))
                for seed in seeds
            }
            cells.append(Cell(stage, variant, sets))
    timelines = {i: made for pool in pools.values() for i, made in pool.timelines.items()}
    trials = PolicyTrials(folder, max_steps=plan.max_steps, budget_steps=plan.budget_steps)
    with (folder / "units.jsonl").open("a") as log:
        for line in _units(cells, share, rng):
            log.write(json.dumps(line) + "\n")
    study = Study(
        plan=plan,
        trials=trials,
        pools=pools,
        reference=reference,
        cells=tuple(cells),
        problems=problems,
        seconds=({"what": "roll", "part": "paper", "units": 12, "steps": 99, "seconds": 1.25},),
        n_reference=3,
        timelines=timelines,
    )
    made: dict[str, Any] = json.loads(json.dumps(results(study), allow_nan=False))
    return made


def _units(cells: list[Cell], share: float, rng: np.random.Generator) -> list[dict[str, Any]]:
    """The log of the trials: purer sets do better, as the seed has it."""
    rows: dict[tuple[str, str], dict[str, Any]] = {}
    for cell in cells:
        for seed, made in cell.sets.items():
            policy = cell.policies[seed]
            n = made.n_pool + made.n_reference
            pure = (made.n_good + made.n_reference) / n if n else 0.0
            chance = float(np.clip(pure + rng.normal(0, 0.25), 0.02, 0.97))
            rows[policy, ""] = {"kind": "policy", "policy": policy, "status": "ok"}
            for start in start_names(cell.stage.starts):
                if rng.random() < share:
                    success = bool(rng.random() < chance)
                    rows[policy, start] = {
                        "kind": "rollout", "policy": policy, "start": start, "success": success,
                        "steps": 200, "stage": "RELEASE" if success else "LIFT",
                        "ended": "success" if success else "lost", "status": "ok", "reason": "",
                    }  # fmt: skip
    return list(rows.values())


def _pool(folder: Path, name: str, plan: StudyPlan, rng: np.random.Generator) -> Pool:
    n = int(plan.pools[name]["episodes"])
    n_good = round(n * (1 - float(plan.pools[name]["contamination"])))
    ids = [f"{name}-{k:03}" for k in range(n)]
    good = {i: k < n_good for k, i in enumerate(ids)}
    scores = {
        scorer: {
            i: float(rng.normal() + good[i] * SKILL.get(scorer.removesuffix("_label_free"), 0.0))
            for i in ids
        }
        for scorer in plan.scorers
    }
    needs = {s: ("pool",) if s.endswith("_free") else ("reference",) for s in plan.scorers}
    curated, timelines, curator = None, {}, {}
    if any(term.name in DECIDED for term in plan.terms(name)):
        carried = list(_carried(good, rng))
        margins = {t.margin for t in plan.terms(name) if t.margin is not None}
        curated = curate([episode for episode, _ in carried], margins)
        timelines = {e.id: timeline_of(e) for e, _ in carried}
        released = {e.id: at for e, at in carried if not good[e.id]}
        curator = {"curator": compare_with_truth(curated, good, released, timelines)}
    return Pool(
        name=name,
        dataset=Dataset(folder / name, create=True),
        episodes=tuple(ids),
        names={i: i for i in ids},
        good=good,
        scores=scores,
        needs=needs,
        audited=[_audited(scorer, scores[scorer], good, needs[scorer], plan) for scorer in scores],
        notes=["a note of the audit"],
        traces=[_trace(i, good[i]) for i in ids],
        facts={
            "n": n,
            "n_good": n_good,
            "n_starts": n,
            "steps": [300] * n_good + [500] * (n - n_good),
            "release_steps": [140, 150],
            "length_control": {
                "mode": "shortest-reference", "value": None, "steps": 215, "needs": "reference",
            },
            "phases": ["FIRST", "SECOND", "THIRD", "FOURTH", "FIFTH", "SIXTH"],
            "scoring_hash": "0" * 16,
            **curator,
        },
        timelines=timelines,
        curated=curated,
    )  # fmt: skip


def _audited(
    scorer: str,
    scores: dict[str, float],
    good: dict[str, bool],
    needs: tuple[str, ...],
    plan: StudyPlan,
) -> dict[str, Any]:
    """The row of an audit on these scores."""
    n_good = sum(good.values())
    auroc = detection.auroc(list(scores.values()), list(good.values()))
    interval = list(detection.auroc_interval(auroc, n_good, len(good) - n_good))
    paper = TABLE_1.get(scorer)
    return {
        "scorer": scorer,
        "needs": needs[0],
        "auroc_raw": min(1.0, auroc + 0.1),
        "ci_raw": interval,
        "auroc_controlled": auroc,
        "ci": interval,
        "keep": plan.keep_for_audit,
        "precision": 0.25,
        "clean_recall": 0.5,
        "paper": paper.to_json() if paper else None,
        "notes": ["12 abstained: <why>"] if scorer == "entropy" else [],
    }


def _carried(good: dict[str, bool], rng: np.random.Generator) -> Iterator[tuple[Episode, int]]:
    """An object that is carried, or lost, under each id; and when it was let go."""
    for k, (i, is_good) in enumerate(good.items()):
        at = RELEASE_AT if is_good else LIFT_AT + 20 + 5 * k
        made = scene(dropped_at=at, opened_at=at)
        # Without noise a recording counts as frozen.
        moving = ("eef_position", "bowl_position", "plate_position", "joint_position")
        fields = {
            name: values + (name in moving) * 1e-5 * rng.standard_normal(values.shape)
            for name, values in made.fields.items()
        }
        yield replace(made, id=i, name=i, fields=fields), at


def _trace(episode: str, good: bool) -> dict[str, Any]:
    rise = [0.0] * 24 + [0.02 * k for k in range(24)]
    held = [-1.0] * 16 + [1.0] * (24 if good else 8) + [-1.0] * (8 if good else 24)
    heights: list[float | None] = [0.9 + (x if good else 0.0) for x in rise]
    heights[-1] = None
    return {
        "episode": episode,
        "name": episode,
        "good": good,
        "object_height_m": heights,
        "effector_height_m": heights,
        "gripper": held,
    }
