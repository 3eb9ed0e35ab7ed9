"""The compiled substep loop: physics, control and sensors in one call.

External joint torque is what the motors and the nominal dynamics do not explain,

    τ_ext = M(q) q̈ + h(q, q̇) - τ_passive - τ_motor,

the quantity a momentum observer estimates (Haddadin, De Luca, Albu-Schäffer 2017, Eq. 15 at infinite gain).
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from numba import types
from numpy.typing import NDArray

from asm_gym.compilation import Bound, compiled, inner
from asm_gym.envs.arm_brake import slow_down
from asm_gym.envs.controller_inputs import within
from asm_gym.envs.controllers import (
    HELD,
    control,
    length,
    note_strengths,
    read_arm,
    set_goal,
)
from asm_gym.envs.mujoco_views import (
    FELT,
    JOINTS,
    Arm,
    Arms,
    Floats,
    Goals,
    Ints,
    NominalViews,
    SubstepLimits,
    Views,
    Work,
    link_library,
)

# Parts of one arm's sample in a substep; those that have limits come first.
EXTERNAL = slice(0, JOINTS)
WRENCH = slice(EXTERNAL.stop, EXTERNAL.stop + 6)
MOTOR = slice(WRENCH.stop, WRENCH.stop + JOINTS)
CONTACT = slice(MOTOR.stop, MOTOR.stop + 3)
VELOCITY = slice(CONTACT.stop, CONTACT.stop + 6)
SAMPLE = VELOCITY.stop
_WRENCH = WRENCH.start
_MOTOR = MOTOR.start
_CONTACT = CONTACT.start
_VELOCITY = VELOCITY.start

OBSERVED_BOUND = 100.0  # of observations; nothing that a task does comes near it

link_library()
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
    if nominal.model == 0:
        return
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
    for a in range(len(arms)):
        arm = arms[a]
        row = samples[a, k]
        for i in range(SAMPLE):
            row[i] = 0.0
        read_torques(views, nominal, arm, row)
        for i in range(6):
            row[_WRENCH + i] = views.sensordata[arm.wrench + i]
        read_contact(views, arm, row)
        read_hand_velocity(views, arm, row)


@partial(inner, inlined=True)
def read_torques(views: Views, nominal: NominalViews, arm: Arm, row: Floats) -> None:
    """Add the external torques of an arm's joints to a row of 0, and write those of its motors."""
    t = 0
    while arm.tree_dofs[t] >= 0:
        add_inertia(views, nominal, arm, arm.tree_dofs[t], row)
        t += 1
    for i in range(arm.joint_count):
        dof = arm.dofs[i]
        motor_torque = views.qfrc_actuator[dof]
        unknown_damping = views.dof_damping[dof] - nominal.damping[dof]
        passive = views.qfrc_passive[dof] + unknown_damping * views.qvel[dof]
        row[i] += nominal.bias[dof] - passive - motor_torque
        row[_MOTOR + i] = motor_torque


@partial(inner, inlined=True)
def add_inertia(views: Views, nominal: NominalViews, arm: Arm, i: int, row: Floats) -> None:
    """Add what row ``i`` of the mass matrix, and the column that mirrors it, give the torques M q̈."""
    first = views.M_rowadr[i]
    last = first + views.M_rownnz[i] - 1
    for at in range(last, first - 1, -1):
        j = views.M_colind[at]
        mass = nominal.mass[at]
        for r in range(arm.joint_count):
            dof = arm.dofs[r]
            if dof == i:
                row[r] += mass * views.qacc[j]
            elif dof == j:
                row[r] += mass * views.qacc[i]


@partial(inner, inlined=True)
def read_contact(views: Views, arm: Arm, row: Floats) -> None:
    """Add the contact force on an arm, less the loads that faults apply, to a row of 0."""
    t = 0
    while arm.bodies[t] >= 0:
        body = arm.bodies[t]
        wrench = views.cfrc_ext[body]
        applied = views.xfrc_applied[body]
        for i in range(3):
            row[_CONTACT + i] += wrench[3 + i] - applied[i]
        t += 1


@partial(inner, inlined=True)
def read_hand_velocity(views: Views, arm: Arm, row: Floats) -> None:
    """Write the hand's linear and angular velocity."""
    twist = views.cvel[arm.site_body]  # at the robot's centre of mass: angular, then linear
    hand = views.site_xpos[arm.site]
    origin = views.subtree_com[arm.root]
    for i in range(3):
        j = (i + 1) % 3
        m = (i + 2) % 3
        y = hand[j] - origin[j]
        z = hand[m] - origin[m]
        turning = twist[j] * z - twist[m] * y
        row[_VELOCITY + i] = twist[3 + i] + turning
        row[_VELOCITY + 3 + i] = twist[i]


@inner
def largest_share(limits: Floats, k: int, samples: Floats, largest: float) -> float:
    """Return the greater of ``largest`` and the largest |load| / limit in substep ``k``.

    The limits are (A, FELT). A load that is NaN makes it infinite.
    """
    for a in range(len(limits)):
        loads = samples[a, k]
        for i in range(FELT):
            share = abs(loads[i]) / limits[a, i]
            if np.isnan(share):
                return np.inf
            largest = max(largest, share)
    return largest


@compiled
def feel(goals: Goals, limits: SubstepLimits, k: int, samples: Floats) -> None:
    """Compare the load of the arms in substep ``k`` with the limits.

    Note the first substep in which a limit is passed; if ``status.stops``, hold all arms from the
    next substep on. Arms that are held already keep their place.
    """
    status = limits.status[0]
    status.substeps += 1
    if status.armed:
        before = limits.load_share[0]
        limits.load_share[0] = largest_share(limits.load_limits, k, samples, before)
    if status.passed_after > 0 or limits.load_share[0] <= 1.0:
        return
    status.passed_after = status.substeps
    if status.stops:
        for a in range(len(goals)):
            if goals[a].held == 0:
                goals[a].held = HELD


@compiled
def evaluate_nominal(views: Views, nominal: NominalViews) -> None:
    """Evaluate the nominal model's dynamics, where controllers are not compiled."""
    _evaluate_nominal(views, nominal)


@partial(compiled, calls=("detection",))
def brake_beneath(
    views: Views, nominal: NominalViews, arms: Arms, goals: Goals, work: Work, limits: SubstepLimits
) -> None:
    """Brake the arms that are held or too fast, where their controllers are not compiled."""
    for a in range(len(arms)):
        if goals[a].held:
            control(views, nominal, arms[a], goals[a], work)
        else:
            read_arm(views, nominal, arms[a], work)
            limits.status[0].braked += slow_down(views, arms[a], goals[a], a, limits, work)


@partial(compiled, nogil=True, calls=("detection",))
def run(bound: Bound, fresh: bool, first: int, count: int) -> None:
    """Run ``count`` physics substeps, controllers and sensors included.

    Args:
        bound: its ``parts`` are, in this order: ``Views``, ``NominalViews``, ``Arms``, ``Goals``,
            ``Work``, ``SubstepLimits``; the action (N,) in robosuite's units; samples (A, K, SAMPLE)
            of A arms and K substeps of a row, written at ``first`` and after.
        fresh: the action moves the set-points in the first of these substeps.
        first: index of the first substep within the row.

    From the substep after a limit is passed, the arms stay where they are, where the limits ask for that.
    """
    views, nominal, arms, goals, work, limits, action, samples = bound.parts
    for k in range(first, first + count):
        _step1(views.model, views.data)
        _evaluate_nominal(views, nominal)
        for a in range(len(arms)):
            arm = arms[a]
            goal = goals[a]
            if fresh and k == first and goal.held == 0:
                set_goal(views, arm, goal, action, work)
            note_strengths(views, arm, goal)
            control(views, nominal, arm, goal, work)
            if goal.held == 0:
                limits.status[0].braked += slow_down(views, arm, goal, a, limits, work)
        _step2(views.model, views.data)
        # the place for all that is measured in every substep
        sample(views, nominal, arms, k, samples)
        feel(goals, limits, k, samples)


@compiled
def sense(
    sources: tuple[Floats, ...], places: Ints, other_values: Floats, noise: Floats, row: Floats
) -> None:
    """Turn standard normal draws into readings.

    Args:
        sources: arrays that the arms' sensors read.
        places: (P, 2) source of each number that they read, and its index there.
        other_values: (M - P,) true values of the other numbers.
        noise: (M,) standard deviations.
        row: (M,) draws on entry, readings on return.
    """
    count = len(places)
    for n in range(count):
        source = sources[places[n, 0]]
        value = source[places[n, 1]]
        row[n] = value + noise[n] * row[n]
    for n in range(count, len(row)):
        value = other_values[n - count]
        row[n] = value + noise[n] * row[n]


@compiled
def finish(
    row: Floats,
    resolution: Floats,
    carried: Ints,
    stream: NDArray[np.float32],
    observed: Ints,
    observation: NDArray[np.float32],
) -> tuple[bool, bool]:
    """Round a row (M,) in place to the sensors' resolution (M,), 0 for none, and share its numbers out.

    Args:
        carried, observed: which numbers go into the stream (D,), and which into the observation (S,), where they are
            clipped to ``OBSERVED_BOUND`` and NaN becomes 0.

    Returns:
        Whether row and stream are finite in single precision.
    """
    row_finite = True
    for n in range(len(row)):
        step = resolution[n]
        if step > 0.0:
            row[n] = np.rint(row[n] / step) * step
        row_finite = row_finite and np.isfinite(np.float32(row[n]))

    stream_finite = True
    for n in range(len(carried)):
        stream[n] = np.float32(row[carried[n]])
        stream_finite = stream_finite and np.isfinite(stream[n])

    for n in range(len(observed)):
        value = within(row[observed[n]], -OBSERVED_BOUND, OBSERVED_BOUND)
        if np.isnan(value):
            value = 0.0
        observation[n] = value
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
            mean[a, i] = 0.0
            peak[a, i] = 0.0
            last[a, i] = samples[a, count - 1, i]
            for k in range(count):
                value = samples[a, k, i]
                mean[a, i] += value / count
                peak[a, i] = larger(peak[a, i], value)
        for k in range(count):
            force = length(samples[a, k, _CONTACT:_VELOCITY])
            largest = larger(largest, force)
    return largest


@compiled
def summed_excess(samples: Floats, count: int, limit: float) -> float:
    """Return the contact force beyond ``limit`` [N], summed over the first ``count`` substeps."""
    total = 0.0
    for k in range(count):
        force = 0.0
        for a in range(len(samples)):
            force = larger(force, length(samples[a, k, _CONTACT:_VELOCITY]))
        total += max(force - limit, 0.0)
    return total


@inner
def larger(number: float, other: float) -> float:
    """Return the number of larger magnitude; NaN where one is NaN."""
    if np.isnan(number) or abs(other) <= abs(number):
        return number
    return other


@compiled
def touching(pairs: Ints, one: NDArray[np.bool_], other: NDArray[np.bool_]) -> bool:
    """Whether, among pairs (N, 2) of geoms in contact, one of the first group (G,) touches one of the other (G,)."""
    for n in range(len(pairs)):
        a, b = pairs[n]
        if one[a] and other[b]:
            return True
        if one[b] and other[a]:
            return True
    return False


@compiled
def edited(live: tuple[Floats, ...], frozen: tuple[Floats, ...], rows: Ints) -> bool:
    """Whether arrays (N, M) differ from others in any of ``rows``."""
    for k in range(len(live)):
        values = live[k]
        expected = frozen[k]
        for r in rows:
            for c in range(values.shape[1]):
                if values[r, c] != expected[r, c]:
                    return True
    return False
