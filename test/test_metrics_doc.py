"""docs/metrics.md agrees with the code."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest

from curation_ros.core.decision.rules import RULES
from curation_ros.core.episode.findings import FINDINGS
from curation_ros.core.evidence.length_control import MODES
from curation_ros.core.scorers import SCORERS

_DOCS = Path(__file__).resolve().parents[1] / "docs"


@pytest.fixture
def generator(tmp_path: Path) -> ModuleType:
    """The generator, with its own copy of the document."""
    spec = importlib.util.spec_from_file_location("make_metrics", _DOCS / "make_metrics.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    module.METRICS = tmp_path / "metrics.md"
    module.METRICS.write_text((_DOCS / "metrics.md").read_text())
    return module


def test_committed_document_is_current(generator: ModuleType) -> None:
    assert generator.main(["--check"]) == 0


def test_document_has_every_scorer_parameter_mode_finding_and_rule(generator: ModuleType) -> None:
    document = generator.METRICS.read_text()
    for name, kind in SCORERS.items():
        start = document.index(f"### {name}\n")
        section = document[start : document.index("When it misleads", start)]
        for parameter in kind().params():
            assert f"| `{parameter}` |" in section, (name, parameter)
        assert "µs per episode of 350 steps" in section
    for name in (*MODES, *FINDINGS, *RULES):
        assert f"| `{name}` |" in document, name
    for name in RULES:
        assert f"### Rule {name}\n" in document, name


def test_check_finds_a_change_and_no_new_measurement(
    generator: ModuleType, capsys: pytest.CaptureFixture[str]
) -> None:
    document = generator.METRICS.read_text()
    line = next(k for k in document.splitlines() if k.startswith("- **Cost**"))
    generator.METRICS.write_text(document.replace(line, "- **Cost**: 7 µs, measured elsewhere"))
    assert generator.main(["--check"]) == 0
    generator.METRICS.write_text(document.replace("Higher is better", "Lower is better"))
    assert generator.main(["--check"]) == 1
    assert "not current" in capsys.readouterr().out
    assert generator.main([]) == 0
    assert generator.main(["--check"]) == 0


def test_text_on_the_audit_that_was_written_by_hand_stays(generator: ModuleType) -> None:
    before, begins, rest = generator.METRICS.read_text().partition(generator.AUDIT_BEGINS)
    ends = rest[rest.index(generator.AUDIT_ENDS) :]
    written = f"{before}{begins}\n\nWhat the columns mean.\n\n{ends}"
    generator.METRICS.write_text(written)
    assert generator.main([]) == 0
    assert "What the columns mean." in generator.METRICS.read_text()
    assert generator.main(["--check"]) == 0
