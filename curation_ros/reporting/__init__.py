"""Reports on a study: `results.json` for people, as one HTML file and as Markdown with figures.

A report computes no statistic: every figure in it stands in `results.json`.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from curation_ros.core.errors import CurationError
from curation_ros.files import named_errors, write_atomically
from curation_ros.reporting.findings import check, read_results
from curation_ros.reporting.html import html
from curation_ros.reporting.markdown import markdown

__all__ = ["read_results", "write_report"]


def write_report(found: Mapping[str, Any], folder: Path) -> list[Path]:
    """Write `report.html`, `report.md` and the figures of the latter.

    Args:
        found: as `curation_ros.study.results.results` returns it and `results.json` holds it.
        folder: made where it does not exist; what is there is replaced.

    Returns:
        The files, the report first.

    Raises:
        ConfigError: if `found` is no results of a study.
        CurationError: if matplotlib is missing or a file cannot be written.
    """
    check(found)
    try:
        from curation_ros.reporting.page import page
    except ImportError as err:
        if (err.name or "").partition(".")[0] != "matplotlib":
            raise
        raise CurationError("the report needs matplotlib: install the extra [report]") from err
    made = page(found)
    files = {"report.html": html(made), "report.md": markdown(made)}
    files |= {f"{figure.name}.svg": figure.whole for figure in made.figures}
    with named_errors(folder):
        for name, text in files.items():
            write_atomically(folder / name, text)
    return [folder / name for name in files]
