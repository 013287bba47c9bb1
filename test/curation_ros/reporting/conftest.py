from __future__ import annotations

from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest


@pytest.fixture(scope="session")
def _made(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    from made_study import made_results, small_plan

    return made_results(tmp_path_factory.mktemp("study"), small_plan())


@pytest.fixture
def found(_made: dict[str, Any]) -> dict[str, Any]:
    """Results of a study, for a test to change."""
    return deepcopy(_made)


@pytest.fixture(scope="session")
def report(_made: dict[str, Any], tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Files of a report on these results, written once."""
    from curation_ros.reporting import write_report

    return write_report(_made, tmp_path_factory.mktemp("report"))


@pytest.fixture(scope="session")
def nothing_done(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Results of a study without any rollout."""
    from made_study import made_results, small_plan

    problems = ("policy <x>: it did not converge",)
    folder = tmp_path_factory.mktemp("nothing")
    return made_results(folder, small_plan(), share=0.0, problems=problems)


@pytest.fixture(scope="session")
def _salvaged(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    from made_study import made_results, salvage_plan

    return made_results(tmp_path_factory.mktemp("salvage"), salvage_plan())


@pytest.fixture
def salvaged(_salvaged: dict[str, Any]) -> dict[str, Any]:
    """Results of a study of salvage, for a test to change."""
    return deepcopy(_salvaged)
