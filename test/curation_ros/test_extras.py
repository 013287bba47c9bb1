from __future__ import annotations

import re
from pathlib import Path

import pytest

from curation_ros.extras import EXTRAS, how_to_install

_SETUP = Path(__file__).resolve().parents[2] / "setup.py"


@pytest.mark.parametrize(
    ("module", "extra"),
    [
        ("torch", "policy"),
        ("torch.nn", "policy"),
        ("matplotlib.pyplot", "report"),
        ("rclpy", "ros"),
        ("diagnostic_msgs.msg", "ros"),
        ("std_srvs", "ros"),
    ],
)
def test_missing_module_is_brought_by_its_extra(module: str, extra: str) -> None:
    assert f"pip install '.[{extra}]'" in how_to_install(module)


def test_missing_requirement_of_the_package_needs_no_extra() -> None:
    assert how_to_install("numpy") == "pip install ."


def test_extras_are_those_of_setup() -> None:
    source = _SETUP.read_text()
    known = re.findall(r'^        "(\w+)": \[', source, flags=re.MULTILINE)
    assert {*EXTRAS.values(), "ros"} <= set(known)
