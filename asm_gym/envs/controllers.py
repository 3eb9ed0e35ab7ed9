"""Robosuite's two commonest controllers, compiled.

Operational space control (Khatib 1987), as robosuite computes it, with J the hand's Jacobian and M the mass matrix:

    Λ = (J M⁻¹ Jᵀ)⁻¹,   F = Kp e - Kd v,   p = M (10 (q₀ - q) - 2√10 q̇),
    τ = Jᵀ [Λx Fx; Λr Fr] + h + (I - Jᵀ Λ J M⁻¹) p

Joint position control is τ = M (Kp (q* - q) - Kd q̇) + h. An arm that is held is braked beneath its controller,

    τ = s - M Kd q̇ + h,   s = M Kp (q₀ - q),   |sᵢ| <= Y (rᵢ + r₀),

critically damped about the place q₀ where the hold began: it goes q̇/(e √Kp) further where its motors have the torque,
and comes back without overshoot. Once it has come to rest it yields: where the spring of a joint would take more than
the force Y gives at the hand, which is rᵢ from the joint's axis, q₀ follows. Everything is solved through Cholesky
factors instead of robosuite's pseudo-inverses: the same numbers to rounding, and most of the speed.

Loops over arrays that exist already compile in a fifth of the time that array expressions take. Functions that take
tuples of arrays are inlined: each call would pass hundreds of numbers.
"""

from __future__ import annotations

import math
from functools import partial

import numpy as np

from asm_gym.compilation import inner
from asm_gym.envs.controller_inputs import rotation, scaled, within
from asm_gym.envs.mujoco_views import (
    JOINT_POSITION,
    Arm,
    Floats,
    Goal,
    NominalViews,
    Views,
    Work,
)

HOLD_STIFFNESS = 400.0  # Kp of an arm that is held [1/s²]
HOLD_DAMPING = 2.0 * math.sqrt(HOLD_STIFFNESS)  # its Kd [1/s]
YIELDS_AT = 60.0  # Y: force at the hand from which a held arm at rest gives way [N]
POSTURE_STIFFNESS = 10.0  # Kp of the posture of spare joints [1/s²]
POSTURE_DAMPING = 2.0 * math.sqrt(POSTURE_STIFFNESS)  # its Kd [1/s]

# States of ``Goal.held``; 0 is free.
HELD = 1  # to be held from the next substep on
BRAKING = 2  # on its way to rest
YIELDING = 3  # since it came to rest

LEAST_TORQUE = 1.0  # a smaller command does not tell how strong its motor is [N m]
WEAKEST = 0.2  # a motor is commanded at most the inverse of it times its torque
RESTING = 0.1  # an arm none of whose joints is faster than this has come to rest [rad/s]
YIELD_LEVER = 0.15  # r₀: the least lever of a joint [m]


@inner
def cholesky(M: Floats, n: int, L: Floats) -> None:
    """Write the lower factor of M (n, n) into L.

    A row that depends on those before it, or is not finite, becomes 0 in L.
    """
    for i in range(n):
        row = L[i]
        for j in range(i):
            earlier = L[j]
            entry = M[i, j]
            for k in range(j):
                entry -= row[k] * earlier[k]
            row[j] = divided(entry, earlier[j])

        square = M[i, i]
        for k in range(i):
            square -= row[k] * row[k]
        if square > 0.0:
            row[i] = np.sqrt(square)
        else:
            for k in range(i + 1):
                row[k] = 0.0


@inner
def divided(number: float, pivot: float) -> float:
    """Return the quotient by a diagonal number of a factor; 0 where its row is."""
    if pivot > 0.0:
        return number / pivot
    return 0.0


@inner
def forward(L: Floats, n: int, b: Floats) -> None:
    """b ← L⁻¹ b (n,); 0 where a row of L is."""
    for i in range(n):
        row = L[i]
        entry = b[i]
        for k in range(i):
            entry -= row[k] * b[k]
        b[i] = divided(entry, row[i])


@inner
def backward(L: Floats, n: int, b: Floats) -> None:
    """b ← L⁻ᵀ b (n,); 0 where a row of L is."""
    for i in range(n - 1, -1, -1):
        entry = b[i]
        for k in range(i + 1, n):
            entry -= L[k, i] * b[k]
        b[i] = divided(entry, L[i, i])


@inner
def solve(M: Floats, n: int, L: Floats, b: Floats) -> None:
    """b ← M⁻¹ b (n,), where L is scratch.

    Where M is singular, the numbers of rows that depend on those before them become 0.
    """
    cholesky(M, n, L)
    forward(L, n, b)
    backward(L, n, b)


@inner
def multiply(M: Floats, n: int, x: Floats, product: Floats) -> None:
    """Write M x of the first n rows and columns into ``product``."""
    for i in range(n):
        row = M[i]
        product[i] = 0.0
        for j in range(n):
            product[i] += row[j] * x[j]


@inner
def rotate(R: Floats, frame: Floats, product: Floats) -> None:
    """Write the product of two rotations (3, 3) into ``product``."""
    for i in range(3):
        for j in range(3):
            entry = 0.0
            for k in range(3):
                entry += R[i, k] * frame[k, j]
            product[i, j] = entry


@partial(inner, inlined=True)
def note_strengths(views: Views, arm: Arm, goal: Goal) -> None:
    """Note which share of its last command each motor has delivered."""
    for i in range(arm.joint_count):
        commanded = arm.gears[i] * views.ctrl[arm.motors[i]]
        if abs(commanded) > LEAST_TORQUE:
            share = views.qfrc_actuator[arm.dofs[i]] / commanded
            goal.strengths[i] = within(share, WEAKEST, 1.0)


@partial(inner, inlined=True)
def set_goal(views: Views, arm: Arm, goal: Goal, action: Floats, work: Work) -> None:
    """Move the set-point of an arm as the action asks, from where the arm is now."""
    change = work.displacement
    for i in range(arm.input_count):
        number = arm.first_input + i
        change[i] = scaled(action[number], arm.scaling, i)
    if arm.controller == JOINT_POSITION:
        for i in range(arm.joint_count):
            goal.joints[i] = views.qpos[arm.qpos[i]] + change[i]
    else:
        set_pose(views, arm, goal, work)


@partial(inner, inlined=True)
def set_pose(views: Views, arm: Arm, goal: Goal, work: Work) -> None:
    """Move the hand's set-point by ``work.displacement``, the position's and the turn's, in the frame of actions."""
    change = work.displacement
    base = views.site_xmat[arm.frame].reshape((3, 3))
    hand = views.site_xmat[arm.site].reshape((3, 3))
    turn = work.rotations[0]
    hand_in_base = work.rotations[1]
    turned_in_base = work.rotations[2]
    rotation(change[3:], turn)
    position = views.site_xpos[arm.site]
    for i in range(3):
        goal.position[i] = position[i]
        for j in range(3):
            goal.position[i] += base[i, j] * change[j]

    rotate(base.T, hand, hand_in_base)
    rotate(turn, hand_in_base, turned_in_base)
    rotate(base, turned_in_base, goal.orientation)


@partial(inner, inlined=True)
def read_arm(views: Views, nominal: NominalViews, arm: Arm, work: Work) -> None:
    """Write the state of an arm and its dynamics, as the robot knows itself.

    These are angles, velocities, mass, bias and Jacobian of ``work``.
    """
    hand = views.site_xpos[arm.site]
    origin = views.subtree_com[arm.root]
    jacobian = work.jacobian
    for i in range(arm.joint_count):
        dof = arm.dofs[i]
        work.angles[i] = views.qpos[arm.qpos[i]]
        work.velocities[i] = views.qvel[dof]
        work.bias[i] = nominal.bias[dof]
        read_mass(views, nominal, arm, i, work.mass)
        motion = views.cdof[dof]
        x, y, z = velocity_at(motion, hand, origin)
        jacobian[0, i] = x
        jacobian[1, i] = y
        jacobian[2, i] = z
        for axis in range(3):
            jacobian[3 + axis, i] = motion[axis]


@inner
def velocity_at(motion: Floats, place: Floats, origin: Floats) -> tuple[float, float, float]:
    """Return the velocity of a body's point at a place (3,).

    ``motion`` (6,) is the body's angular velocity, then its linear velocity at an origin (3,).
    """
    x = place[0] - origin[0]
    y = place[1] - origin[1]
    z = place[2] - origin[2]
    return (
        motion[3] + motion[1] * z - motion[2] * y,
        motion[4] + motion[2] * x - motion[0] * z,
        motion[5] + motion[0] * y - motion[1] * x,
    )


@partial(inner, inlined=True)
def read_mass(views: Views, nominal: NominalViews, arm: Arm, i: int, mass: Floats) -> None:
    """Write row and column ``i`` of an arm's mass matrix, up to the diagonal."""
    dof = arm.dofs[i]
    first = views.M_rowadr[dof]
    last = first + views.M_rownnz[dof] - 1
    column = i
    for at in range(last, first - 1, -1):
        other = views.M_colind[at]
        while column >= 0 and arm.dofs[column] > other:
            column -= 1
        if column >= 0 and arm.dofs[column] == other:
            mass[i, column] = nominal.mass[at]
            mass[column, i] = nominal.mass[at]


@partial(inner, inlined=True)
def osc_torques(work: Work, n: int) -> None:
    """Write the torques of operational space control of n joints into ``work.torques``.

    Taken from ``work``: mass M, bias h, Jacobian J; the torques p that keep the posture, in ``torques``; and the
    acceleration wanted of the hand, Kp e - Kd v, in ``force``.
    """
    jacobian = work.jacobian
    weighted = work.weighted
    products = work.products
    force = work.force
    posture_force = work.posture_force
    for i in range(n):
        weighted[6, i] = work.torques[i]
        for r in range(6):
            weighted[r, i] = jacobian[r, i]

    # Λ⁻¹ = J M⁻¹ Jᵀ, and below it J M⁻¹ p.
    cholesky(work.mass, n, work.factor)
    for r in range(7):
        forward(work.factor, n, weighted[r])  # J L⁻ᵀ, then p L⁻ᵀ
    inner_products(weighted, 7, n, products)
    for r in range(6):
        posture_force[r] = products[6, r]
    solve(products, 6, work.factor, posture_force)  # Λ J M⁻¹ p

    # The force comes of linear and angular motion, each by itself.
    for r in range(3):
        for c in range(3):
            products[3 + r, c] = 0.0
    solve(products, 6, work.factor, force)  # [Λx Fx; Λr Fr]

    for i in range(n):
        torque = work.torques[i] + work.bias[i]
        for r in range(6):
            torque += jacobian[r, i] * (force[r] - posture_force[r])
        work.torques[i] = torque


@inner
def inner_products(A: Floats, rows: int, n: int, products: Floats) -> None:
    """Write the inner product of rows r and c <= r of A (rows, n) into products[r, c]."""
    for r in range(rows):
        for c in range(r + 1):
            entry = 0.0
            for i in range(n):
                entry += A[r, i] * A[c, i]
            products[r, c] = entry


@partial(inner, inlined=True)
def brake(arm: Arm, goal: Goal, work: Work) -> None:
    """Write the torques that hold an arm at its anchor, which gives way to what presses too hard."""
    n = arm.joint_count
    if goal.held == HELD:
        for i in range(n):
            goal.anchor[i] = work.angles[i]

    fastest = 0.0
    for i in range(n):
        work.displacement[i] = goal.anchor[i] - work.angles[i]
        fastest = max(fastest, abs(work.velocities[i]))
    if fastest < RESTING:
        goal.held = YIELDING
    elif goal.held == HELD:
        goal.held = BRAKING

    if goal.held == YIELDING:
        multiply(work.mass, n, work.displacement, work.torques)
        for i in range(n):
            give_way(goal, work, i)
    for i in range(n):
        spring = HOLD_STIFFNESS * work.displacement[i]
        work.acceleration[i] = spring - HOLD_DAMPING * work.velocities[i]
    accelerate(work, n)


@partial(inner, inlined=True)
def give_way(goal: Goal, work: Work, i: int) -> None:
    """Move the anchor of joint ``i`` to where its spring takes no more than its share of ``YIELDS_AT``.

    ``work.torques`` are those of a spring of stiffness 1.
    """
    x = work.jacobian[0, i]
    y = work.jacobian[1, i]
    z = work.jacobian[2, i]
    lever = np.sqrt(x**2 + y**2 + z**2)
    most = YIELDS_AT * (lever + YIELD_LEVER)
    spring = HOLD_STIFFNESS * abs(work.torques[i])
    if spring > most:
        work.displacement[i] *= most / spring
        goal.anchor[i] = work.angles[i] + work.displacement[i]


@partial(inner, inlined=True)
def accelerate(work: Work, n: int) -> None:
    """Write the torques M q̈ + h that give n joints the wanted acceleration q̈."""
    multiply(work.mass, n, work.acceleration, work.torques)
    for i in range(n):
        work.torques[i] += work.bias[i]


@partial(inner, inlined=True)
def track_joints(arm: Arm, goal: Goal, work: Work) -> None:
    """Write the torques of joint position control."""
    n = arm.joint_count
    for i in range(n):
        error = goal.joints[i] - work.angles[i]
        damping = arm.kd[i] * work.velocities[i]
        work.acceleration[i] = arm.kp[i] * error - damping
    accelerate(work, n)


@partial(inner, inlined=True)
def track_pose(views: Views, arm: Arm, goal: Goal, work: Work) -> None:
    """Write the torques of operational space control."""
    n = arm.joint_count
    for i in range(n):
        error = arm.rest_angles[i] - work.angles[i]
        spring = POSTURE_STIFFNESS * error
        work.acceleration[i] = spring - POSTURE_DAMPING * work.velocities[i]
    multiply(work.mass, n, work.acceleration, work.torques)

    read_pose_error(views, arm, goal, work.force)
    for r in range(6):
        motion = work.jacobian[r]
        velocity = 0.0
        for i in range(n):
            velocity += motion[i] * work.velocities[i]
        work.force[r] = arm.kp[r] * work.force[r] - arm.kd[r] * velocity
    osc_torques(work, n)


@partial(inner, inlined=True)
def read_pose_error(views: Views, arm: Arm, goal: Goal, error: Floats) -> None:
    """Write the way (6,) from the hand's pose to its set-point: position [m], then orientation [rad]."""
    position = views.site_xpos[arm.site]
    hand = views.site_xmat[arm.site]
    wanted = goal.orientation
    for i in range(3):
        error[i] = goal.position[i] - position[i]
        j = (i + 1) % 3
        k = (i + 2) % 3
        turn = 0.0
        for c in range(3):
            turn += hand[3 * j + c] * wanted[k, c]
            turn -= hand[3 * k + c] * wanted[j, c]
        error[3 + i] = 0.5 * turn


@inner
def length(vector: Floats) -> float:
    """Return the length of three numbers."""
    x = vector[0]
    y = vector[1]
    z = vector[2]
    return np.sqrt(x * x + y * y + z * z)


@partial(inner, inlined=True)
def command(views: Views, motor: int, torque: float) -> None:
    """Command a motor, as far as it goes."""
    bounds = views.actuator_ctrlrange[motor]
    views.ctrl[motor] = within(torque, bounds[0], bounds[1])


@partial(inner, inlined=True)
def control(views: Views, nominal: NominalViews, arm: Arm, goal: Goal, work: Work) -> None:
    """Command the motors of an arm by its controller, or hold it."""
    read_arm(views, nominal, arm, work)
    if goal.held:
        brake(arm, goal, work)
    elif arm.controller == JOINT_POSITION:
        track_joints(arm, goal, work)
    else:
        track_pose(views, arm, goal, work)
    for i in range(arm.joint_count):
        torque = work.torques[i]
        if goal.held:
            torque /= goal.strengths[i]
        command(views, arm.motors[i], torque)
