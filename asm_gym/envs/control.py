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

from functools import partial

import numpy as np

from asm_gym.compilation import inner
from asm_gym.envs.commands import rotation, scaled, within
from asm_gym.envs.mujoco_views import (
    JOINT_POSITION,
    Arm,
    Floats,
    Goal,
    NominalViews,
    Views,
    Work,
)

HOLD_STIFFNESS = 400.0  # Kp of an arm that is held [1/s²]; Kd is 2 √Kp
YIELDS_AT = 60.0  # Y: force at the hand from which a held arm at rest gives way [N]
POSTURE_STIFFNESS = 10.0  # Kp of the posture of spare joints [1/s²]; Kd is 2 √Kp

# States of ``Goal.held``; 0 is free.
HELD = 1  # to be held from the next substep on
BRAKING = 2  # on its way to rest
YIELDING = 3  # since it came to rest

REACHES = 0.15  # from fingers to the far end of what they hold, and from links to joints [m]
SLOWING = 200.0  # share of the speed beyond its limit that an arm loses in a second [1/s]
RESTING = 0.1  # an arm none of whose joints is faster than this has come to rest [rad/s]
YIELD_LEVER = 0.15  # r₀: the least lever of a joint [m]


@inner
def cholesky(M: Floats, n: int, L: Floats) -> None:
    """Write the lower factor of M (n, n) into L.

    A row that depends on those before it, or is not finite, becomes 0 in L.
    """
    for i in range(n):
        for j in range(i):
            s = M[i, j]
            for k in range(j):
                s -= L[i, k] * L[j, k]
            L[i, j] = divided(s, L[j, j])

        s = M[i, i]
        for k in range(i):
            s -= L[i, k] * L[i, k]
        if s > 0.0:
            L[i, i] = np.sqrt(s)
        else:
            for k in range(i + 1):
                L[i, k] = 0.0


@inner
def divided(number: float, pivot: float) -> float:
    """Return the quotient by a diagonal number of a factor; 0 where its row is."""
    if pivot > 0.0:
        return number / pivot
    return 0.0


@inner
def forward(L: Floats, n: int, B: Floats, r: int) -> None:
    """b ← L⁻¹ b, where b is row ``r`` of B; 0 where a row of L is."""
    for i in range(n):
        s = B[r, i]
        for k in range(i):
            s -= L[i, k] * B[r, k]
        B[r, i] = divided(s, L[i, i])


@inner
def solve(M: Floats, n: int, L: Floats, B: Floats, r: int) -> None:
    """b ← M⁻¹ b, where b is row ``r`` of B, and L is scratch.

    Where M is singular, the numbers of rows that depend on those before them become 0.
    """
    cholesky(M, n, L)
    forward(L, n, B, r)
    for i in range(n - 1, -1, -1):
        s = B[r, i]
        for k in range(i + 1, n):
            s -= L[k, i] * B[r, k]
        B[r, i] = divided(s, L[i, i])


@inner
def multiply(M: Floats, n: int, x: Floats, out: Floats) -> None:
    """Write M x of the first n rows and columns into out."""
    for i in range(n):
        out[i] = 0.0
        for j in range(n):
            out[i] += M[i, j] * x[j]


@inner
def rotate(R: Floats, frame: Floats, out: Floats) -> None:
    """Write the product of two rotations (3, 3) into out."""
    for i in range(3):
        for j in range(3):
            out[i, j] = 0.0
            for k in range(3):
                out[i, j] += R[i, k] * frame[k, j]


@inner
def rotate_back(R: Floats, frame: Floats, out: Floats) -> None:
    """Write Rᵀ times another rotation (3, 3) into out."""
    for i in range(3):
        for j in range(3):
            out[i, j] = 0.0
            for k in range(3):
                out[i, j] += R[k, i] * frame[k, j]


@inner
def read_frame(orientations: Floats, site: int, frame: Floats) -> None:
    """Write the orientation (3, 3) of a site, the world's for -1, into frame."""
    for i in range(3):
        for j in range(3):
            frame[i, j] = 1.0 * (i == j)
            if site >= 0:
                frame[i, j] = orientations[site, 3 * i + j]


@partial(inner, inlined=True)
def set_goal(views: Views, arm: Arm, goal: Goal, action: Floats, work: Work) -> None:
    """Move the set-point of an arm as the action asks, from where the arm is now."""
    for i in range(arm.inputs):
        work.p[i] = scaled(action[arm.first + i], arm.scaling, i)
    if arm.kind == JOINT_POSITION:
        for i in range(arm.joints):
            angle = views.qpos[arm.qpos[i]] + work.p[i]
            goal.joints[i] = within(angle, arm.limits[i, 0], arm.limits[i, 1])
    else:
        set_pose(views, arm, goal, work)


@partial(inner, inlined=True)
def set_pose(views: Views, arm: Arm, goal: Goal, work: Work) -> None:
    """Move the hand's set-point by the change p (6,) in the frame of actions; M, L, A and G are scratch."""
    hand = work.M
    base = work.L
    turn = work.G
    read_frame(views.site_xmat, arm.site, hand)
    read_frame(views.site_xmat, arm.frame, base)
    rotation(work.p[3:], turn)
    for i in range(3):
        goal.position[i] = views.site_xpos[arm.site, i]
        for j in range(3):
            goal.position[i] += base[i, j] * work.p[j]

    # R turn Rᵀ hand, where R is the orientation of the base.
    rotate_back(base, hand, work.A)
    rotate(turn, work.A, hand)
    rotate(base, hand, goal.orientation)


@partial(inner, inlined=True)
def read_arm(views: Views, nominal: NominalViews, arm: Arm, work: Work) -> None:
    """Write the state of an arm and its dynamics, as the robot knows itself: q, v, M, h and J of ``Work``."""
    x = views.site_xpos[arm.site, 0] - views.subtree_com[arm.root, 0]
    y = views.site_xpos[arm.site, 1] - views.subtree_com[arm.root, 1]
    z = views.site_xpos[arm.site, 2] - views.subtree_com[arm.root, 2]
    J = work.J
    for i in range(arm.joints):
        dof = arm.dofs[i]
        work.q[i] = views.qpos[arm.qpos[i]]
        work.v[i] = views.qvel[dof]
        work.h[i] = nominal.bias[dof]
        read_mass(views, nominal, arm, i, work.M)
        for r in range(3):
            J[3 + r, i] = views.cdof[dof, r]
        J[0, i] = views.cdof[dof, 3] + J[4, i] * z - J[5, i] * y
        J[1, i] = views.cdof[dof, 4] + J[5, i] * x - J[3, i] * z
        J[2, i] = views.cdof[dof, 5] + J[3, i] * y - J[4, i] * x


@partial(inner, inlined=True)
def read_mass(views: Views, nominal: NominalViews, arm: Arm, i: int, M: Floats) -> None:
    """Write row and column ``i`` of an arm's mass matrix, up to the diagonal."""
    dof = arm.dofs[i]
    first = views.M_rowadr[dof]
    column = i
    for at in range(first + views.M_rownnz[dof] - 1, first - 1, -1):
        while column >= 0 and arm.dofs[column] > views.M_colind[at]:
            column -= 1
        if column >= 0 and arm.dofs[column] == views.M_colind[at]:
            M[i, column] = nominal.mass[at]
            M[column, i] = nominal.mass[at]


@partial(inner, inlined=True)
def osc_torques(work: Work, n: int) -> None:
    """Write the torques of operational space control into tau.

    Of ``work``: mass matrix M (n, n), bias h (n,), Jacobian J (6, n), the torque that keeps the posture, tau (n,), and
    the acceleration wanted of the hand, Kp e - Kd v, as the first row of F (2, 6).
    """
    J = work.J
    A = work.A
    G = work.G
    F = work.F
    for i in range(n):
        A[6, i] = work.tau[i]
        for r in range(6):
            A[r, i] = J[r, i]

    # J M⁻¹ Jᵀ, and below it J M⁻¹ p.
    cholesky(work.M, n, work.L)
    for r in range(7):
        forward(work.L, n, A, r)  # J L⁻ᵀ, then p L⁻ᵀ
    inner_products(A, 7, n, G)
    for r in range(6):
        F[1, r] = G[6, r]

    solve(G, 6, work.L, F, 1)
    for r in range(3):  # the force comes of linear and angular motion, each by itself
        for c in range(3):
            G[3 + r, c] = 0.0
    solve(G, 6, work.L, F, 0)

    for i in range(n):
        work.tau[i] += work.h[i]
        for r in range(6):
            work.tau[i] += J[r, i] * (F[0, r] - F[1, r])


@inner
def inner_products(A: Floats, rows: int, n: int, G: Floats) -> None:
    """Write the inner product of rows r and c <= r of A (rows, n) into G[r, c]."""
    for r in range(rows):
        for c in range(r + 1):
            G[r, c] = 0.0
            for i in range(n):
                G[r, c] += A[r, i] * A[c, i]


@partial(inner, inlined=True)
def brake(arm: Arm, goal: Goal, work: Work) -> None:
    """Write the torques that hold an arm at its anchor, which follows what presses too hard, into tau."""
    n = arm.joints
    fastest = 0.0
    for i in range(n):
        if goal.held == HELD:
            goal.anchor[i] = work.q[i]
        work.p[i] = goal.anchor[i] - work.q[i]
        fastest = max(fastest, abs(work.v[i]))
    if fastest < RESTING:
        goal.held = YIELDING
    elif goal.held == HELD:
        goal.held = BRAKING

    multiply(work.M, n, work.p, work.tau)
    if goal.held == YIELDING:
        for i in range(n):
            give_way(goal, work, i)
    # Spring and damping share the mass matrix.
    for i in range(n):
        work.p[i] = HOLD_STIFFNESS * work.p[i] - 2.0 * np.sqrt(HOLD_STIFFNESS) * work.v[i]
    multiply(work.M, n, work.p, work.tau)
    for i in range(n):
        work.tau[i] += work.h[i]


@partial(inner, inlined=True)
def give_way(goal: Goal, work: Work, i: int) -> None:
    """Move the anchor of joint ``i`` to where its spring takes no more than its share of ``YIELDS_AT``."""
    x = work.J[0, i]
    y = work.J[1, i]
    z = work.J[2, i]
    most = YIELDS_AT * (np.sqrt(x**2 + y**2 + z**2) + YIELD_LEVER)
    spring = HOLD_STIFFNESS * abs(work.tau[i])
    if spring > most:
        work.p[i] *= most / spring
        goal.anchor[i] = work.q[i] + work.p[i]


@partial(inner, inlined=True)
def track(views: Views, arm: Arm, goal: Goal, work: Work) -> None:
    """Write the torques of an arm's controller into tau."""
    if arm.kind == JOINT_POSITION:
        track_joints(arm, goal, work)
    else:
        track_pose(views, arm, goal, work)


@partial(inner, inlined=True)
def track_joints(arm: Arm, goal: Goal, work: Work) -> None:
    """Write the torques of joint position control into tau."""
    n = arm.joints
    for i in range(n):
        error = goal.joints[i] - work.q[i]
        work.p[i] = arm.kp[i] * error - arm.kd[i] * work.v[i]
        work.tau[i] = work.p[i]
    if arm.compensate:
        multiply(work.M, n, work.p, work.tau)
        for i in range(n):
            work.tau[i] += work.h[i]


@partial(inner, inlined=True)
def track_pose(views: Views, arm: Arm, goal: Goal, work: Work) -> None:
    """Write the torques of operational space control into tau."""
    n = arm.joints
    for i in range(n):
        error = arm.rest[i] - work.q[i]
        work.p[i] = POSTURE_STIFFNESS * error - 2.0 * np.sqrt(POSTURE_STIFFNESS) * work.v[i]
    multiply(work.M, n, work.p, work.tau)

    error = work.F[0]
    for i in range(3):
        error[i] = goal.position[i] - views.site_xpos[arm.site, i]
        j = (i + 1) % 3
        k = (i + 2) % 3
        turn = 0.0
        for c in range(3):
            turn += views.site_xmat[arm.site, 3 * j + c] * goal.orientation[k, c]
            turn -= views.site_xmat[arm.site, 3 * k + c] * goal.orientation[j, c]
        error[3 + i] = 0.5 * turn
    for r in range(6):
        velocity = 0.0
        for i in range(n):
            velocity += work.J[r, i] * work.v[i]
        error[r] = arm.kp[r] * error[r] - arm.kd[r] * velocity
    osc_torques(work, n)


@partial(inner, inlined=True)
def fastest_point(views: Views, arm: Arm) -> float:
    """Return the greatest speed of any point within ``REACHES`` of the hand or of a link's origin [m/s]."""
    origin = views.subtree_com[arm.root]  # at which MuJoCo's velocities of bodies are
    hand = arm.links[0]
    fastest = point_speed(views.cvel[hand], views.site_xpos[arm.site], origin)
    n = 1
    while arm.links[n] >= 0:
        link = arm.links[n]
        fastest = max(fastest, point_speed(views.cvel[link], views.xpos[link], origin))
        n += 1
    return fastest


@inner
def point_speed(velocity: Floats, place: Floats, origin: Floats) -> float:
    """Return how fast the furthest point about a place (3,) may go, by its body's velocity (6,) at an origin (3,)."""
    x = place[0] - origin[0]
    y = place[1] - origin[1]
    z = place[2] - origin[2]
    vx = velocity[3] + velocity[1] * z - velocity[2] * y
    vy = velocity[4] + velocity[2] * x - velocity[0] * z
    vz = velocity[5] + velocity[0] * y - velocity[1] * x
    return np.sqrt(vx * vx + vy * vy + vz * vz) + REACHES * length(velocity[:3])


@inner
def length(vector: Floats) -> float:
    """Return the length of three numbers."""
    x = vector[0]
    y = vector[1]
    z = vector[2]
    return np.sqrt(x * x + y * y + z * z)


@partial(inner, inlined=True)
def slow_down(views: Views, arm: Arm, limit: float, work: Work) -> bool:
    """Brake an arm, of which M and v are known, along its own motion while its fastest point passes its limit [m/s].

    Return whether it does.
    """
    if limit == np.inf:
        return False
    speed = fastest_point(views, arm)
    if not speed > limit:
        return False

    for i in range(arm.joints):
        work.p[i] = SLOWING * (1.0 - limit / speed) * work.v[i]
    multiply(work.M, arm.joints, work.p, work.tau)
    for i in range(arm.joints):
        motor = arm.motors[i]
        command(views, motor, views.ctrl[motor] - work.tau[i])
    return True


@partial(inner, inlined=True)
def command(views: Views, motor: int, torque: float) -> None:
    """Command a motor, as far as it goes."""
    bounds = views.actuator_ctrlrange
    views.ctrl[motor] = within(torque, bounds[motor, 0], bounds[motor, 1])


@partial(inner, inlined=True)
def control(views: Views, nominal: NominalViews, arm: Arm, goal: Goal, work: Work) -> None:
    """Command the motors of an arm."""
    read_arm(views, nominal, arm, work)
    if goal.held:
        brake(arm, goal, work)
    else:
        track(views, arm, goal, work)
    for i in range(arm.joints):
        command(views, arm.motors[i], work.tau[i])
