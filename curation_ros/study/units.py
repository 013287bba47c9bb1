"""Units of work of a study: a policy to train, a rollout to do, and their lines in the log."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from curation_ros.configuration import share_file
from curation_ros.core.errors import ConfigError
from curation_ros.core.types import JsonObject, Span
from policy_node.settings import DEFAULTS
from policy_node.variants import Variant, read_training_config
from sim_node.settings import SIMULATED_TASK
from sim_node.tasks import start_names

#: Called with each row when it is logged.
Progress = Callable[[JsonObject], None]


@dataclass(frozen=True)
class PolicyUnit:
    """A policy to train.

    Attributes:
        set_id: name of the training set. Equal sets have equal names, and are trained on once.
        variant: name of what the policy observes and commands, in config/training.yaml.
        seed: of the training.
        bags: what to train on, each with the span or None for all of it.
        steps: gradient steps.
        start_jitter_m: see `TrainingSettings`.
        selection: name and hash of the manifest, for the card.
    """

    set_id: str
    variant: str
    seed: int
    bags: tuple[tuple[Path, Span | None], ...]
    steps: int = DEFAULTS.steps
    start_jitter_m: float = DEFAULTS.start_jitter_m
    selection: tuple[str, str] = ("", "")

    @property
    def key(self) -> str:
        """Id of the policy."""
        return f"{self.set_id}-{self.variant}-s{self.seed}"

    @property
    def content(self) -> str:
        """Hash of all that the weights depend on; bags count by name, which is their episode."""
        bags = sorted([bag.name, list(span or ())] for bag, span in self.bags)
        text = json.dumps([bags, self.variant, self.seed, self.steps, self.start_jitter_m])
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    def row(self, **result: Any) -> JsonObject:
        """Its line of `units.jsonl`."""
        return {
            "kind": "policy",
            "policy": self.key,
            "set": self.set_id,
            "variant": self.variant,
            "seed": self.seed,
            "steps": self.steps,
            "loss": None,
            "seconds": None,
            "content": self.content,
            **result,
        }


@dataclass(frozen=True)
class RolloutUnit:
    """A rollout to do.

    Attributes:
        policy: id of the policy.
        start: such as official:3 or generated:7:12, or a name such as official-03.
    """

    policy: str
    start: str

    @property
    def key(self) -> tuple[str, str]:
        """Policy and start: no two rollouts of a study have both."""
        return (self.policy, self.start)

    def row(self, **result: Any) -> JsonObject:
        """Its line of `units.jsonl`."""
        return {"kind": "rollout", "policy": self.policy, "start": self.start, **result}


Unit = TypeVar("Unit", PolicyUnit, RolloutUnit)


def named_variant(name: str) -> Variant:
    """A variant of config/training.yaml, by which studies name what policies observe and command.

    Raises:
        ConfigError: if there is none of this name.
    """
    return read_training_config(share_file("config/training.yaml")).variant(name)


def start_name(start: str, simulated_task: str = SIMULATED_TASK) -> str:
    """Name of a start of a task as `Start` has it, also for official:3 and generated:7:12.

    Raises:
        ConfigError: if it is no single start of the task, or there is no such task.
    """
    found = re.fullmatch(
        r"official[:-]([0-9]{1,9})|generated[:-]([0-9]{1,9})[:-]([0-9]{1,9})", start
    )
    if not found:
        raise ConfigError(
            f"start {start!r} is none; expected official:3, generated:7:12 or a name of a start"
        )
    kind = "official" if found[1] else f"generated:{found[2]}"
    index = int(found[1] or found[3])
    [name] = start_names(f"{kind}:{index}:{index + 1}", simulated_task)
    return name
