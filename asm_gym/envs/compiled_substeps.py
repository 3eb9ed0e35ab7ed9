"""The compiled substep loop: physics, control and sensors in one call.

External joint torque is what the motors and the nominal dynamics do not explain,

    τ_ext = M(q) q̈ + h(q, q̇) - τ_passive - τ_motor,

the quantity a momentum observer estimates (Haddadin, De Luca, Albu-Schäffer 2017, Eq. 15 at infinite gain).
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from llvmlite import binding
from numba import types
from numpy.typing import NDArray

from asm_gym.compilation import compiled, inner
from asm_gym.envs.control import HELD, control, read_arm, set_goal, slow_down
from asm_gym.envs.mujoco_views import (
    ACTS,
    ARMED,
    BRAKED,
    FELT,
    JOINTS,
    PASSED_IN,
    STAYED,
    SUBSTEPS,
    Arms,
    Bound,
    Floats,
    Goals,
    Ints,
    NominalViews,
    SubstepLimits,
    Views,
    Work,
)

# Parts of one arm's sample in a substep.
EXTERNAL = slice(0, JOINTS)
MOTOR = slice(JOINTS, 2 * JOINTS)
WRENCH = slice(2 * JOINTS, 2 * JOINTS + 6)
CONTACT = slice(2 * JOINTS + 6, 2 * JOINTS + 9)
VELOCITY = slice(2 * JOINTS + 9, 2 * JOINTS + 15)
SAMPLE = VELOCITY.stop
_WRENCH, _CONTACT, _VELOCITY = WRENCH.start, CONTACT.start, VELOCITY.start

# MuJoCo's own functions, linked by name so that the compiled loop can be cached on disk.
binding.load_library_permanently(str(next(Path(mujoco.__file__).parent.glob("libmujoco*"))))
_on_data = types.void(types.intp, types.intp)
_step1: Any = types.ExternalFunction("mj_step1", _on_data)
_step2: Any = types.ExternalFunction("mj_step2", _on_data)
_kinematics: Any = types.ExternalFunction("mj_kinematics", _on_data)
_com_pos: Any = types.ExternalFunction("mj_comPos", _on_data)
_com_vel: Any = types.ExternalFunction("mj_comVel", _on_data)
_mass: Any = types.ExternalFunction("mj_makeM", _on_data)
_rne: Any = types.ExternalFunction(
    "mj_rne", types.void(types.intp, types.intp, types.int32, types.intp)
)


@partial(inner, inlined=True)
def _evaluate_nominal(views: Views, nominal: NominalViews) -> None:
    """Evaluate the nominal model's dynamics at the live joint positions and velocities."""
    for i in range(len(nominal.qpos)):
        nominal.qpos[i] = views.qpos[i]
    for i in range(len(nominal.qvel)):
        nominal.qvel[i] = views.qvel[i]
    _kinematics(nominal.model, nominal.data)
    _com_pos(nominal.model, nominal.data)
    _mass(nominal.model, nominal.data)
    _com_vel(nominal.model, nominal.data)
    _rne(nominal.model, nominal.data, 0, nominal.bias_at)


@compiled
def sample(views: Views, nominal: NominalViews, arms: Arms, k: int, samples: Floats) -> None:
    """Write the sensor values of every arm after substep ``k`` into samples (A, K, SAMPLE)."""
    for a in range(len(arms.joints)):
        for i in range(SAMPLE):
            samples[a, k, i] = 0.0
        for t in range(arms.tree.shape[1]):
            i = arms.tree[a, t]
            if i < 0:
                break
            first = views.M_rowadr[i]
            for at in range(first + views.M_rownnz[i] - 1, first - 1, -1):
                j = views.M_colind[at]
                for r in range(arms.joints[a]):
                    if arms.dofs[a, r] == i:
                        samples[a, k, r] += nominal.mass[at] * views.qacc[j]
                    elif arms.dofs[a, r] == j:
                        samples[a, k, r] += nominal.mass[at] * views.qacc[i]
        for i in range(arms.joints[a]):
            dof = arms.dofs[a, i]
            damped = (
                views.qfrc_passive[dof]
                + (views.dof_damping[dof] - nominal.damping[dof]) * views.qvel[dof]
            )
            samples[a, k, i] += nominal.bias[dof] - damped - views.qfrc_actuator[dof]
            samples[a, k, JOINTS + i] = views.qfrc_actuator[dof]
        for i in range(6):
            samples[a, k, _WRENCH + i] = views.sensordata[arms.wrench[a] + i]
        for t in range(arms.bodies.shape[1]):
            body = arms.bodies[a, t]
            if body < 0:
                break
            for i in range(3):
                samples[a, k, _CONTACT + i] += (
                    views.cfrc_ext[body, 3 + i] - views.xfrc_applied[body, i]
                )
        site, body, root = arms.site[a], arms.site_body[a], arms.root[a]
        for i in range(3):
            j, m = (i + 1) % 3, (i + 2) % 3
            y = views.site_xpos[site, j] - views.subtree_com[root, j]
            z = views.site_xpos[site, m] - views.subtree_com[root, m]
            turning = views.cvel[body, j] * z - views.cvel[body, m] * y
            samples[a, k, _VELOCITY + i] = views.cvel[body, 3 + i] + turning
            samples[a, k, _VELOCITY + 3 + i] = views.cvel[body, i]


@compiled
def feel(joints: Ints, limits: SubstepLimits, held: Ints, k: int, samples: Floats) -> None:
    """Compare the load of arms of so many ``joints`` (A,) in substep ``k`` with the limits; NaN passes a limit.

    Where a limit is the first to be passed in a control step, and asks for it, all arms are ``held`` (A,) from the next
    substep on where they then are; those that are held already, where they were.
    """
    state = limits.state
    for a in range(len(joints) if state[ARMED] else 0):
        for i in range(FELT):
            if i < JOINTS and i >= joints[a]:
                continue
            load = abs(samples[a, k, i if i < JOINTS else i - JOINTS + _WRENCH]) / limits.most[a, i]
            if not load <= limits.load[0]:
                limits.load[0] = load if load == load else np.inf
            if state[PASSED_IN] < 0 and not load <= 1.0:
                state[PASSED_IN] = state[SUBSTEPS]
    state[SUBSTEPS] += 1
    if state[ACTS] == 0 or state[PASSED_IN] < 0 or state[STAYED] != 0:
        return
    state[STAYED] = 1
    for a in range(len(held)):
        if held[a] == 0:
            held[a] = HELD


@compiled
def brake_beneath(
    views: Views, nominal: NominalViews, arms: Arms, goals: Goals, work: Work, limits: SubstepLimits
) -> None:
    """Brake the arms that are held or too fast, where their controllers are not compiled."""
    if nominal.model != 0:
        _evaluate_nominal(views, nominal)
    for a in range(len(arms.joints)):
        if goals.held[a] != 0:
            control(views, nominal, arms, goals, work, a)
        else:
            read_arm(views, nominal, arms, work, a)
            limits.state[BRAKED] += slow_down(views, arms, limits, work, a)


@compiled
def bind(*parts: Any) -> Bound:
    """Return what ``run`` works on.

    Args:
        parts: ``Views``, ``NominalViews``, ``Arms``, ``Goals``, ``Work``, ``SubstepLimits``; samples (A, K, SAMPLE).
    """
    return Bound(parts)  # type: ignore[no-untyped-call]


@partial(compiled, nogil=True)
def run(bound: Bound, fresh: bool, first: int, count: int) -> None:
    """Run ``count`` physics substeps, controllers and sensors included.

    Args:
        bound: of ``bind``; samples are written at ``first`` and after.
        fresh: the action moves the set-points in the first of these substeps.
        first: index of the first substep within the row.

    From the substep after a limit is passed, the arms stay where they are, where the limits ask for that.
    """
    views, nominal, arms, goals, work, limits, samples = bound.parts
    for k in range(first, first + count):
        _step1(views.model, views.data)
        if nominal.model != 0:
            _evaluate_nominal(views, nominal)
        for a in range(len(arms.joints)):
            if fresh and k == first and goals.held[a] == 0:
                set_goal(views, arms, goals, work, a)
            control(views, nominal, arms, goals, work, a)
            if goals.held[a] == 0:
                limits.state[BRAKED] += slow_down(views, arms, limits, work, a)
        _step2(views.model, views.data)
        # the place for all that is measured in every substep
        sample(views, nominal, arms, k, samples)
        feel(arms.joints, limits, goals.held, k, samples)


@compiled
def sense(
    sources: tuple[Floats, ...], where: Ints, beside: Floats, noise: Floats, row: Floats
) -> None:
    """Turn standard normal draws (M,) in ``row`` into readings with ``noise`` (M,).

    Args:
        sources, where: arrays that the arms' sensors read; (P, 2) each number's source and its index there.
        beside: (M - P,) true values of the other numbers.
    """
    for n in range(len(row)):
        value = sources[where[n, 0]][where[n, 1]] if n < len(where) else beside[n - len(where)]
        row[n] = value + noise[n] * row[n]


@compiled
def finish(
    row: Floats,
    steps: Floats,
    carried: Ints,
    stream: NDArray[np.float32],
    seen: Ints,
    bound: float,
    observation: NDArray[np.float32],
) -> tuple[bool, bool]:
    """Round a row (M,) in place to resolutions ``steps`` (M,), 0 for none, and share its numbers out.

    Args:
        carried, seen: which numbers go into the stream (D,), and which into the observation (S,).
        bound: to which the observation is clipped; NaN becomes 0 there.

    Returns:
        Whether row and stream are finite in single precision.
    """
    row_finite = stream_finite = True
    for n in range(len(row)):
        if steps[n] > 0.0:
            row[n] = np.rint(row[n] / steps[n]) * steps[n]
        row_finite = row_finite and np.isfinite(np.float32(row[n]))
    for n in range(len(carried)):
        stream[n] = np.float32(row[carried[n]])
        stream_finite = stream_finite and np.isfinite(stream[n])
    for n in range(len(seen)):
        value = row[seen[n]]
        observation[n] = min(max(value, -bound), bound) if value == value else 0.0
    return row_finite, stream_finite


@compiled
def summarise(samples: Floats, count: int, mean: Floats, peak: Floats, last: Floats) -> float:
    """Write the mean, signed peak and last of the first ``count`` substeps into mean, peak and last (A, SAMPLE).

    Returns:
        The largest norm of the contact force on an arm [N]; not finite where a sample is not.
    """
    largest = 0.0
    for a in range(len(samples)):
        for i in range(SAMPLE):
            mean[a, i] = peak[a, i] = 0.0
            last[a, i] = samples[a, count - 1, i]
            for k in range(count):
                value = samples[a, k, i]
                mean[a, i] += value / count
                # NaN compares false: it is taken when it comes, and stays.
                if not abs(value) <= abs(peak[a, i]) and peak[a, i] == peak[a, i]:
                    peak[a, i] = value
        for k in range(count):
            x, y, z = (
                samples[a, k, _CONTACT],
                samples[a, k, _CONTACT + 1],
                samples[a, k, _CONTACT + 2],
            )
            force = np.sqrt(x * x + y * y + z * z)
            if not force <= largest and largest == largest:
                largest = force
    return largest


@compiled
def touching(pairs: Ints, one: NDArray[np.bool_], other: NDArray[np.bool_]) -> bool:
    """Whether, among pairs (N, 2) of geoms in contact, one of the first group (G,) touches one of the other (G,)."""
    for n in range(len(pairs)):
        a, b = pairs[n]
        if (one[a] and other[b]) or (one[b] and other[a]):
            return True
    return False


@compiled
def edited(live: tuple[Floats, ...], frozen: tuple[Floats, ...], rows: Ints) -> bool:
    """Whether arrays (N, M) differ from others in any of ``rows``."""
    for k in range(len(live)):
        for r in rows:
            for c in range(live[k].shape[1]):
                if live[k][r, c] != frozen[k][r, c]:
                    return True
    return False
