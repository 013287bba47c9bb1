"""Consequence on simulated demonstrations: real physics, real bags."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from curation_ros.core.episode.episode import Episode
from curation_ros.core.evidence.carrying import carrying_of
from curation_ros.core.evidence.fingers import held_by_fingers
from curation_ros.core.scorers import SCORERS
from curation_ros.dataset.dataset import Dataset
from curation_ros.dataset.episodes import read_episode

pytestmark = pytest.mark.sim
pytest.importorskip("libero", reason="LIBERO is not installed")

from curation_ros.study.collect import Collection, collect  # noqa: E402 - needs LIBERO
from sim_node.defects import DEFECTS, Defect  # noqa: E402
from sim_node.defects.none import NoDefect  # noqa: E402
from sim_node.environment import GRIPPER_OPEN  # noqa: E402
from sim_node.tasks.task import Step  # noqa: E402

SEED = 109
FIELDS = ("bowl_position", "eef_position")
NAMES = ("object_coupling", "grip_consistency", "phase_events")


class LateDrop(NoDefect):
    """Opens in the middle of TRANSPORT, for good."""

    _n_steps = 0

    def act(self, step: Step) -> tuple[Any, float]:
        action, gripper = super().act(step)
        self._n_steps += step.phase_name == "TRANSPORT"
        return action, GRIPPER_OPEN if self._n_steps > 25 else gripper


class MissedGrasp(NoDefect):
    """Goes up while it closes: the fingers close on nothing, above the rim."""

    def act(self, step: Step) -> tuple[Any, float]:
        action, gripper = super().act(step)
        if step.phase_name == "GRASP":
            action = np.array([0.0, 0.0, 0.9])
        return action, gripper


@pytest.fixture(scope="module")
def episodes(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, list[Episode]]]:
    """Defect -> two demonstrations with it."""
    patch = pytest.MonkeyPatch()
    patch.setitem(DEFECTS, "late_drop", Defect("late_drop", "", LateDrop))
    patch.setitem(DEFECTS, "missed_grasp", Defect("missed_grasp", "", MissedGrasp))
    found: dict[str, list[Episode]] = {}
    for defect in ("none", "early_release", "late_drop", "missed_grasp"):
        dataset = Dataset(tmp_path_factory.mktemp(defect) / "data", create=True)
        plan = Collection(
            episodes=2,
            contamination=float(defect != "none"),
            defect=defect,
            seed=SEED,
            max_steps=400,
            max_steps_defective=280,
        )
        truths = [one.truth for one in collect(dataset.path, plan)]
        bags = [dataset.bag_path(str(t["episode"])) for t in truths if t is not None]
        found[defect] = [read_episode(bag) for bag in bags]
        outcomes = {t["outcome"] for t in truths if t is not None}
        assert outcomes == {"succeeded" if defect == "none" else "failed"}
    yield found
    patch.undo()


def test_clean_ones_are_carried_although_the_bowl_tilts(
    episodes: dict[str, list[Episode]],
) -> None:
    for episode in episodes["none"]:
        [hold] = carrying_of(episode).holds
        assert (hold.state, hold.object) == ("carried", "bowl_position")
        offset = episode.fields["bowl_position"] - episode.fields["eef_position"]
        tilt_m = np.linalg.norm(offset[hold.first : hold.last] - offset[hold.first], axis=1)
        assert tilt_m.max() > 0.01
        distance_m = np.linalg.norm(offset[hold.first : hold.last], axis=1)
        assert np.abs(distance_m - distance_m[0]).max() < 0.02
        heights_m = [episode.fields[f][hold.first : hold.last, 2] for f in FIELDS]
        top = int(np.argmax(heights_m[1]))
        bowl_rose_m, hand_rose_m = (h[top] - h[0] for h in heights_m)
        assert 0.85 < bowl_rose_m / hand_rose_m < 1.05
        assert held_by_fingers(episode).state == "carried"
        assert [SCORERS[name]().score(episode) for name in NAMES] == [1.0, 1.0, 1.0]


@pytest.mark.parametrize(
    ("defect", "phase"), [("early_release", "LIFT"), ("late_drop", "TRANSPORT")]
)
def test_drops_are_found_where_they_are(
    episodes: dict[str, list[Episode]], defect: str, phase: str
) -> None:
    for episode in episodes[defect]:
        command = episode.fields["gripper"][:, 0]
        opened = int(np.flatnonzero((command < 0) & (episode.phase == _index(episode, phase)))[0])
        for found in (carrying_of(episode), held_by_fingers(episode)):
            [hold] = found.holds
            assert (hold.state, hold.phase, hold.opened) == ("broken", phase, True)
            assert hold.departed is not None
            assert hold.noticed is not None
            # It is out of the fingers two to three steps after the command.
            assert opened < hold.departed <= opened + 6
            assert hold.noticed <= opened + 9
        scores = [SCORERS[name]().score(episode) for name in NAMES]
        assert max(scores) < 0.95


def test_missed_grasps_were_never_carried(episodes: dict[str, list[Episode]]) -> None:
    for episode in episodes["missed_grasp"]:
        assert carrying_of(episode).state == "never"
        # Its fingers are still closing when LIFT begins: it takes a few steps to see on what.
        assert held_by_fingers(episode).state in ("never", "broken")
        assert SCORERS["object_coupling"]().score(episode) == 0.0
        assert SCORERS["grip_consistency"]().score(episode) < 0.1
        # Commands alone do not show it.
        assert SCORERS["phase_events"]().score(episode) == 1.0


def _index(episode: Episode, phase: str) -> int:
    return episode.phase_labels.index(phase)
