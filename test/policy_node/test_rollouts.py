from __future__ import annotations

import json

import numpy as np
import pytest
from demonstrations import TOPIC_MAP
from mlps import mlp
from toy_policies import ChunkedPolicy

pytestmark = pytest.mark.sim
pytest.importorskip("mujoco")
pytest.importorskip("libero")

from sim_node.fields import ObservedFields  # noqa: E402 - needs LIBERO
from sim_node.settings import EpisodeLimits  # noqa: E402 - needs LIBERO
from sim_node.tasks.bowl_on_plate import TASK  # noqa: E402 - needs LIBERO
from sim_node.tasks.task import Step  # noqa: E402 - needs LIBERO

MAX_STEPS = 12


@pytest.fixture(scope="module")
def env():
    with TASK.environment() as simulator:
        yield simulator


@pytest.fixture(scope="module")
def start():
    return TASK.start("generated-0-000")


def test_observations_become_fields_of_the_topic_map(env, start):
    observed = ObservedFields(env, TOPIC_MAP, [*mlp("fingers").observed, "joint_position"])
    first = env.reset(start.state)
    values = observed.values(Step(0, first, 3, "LIFT", 0.5))
    for name, value in values.items():
        assert value.shape == (len(TOPIC_MAP.fields[name].values),)
    assert set(mlp("fingers").observed) <= {*values, "phase"}
    assert 0.8 < values["bowl_position"][2] < 1.0


def test_rollout_is_bounded_and_repeats_exactly(env, start):
    from policy_node.rollouts import rollout

    made = mlp()
    first = rollout(env, TASK, start, made, TOPIC_MAP, MAX_STEPS)
    state = env.data.qpos.copy()
    assert rollout(env, TASK, start, made, TOPIC_MAP, MAX_STEPS) == first
    np.testing.assert_array_equal(env.data.qpos, state)
    assert json.loads(json.dumps(first.to_json())) == {
        "policy": made.card.id,
        "start": start.name,
        "success": False,
        "steps": MAX_STEPS,
        "stage": first.stage,
    }
    assert first.stage in TASK.phases


def test_success_ends_the_rollout(env, start, monkeypatch):
    from policy_node.rollouts import rollout

    monkeypatch.setattr(env, "is_success", lambda: True)
    done = rollout(env, TASK, start, mlp(), TOPIC_MAP, MAX_STEPS)
    assert (done.success, done.steps) == (True, 1)


@pytest.mark.parametrize(("defect", "why"), [("none", ""), ("early_release", "lost")])
def test_a_dropped_bowl_is_given_up_and_a_carried_one_is_not(env, start, defect, why):
    from policy_node.rollouts import GiveUp
    from sim_node.defects import DEFECTS
    from sim_node.episodes import run_episode

    def run(give_up):
        controller = DEFECTS[defect].inject(TASK.expert(0), TASK, 0)
        limits = EpisodeLimits(steps_after_success=0)
        return run_episode(env, TASK, start, controller, limits, give_up=give_up)

    ended, whole = run(GiveUp(TASK)), run(None)
    assert ended.given_up == why
    assert ended.is_success == whole.is_success == (defect == "none")
    assert (ended.n_steps == whole.n_steps) == (defect == "none")
    assert ended.n_steps < 300


def test_a_policy_that_goes_nowhere_is_given_up(env, start):
    from policy_node.rollouts import GiveUp, rollout

    class Idle(ChunkedPolicy):
        def act(self):
            return {"twist": np.zeros(3), "gripper": np.array([-1.0])}

    ended = rollout(env, TASK, start, Idle(), TOPIC_MAP, gives_up=True)
    assert (ended.success, ended.ended, ended.steps) == (False, "phase", GiveUp.PHASE_STEPS)
    assert ended.stage == TASK.phases[0]


@pytest.mark.parametrize("ensembles", [False, True])
def test_chunked_policy_is_rolled_out_like_any_other(env, start, ensembles):
    """Its commands are those that it gives when it is shown the same observations alone."""
    from policy_node.rollouts import SimController
    from sim_node.episodes import run_episode

    steps = []
    controller = SimController(ChunkedPolicy(5, ensembles), env, TOPIC_MAP)
    run_episode(
        env,
        TASK,
        start,
        controller,
        EpisodeLimits(MAX_STEPS),
        on_step=lambda *s: steps.append(s),
    )
    alone = ChunkedPolicy(horizon=5, ensembles=ensembles)
    observed = ObservedFields(env, TOPIC_MAP, alone.observed)
    for step, executed in steps:
        alone.observe(observed.values(step))
        command = alone.act()
        np.testing.assert_array_equal(executed.action_xyz, command["twist"])
        assert executed.gripper == command["gripper"][0]
    assert len(steps) == MAX_STEPS


def test_policy_without_gripper_leaves_it_as_it_is(env, start):
    from policy_node.rollouts import SimController

    class Handless(ChunkedPolicy):
        commanded = ("twist",)

        def act(self):
            return {"twist": super().act()["twist"]}

    step = Step(0, env.reset(start.state), 0, TASK.phases[0], 0.0)
    _, gripper = SimController(Handless(), env, TOPIC_MAP).act(step)
    assert gripper == 0.0
