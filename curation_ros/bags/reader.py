"""Opens bags: ours, those of rosbag2 and of other writers, with or without metadata.yaml."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any, TypeAlias

from curation_ros.bags.bag import Bag
from curation_ros.bags.folders import found_files, listed_files
from curation_ros.bags.mcap_file import open_now
from curation_ros.bags.mcap_info import McapInfo, read_info
from curation_ros.bags.recovery import custom_data_of
from curation_ros.bags.topics import BagTopic, collect_topics
from curation_ros.bags.writer import own_metadata
from curation_ros.bags.yaml_text import MOST_BYTES, load_yaml
from curation_ros.core.errors import BagError


def open_bag(path: Path) -> Bag:
    """Open a bag.

    Args:
        path: folder of a bag, with or without metadata.yaml, or one .mcap file.

    Raises:
        BagError: if it is missing, truncated, of another storage or encoding, or compressed as a
            whole, saying which and what to do.
    """
    known = _open_own(path)
    if known is not None:
        mcap_paths, infos, custom_data = known
    else:
        mcap_paths, infos, custom_data = _open_any(path)
    topics: dict[str, BagTopic] = {}
    unreadable: dict[str, str] = {}
    definitions: dict[str, str] = {}
    for file, info in zip(mcap_paths, infos, strict=True):
        collect_topics(file, info, topics, unreadable, definitions)
    if not topics and unreadable:
        name, reason = next(iter(unreadable.items()))
        raise BagError(
            f"{path}: no topic can be read: {name}: {reason}", finding="foreign-encoding"
        )
    filled = [info for info in infos if info.counts]
    return Bag(
        path=path,
        mcap_paths=mcap_paths,
        topics=topics,
        unreadable=unreadable,
        definitions=definitions,
        custom_data=custom_data,
        start_ns=min((info.start_ns for info in filled), default=0),
        end_ns=max((info.end_ns for info in filled), default=0),
        _infos=infos,
    )


_Opened: TypeAlias = tuple[tuple[Path, ...], tuple[McapInfo, ...], dict[str, str]]


def _open_own(folder: Path) -> _Opened | None:
    """Open a folder as our writer left it, without parsing YAML; None for any other."""
    try:
        content = _metadata_bytes(folder)
        [file] = [entry.path for entry in os.scandir(folder) if entry.name.endswith(".mcap")]
        info = _checked_info(Path(file))
    except (OSError, ValueError, BagError):
        return None  # reading it as a foreign bag reports what is wrong
    custom_data = _own_custom_data(info)
    if custom_data is None or info.own is None:
        return None
    if info.own != own_metadata(custom_data, os.path.basename(file), content):
        return None
    return (Path(file),), (info,), custom_data


def _own_custom_data(info: McapInfo) -> dict[str, str] | None:
    """custom_data as our writer repeated it in the file; None if there is none."""
    try:
        raw = json.loads((info.own or {}).get("custom_data", ""))
    except (ValueError, RecursionError):
        return None
    return {str(k): str(v) for k, v in raw.items()} if isinstance(raw, dict) else None


def _open_any(path: Path) -> _Opened:
    custom_data: dict[str, str] | None = None
    if path.is_dir():
        metadata = _read_metadata_file(path)
        mcap_paths = listed_files(path, metadata) if metadata else found_files(path)
        if metadata is not None:
            raw = metadata.get("custom_data") or {}
            custom_data = {str(k): str(v) for k, v in raw.items()}
    else:
        mcap_paths = (path,)
    infos = tuple(_checked_info(p) for p in mcap_paths)
    if custom_data is None:
        custom_data = _own_custom_data(infos[-1])
    if custom_data is None:
        records = [info.rosbag2 for info in infos if info.rosbag2 is not None]
        custom_data = custom_data_of(records[-1]) if records else {}
    return mcap_paths, infos, custom_data


def _metadata_bytes(folder: Path) -> bytes:
    """The text of metadata.yaml, or its beginning where it is too large to be metadata."""
    with open_now(folder / "metadata.yaml") as file:
        return file.read(MOST_BYTES + 1)


def _read_metadata_file(folder: Path) -> dict[str, Any] | None:
    """Contents of metadata.yaml; None if it is missing or spoilt, since the files repeat it."""
    path = folder / "metadata.yaml"
    try:
        raw = load_yaml(_metadata_bytes(folder))
    except FileNotFoundError:
        return None
    except OSError as err:
        raise BagError(f"{path}: {err.strerror}") from err
    except ValueError:
        return None
    info = raw.get("rosbag2_bagfile_information") if isinstance(raw, dict) else None
    if not isinstance(info, dict) or not isinstance(info.get("custom_data") or {}, dict):
        return None
    return info


def _checked_info(path: Path) -> McapInfo:
    info = read_info(path)
    if info.profile not in ("ros2", ""):
        raise BagError(
            f"{path}: MCAP profile {info.profile!r}, expected 'ros2'", finding="foreign-encoding"
        )
    return info
