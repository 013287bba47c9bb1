"""The manifest: what it refuses, what it keeps through JSON, what it warns of."""

from __future__ import annotations

import json

import pytest

from curation_ros.core.decision.balance import Balance, Shown
from curation_ros.core.decision.manifest import Entry, Manifest
from curation_ros.core.errors import ConfigError


def manifest(**changes: object) -> Manifest:
    given = {
        "name": "top-60",
        "created_at": "2026-11-22T01:00:00Z",
        "dataset": "demo",
        "scorer": "knn",
        "rule": "top-fraction",
        "entries": (Entry("a", "n1"), Entry("b", "n2", (0, 5)), Entry("b", "n2", (9, 12))),
        "kept_of": 3,
        "rule_params": {"value": 0.75, "seed": 0},
        "state_hash": "f00",
        "abstained": ("c",),
    }
    return Manifest(**{**given, **changes})  # type: ignore[arg-type]


def test_manifest_survives_json() -> None:
    text = json.dumps(manifest().to_json(), allow_nan=False)
    assert Manifest.from_json(json.loads(text)) == manifest()
    assert json.loads(text)["entries"][1] == {"episode": "b", "name": "n2", "span": [0, 5]}
    assert Manifest.from_json({**manifest().to_json(), "later": 1}) == manifest()


def test_manifest_keeps_the_phases_and_reads_those_of_before() -> None:
    counted = manifest(phases=Balance(2, 2, {"LIFT": Shown(2, 90), "RELEASE": Shown(1, 3)}))
    raw = json.loads(json.dumps(counted.to_json()))
    assert raw["phases"]["shown"]["RELEASE"] == {"demonstrations": 1, "steps": 3}
    assert Manifest.from_json(raw) == counted
    assert "phases" not in manifest().to_json()
    assert manifest().phases is None
    with pytest.raises(ConfigError, match="phases"):
        Manifest.from_json({**raw, "phases": {"shown": 3}})


@pytest.mark.parametrize(
    "changes",
    [
        {"name": ""},
        {"name": "../up"},
        {"name": "a b"},
        {"created_at": "yesterday"},
        {"rule": ""},
        {"entries": (Entry("a", "n"), Entry("a", "n"))},
        {"entries": (Entry("", "n"),)},
        {"entries": (Entry("a", "n", (5, 1)),)},
        {"kept_of": 1},
    ],
)
def test_bad_manifest_is_refused(changes: dict[str, object]) -> None:
    with pytest.raises(ConfigError, match="selection"):
        manifest(**changes)


def test_bad_manifest_json_is_refused() -> None:
    raw = manifest().to_json()
    for key in raw:
        with pytest.raises(ConfigError):
            Manifest.from_json({k: v for k, v in raw.items() if k != key})
    for bad in ([], None, {**raw, "entries": [{"episode": "a"}]}, {**raw, "kept_of": "many"}):
        with pytest.raises(ConfigError):
            Manifest.from_json(bad)


def test_warnings_name_a_top_k_that_found_fewer() -> None:
    short = manifest(rule="top-k", rule_params={"value": 5, "seed": 0}, kept_of=4)
    assert short.warnings() == [
        "top-k 5 keeps 3: no other of the 4 episodes has a score that counts"
    ]
    assert manifest(rule="top-k", rule_params={"value": 3, "seed": 0}).warnings() == []
    phases = Balance(4, 4, {"LIFT": Shown(1, 9)})
    assert manifest(phases=phases).warnings() == phases.warnings() != []
