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

from asm_gym.addresses import floats1, floats2, floats3, whole1, whole2
from asm_gym.compilation import compiled
from asm_gym.envs.control import brake, control, hand_velocity, hold_at, set_goal
from asm_gym.envs.mujoco_views import (
    ACTS,
    ARMED,
    FELT,
    JOINTS,
    LEFT,
    PASSED,
    STAYED,
    Arms,
    Floats,
    Goals,
    Ints,
    NominalViews,
    SubstepLimits,
    Views,
    arms_at,
    goals_at,
    limits_at,
    nominal_at,
    views_at,
)

# What one arm's sensors give in a substep, side by side.
EXTERNAL = slice(0, JOINTS)
MOTOR = slice(JOINTS, 2 * JOINTS)
WRENCH = slice(2 * JOINTS, 2 * JOINTS + 6)
CONTACT = slice(2 * JOINTS + 6, 2 * JOINTS + 9)
VELOCITY = slice(2 * JOINTS + 9, 2 * JOINTS + 15)
OUTSIDE = slice(2 * JOINTS + 15, 2 * JOINTS + 18)
SAMPLE = OUTSIDE.stop

ARMS_AT = len(Views._fields)
GOALS_AT = ARMS_AT + len(Arms._fields)
LIMITS_AT = GOALS_AT + len(Goals._fields)
"""Where these begin in the table of ``run``, after Views."""

# MuJoCo's own functions, linked by name so that the compiled loop can be cached on disk.
binding.load_library_permanently(str(next(Path(mujoco.__file__).parent.glob("libmujoco*"))))
_on_data = types.void(types.intp, types.intp)
_step1: Any = types.ExternalFunction("mj_step1", _on_data)
_step2: Any = types.ExternalFunction("mj_step2", _on_data)
_kinematics: Any = types.ExternalFunction("mj_kinematics", _on_data)
_com_pos: Any = types.ExternalFunction("mj_comPos", _on_data)
_com_vel: Any = types.ExternalFunction("mj_comVel", _on_data)
_mass: Any = types.ExternalFunction("mj_makeM" if hasattr(mujoco, "mj_makeM") else "mj_crb", _on_data)
_rne: Any = types.ExternalFunction("mj_rne", types.void(types.intp, types.intp, types.int32, types.intp))


@compiled
def _believe(views: Views, nominal: NominalViews) -> None:
    """Brings the nominal model's dynamics to the live joint positions and velocities."""
    nominal.qpos[:] = views.qpos
    nominal.qvel[:] = views.qvel
    _kinematics(nominal.model, nominal.data)
    _com_pos(nominal.model, nominal.data)
    _mass(nominal.model, nominal.data)
    _com_vel(nominal.model, nominal.data)
    _rne(nominal.model, nominal.data, 0, nominal.bias.ctypes.data)


@compiled
def sample(views: Views, nominal: NominalViews, arms: Arms, k: int, samples: Floats) -> None:
    """Writes what the sensors of every arm give after substep ``k`` into samples (A, K, SAMPLE)."""
    edited = nominal.model != 0
    mass = nominal.mass if edited else views.mass
    bias = nominal.bias if edited else views.bias
    needed = np.empty(JOINTS)
    for a in range(len(arms.joints)):
        row = samples[a, k]
        n = arms.joints[a]
        needed[:] = 0.0
        for t in range(arms.tree.shape[1]):
            i = arms.tree[a, t]
            if i < 0:
                break
            j, at = i, views.mass_address[i]
            while j >= 0:
                for r in range(n):
                    if arms.dofs[a, r] == i:
                        needed[r] += mass[at] * views.qacc[j]
                    elif arms.dofs[a, r] == j:
                        needed[r] += mass[at] * views.qacc[i]
                at += 1
                j = views.parent[j]
        for i in range(n):
            dof = arms.dofs[a, i]
            damped = views.passive[dof] + (views.damping[dof] - nominal.damping[dof]) * views.qvel[dof]
            row[i] = needed[i] + bias[dof] - damped - views.actuator[dof]
            row[JOINTS + i] = views.actuator[dof]
        at = arms.wrench[a]
        for i in range(6):
            row[2 * JOINTS + i] = views.sensordata[at + i]
        for i in range(3):
            row[2 * JOINTS + 6 + i] = row[2 * JOINTS + 15 + i] = 0.0
        for t in range(arms.bodies.shape[1]):
            body = arms.bodies[a, t]
            if body < 0:
                break
            for i in range(3):
                row[2 * JOINTS + 6 + i] += views.contact[body, 3 + i] - views.applied[body, i]
                row[2 * JOINTS + 15 + i] += views.contact[body, 3 + i]
        hand_velocity(views, arms, a, views.subtree_com[arms.root[a]], row[2 * JOINTS + 9 :])


@compiled
def feel(arms: Arms, limits: SubstepLimits, k: int, samples: Floats) -> None:
    """Compares what the arms felt in substep ``k`` with the limits; what is not a number passes them."""
    state = limits.state
    if state[ARMED]:
        for a in range(len(arms.joints)):
            for i in range(FELT):
                if i < JOINTS and i >= arms.joints[a]:
                    continue
                value = samples[a, k, i if i < JOINTS else i - JOINTS + WRENCH.start]
                load = abs(value) / limits.most[a, i]
                if not load <= limits.load[0]:
                    limits.load[0] = load if load == load else np.inf
                if state[LEFT] < 0 and not load <= 1.0:
                    state[LEFT] = state[PASSED]
    state[PASSED] += 1


@compiled
def brake_held(views: Views, nominal: NominalViews, arms: Arms, goals: Goals) -> None:
    """Brakes the arms that are held, beneath controllers that are not compiled."""
    if goals.held.any():
        if nominal.model != 0:
            _believe(views, nominal)
        for a in range(len(arms.joints)):
            if goals.held[a]:
                brake(views, nominal, arms, goals, a)


@compiled
def must_stay(limits: SubstepLimits) -> bool:
    """Whether the arms are to be told now to stay, which they are once."""
    state = limits.state
    now = state[ACTS] and state[LEFT] >= 0 and not state[STAYED]
    if now:
        state[STAYED] = 1
    return bool(now)


@partial(compiled, calls=(".",), nogil=True)
def run(t: Any, nominal_table: Any, fresh: bool, first: int, count: int) -> None:
    """Runs ``count`` physics substeps, controllers and sensors included.

    Args:
        t: the ``table`` of Views, Arms, Goals, SubstepLimits, the action in metres and radians (A, JOINTS), the
            rotation it asks for (A, 3, 3), and samples (A, K, SAMPLE), which are written at ``first`` and after. From
            the substep after a limit is passed, the arms stay where they are, if that is asked for.
        nominal_table: of NominalViews.
        fresh: the set-points are to be moved by the action in the first of these substeps.
        first: which substep of the control step comes next.
    """
    views, nominal, arms = views_at(t), nominal_at(nominal_table), arms_at(t[ARMS_AT:])
    goals, limits = goals_at(t[GOALS_AT:]), limits_at(t[LIMITS_AT:])
    last = len(t) - 3
    deltas, turns, samples = floats2(t, last), floats3(t, last + 1), floats3(t, last + 2)
    for k in range(first, first + count):
        _step1(views.model, views.data)
        if nominal.model != 0:
            _believe(views, nominal)
        stay = must_stay(limits)
        for a in range(len(arms.joints)):
            if stay:
                hold_at(views, arms, goals, a)
            elif fresh and k == first:
                set_goal(views, arms, goals, a, deltas[a], turns[a])
            control(views, nominal, arms, goals, a)
        _step2(views.model, views.data)
        sample(views, nominal, arms, k, samples)
        feel(arms, limits, k, samples)


@partial(compiled, calls=(".",))
def read(t: Any, count: int, beside: Any, row: Any, stream: Any) -> tuple[float, float, float, bool, bool]:
    """Summarises the first ``count`` samples, if there are any, and writes what the sensors read, and its stream.

    Args:
        t: the ``table`` of samples, their mean, peak and last, arrays of MuJoCo's, ``where`` (P, 2) of each number that
            the arms sense its source among mean and those after it, and its place there, the (M,) noise, the (M,) steps
            of resolution, 0 for none, and (D,) which numbers of a row the stream carries.
        beside: (M - P,) what comes after what the arms sense.
        row: (M,) of how many standard deviations each number is off; what is read is written there.
        stream: (D,) of single precision, written.

    Returns:
        What ``summarise`` does, and whether the row and the stream are finite, in single precision.
    """
    mean, peak, last = floats2(t, 1), floats2(t, 2), floats2(t, 3)
    contact, external, usual = summarise(floats3(t, 0), count, mean, peak, last) if count else (0.0, 0.0, 0.0)
    arms = mean.ravel(), peak.ravel(), last.ravel()
    sources = *arms, floats1(t, 4), floats1(t, 5), floats1(t, 6), floats1(t, 7), floats1(t, 8), floats1(t, 9)
    where, noise, steps, carried = whole2(t, 10), floats1(t, 11), floats1(t, 12), whole1(t, 13)
    whole = through = True
    for n in range(len(row)):
        value = sources[where[n, 0]][where[n, 1]] if n < len(where) else beside[n - len(where)]
        value += noise[n] * row[n]
        row[n] = np.rint(value / steps[n]) * steps[n] if steps[n] > 0.0 else value
        whole = whole and np.isfinite(np.float32(row[n]))
    for n in range(len(carried)):
        stream[n] = np.float32(row[carried[n]])
        through = through and np.isfinite(stream[n])
    return contact, external, usual, whole, through


@compiled
def summarise(samples: Floats, count: int, mean: Floats, peak: Floats, last: Floats) -> tuple[float, float, float]:
    """Writes the mean, signed peak and last of the first ``count`` substeps into mean, peak and last (A, SAMPLE).

    Returns:
        The largest contact force on an arm, the largest force on it from anything outside, and the mean of the latter
        [N], norms of their vectors; not finite where a sample is not.
    """
    largest = external = total = 0.0
    for a in range(len(samples)):
        mean[a] = 0.0
        peak[a] = 0.0
        last[a] = samples[a, count - 1]
        for k in range(count):
            row = samples[a, k]
            for i in range(SAMPLE):
                mean[a, i] += row[i] / count
                # NaN compares false: it is taken when it comes, and stays.
                if not abs(row[i]) <= abs(peak[a, i]) and peak[a, i] == peak[a, i]:
                    peak[a, i] = row[i]
            force = np.sqrt(np.sum(row[2 * JOINTS + 6 : 2 * JOINTS + 9] ** 2))
            if not force <= largest and largest == largest:
                largest = force
            outside = np.sqrt(np.sum(row[2 * JOINTS + 15 : 2 * JOINTS + 18] ** 2))
            total += outside / count
            if not outside <= external and external == external:
                external = outside
    return largest, external, total


@compiled
def mean_felt(samples: Floats, count: int, arms: Ints, columns: Ints, out: Floats) -> None:
    """Writes the mean of the first ``count`` samples of ``arms`` (N,) at ``columns`` (N,) into out."""
    for n in range(len(out)):
        total = samples[arms[n], 0, columns[n]]
        for k in range(1, count):
            total += samples[arms[n], k, columns[n]]
        out[n] = total / count


@compiled
def edited(live: Floats, frozen: Floats, rows: Ints) -> bool:
    """Whether two arrays (N, M) differ in any of ``rows``."""
    for r in rows:
        for c in range(live.shape[1]):
            if live[r, c] != frozen[r, c]:
                return True
    return False
