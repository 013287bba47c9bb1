from __future__ import annotations

import re
from copy import deepcopy
from typing import Any

import pytest

pytestmark = pytest.mark.sim
pytest.importorskip("libero", reason="LIBERO is not installed")

from made_study import made_results, small_plan  # noqa: E402 - needs LIBERO

from curation_ros.core.errors import ConfigError  # noqa: E402 - as above
from curation_ros.study.results_format import check_results  # noqa: E402 - as above


@pytest.fixture(scope="module")
def _made(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    return made_results(tmp_path_factory.mktemp("study"), small_plan(), share=0.5)


@pytest.fixture
def found(_made: dict[str, Any]) -> dict[str, Any]:
    return deepcopy(_made)


@pytest.mark.parametrize(
    ("spoil", "complaint"),
    [
        (lambda r: r.pop("format"), "no key 'format'"),
        (lambda r: r.update(format=2), "results of format 2, this reads 1"),
        (lambda r: r.pop("stages"), "no key 'stages'"),
        (lambda r: r.update(stages={}), "'stages' is {}"),
        (lambda r: r["stages"][0].pop("kind"), "stage: no key 'kind'"),
        (lambda r: r["stages"][0]["rows"][3].pop("rate"), "stage 'paper', row: no key 'rate'"),
        (lambda r: r["stages"][0]["rows"][3].update(rate="1"), "'rate' is '1'"),
        (lambda r: r["stages"][0]["rows"][3].update(row="best@3"), "training set 'best@3'"),
        (lambda r: r["stages"][0]["rows"][3].update(pool="other"), "no pool 'other'"),
        (lambda r: r["stages"][2]["contrasts"][0].pop("p"), "contrast: no key 'p'"),
        (lambda r: r["pools"]["paired"].pop("audit"), "pool 'paired': no key 'audit'"),
        (lambda r: r["stages"].append(7), "stage: expected a mapping, found 7"),
    ],
)
def test_wrong_results_are_refused_in_one_line(
    found: dict[str, Any], spoil: Any, complaint: str
) -> None:
    check_results(found)
    spoil(found)
    with pytest.raises(ConfigError, match=re.escape(complaint)) as refused:
        check_results(found)
    assert "\n" not in str(refused.value)
