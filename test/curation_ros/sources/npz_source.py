"""A toy format, as another package might bring one: several episodes in one .npz file.

Each episode is a group of arrays `<episode>/<field>`, with `<episode>/stamps_ns`. The roles of
the fields are JSON in `roles`.
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from curation_ros.core.episode.episode import Episode
from curation_ros.core.episode.topic_map import TopicMap
from curation_ros.core.errors import EpisodeError
from curation_ros.sources import stamp_of_files


class NpzSource:
    name = "npz"

    def recognises(self, path: Path) -> bool:
        return _file_of(path).suffix == ".npz" and _file_of(path).is_file()

    def find(self, path: Path) -> list[Path]:
        if path.suffix != ".npz":
            return [path]
        names = sorted({key.split("/")[0] for key in _load(path) if "/" in key})
        return [path / name for name in names]

    def read(
        self, path: Path, topic_map: TopicMap | None = None, *, claimed_id: str = ""
    ) -> Episode:
        arrays = _load(_file_of(path))
        prefix = f"{path.name}/"
        fields = {k.removeprefix(prefix): v for k, v in arrays.items() if k.startswith(prefix)}
        if not fields:
            raise EpisodeError(f"{path}: no such episode")
        stamps_ns = fields.pop("stamps_ns")
        roles = json.loads(str(arrays["roles"]))
        if topic_map is not None:
            fields = {name: fields[name] for name in topic_map.fields if name in fields}
        return Episode.from_arrays(
            fields, topic_map or roles, stamps_ns=stamps_ns, name=path.name, gripper={"opens": -1}
        )

    def stamp(self, path: Path) -> str:
        return stamp_of_files(_file_of(path))


def _file_of(path: Path) -> Path:
    return path if path.suffix == ".npz" else path.parent


def _load(file: Path) -> dict[str, Any]:
    try:
        with np.load(file) as stored:
            return dict(stored)
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as err:
        raise EpisodeError(f"{file}: {err}", finding="unreadable") from err


def write_npz(file: Path, episodes: Mapping[str, Episode], roles: Mapping[str, str]) -> None:
    """Write those fields of episodes that have a role."""
    arrays: dict[str, Any] = {"roles": json.dumps(roles)}
    for name, episode in episodes.items():
        arrays[f"{name}/stamps_ns"] = episode.stamps_ns
        arrays |= {f"{name}/{field}": episode.fields[field] for field in roles}
    np.savez(file, **arrays)
