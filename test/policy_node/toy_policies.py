"""Policies of other kinds, as somebody else would write them: chunks of commands, and images."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from curation_ros.core.episode.topic_map import TopicMap
from curation_ros.core.errors import PolicyError
from policy_node.policy import (
    Command,
    PolicyCard,
    Values,
    check_observed,
    read_card,
    write_policy,
)


def toy_card(kind: str) -> PolicyCard:
    return PolicyCard(
        kind=kind,
        id="01990000-0000-7000-8000-00000000000c",
        created_at="2026-01-01T00:00:00+00:00",
        topic_map_hash="",
        selection_name="",
        selection_hash="",
        episodes=(),
        seed=0,
        versions={},
    )


def card_of(folder: Path) -> PolicyCard:
    raw = read_card(folder)
    return PolicyCard(
        **{key: raw[key] for key in vars(toy_card("")) if key != "episodes"},
        episodes=tuple(raw["episodes"]),
    )


class ChunkedPolicy:
    """Plans the commands of the next H steps at once, as ACT and diffusion policies do.

    The plan closes in on the place where the episode began. Without temporal ensembling a chunk
    is followed to its end; with it, each step makes a chunk, and the command is the mean of
    all chunks for the step.
    """

    observed = ("eef_position",)
    commanded = ("twist", "gripper")

    def __init__(self, horizon: int = 4, ensembles: bool = False) -> None:
        self.card = toy_card("toy-chunked")
        self.horizon, self.ensembles = horizon, ensembles
        self.reset()

    def check(self, topic_map: TopicMap) -> None:
        for name in (*self.observed, *self.commanded):
            if name not in topic_map.fields:
                raise PolicyError(f"policy {self.card.id}: the topic map has no field {name!r}")

    def reset(self) -> None:
        self._step = -1
        self._chunks: dict[int, np.ndarray] = {}

    def observe(self, values: Values) -> None:
        check_observed(values, self.observed)
        place = np.asarray(values["eef_position"], dtype=np.float64)
        if place.shape != (3,) or not np.isfinite(place).all():
            raise PolicyError(f"observation: eef_position is {place}, expected 3 finite numbers")
        self._step += 1
        if self.ensembles or self._step % self.horizon == 0:
            self._chunks[self._step] = self._plan(place)

    def act(self) -> Command:
        if self._step < 0:
            raise PolicyError("nothing was observed")
        planned = [
            chunk[self._step - first]
            for first, chunk in self._chunks.items()
            if self._step - first < self.horizon
        ]
        command = np.mean(planned, axis=0)
        return {"twist": command[:3], "gripper": np.sign(command[3:])}

    def _plan(self, place: np.ndarray) -> np.ndarray:
        """(H, 4) commands; row k belongs to the step k steps ahead."""
        fading = 0.5 ** np.arange(self.horizon)
        return np.column_stack([np.outer(fading, -place), 2.0 * (fading > 0.3) - 1.0])

    def save(self, folder: Path) -> Path:
        settings = {"horizon": self.horizon, "ensembles": self.ensembles}
        return write_policy(
            folder, self.card.to_json(), {"settings.json": json.dumps(settings).encode()}
        )

    @classmethod
    def load(cls, folder: Path) -> ChunkedPolicy:
        card = card_of(folder)
        made = cls(**json.loads((folder / "settings.json").read_text()))
        made.card = card
        return made


class ImagePolicy:
    """Drives towards the brightest place of a camera's image; remembers the image before."""

    observed = ("camera", "joint_position")
    commanded = ("joint_velocity",)
    shape = (6, 8, 3)

    def __init__(self) -> None:
        self.card = toy_card("toy-image")
        self.reset()

    def check(self, topic_map: TopicMap) -> None:
        raise PolicyError("topic maps have no images")

    def reset(self) -> None:
        self._last: np.ndarray | None = None
        self._command: np.ndarray | None = None

    def observe(self, values: Values) -> None:
        check_observed(values, self.observed)
        image = np.asarray(values["camera"])
        if image.shape != self.shape or image.dtype != np.uint8:
            raise PolicyError(
                f"observation: camera is {image.dtype} {image.shape}, expected uint8 {self.shape}"
            )
        grey = image.mean(axis=2)
        moved = grey - (grey if self._last is None else self._last)
        row, column = np.unravel_index(int(np.argmax(grey)), grey.shape)
        joints = np.asarray(values["joint_position"], dtype=np.float64)
        self._command = 0.01 * joints + [float(row), float(column), float(moved.sum())]
        self._last = grey

    def act(self) -> Command:
        if self._command is None:
            raise PolicyError("nothing was observed")
        return {"joint_velocity": self._command.copy()}

    def save(self, folder: Path) -> Path:
        return write_policy(folder, self.card.to_json(), {})

    @classmethod
    def load(cls, folder: Path) -> ImagePolicy:
        made = cls()
        made.card = card_of(folder)
        return made


def image_steps(n: int, seed: int = 0) -> list[dict[str, Any]]:
    """Observations of the image policy."""
    rng = np.random.default_rng(seed)
    return [
        {
            "camera": rng.integers(0, 256, ImagePolicy.shape, dtype=np.uint8),
            "joint_position": rng.normal(size=3),
        }
        for _ in range(n)
    ]
