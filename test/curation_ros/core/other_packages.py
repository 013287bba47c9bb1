"""Installs a package in a folder: what pip would leave there."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path


def install(
    folder: Path, name: str, entry_points: Mapping[str, Mapping[str, str]], code: str
) -> Path:
    """Install a package of one module.

    Args:
        folder: to be put on the path.
        name: of the distribution; its module is called the same, with underscores.
        entry_points: group -> name -> object.
        code: of the module.

    Returns:
        The folder.
    """
    module = name.replace("-", "_")
    info = folder / f"{module}-0.3.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 0.3\n")
    (info / "entry_points.txt").write_text(
        "\n".join(
            f"[{group}]\n" + "".join(f"{key} = {value}\n" for key, value in offered.items())
            for group, offered in entry_points.items()
        )
    )
    (folder / f"{module}.py").write_text(code)
    return folder
