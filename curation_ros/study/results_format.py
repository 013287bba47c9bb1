"""The format of `results.json`: its keys and their types, and how it is read."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NoReturn

from curation_ros.core.errors import ConfigError
from curation_ros.core.types import JsonObject
from curation_ros.files import named_errors
from curation_ros.study.terms import parse_row

#: Version of the format; it goes up when a key changes its meaning.
FORMAT = 1

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


def read_results(path: Path) -> JsonObject:
    """Read a `results.json`.

    Raises:
        ConfigError: if the file holds no results of a study, or another format of them.
        CurationError: if the file cannot be read.
    """
    with named_errors(path):
        raw = path.read_bytes()
    try:
        found = json.loads(raw, parse_constant=_no_constant)
    except (ValueError, RecursionError) as err:
        raise ConfigError(f"{path}: not JSON: {err}") from err
    try:
        check_results(found)
    except ConfigError as err:
        raise ConfigError(f"{path}: {err}") from err
    return dict(found)


def check_results(found: Any) -> None:
    """Check that this is the results of a study.

    Raises:
        ConfigError: naming the key that is missing or has the wrong type.
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
