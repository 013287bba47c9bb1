"""One control step of robosuite's OSC_POSE controller and MuJoCo, compiled to machine code.

robosuite runs MuJoCo's whole pipeline two or three times per 2 ms of simulated time, and computes
the controller in Python. Here the pipeline runs once: `mj_step1`, torques, `mj_step2`. Numba
compiles the controller, which calls MuJoCo's C functions by their names. The arithmetic is that of
robosuite 1.4, with one exception: 3x3, 6x6 and 7x7 systems are solved by Cholesky factors instead
of (pseudo-)inverses. Both agree to rounding, which a test checks against the stock path.

The first import of this module compiles the machine code, which takes seconds. Later imports load
it.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import llvmlite.binding
import mujoco
import numpy as np
from numba import njit, types

from curation_ros.core.errors import SimError

N_ARM = 7
"""Joints of the arm; they are the first ones of the model."""

GRIPPER_SPEED_PER_SUBSTEP = 0.01
"""Speed of the normalised finger target, as in robosuite's PandaGripper."""

NULLSPACE_KP = 10.0
NULLSPACE_KV = 2.0 * 10.0**0.5
"""Stiffness and critical damping to the nominal posture, as in robosuite's nullspace_torques."""


def _link_mujoco() -> None:
    """Link the C functions of Python's MuJoCo for Numba."""
    folder = Path(mujoco.__file__).parent
    for pattern in ("libmujoco.so*", "libmujoco*.dylib", "mujoco.dll"):
        for library in sorted(folder.glob(pattern)):
            try:
                llvmlite.binding.load_library_permanently(str(library))
            except RuntimeError as error:
                raise SimError(f"MuJoCo's library cannot be linked: {error}") from error
            return
    raise SimError(f"no MuJoCo library in {folder}")


def _compiled(signature: str) -> Callable[[Callable[..., Any]], Any]:
    """Numba's njit with a cache on disk, if there is a place for one."""
    # A division by zero gives a NaN, as elsewhere in MuJoCo; the check for divergence finds it.
    options: dict[str, Any] = {"nogil": True, "error_model": "numpy"}

    def decorate(function: Callable[..., Any]) -> Any:
        try:
            return njit(signature, cache=True, **options)(function)
        except RuntimeError as error:
            if "cannot cache" not in str(error):
                raise
            return njit(signature, **options)(function)

    return decorate


_link_mujoco()
_ADDRESS = types.intp
# By name: machine code with addresses cannot be cached.
_mj_step1: Any = types.ExternalFunction("mj_step1", types.void(_ADDRESS, _ADDRESS))
_mj_step2: Any = types.ExternalFunction("mj_step2", types.void(_ADDRESS, _ADDRESS))
_mj_kinematics: Any = types.ExternalFunction("mj_kinematics", types.void(_ADDRESS, _ADDRESS))
_mj_jac_site: Any = types.ExternalFunction(
    "mj_jacSite", types.void(_ADDRESS, _ADDRESS, _ADDRESS, _ADDRESS, types.int32)
)
# Not mj_fullM, because its arguments differ between versions of MuJoCo.
_mj_mul_m: Any = types.ExternalFunction(
    "mj_mulM", types.void(_ADDRESS, _ADDRESS, _ADDRESS, _ADDRESS)
)


@_compiled("void(float64[:,::1], int64)")
def _factor(a, n):  # type: ignore[no-untyped-def]
    """Replace the lower triangle of the symmetric (n, n) block by its Cholesky factor.

    A matrix that is not positive definite gives NaN, and the check for divergence finds it.
    """
    for j in range(n):
        for k in range(j):
            a[j, j] -= a[j, k] * a[j, k]
        a[j, j] = np.sqrt(a[j, j])
        for i in range(j + 1, n):
            for k in range(j):
                a[i, j] -= a[i, k] * a[j, k]
            a[i, j] /= a[j, j]


@_compiled("void(float64[:,::1], int64, float64[::1])")
def _solve(factor, n, b):  # type: ignore[no-untyped-def]
    """Solve in place for one right-hand side, given the Cholesky factor."""
    for i in range(n):
        for k in range(i):
            b[i] -= factor[i, k] * b[k]
        b[i] /= factor[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            b[i] -= factor[k, i] * b[k]
        b[i] /= factor[i, i]


@_compiled(
    "void(intp, intp, int64, int32, float64[::1], float64[::1], float64[::1], float64[::1], "
    "float64[::1], float64[::1], float64[::1], float64[:,::1], float64[::1], float64, float64, "
    "float64[:,::1], float64[::1], float64)"
)
def control_step(  # type: ignore[no-untyped-def]
    model,
    data,
    n_substeps,
    site_id,
    qpos,
    qvel,
    ctrl,
    qfrc_bias,
    site_position,
    site_rotation,
    delta_position_m,
    goal_rotation,
    nominal_joint_position_rad,
    kp,
    kd,
    ctrl_range,
    finger_target,
    gripper_sign,
):
    """Advance the simulation by one control step and refresh the poses.

    Args:
        model: address of the mjModel.
        data: address of the mjData.
        n_substeps: MuJoCo steps per control step.
        site_id: of the grip site.
        qpos: (nq,) view of the mjData, arm first, then the two fingers.
        qvel: (nv,) view of the mjData, in the same order.
        ctrl: (nu,) view of the mjData, in the same order.
        qfrc_bias: (nv,) view of the mjData.
        site_position: (3,) view of the grip site's position in the mjData.
        site_rotation: (9,) view of the grip site's rotation matrix in the mjData.
        delta_position_m: (3,) goal relative to the position at the start of the step.
        goal_rotation: (3, 3) rotation to hold.
        nominal_joint_position_rad: (7,) posture to which the null space is drawn.
        kp: stiffness, 1/s^2.
        kd: damping, 1/s.
        ctrl_range: (nu, 2) limits: torques of the arm, positions of the fingers.
        finger_target: (2,) normalised finger targets, kept from step to step, changed in place.
        gripper_sign: -1 opens, +1 closes, 0 holds the target.
    """
    n_velocity = qvel.shape[0]
    jacobian_p = np.empty((3, n_velocity))
    jacobian_r = np.empty((3, n_velocity))
    unit = np.zeros(n_velocity)
    column = np.empty(n_velocity)
    mass = np.empty((7, 7))
    mass_factor = np.empty((7, 7))
    jacobian = np.empty((6, 7))
    a = np.empty((6, 7))  # J M^-1
    inverse_lambda = np.empty((6, 6))
    lambda_factor = np.empty((6, 6))
    position_factor = np.empty((3, 3))
    rotation_factor = np.empty((3, 3))
    force = np.empty(3)
    torque = np.empty(3)
    velocity = np.empty(6)
    posture = np.empty(7)
    null = np.empty(6)
    goal_position = np.empty(3)

    for substep in range(n_substeps):
        _mj_step1(model, data)
        if substep == 0:
            for i in range(3):
                goal_position[i] = site_position[i] + delta_position_m[i]

        _mj_jac_site(model, data, jacobian_p.ctypes.data, jacobian_r.ctypes.data, site_id)
        for i in range(3):
            velocity[i] = 0.0
            velocity[3 + i] = 0.0
            for j in range(7):
                jacobian[i, j] = jacobian_p[i, j]
                jacobian[3 + i, j] = jacobian_r[i, j]
                velocity[i] += jacobian_p[i, j] * qvel[j]
                velocity[3 + i] += jacobian_r[i, j] * qvel[j]
        for j in range(7):
            unit[j] = 1.0
            _mj_mul_m(model, data, column.ctypes.data, unit.ctypes.data)
            unit[j] = 0.0
            for i in range(7):
                mass[i, j] = column[i]
                mass_factor[i, j] = column[i]

        _factor(mass_factor, 7)
        for i in range(6):
            for j in range(7):
                a[i, j] = jacobian[i, j]
            _solve(mass_factor, 7, a[i])
        for i in range(6):
            for j in range(6):
                total = 0.0
                for k in range(7):
                    total += a[i, k] * jacobian[j, k]
                inverse_lambda[i, j] = total
                lambda_factor[i, j] = total
        for i in range(3):
            for j in range(3):
                position_factor[i, j] = inverse_lambda[i, j]
                rotation_factor[i, j] = inverse_lambda[3 + i, 3 + j]

        # Half the sum of the cross products of the axes is the remaining rotation.
        for i in range(3):
            force[i] = kp * (goal_position[i] - site_position[i]) - kd * velocity[i]
            torque[i] = -kd * velocity[3 + i]
        for axis in range(3):
            c0 = site_rotation[axis]
            c1 = site_rotation[3 + axis]
            c2 = site_rotation[6 + axis]
            d0 = goal_rotation[0, axis]
            d1 = goal_rotation[1, axis]
            d2 = goal_rotation[2, axis]
            torque[0] += kp * 0.5 * (c1 * d2 - c2 * d1)
            torque[1] += kp * 0.5 * (c2 * d0 - c0 * d2)
            torque[2] += kp * 0.5 * (c0 * d1 - c1 * d0)
        _factor(position_factor, 3)
        _solve(position_factor, 3, force)
        _factor(rotation_factor, 3)
        _solve(rotation_factor, 3, torque)

        # Torques to the nominal posture, minus the part that would move the hand.
        for i in range(7):
            total = 0.0
            for j in range(7):
                total += mass[i, j] * (
                    NULLSPACE_KP * (nominal_joint_position_rad[j] - qpos[j])
                    - NULLSPACE_KV * qvel[j]
                )
            posture[i] = total
        for i in range(6):
            total = 0.0
            for j in range(7):
                total += a[i, j] * posture[j]
            null[i] = total
        _factor(lambda_factor, 6)
        _solve(lambda_factor, 6, null)

        for j in range(7):
            total = qfrc_bias[j] + posture[j]
            for i in range(3):
                total += jacobian[i, j] * (force[i] - null[i])
                total += jacobian[3 + i, j] * (torque[i] - null[3 + i])
            ctrl[j] = min(max(total, ctrl_range[j, 0]), ctrl_range[j, 1])

        # The two fingers move in opposite directions.
        for finger in range(2):
            direction = -1.0 if finger == 0 else 1.0
            target = finger_target[finger] + direction * GRIPPER_SPEED_PER_SUBSTEP * gripper_sign
            target = min(max(target, -1.0), 1.0)
            finger_target[finger] = target
            low = ctrl_range[7 + finger, 0]
            high = ctrl_range[7 + finger, 1]
            ctrl[7 + finger] = 0.5 * (high + low) + 0.5 * (high - low) * target
        _mj_step2(model, data)

    # mj_step2 leaves the poses as they were before the last substep.
    _mj_kinematics(model, data)
