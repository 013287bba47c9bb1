"""The plan of a study: datasets, training sets, seeds and starts, fixed before anything runs."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from curation_ros.core.errors import ConfigError
from curation_ros.core.scorers import SCORERS, find_scorer, is_scorer
from curation_ros.core.yaml_file import read_yaml
from curation_ros.study.terms import Term, parse_row
from policy_node.settings import DEFAULTS
from sim_node.settings import MAX_STEPS, SIMULATED_TASK

#: What a stage is for. Results of `screen` are for exploring; nothing is claimed from them.
KINDS = ("protocol", "screen", "confirm")
#: Largest number of contrasts in a stage.
MAX_CONTRASTS = 12


@dataclass(frozen=True)
class Contrast:
    """A planned comparison: is a better than b?

    Attributes:
        a, b: training sets.
        pool: pool of both.
        variant: variant of the observations.
        why: the question that it answers.
    """

    a: str
    b: str
    pool: str
    variant: str
    why: str = ""


@dataclass(frozen=True)
class Stage:
    """Policies of some training sets, trained with some seeds, rolled out from some starts.

    Attributes:
        name: name of the stage.
        kind: one of KINDS.
        pools: contaminated datasets that training sets are taken from.
        variants: variants of the observations.
        seeds: training seeds, the same for every training set.
        starts: start states of the rollouts, such as official:0:50, the same for every policy.
        rows: training sets, in the order of the work.
        contrasts: planned comparisons. Their training sets count as rows.
        draw_seeds: number of training seeds for each named draw of a control. The draws divide
            the seeds among them.
    """

    name: str
    kind: str
    pools: tuple[str, ...]
    variants: tuple[str, ...]
    seeds: tuple[int, ...]
    starts: str
    rows: tuple[str, ...] = ()
    contrasts: tuple[Contrast, ...] = ()
    draw_seeds: int = 1

    def cells(self) -> list[tuple[str, str, str]]:
        """(pool, variant, row) of every training, in order."""
        planned = [(p, v, r) for p in self.pools for v in self.variants for r in self.rows]
        for one in self.contrasts:
            planned += [(one.pool, one.variant, one.a), (one.pool, one.variant, one.b)]
        return list(dict.fromkeys(planned))

    def seeds_of(self, row: str) -> tuple[int, ...]:
        """Training seeds of a row."""
        draws = [t.draw for t in parse_row(row) if t.draw is not None]
        if not draws:
            return self.seeds
        first = draws[0] % len(self.seeds)
        return tuple(self.seeds[(first + k) % len(self.seeds)] for k in range(self.draw_seeds))


@dataclass(frozen=True)
class StudyPlan:
    """A study.

    Attributes:
        name: name of the study and of its folder.
        question: the question that it answers.
        reference: parameters of the collection of trusted demonstrations.
        pools: name -> parameters of the collection of a contaminated dataset.
        stages: its stages, in order.
        budget_steps: simulation steps that all rollouts together may take.
        max_steps: largest number of commands in a rollout.
        gives_up: end rollouts that are lost early, see `policy_node.rollouts.GiveUp`.
        gradient_steps: gradient steps of each training.
        length: length control of the scorers, see `curation_ros.batch.audit_length.LENGTHS`.
        length_value: value of the length control.
        scorers: the scorers that are audited and that rows may name.
        keep_for_audit: number of episodes that the audit keeps.
        selection_seed: seed of ties and of the controls.
        looks_before: earlier looks at results on the official starts, a line each.
        more: parameters of the collection of further clean demonstrations; empty for none.
        simulated_task: task of collections and rollouts, a key of `sim_node.tasks.TASKS`.
        topic_map: YAML file of the topic map of collections and rollouts; empty: the default one.
        raw: the plan as it was written.
    """

    name: str
    question: str
    reference: Mapping[str, Any]
    pools: Mapping[str, Mapping[str, Any]]
    stages: tuple[Stage, ...]
    budget_steps: int = 4_000_000
    max_steps: int = MAX_STEPS
    gives_up: bool = True
    gradient_steps: int = DEFAULTS.steps
    length: str = "shortest-reference"
    length_value: float | None = None
    scorers: tuple[str, ...] = ()
    keep_for_audit: int = 60
    selection_seed: int = 0
    looks_before: tuple[str, ...] = ()
    more: Mapping[str, Any] = field(default_factory=dict)
    simulated_task: str = SIMULATED_TASK
    topic_map: str = ""
    raw: Mapping[str, Any] = field(default_factory=dict, compare=False)

    @property
    def hash(self) -> str:
        """Hash of the whole plan, including its contrasts."""
        return hashlib.sha256(json.dumps(self.raw, sort_keys=True).encode()).hexdigest()[:16]

    @property
    def collections(self) -> dict[str, Mapping[str, Any]]:
        """Name of each dataset -> parameters of its collection."""
        more = {"more": self.more} if self.more else {}
        return {"reference": self.reference, **more, **self.pools}

    def only(self, names: Sequence[str]) -> StudyPlan:
        """The plan with only some stages and the pools that they use; the hash stays the same.

        Raises:
            ConfigError: if a stage does not exist.
        """
        known = [stage.name for stage in self.stages]
        for name in names:
            if name not in known:
                raise ConfigError(f"no stage {name!r}; there are {', '.join(known)}")
        stages = tuple(stage for stage in self.stages if stage.name in names)
        used = {pool for stage in stages for pool, _, _ in stage.cells()}
        pools = {name: pool for name, pool in self.pools.items() if name in used}
        return replace(self, stages=stages, pools=pools)

    def terms(self, pool: str) -> set[Term]:
        """All terms of the rows of a pool."""
        return {
            term
            for stage in self.stages
            for name, _, row in stage.cells()
            if name == pool
            for term in parse_row(row)
        }


def read_plan(path: Path) -> StudyPlan:
    """Read the YAML file of a study; `contrasts_file` of a stage is relative to its folder.

    Raises:
        ConfigError: naming the file and the key that is wrong.
    """
    raw = _read_mapping(path)
    for stage in raw.get("stages") or ():
        beside = stage.pop("contrasts_file", None) if isinstance(stage, dict) else None
        if beside is not None:
            contrasts = _read_mapping(path.parent / str(beside))
            stage["contrasts"] = contrasts.get("contrasts")
    try:
        return plan_from(raw)
    except ConfigError as err:
        raise ConfigError(f"study {path}: {err}") from err
    except (KeyError, TypeError, ValueError, AttributeError) as err:
        raise ConfigError(f"study {path}: {type(err).__name__}: {err}") from err


def plan_from(raw: Mapping[str, Any]) -> StudyPlan:
    """Make a plan from plain data.

    Raises:
        ConfigError: if a key is unknown or missing, or a value is wrong.
    """
    given = _checked(raw, StudyPlan, "plan", leave=("raw",))
    stages = []
    for entry in given.pop("stages"):
        stage = _checked(entry, Stage, "stage")
        where = f"stage {stage['name']!r}"
        contrasts = tuple(
            Contrast(**_checked(c, Contrast, f"{where}, contrast"))
            for c in stage.pop("contrasts", ())
        )
        rows = tuple(r for text in stage.pop("rows", ()) for r in _expanded(text, where))
        for key in ("pools", "variants"):
            stage[key] = _names(stage[key], f"{where}: {key}")
        stage["seeds"] = tuple(int(s) for s in stage["seeds"])
        stages.append(Stage(**stage, rows=rows, contrasts=contrasts))
    given["scorers"] = _names(given.get("scorers") or tuple(SCORERS), "scorers")
    given["looks_before"] = tuple(str(t) for t in given.get("looks_before", ()))
    plan = StudyPlan(**given, stages=tuple(stages), raw=json.loads(json.dumps(raw)))
    _check(plan)
    return plan


def _check(plan: StudyPlan) -> None:
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]*", plan.name):
        raise ConfigError(f"name {plan.name!r}: letters, digits, '.', '_' and '-' only")
    if not plan.stages or not plan.pools:
        raise ConfigError("a study needs pools and stages")
    for name in {"reference", "more"} & set(plan.pools):
        raise ConfigError(f"a pool cannot be called {name!r}: another dataset has that name")
    for name in plan.scorers:
        find_scorer(name)
    names = [stage.name for stage in plan.stages]
    if len(set(names)) < len(names):
        raise ConfigError(f"stages {names}: two of them have the same name")
    for stage in plan.stages:
        where = f"stage {stage.name!r}"
        _check_stage(stage, where)
        for pool, _, row in stage.cells():
            if pool not in plan.pools:
                raise ConfigError(f"{where}: no pool {pool!r}; there are {', '.join(plan.pools)}")
            for term in parse_row(row):
                _check_term(plan, pool, term, f"{where}: {row!r}")


def _check_stage(stage: Stage, where: str) -> None:
    if stage.kind not in KINDS:
        raise ConfigError(f"{where}: kind {stage.kind!r} is none of {', '.join(KINDS)}")
    if not stage.seeds or len(set(stage.seeds)) < len(stage.seeds):
        raise ConfigError(f"{where}: seeds {stage.seeds}: expected at least one, each only once")
    if len(stage.contrasts) > MAX_CONTRASTS:
        raise ConfigError(
            f"{where}: {len(stage.contrasts)} contrasts, at most {MAX_CONTRASTS} are planned"
        )
    if not 1 <= stage.draw_seeds <= len(stage.seeds):
        raise ConfigError(f"{where}: draw_seeds {stage.draw_seeds} of {len(stage.seeds)} seeds")


def _check_term(plan: StudyPlan, pool: str, term: Term, where: str) -> None:
    source = "more" if term.name == "more" else pool
    if source not in plan.collections:
        raise ConfigError(f"{where}: the plan has no dataset {source!r}")
    n = int(plan.collections[source]["episodes"])
    if term.keep is not None and term.keep > n:
        raise ConfigError(f"{where} keeps more than the {n} of {source}")
    if is_scorer(term.name) and term.name not in plan.scorers:
        raise ConfigError(f"{where}: {term.name} is none of the plan's scorers")


def _expanded(text: str, where: str) -> list[str]:
    """Expand `knn@{12,16}` and `random@16#{0..9}` to several rows."""
    if not isinstance(text, str):
        raise ConfigError(f"{where}: row {text!r:.60}: expected a text such as knn@16")
    braces = re.search(r"\{([^}]*)\}", text)
    if not braces:
        parse_row(text)
        return [text]
    limits = re.fullmatch(r"\s*([0-9]+)\.\.([0-9]+)\s*", braces[1])
    values = (
        [str(k) for k in range(int(limits[1]), int(limits[2]) + 1)]
        if limits
        else [v.strip() for v in braces[1].split(",")]
    )
    before, after = text[: braces.start()], text[braces.end() :]
    return [row for value in values for row in _expanded(before + value + after, where)]


def _names(value: Any, what: str) -> tuple[str, ...]:
    if not isinstance(value, list | tuple) or not all(isinstance(v, str) for v in value):
        raise ConfigError(f"{what} is {value!r:.60}, expected a list of names")
    return tuple(value)


def _checked(raw: Any, kind: type[Any], what: str, leave: Sequence[str] = ()) -> dict[str, Any]:
    """A mapping with all keys that a dataclass requires and none that it lacks."""
    if not isinstance(raw, Mapping):
        raise ConfigError(f"{what}: expected a mapping, found {raw!r:.60}")
    known = {f.name: f for f in fields(kind) if f.name not in leave}
    for key in raw:
        if key not in known:
            raise ConfigError(f"{what}: unknown key {key!r}; known are {', '.join(known)}")
    for name, one in known.items():
        needed = one.default is MISSING and one.default_factory is MISSING
        if needed and name not in raw:
            raise ConfigError(f"{what}: no key {name!r}")
    return dict(raw)


def _read_mapping(path: Path) -> dict[str, Any]:
    raw = read_yaml(path, "study")
    if not isinstance(raw, dict):
        raise ConfigError(f"study {path}: expected a mapping, found {raw!r:.60}")
    return raw
