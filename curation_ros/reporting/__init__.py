"""Reports on a study: `results.json` for people, as one HTML file and as Markdown with figures.

A report computes no statistics. Every number in it is in `results.json`.
"""

from __future__ import annotations

from pathlib import Path

from curation_ros.core.errors import CurationError
from curation_ros.core.types import JsonObject
from curation_ros.files import named_errors, write_atomically
from curation_ros.reporting.html import to_html
from curation_ros.reporting.markdown import to_markdown
from curation_ros.study.results_format import check_results, read_results

__all__ = ["read_results", "write_report"]


def write_report(results: JsonObject, folder: Path) -> list[Path]:
    """Write `report.html`, `report.md` and the figures of the latter.

    Args:
        results: as `curation_ros.study.results.results` returns them and `results.json` holds
            them.
        folder: created if it does not exist; files of the same names are replaced.

    Returns:
        Paths of the files, the HTML report first.

    Raises:
        ConfigError: if `results` are not the results of a study.
        CurationError: if matplotlib is missing or a file cannot be written.
    """
    check_results(results)
    try:
        from curation_ros.reporting.page import build_page
    except ImportError as err:
        if (err.name or "").partition(".")[0] != "matplotlib":
            raise
        raise CurationError("reports need matplotlib: pip install '.[report]'") from err
    page = build_page(results)
    files = {"report.html": to_html(page), "report.md": to_markdown(page)}
    files |= {f"{figure.name}.svg": figure.whole for figure in page.figures}
    with named_errors(folder):
        for name, text in files.items():
            write_atomically(folder / name, text)
    return [folder / name for name in files]
