"""What happens in a demo, in the order of its steps, and what a demo is made of."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, TypeAlias

from curation_ros.core.episode.status import Status
from curation_ros.core.errors import ConfigError

#: Names of the selections: one policy is trained on each.
EVERYTHING, KEPT, KEPT_AND_SALVAGED = "everything", "kept", "kept-and-salvaged"


@dataclass(frozen=True)
class DemoSettings:
    """The size of a demo: gradient steps and rollouts per policy, demonstrations to record.

    Raises:
        ConfigError: if a number is below 1.
    """

    train_steps: int
    rollouts: int = 10
    demonstrations: int = 24

    def __post_init__(self) -> None:
        for field in fields(self):
            if (value := getattr(self, field.name)) < 1:
                raise ConfigError(f"demo: {field.name} is {value}, expected at least 1")


@dataclass(frozen=True)
class Recording:
    """An episode has started or ended; `name` is empty while the nodes start."""

    name: str
    n_ended: int


@dataclass(frozen=True)
class Alerted:
    """The curator has published an alert."""

    status: Status


@dataclass(frozen=True)
class Decided:
    """The curator has published a decision.

    Attributes:
        status: the decision.
        lead_s: how much earlier the alert came, in s. `alert_before_s` is by the wall clock,
            `alert_before_end_s` by the episode's own clock, up to its end: the simulator may be
            faster or slower than a robot. Empty without an alert.
    """

    status: Status
    lead_s: Mapping[str, float]


@dataclass(frozen=True)
class Selected:
    """The demonstrations are sorted into selections.

    Attributes:
        manifests: selection -> path of its manifest. Without a salvaged demonstration there is
            no `kept-and-salvaged`.
        n_kept: demonstrations that are kept whole.
        n_all: demonstrations that were recorded.
        salvaged_s: duration of the salvaged beginning of each other demonstration, in s.
        decided_by: scorer -> number of decisions that it made.
    """

    manifests: Mapping[str, Path]
    n_kept: int
    n_all: int
    salvaged_s: tuple[float, ...]
    decided_by: Mapping[str, int]


@dataclass(frozen=True)
class Drawn:
    """The first salvaged demonstration, if there is one, is drawn, unless a module is missing."""

    pictures: tuple[Path, ...]
    missing: str = ""


@dataclass(frozen=True)
class Training:
    """Training goes on; `steps` is selection -> gradient steps done."""

    steps: Mapping[str, int]


@dataclass(frozen=True)
class Driving:
    """The policies drive; `rollouts` is selection -> outcomes so far, True for a success."""

    rollouts: Mapping[str, tuple[bool, ...]]


@dataclass(frozen=True)
class Finished:
    """The demo is over; `results` is selection -> summary of its policy's rollouts."""

    results: Mapping[str, dict[str, Any]]


DemoEvent: TypeAlias = (
    Recording | Alerted | Decided | Selected | Drawn | Training | Driving | Finished
)
