"""What every policy is: a small protocol, a card beside its weights, and loading by its kind.

A new kind of policy is one file with a class that has the methods of `Policy`, and one line in
`POLICIES`. `policy_node.testing.check_policy` runs any class through the rules.
"""

from __future__ import annotations

import importlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy.typing as npt

from curation_ros.core.episode.topic_map import TopicMap
from curation_ros.core.errors import PolicyError
from curation_ros.core.types import Floats
from curation_ros.files import write_folder_atomically

#: Kind on the card -> module and class. A class is imported when a policy of its kind is loaded.
POLICIES = {
    "mlp": "policy_node.mlp:MlpPolicy",
}

CARD = "card.json"
#: Layout of card.json. Format 1 has no kind: its policies are MLPs.
FORMAT = 2
_FORMATS = (1, FORMAT)
_FIRST_KIND = "mlp"

#: One step by field of the topic map: (d,) values, the index of a phase, or an image of any shape.
Values = Mapping[str, npt.NDArray[Any]]
#: (d,) values by command field of the topic map, in the field's unit.
Command = Mapping[str, Floats]

_Self = TypeVar("_Self", bound="Policy")


@dataclass(frozen=True)
class PolicyCard:
    """What a policy is and where it comes from; a kind of policy may add fields of its own.

    Attributes:
        kind: key of `POLICIES`.
        id: UUID, version 7.
        created_at: UTC, ISO 8601.
        topic_map_hash: of the episodes that it was trained on.
        selection_name, selection_hash: manifest of these episodes; empty without one.
        episodes: `id`, `span` (nanoseconds from the start stamp, or null for all) and `n_steps`
            of each, sorted by id.
        seed: of the training.
        versions: of python and the packages that made it.
    """

    kind: str
    id: str
    created_at: str
    topic_map_hash: str
    selection_name: str
    selection_hash: str
    episodes: tuple[Mapping[str, Any], ...]
    seed: int
    versions: Mapping[str, str]

    def to_json(self) -> dict[str, Any]:
        """The fields above as plain data."""
        raw = {f.name: getattr(self, f.name) for f in fields(PolicyCard)}
        return raw | {"episodes": list(self.episodes)}


class Policy(Protocol):
    """Answers each observation of an episode with a command.

    An episode is `reset`, then `observe` and `act` for each step. A policy may keep state between
    steps, such as the first observation or a chunk of commands. State changes in `observe` and
    `reset` alone: `act` gives one command per observation, however often it is called.
    A policy drives one episode at a time.
    """

    @property
    def card(self) -> PolicyCard:
        """What it is."""
        ...

    @property
    def observed(self) -> tuple[str, ...]:
        """Fields of the topic map that `observe` needs."""
        ...

    @property
    def commanded(self) -> tuple[str, ...]:
        """Command fields of the topic map that `act` answers with."""
        ...

    def check(self, topic_map: TopicMap) -> None:
        """Refuse to drive a robot whose topics mean something else than those of the training.

        Raises:
            PolicyError: naming what was found and what was expected.
        """
        ...

    def reset(self) -> None:
        """Forget the episode: the next observation is the first of another one."""
        ...

    def observe(self, values: Values) -> None:
        """Take the observation of the next step.

        Args:
            values: by field, at least those of `observed`. They are copied where they are kept:
                the caller may fill the same arrays again.

        Raises:
            PolicyError: if a field is missing, has a wrong shape or is not finite. The policy is
                then as it was before the call.
        """
        ...

    def act(self) -> Command:
        """The command that answers the last observation; equal for each call.

        Raises:
            PolicyError: if nothing was observed since `reset`, or the answer is not finite.
        """
        ...

    def save(self, folder: Path) -> Path:
        """Write weights and card; `write_policy` does it for any kind.

        Returns:
            The folder.

        Raises:
            PolicyError: if the folder exists or cannot be written.
        """
        ...

    @classmethod
    def load(cls: type[_Self], folder: Path) -> _Self:
        """Read what `save` wrote.

        Raises:
            PolicyError: if a file is missing or damaged; the message names file, found and
                expected.
        """
        ...


def load_policy(folder: Path | str) -> Policy:
    """Load a policy of any kind.

    Raises:
        PolicyError: if a file is missing, damaged, or of a kind that is not in `POLICIES`.
    """
    folder = Path(folder)
    kind = read_card(folder)["kind"]
    if not isinstance(kind, str) or kind not in POLICIES:
        raise PolicyError(
            f"{folder / CARD}: kind {kind!r} of policy is none of {', '.join(POLICIES)}"
        )
    module, _, name = POLICIES[kind].partition(":")
    policy: Policy = getattr(importlib.import_module(module), name).load(folder)
    return policy


def read_card(folder: Path) -> dict[str, Any]:
    """Read card.json of a policy of any kind.

    Returns:
        The JSON object, with a `kind` in any case.

    Raises:
        PolicyError: if the file is missing, is no JSON object, or has another format or no kind.
    """
    file = folder / CARD
    try:
        raw = json.loads(read_file(file))
    except ValueError as err:
        raise PolicyError(f"{file} is not JSON: {str(err).splitlines()[0]}") from err
    if not isinstance(raw, dict):
        raise PolicyError(f"{file}: expected a JSON object, found {raw!r:.60}")
    if raw.get("format") == 1:
        raw["kind"] = _FIRST_KIND
    for key in ("format", "kind"):
        if key not in raw:
            raise PolicyError(f"{file}: the key {key!r} is missing")
    if raw["format"] not in _FORMATS:
        raise PolicyError(f"{file}: 'format' is {raw['format']!r}, expected {FORMAT}")
    return raw


def write_policy(folder: Path | str, card: Mapping[str, Any], files: Mapping[str, bytes]) -> Path:
    """Write a policy; the folder appears whole or not at all.

    Args:
        folder: must not exist; its parents are made.
        card: plain data with `kind`, for card.json.
        files: file name -> content.

    Returns:
        The folder.

    Raises:
        PolicyError: if it exists or cannot be written.
    """
    folder = Path(folder)
    text = json.dumps({"format": FORMAT, **card}, indent=1, allow_nan=False) + "\n"
    try:
        write_folder_atomically(folder, {**files, CARD: text})
    except FileExistsError as err:
        raise PolicyError(f"policy {folder} exists") from err
    except OSError as err:
        raise PolicyError(f"policy {folder}: {err.strerror}") from err
    return folder


def read_file(file: Path) -> bytes:
    """Content of a file of a policy.

    Raises:
        PolicyError: if it cannot be read.
    """
    try:
        return file.read_bytes()
    except OSError as err:
        raise PolicyError(f"{file}: {err.strerror}") from err


def check_observed(values: Values, observed: tuple[str, ...]) -> None:
    """Refuse an observation that lacks a field.

    Raises:
        PolicyError: naming the field.
    """
    for name in observed:
        if name not in values:
            raise PolicyError(
                f"observation: no field {name!r}; it has {', '.join(values) or 'none'}"
            )
