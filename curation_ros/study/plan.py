"""The plan of a study: datasets, training sets, seeds, starts; all of it before anything runs."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, TypeVar

import yaml

from curation_ros.core.errors import ConfigError
from curation_ros.core.scorers import SCORERS
from curation_ros.study.terms import Term, parse_row

#: What a stage is for. `screen` figures are for looking around: nothing is claimed from them.
KINDS = ("protocol", "screen", "confirm")
#: Most contrasts of a stage that confirms.
MAX_CONTRASTS = 12


@dataclass(frozen=True)
class Contrast:
    """A planned comparison: is a better than b?

    Attributes:
        a, b: training sets.
        pool: whose.
        variant: of the observations.
        why: the question, in words.
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
        name: of the stage.
        kind: one of KINDS.
        pools: contaminated datasets that training sets are made of.
        variants: of the observations.
        seeds: of the training; the same for every training set.
        starts: of the rollouts, such as official:0:50; the same for every policy.
        rows: training sets, in the order in which they are worked on.
        contrasts: planned comparisons; training sets that these need are rows, too.
        draw_seeds: seeds of each draw of a control that is named with its draw; draws share the
            seeds out.
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
        """(pool, variant, row) of all that is to be trained, in order."""
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
        name: of its folder.
        question: in words.
        reference: parameters of the collection of trusted demonstrations.
        pools: name -> parameters of the collection of a contaminated dataset.
        stages: in order.
        budget_steps: simulation steps that its rollouts may take.
        max_steps: most commands of a rollout.
        gives_up: end a rollout that is as good as lost, see `policy_node.rollouts.GiveUp`.
        gradient_steps: of each training.
        length: length control of the scorers, see `curation_ros.batch.audit.LENGTHS`.
        length_value: its value.
        scorers: audited, and ranked by.
        keep_for_audit: how many the audit's table keeps.
        selection_seed: orders equal scores, and draws the controls.
        looks_before: earlier looks at the official starts, in words; a line each.
        more: parameters of the collection of further clean demonstrations; none: none are there.
    """

    name: str
    question: str
    reference: Mapping[str, Any]
    pools: Mapping[str, Mapping[str, Any]]
    stages: tuple[Stage, ...]
    budget_steps: int = 4_000_000
    max_steps: int = 500
    gives_up: bool = True
    gradient_steps: int = 4000
    length: str = "shortest-reference"
    length_value: float | None = None
    scorers: tuple[str, ...] = ()
    keep_for_audit: int = 60
    selection_seed: int = 0
    looks_before: tuple[str, ...] = ()
    more: Mapping[str, Any] = field(default_factory=dict)
    raw: Mapping[str, Any] = field(default_factory=dict, compare=False)

    @property
    def hash(self) -> str:
        """Of the whole plan, contrasts included."""
        return hashlib.sha256(json.dumps(self.raw, sort_keys=True).encode()).hexdigest()[:16]

    @property
    def collections(self) -> dict[str, Mapping[str, Any]]:
        """Parameters of all collections, by the names of their datasets."""
        more = {"more": self.more} if self.more else {}
        return {"reference": self.reference, **more, **self.pools}

    def only(self, names: Sequence[str]) -> StudyPlan:
        """The plan with some of its stages, and the pools that these use; its hash stays.

        Raises:
            ConfigError: if there is no such stage.
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
        """Everything that the rows of a pool are made of."""
        return {
            term
            for stage in self.stages
            for name, _, row in stage.cells()
            if name == pool
            for term in parse_row(row)
        }


def read_plan(path: Path) -> StudyPlan:
    """Read a study's YAML; `contrasts_file` of a stage is read from beside it.

    Raises:
        ConfigError: naming file and key.
    """
    raw = _read_yaml(path)
    for stage in raw.get("stages") or ():
        beside = stage.pop("contrasts_file", None) if isinstance(stage, dict) else None
        if beside is not None:
            contrasts = _read_yaml(path.parent / str(beside))
            stage["contrasts"] = contrasts.get("contrasts")
    try:
        return plan_from(raw)
    except ConfigError as err:
        raise ConfigError(f"study {path}: {err}") from err
    except (KeyError, TypeError, ValueError, AttributeError) as err:
        raise ConfigError(f"study {path}: {type(err).__name__}: {err}") from err


def plan_from(raw: Mapping[str, Any]) -> StudyPlan:
    """The plan that plain data describe.

    Raises:
        ConfigError: if a key is unknown or missing, or a value makes no sense.
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
        raise ConfigError(f"a pool cannot be called {name!r}: that is the name of a dataset")
    for name in plan.scorers:
        if name not in SCORERS:
            raise ConfigError(f"no scorer {name!r}; there are {', '.join(SCORERS)}")
    names = [stage.name for stage in plan.stages]
    if len(set(names)) < len(names):
        raise ConfigError(f"stages {names}: a name is there twice")
    for stage in plan.stages:
        where = f"stage {stage.name!r}"
        if stage.kind not in KINDS:
            raise ConfigError(f"{where}: kind {stage.kind!r} is none of {', '.join(KINDS)}")
        if not stage.seeds or len(set(stage.seeds)) < len(stage.seeds):
            raise ConfigError(f"{where}: seeds {stage.seeds}: expected some, each once")
        if len(stage.contrasts) > MAX_CONTRASTS:
            raise ConfigError(
                f"{where}: {len(stage.contrasts)} contrasts, at most {MAX_CONTRASTS} are planned"
            )
        if not 1 <= stage.draw_seeds <= len(stage.seeds):
            raise ConfigError(
                f"{where}: draw_seeds {stage.draw_seeds} of {len(stage.seeds)} seeds"
            )
        for pool, _, row in stage.cells():
            if pool not in plan.pools:
                raise ConfigError(f"{where}: no pool {pool!r}; there are {', '.join(plan.pools)}")
            for term in parse_row(row):
                source = "more" if term.name == "more" else pool
                if source not in plan.collections:
                    raise ConfigError(f"{where}: {row!r}: the plan has no dataset {source!r}")
                n = int(plan.collections[source]["episodes"])
                if term.keep is not None and term.keep > n:
                    raise ConfigError(f"{where}: {row!r} keeps more than the {n} of {source}")
                if term.name in SCORERS and term.name not in plan.scorers:
                    raise ConfigError(f"{where}: {row!r}: {term.name} is none of the scorers")


def _expanded(text: str, where: str) -> list[str]:
    """`knn@{12,16}` and `random@16#{0..9}` are several rows."""
    if not isinstance(text, str):
        raise ConfigError(f"{where}: row {text!r:.60}: expected a text such as knn@16")
    found = re.search(r"\{([^}]*)\}", text)
    if not found:
        parse_row(text)
        return [text]
    span = re.fullmatch(r"\s*([0-9]+)\.\.([0-9]+)\s*", found[1])
    values = (
        [str(k) for k in range(int(span[1]), int(span[2]) + 1)]
        if span
        else [v.strip() for v in found[1].split(",")]
    )
    return [
        row
        for value in values
        for row in _expanded(text[: found.start()] + value + text[found.end() :], where)
    ]


def _names(value: Any, what: str) -> tuple[str, ...]:
    if not isinstance(value, list | tuple) or not all(isinstance(v, str) for v in value):
        raise ConfigError(f"{what} is {value!r:.60}, expected a list of names")
    return tuple(value)


Kind = TypeVar("Kind")


def _checked(raw: Any, kind: type[Any], what: str, leave: Sequence[str] = ()) -> dict[str, Any]:
    """A mapping that has all keys that a dataclass needs, and none that it does not know."""
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


def _read_yaml(path: Path) -> dict[str, Any]:
    try:
        raw = yaml.safe_load(path.read_text())
    except OSError as err:
        raise ConfigError(f"{path}: {err.strerror}") from err
    except (yaml.YAMLError, ValueError) as err:
        mark = getattr(err, "problem_mark", None)
        line = f", line {mark.line + 1}" if mark is not None else ""
        what = getattr(err, "problem", None) or str(err).splitlines()[0]
        raise ConfigError(f"{path}{line}: not YAML: {what}") from err
    if not isinstance(raw, dict):
        raise ConfigError(f"{path}: expected a mapping, found {raw!r:.60}")
    return raw
