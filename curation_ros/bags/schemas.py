"""Schema text and type hash of a message type: of the installed ROS packages, else of rosbags."""

from __future__ import annotations

import functools
import importlib.util
import json
import os
from pathlib import Path
from typing import Any, NamedTuple

from curation_ros.bags.definitions import SEPARATOR, dependencies, full_type_name
from curation_ros.core.errors import BagError


class MessageSchema(NamedTuple):
    """What an MCAP file stores of a message type.

    Attributes:
        name: such as `sensor_msgs/msg/JointState`.
        text: its .msg text, then every dependency breadth first (encoding `ros2msg`).
        type_hash: `RIHS01_` and 64 hexadecimal digits; empty where it is unknown.
    """

    name: str
    text: str
    type_hash: str


@functools.cache
def message_schema(type_name: str) -> MessageSchema:
    """Find the definition of a message type on this machine.

    Args:
        type_name: such as `sensor_msgs/msg/JointState`.

    Raises:
        BagError: if neither an installed ROS package nor rosbags knows the type.
    """
    parts = type_name.split("/")
    if len(parts) != 3 or parts[1] != "msg" or not all(p.isidentifier() for p in parts):
        text = f"message type {type_name!r} is not of the form package/msg/Type"
        raise BagError(text, finding="bad-definition")
    installed = _installed_schema(type_name)
    return installed if installed is not None else _rosbags_schema(type_name)


def _installed_schema(type_name: str) -> MessageSchema | None:
    folder = _share_folder(type_name)
    if folder is None:
        return None
    sections: dict[str, str] = {}
    pending = [type_name]
    while pending:
        name = pending.pop(0)
        if name in sections:
            continue
        sections[name] = _installed_text(name)
        pending += dependencies(name, sections[name])
    head, *rest = sections.items()
    text = head[1] + "".join(
        f"\n{SEPARATOR}\nMSG: {name.replace('/msg/', '/')}\n{body}" for name, body in rest
    )
    # The graph announces the hash of this file. For two types rosbags computes another one.
    path = folder / f"{type_name.split('/')[2]}.json"
    try:
        hashes = {
            full_type_name(h["type_name"]): str(h["hash_string"])
            for h in json.loads(path.read_text("utf-8"))["type_hashes"]
        }
    except (OSError, ValueError, KeyError, TypeError):
        hashes = {}
    return MessageSchema(type_name, text, hashes.get(type_name, ""))


def _installed_text(type_name: str) -> str:
    folder = _share_folder(type_name)
    if folder is None:
        return message_schema(type_name).text.split(f"\n{SEPARATOR}\n")[0]
    path = folder / f"{type_name.split('/')[2]}.msg"
    try:
        return path.read_text("utf-8")
    except (OSError, UnicodeDecodeError) as err:
        raise BagError(f"definition of {type_name}: {path}: {err}") from err


def _share_folder(type_name: str) -> Path | None:
    """Folder with the .msg file: wheels and /opt/ros have <prefix>/share/<package>/msg alike."""
    package, _, name = type_name.split("/")
    prefixes = [Path(p) for p in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if p]
    spec = importlib.util.find_spec(package)
    if spec is not None:
        for place in spec.submodule_search_locations or ():
            prefixes += Path(place).parents
    for prefix in prefixes:
        folder = prefix / "share" / package / "msg"
        if (folder / f"{name}.msg").is_file():
            return folder
    return None


@functools.cache
def jazzy_typestore() -> Any:  # rosbags gives no public name to the class
    """The messages of Jazzy, as rosbags knows them without ROS."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_JAZZY)


def _rosbags_schema(type_name: str) -> MessageSchema:
    try:
        store = jazzy_typestore()
    except ImportError as err:
        raise BagError(
            f"no definition of {type_name}: its ROS package is not installed, nor is rosbags",
            finding="bad-definition",
        ) from err
    if type_name not in store.fielddefs:
        raise BagError(
            f"no definition of {type_name}: its ROS package is not installed, and it is not among "
            "the Jazzy types of rosbags",
            finding="bad-definition",
        )
    text = str(store.generate_msgdef(type_name, ros_version=2)[0])
    return MessageSchema(type_name, text, str(store.hash_rihs01(type_name)))
