"""Reads `results.json`, and finds the rows in it that belong together."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn

from curation_ros.core.errors import ConfigError
from curation_ros.files import named_errors
from curation_ros.study.plan import parse_row

#: Of `results.json`; see `curation_ros.study.results.FORMAT`, which needs a simulator to import.
FORMAT = 1
Row = Mapping[str, Any]

_OPTIONAL = (int, float, type(None))
_LIST = (list, tuple)
_RESULTS = {
    "name": str, "question": str, "created_at": str, "plan": Mapping, "plan_hash": str,
    "versions": Mapping, "machine": Mapping, "budget": Mapping, "reference": Mapping,
    "pools": Mapping, "stages": _LIST, "official_looks": Mapping, "seconds": _LIST,
    "problems": _LIST,
}  # fmt: skip
_BUDGET = dict.fromkeys(("declared_steps", "used_steps", "max_steps", "rollouts", "policies"), int)
_POOL = {
    "n": int, "n_good": int, "n_starts": int, "length_control": Mapping, "purity_ceiling": Mapping,
    "audit": _LIST, "notes": _LIST, "needs": Mapping, "traces": _LIST, "steps": _LIST,
}  # fmt: skip
_AUDITED = {
    "scorer": str, "needs": str, "auroc_raw": _OPTIONAL, "auroc_controlled": _OPTIONAL,
    "ci_raw": (*_LIST, type(None)), "ci": (*_LIST, type(None)), "keep": _OPTIONAL,
    "notes": _LIST,
}  # fmt: skip
_STAGE = {
    "name": str, "kind": str, "pools": _LIST, "variants": _LIST, "seeds": _LIST, "starts": _LIST,
    "rows": _LIST, "correlations": _LIST, "contrasts": _LIST, "missing": int,
}  # fmt: skip
_ROW = {
    "pool": str, "variant": str, "row": str, "set": str, "needs": _LIST, "n": int, "n_pool": int,
    "n_good": _OPTIONAL, "n_reference": int, "contamination": _OPTIONAL, "episodes": _LIST,
    "scorer": str, "keep": _OPTIONAL, "auroc": _OPTIONAL, "auroc_raw": _OPTIONAL,
    "auroc_ci": (*_LIST, type(None)), "n_missing": int, "outcomes": Mapping, "rate": _OPTIONAL,
    "interval": (*_LIST, type(None)), "sd": _OPTIONAL, "sd_population": _OPTIONAL,
    "counts": _LIST, "modes": (Mapping, type(None)), "gap_closed": _OPTIONAL,
    "rival": (Mapping, type(None)), "stages_reached": Mapping, "ended": Mapping,
    "tied_at_cut": _OPTIONAL,
}  # fmt: skip
_CONTRAST = {"a": str, "b": str, "pool": str, "variant": str, "why": str, "p_holm": _OPTIONAL}
_MADE = {
    "value": _OPTIONAL, "interval": (*_LIST, type(None)), "n_seeds": int, "n_starts": int,
    "n_unpaired": int, "p": _OPTIONAL, "p_floor": _OPTIONAL, "sd_of_seeds": _OPTIONAL,
    "minimum_detectable": _OPTIONAL,
}  # fmt: skip
_CORRELATION = {
    "pool": str, "variant": str, "keep": int, "against": str, "n": int, "rho": _OPTIONAL,
    "p": _OPTIONAL, "interval": (*_LIST, type(None)), "is_exact": (bool, type(None)),
}  # fmt: skip


def read_results(path: Path) -> dict[str, Any]:
    """What a `results.json` holds.

    Raises:
        ConfigError: if it is none, or one of another format.
        CurationError: if it cannot be read.
    """
    with named_errors(path):
        raw = path.read_bytes()
    try:
        found = json.loads(raw, parse_constant=_no_constant)
    except (ValueError, RecursionError) as err:
        raise ConfigError(f"{path}: not JSON: {err}") from err
    try:
        check(found)
    except ConfigError as err:
        raise ConfigError(f"{path}: {err}") from err
    return dict(found)


def check(found: Any) -> None:
    """Complain about what is no results of a study.

    Raises:
        ConfigError: naming the key.
    """
    if not isinstance(found, Mapping) or "format" not in found:
        raise ConfigError("no results of a study: there is no key 'format'")
    if found["format"] != FORMAT:
        raise ConfigError(f"results of format {found['format']!r:.20}, this reads {FORMAT}")
    _demand(found, _RESULTS, "results")
    _demand(found["budget"], _BUDGET, "budget")
    _demand(found["official_looks"], {"before": _LIST, "here": _LIST}, "official_looks")
    for name, pool in found["pools"].items():
        _demand(pool, _POOL, f"pool {name!r}")
        for row in pool["audit"]:
            _demand(row, _AUDITED, f"pool {name!r}, audit")
    for stage in found["stages"]:
        _demand(stage, _STAGE, "stage")
        where = f"stage {stage['name']!r}"
        for row in stage["rows"]:
            _demand(row, _ROW, f"{where}, row")
            if row["pool"] not in found["pools"]:
                raise ConfigError(f"{where}: there is no pool {row['pool']!r}")
            parse_row(row["row"])
        for one in stage["correlations"]:
            _demand(one, _CORRELATION, f"{where}, correlation")
        for one in stage["contrasts"]:
            _demand(one, _CONTRAST | (_MADE if "value" in one else {}), f"{where}, contrast")


def _demand(found: Any, keys: Mapping[str, Any], what: str) -> None:
    if not isinstance(found, Mapping):
        raise ConfigError(f"{what}: expected a mapping, found {found!r:.40}")
    for key, kind in keys.items():
        if key not in found:
            raise ConfigError(f"{what}: no key {key!r}")
        if not isinstance(found[key], kind):
            raise ConfigError(f"{what}: {key!r} is {found[key]!r:.40}")


def _no_constant(text: str) -> NoReturn:
    raise ValueError(f"{text} is no JSON")


def groups(stage: Row) -> list[tuple[str, str, list[Row]]]:
    """(pool, variant, rows) of a stage, in the order of the plan."""
    found: dict[tuple[str, str], list[Row]] = {}
    for row in stage["rows"]:
        found.setdefault((row["pool"], row["variant"]), []).append(row)
    return [(pool, variant, rows) for (pool, variant), rows in found.items()]


def named(rows: Sequence[Row], name: str) -> Row | None:
    """The row that the plan calls so."""
    return next((row for row in rows if row["row"] == name), None)


def is_plain(row: Row) -> bool:
    """Whether it is what one scorer keeps, and nothing else."""
    return bool(row["scorer"]) and "+" not in row["row"]


def has_scorers(found: Row) -> bool:
    """Whether any training set is what a scorer keeps."""
    return any(row["scorer"] for stage in found["stages"] for row in stage["rows"])


def keep_counts(rows: Sequence[Row]) -> list[int]:
    """How many scorers keep, of these rows."""
    return sorted({row["keep"] for row in rows if is_plain(row)})


def main_keep(found: Row, pool: str, rows: Sequence[Row]) -> int | None:
    """The number kept that a figure with one point a scorer shows: the audit's, if it is there."""
    counts = keep_counts(rows)
    audited = next((row["keep"] for row in found["pools"][pool]["audit"]), None)
    return audited if audited in counts else (counts[-1] if counts else None)


def at_keep(rows: Sequence[Row], keep: int | None) -> list[Row]:
    """What each scorer keeps of that number."""
    return [row for row in rows if is_plain(row) and row["keep"] == keep]


def draws(rows: Sequence[Row], control: str) -> dict[int, list[Row]]:
    """Number kept -> rows of a control: one, or one for each draw."""
    found: dict[int, list[Row]] = {}
    for row in rows:
        [first, *more] = parse_row(row["row"])
        if first.name == control and first.keep is not None and not more:
            found.setdefault(first.keep, []).append(row)
    return dict(sorted(found.items()))


def is_sweep(rows: Sequence[Row]) -> bool:
    """Whether there is a curve over the number kept to draw."""
    return len(keep_counts(rows)) >= 3


def stages(found: Row, *kinds: str) -> Iterator[Row]:
    """Stages of these kinds."""
    return (stage for stage in found["stages"] if stage["kind"] in kinds)
