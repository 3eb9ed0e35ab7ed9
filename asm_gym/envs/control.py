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
from asm_gym.envs.commands import rotation, scaled
from asm_gym.envs.mujoco_views import (
    JOINT_POSITION,
    Arms,
    Floats,
    Goals,
    NominalViews,
    SubstepLimits,
    Views,
    Work,
)


@inner
def cholesky(M: Floats, n: int, L: Floats) -> None:
    """Write the lower factor of M (n, n) into L.

    A row that depends on those before it, or is not finite, becomes 0 in L.
    """
    for i in range(n):
        for j in range(i + 1):
            s = M[i, j]
            for k in range(j):
                s -= L[i, k] * L[j, k]
            if i > j:
                L[i, j] = s / L[j, j] if L[j, j] > 0.0 else 0.0
            elif s > 0.0:
                L[i, i] = np.sqrt(s)
            else:
                for k in range(i + 1):
                    L[i, k] = 0.0


@inner
def forward(L: Floats, n: int, B: Floats, r: int) -> None:
    """b ← L⁻¹ b, where b is row ``r`` of B; 0 where a row of L is."""
    for i in range(n):
        s = B[r, i]
        for k in range(i):
            s -= L[i, k] * B[r, k]
        B[r, i] = s / L[i, i] if L[i, i] > 0.0 else 0.0


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
        B[r, i] = s / L[i, i] if L[i, i] > 0.0 else 0.0


HOLD_STIFFNESS = 400.0  # Kp of an arm that is held [1/s²]; Kd is 2 √Kp
YIELDS_AT = (
    60.0  # Y: the force at the hand from which an arm that is held and at rest gives way [N]
)
HELD, BRAKING, YIELDING = 1, 2, 3
"""Of ``Goals.held``: to be held from the next substep on; on its way to rest; and since then."""

REACHES = 0.15  # how far gripper and what it holds are from the point between the fingers, and links from joints [m]
SLOWING = 200.0  # share of the speed beyond its limit that an arm loses in a second [1/s]
RESTING = 0.1  # an arm none of whose joints is faster than this has come to rest [rad/s]
YIELD_LEVER = 0.15  # r₀: what a joint has at least for a lever [m]


@partial(inner, inlined=True)
def set_goal(views: Views, arms: Arms, goals: Goals, work: Work, a: int) -> None:
    """Move the set-point of arm ``a`` as the action asks, from where the arm is now; M, L, A and G are scratch."""
    for i in range(arms.inputs[a]):
        work.p[i] = scaled(goals.action[arms.first[a] + i], arms.scaling, a, i)
    if arms.kind[a] == JOINT_POSITION:
        for i in range(arms.joints[a]):
            goal = views.qpos[arms.qpos[a, i]] + work.p[i]
            goals.joints[a, i] = min(max(goal, arms.limits[a, i, 0]), arms.limits[a, i, 1])
        return
    site, base = arms.site[a], arms.base[a]
    rotation(work.p, 3, work.G)
    for i in range(3):
        for j in range(3):
            work.M[i, j] = views.site_xmat[site, 3 * i + j]
            work.L[i, j] = 1.0 if i == j else 0.0
            if base >= 0:
                work.L[i, j] = views.site_xmat[base, 3 * i + j]
    # R turn Rᵀ hand, where R is the orientation of the base.
    for i in range(3):
        goals.position[a, i] = views.site_xpos[site, i]
        for j in range(3):
            goals.position[a, i] += work.L[i, j] * work.p[j]
            work.A[i, j] = (
                work.L[0, i] * work.M[0, j]
                + work.L[1, i] * work.M[1, j]
                + work.L[2, i] * work.M[2, j]
            )
    for i in range(3):
        for j in range(3):
            work.M[i, j] = (
                work.G[i, 0] * work.A[0, j]
                + work.G[i, 1] * work.A[1, j]
                + work.G[i, 2] * work.A[2, j]
            )
    for i in range(3):
        for j in range(3):
            goals.orientation[a, i, j] = 0.0
            for k in range(3):
                goals.orientation[a, i, j] += work.L[i, k] * work.M[k, j]


@partial(inner, inlined=True)
def read_arm(views: Views, nominal: NominalViews, arms: Arms, work: Work, a: int) -> None:
    """Write mass matrix M and bias h of arm ``a``, as the robot knows itself, its Jacobian J and velocity v."""
    site, root = arms.site[a], arms.root[a]
    x = views.site_xpos[site, 0] - views.subtree_com[root, 0]
    y = views.site_xpos[site, 1] - views.subtree_com[root, 1]
    z = views.site_xpos[site, 2] - views.subtree_com[root, 2]
    for i in range(arms.joints[a]):
        dof, column = arms.dofs[a, i], i
        work.h[i], work.v[i] = nominal.bias[dof], views.qvel[dof]
        first = views.M_rowadr[dof]
        for at in range(first + views.M_rownnz[dof] - 1, first - 1, -1):
            while column >= 0 and arms.dofs[a, column] > views.M_colind[at]:
                column -= 1
            if column >= 0 and arms.dofs[a, column] == views.M_colind[at]:
                work.M[i, column] = nominal.mass[at]
                work.M[column, i] = nominal.mass[at]
        for r in range(3):
            work.J[3 + r, i] = views.cdof[dof, r]
        work.J[0, i] = views.cdof[dof, 3] + work.J[4, i] * z - work.J[5, i] * y
        work.J[1, i] = views.cdof[dof, 4] + work.J[5, i] * x - work.J[3, i] * z
        work.J[2, i] = views.cdof[dof, 5] + work.J[3, i] * y - work.J[4, i] * x


@inner
def multiply(M: Floats, n: int, x: Floats, out: Floats) -> None:
    """Write M x of the first n rows and columns into out."""
    for i in range(n):
        out[i] = 0.0
        for j in range(n):
            out[i] += M[i, j] * x[j]


@partial(inner, inlined=True)
def osc_torques(work: Work, n: int) -> None:
    """Write the torques of operational space control into tau.

    Of ``work``: mass matrix M (n, n), bias h (n,), Jacobian J (6, n), the torque that keeps the posture, tau (n,), and
    the acceleration wanted of the hand, Kp e - Kd v, as the first row of F (2, 6).
    """
    J, A, G, F = work.J, work.A, work.G, work.F
    for i in range(n):
        A[6, i] = work.tau[i]
        for r in range(6):
            A[r, i] = J[r, i]
    cholesky(work.M, n, work.L)
    for r in range(7):
        forward(work.L, n, A, r)  # J L⁻ᵀ, then p L⁻ᵀ
    for r in range(7):  # J M⁻¹ Jᵀ, then J M⁻¹ p
        for c in range(r + 1):
            G[r, c] = 0.0
            for i in range(n):
                G[r, c] += A[r, i] * A[c, i]
    for r in range(6):
        F[1, r] = G[6, r]
    for row in range(1, -1, -1):
        solve(G, F.shape[1], work.L, F, row)
        for r in range(3):  # the force comes of linear and angular motion, each by itself
            for c in range(3):
                G[3 + r, c] = 0.0
    for i in range(n):
        work.tau[i] += work.h[i]
        for r in range(6):
            work.tau[i] += J[r, i] * (F[0, r] - F[1, r])


@partial(inner, inlined=True)
def brake(views: Views, arms: Arms, goals: Goals, work: Work, a: int) -> None:
    """Write the torques that hold arm ``a`` at its anchor, which follows what presses too hard, into tau."""
    n, fastest = arms.joints[a], 0.0
    for i in range(n):
        angle = views.qpos[arms.qpos[a, i]]
        if goals.held[a] == HELD:
            goals.anchor[a, i] = angle
        work.p[i] = goals.anchor[a, i] - angle
        fastest = max(fastest, abs(work.v[i]))
    if fastest < RESTING:
        goals.held[a] = YIELDING
    elif goals.held[a] == HELD:
        goals.held[a] = BRAKING
    multiply(work.M, n, work.p, work.tau)
    if goals.held[a] == YIELDING:
        for i in range(n):
            lever = np.sqrt(work.J[0, i] ** 2 + work.J[1, i] ** 2 + work.J[2, i] ** 2) + YIELD_LEVER
            spring = HOLD_STIFFNESS * abs(work.tau[i])
            if spring > YIELDS_AT * lever:
                work.p[i] *= YIELDS_AT * lever / spring
                goals.anchor[a, i] = views.qpos[arms.qpos[a, i]] + work.p[i]
    # Spring and damping share the mass matrix.
    for i in range(n):
        work.p[i] = HOLD_STIFFNESS * work.p[i] - 2.0 * np.sqrt(HOLD_STIFFNESS) * work.v[i]
    multiply(work.M, n, work.p, work.tau)
    for i in range(n):
        work.tau[i] += work.h[i]


@partial(inner, inlined=True)
def track(views: Views, arms: Arms, goals: Goals, work: Work, a: int) -> None:
    """Write the torques of arm ``a``'s controller into tau."""
    n, site = arms.joints[a], arms.site[a]
    if arms.kind[a] == JOINT_POSITION:
        for i in range(n):
            error = goals.joints[a, i] - views.qpos[arms.qpos[a, i]]
            work.p[i] = arms.kp[a, i] * error - arms.kd[a, i] * work.v[i]
            work.tau[i] = work.p[i]
        if arms.compensate[a]:
            multiply(work.M, n, work.p, work.tau)
            for i in range(n):
                work.tau[i] += work.h[i]
        return
    for i in range(n):
        work.p[i] = (
            10.0 * (arms.rest[a, i] - views.qpos[arms.qpos[a, i]]) - 2.0 * np.sqrt(10.0) * work.v[i]
        )
    multiply(work.M, n, work.p, work.tau)
    for i in range(3):
        work.F[0, i] = goals.position[a, i] - views.site_xpos[site, i]
        j, k = (i + 1) % 3, (i + 2) % 3
        turn = 0.0
        for c in range(3):
            turn += views.site_xmat[site, 3 * j + c] * goals.orientation[a, k, c]
            turn -= views.site_xmat[site, 3 * k + c] * goals.orientation[a, j, c]
        work.F[0, 3 + i] = 0.5 * turn
    for r in range(6):
        velocity = 0.0
        for i in range(n):
            velocity += work.J[r, i] * work.v[i]
        work.F[0, r] = arms.kp[a, r] * work.F[0, r] - arms.kd[a, r] * velocity
    osc_torques(work, n)


@partial(inner, inlined=True)
def fastest_point(views: Views, arms: Arms, a: int) -> float:
    """Return the greatest speed of hand and links of arm ``a``, as far as each ``REACHES`` [m/s]."""
    origin = views.subtree_com[arms.root[a]]  # at which MuJoCo's velocities of bodies are
    hand = arms.links[a, 0]
    fastest = point_speed(views.cvel[hand], views.site_xpos[arms.site[a]], origin)
    for n in range(1, arms.links.shape[1]):
        link = arms.links[a, n]
        if link < 0:
            break
        fastest = max(fastest, point_speed(views.cvel[link], views.xpos[link], origin))
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
    turning = velocity[0] * velocity[0] + velocity[1] * velocity[1] + velocity[2] * velocity[2]
    return np.sqrt(vx * vx + vy * vy + vz * vz) + REACHES * np.sqrt(turning)


@partial(inner, inlined=True)
def slow_down(views: Views, arms: Arms, limits: SubstepLimits, work: Work, a: int) -> bool:
    """Brake arm ``a``, of which M and v are known, along its own motion while its fastest point passes its limit.

    Return whether it does.
    """
    limit = limits.speed[a]
    speed = fastest_point(views, arms, a) if limit < np.inf else 0.0
    if speed > limit:
        for i in range(arms.joints[a]):
            work.p[i] = SLOWING * (1.0 - limit / speed) * work.v[i]
        multiply(work.M, arms.joints[a], work.p, work.tau)
        for i in range(arms.joints[a]):
            m = arms.motors[a, i]
            command = views.ctrl[m] - work.tau[i]
            views.ctrl[m] = min(
                max(command, views.actuator_ctrlrange[m, 0]), views.actuator_ctrlrange[m, 1]
            )
    return speed > limit


@partial(inner, inlined=True)
def control(
    views: Views, nominal: NominalViews, arms: Arms, goals: Goals, work: Work, a: int
) -> None:
    """Command the motors of arm ``a``, as far as they go."""
    read_arm(views, nominal, arms, work, a)
    if goals.held[a]:
        brake(views, arms, goals, work, a)
    else:
        track(views, arms, goals, work, a)
    for i in range(arms.joints[a]):
        m = arms.motors[a, i]
        views.ctrl[m] = min(
            max(work.tau[i], views.actuator_ctrlrange[m, 0]), views.actuator_ctrlrange[m, 1]
        )
