from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hand_made_observations import BOWL_START_M, PLATE_START_M, observation_at

from sim_node.tasks.bowl_on_plate import GEOMETRY, TASK
from sim_node.tasks.pick_and_place import GRASP, LIFT, RELEASE, PickAndPlaceTracker

GRASP_M = GEOMETRY.grasp_point(BOWL_START_M)
PLACE_M = GEOMETRY.place_point(PLATE_START_M)


def ideal_path() -> list[tuple[np.ndarray, float]]:
    """Effector positions and finger widths of an episode that goes through every phase."""
    up = np.array([0.0, 0.0, 1.0])
    waypoints = [
        (np.array([-0.2, 0.0, 1.17]), 0.08, 1),
        (GRASP_M + 0.12 * up, 0.08, 40),
        (GRASP_M + 0.034 * up, 0.08, 30),
        (GRASP_M + 0.034 * up, 0.008, 20),
        (GRASP_M + 0.22 * up, 0.008, 60),
        (PLACE_M + 0.20 * up, 0.008, 40),
        (PLACE_M + 0.08 * up, 0.008, 40),
        (PLACE_M + 0.08 * up, 0.08, 10),
    ]
    path = [(waypoints[0][0], waypoints[0][1])]
    for eef_m, width_m, n in waypoints[1:]:
        start_m, start_width_m = path[-1]
        for fraction in np.linspace(1 / n, 1, n):
            width = start_width_m + fraction * (width_m - start_width_m)
            path.append((start_m + fraction * (eef_m - start_m), width))
    return path


def track(path, bowl_m=BOWL_START_M) -> list[tuple[int, float]]:
    tracker = PickAndPlaceTracker(GEOMETRY, BOWL_START_M, PLATE_START_M)
    rows = []
    for eef_m, width_m in path:
        index = tracker.update(observation_at(eef_m, width_m, bowl_m))
        rows.append((index, tracker.progress))
    return rows


def test_tracker_goes_through_every_phase_in_order():
    indices = [index for index, _ in track(ideal_path())]
    assert sorted(set(indices)) == list(range(6))
    assert set(np.diff(indices)) <= {0, 1}


def test_progress_is_in_bounds_and_never_falls_within_a_phase():
    rng = np.random.default_rng(0)
    shaky = [(eef_m + rng.normal(0, 0.004, 3), width) for eef_m, width in ideal_path()]
    rows = track(shaky)
    for (before, old), (after, new) in pairwise(rows):
        assert 0.0 <= new <= 1.0
        assert after > before or new >= old
    assert rows[-1] == (RELEASE, 1.0)


def test_lift_progress_is_height():
    up = np.array([0.0, 0.0, 1.0])
    tracker = PickAndPlaceTracker(GEOMETRY, BOWL_START_M, PLATE_START_M)
    tracker.index = LIFT
    tracker.update(observation_at(GRASP_M + 0.035 * up))
    tracker.update(observation_at(GRASP_M + 0.11 * up))
    assert tracker.progress == pytest.approx(0.5)


def test_tracker_never_reads_the_live_bowl():
    assert track(ideal_path(), bowl_m=np.full(3, 9.0)) == track(ideal_path())


def test_grasp_lasts_and_needs_closing_fingers():
    up = np.array([0.0, 0.0, 1.0])
    tracker = PickAndPlaceTracker(GEOMETRY, BOWL_START_M, PLATE_START_M)
    tracker.index = GRASP
    for _ in range(15):
        assert tracker.update(observation_at(GRASP_M + 0.034 * up, 0.08)) == GRASP
    assert tracker.update(observation_at(GRASP_M + 0.034 * up, 0.08)) == GRASP
    assert tracker.update(observation_at(GRASP_M + 0.034 * up, 0.0)) == LIFT
    assert tracker.steps_in_phase == 1


def test_task_takes_the_objects_of_the_first_observation():
    first = observation_at(GRASP_M + np.array([0.0, 0.0, 0.12]))
    tracker = TASK.tracker(first)
    tracker.update(first)
    assert TASK.phases[tracker.update(first)] == "DESCEND"
