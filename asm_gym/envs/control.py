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
"""

from __future__ import annotations

import numpy as np

from asm_gym.compilation import compiled
from asm_gym.envs.mujoco_views import JOINT_POSITION, Arms, Floats, Goals, Ints, NominalViews, Views


@compiled
def cholesky(M: Floats, n: int, L: Floats) -> bool:
    """Write the lower factor of M (n, n) into L; False where M is not positive definite."""
    for i in range(n):
        for j in range(i + 1):
            s = M[i, j]
            for k in range(j):
                s -= L[i, k] * L[j, k]
            if i == j:
                if not s > 0.0:
                    return False
                L[i, i] = np.sqrt(s)
            else:
                L[i, j] = s / L[j, j]
    return True


@compiled
def forward(L: Floats, n: int, b: Floats) -> None:
    """b ← L⁻¹ b."""
    for i in range(n):
        s = b[i]
        for k in range(i):
            s -= L[i, k] * b[k]
        b[i] = s / L[i, i]


@compiled
def solve(M: Floats, n: int, b: Floats) -> None:
    """b ← M⁻¹ b, or the least-norm solution where M (n, n) is singular."""
    L = np.empty((n, n))
    if cholesky(M, n, L):
        forward(L, n, b)
        for i in range(n - 1, -1, -1):
            s = b[i]
            for k in range(i + 1, n):
                s -= L[k, i] * b[k]
            b[i] = s / L[i, i]
    elif np.isfinite(M).all():
        b[:n] = np.linalg.pinv(np.ascontiguousarray(M[:n, :n])) @ b[:n]
    else:
        b[:n] = 0.0


@compiled
def mass_matrix(sparse: Floats, views: Views, dofs: Ints, n: int, M: Floats) -> None:
    """Write the mass matrix of one arm's joints (n, n), numbered from the base on, into M."""
    for i in range(n):
        first, column = views.M_rowadr[dofs[i]], i
        for at in range(first + views.M_rownnz[dofs[i]] - 1, first - 1, -1):
            while column >= 0 and dofs[column] > views.M_colind[at]:
                column -= 1
            if column >= 0 and dofs[column] == views.M_colind[at]:
                M[i, column] = sparse[at]
                M[column, i] = sparse[at]


@compiled
def jacobian(views: Views, dofs: Ints, n: int, point: Floats, com: Floats, J: Floats) -> None:
    """Write the Jacobian (6, n) of a point on the arm into J: linear, then angular velocity."""
    x, y, z = point[0] - com[0], point[1] - com[1], point[2] - com[2]
    for i in range(n):
        a = views.cdof[dofs[i]]
        J[0, i] = a[3] + a[1] * z - a[2] * y
        J[1, i] = a[4] + a[2] * x - a[0] * z
        J[2, i] = a[5] + a[0] * y - a[1] * x
        J[3, i], J[4, i], J[5, i] = a[0], a[1], a[2]


HOLD_STIFFNESS = 400.0  # Kp of an arm that is held [1/s²]; Kd is 2 √Kp
YIELDS_AT = 60.0  # Y: the force at the hand from which an arm that is held and at rest gives way [N]
BRAKING, YIELDING = 1, 2  # of ``Goals.held``: on its way to rest, and since then
RESTING = 0.1  # an arm none of whose joints is faster than this has come to rest [rad/s]
YIELD_LEVER = 0.15  # r₀: what a joint has at least for a lever [m]


@compiled
def _base(views: Views, site: int) -> tuple[Floats, Floats]:
    """Position and orientation of the frame that actions are relative to."""
    if site < 0:
        return np.zeros(3), np.eye(3)
    return views.site_xpos[site].copy(), views.site_xmat[site].copy().reshape(3, 3)


@compiled
def set_goal(views: Views, arms: Arms, goals: Goals, a: int, delta: Floats, turn: Floats) -> None:
    """Move the set-point of arm ``a`` by ``delta`` (JOINTS,) and ``turn`` (3, 3) from where the arm is now."""
    if arms.kind[a] == JOINT_POSITION:
        for i in range(arms.joints[a]):
            goal = views.qpos[arms.qpos[a, i]] + delta[i]
            goals.joints[a, i] = min(max(goal, arms.limits[a, i, 0]), arms.limits[a, i, 1])
        return
    origin, R0 = _base(views, arms.base[a])
    hand = views.site_xmat[arms.site[a]].copy().reshape(3, 3)
    goals.position[a] = R0.T @ (views.site_xpos[arms.site[a]] - origin) + delta[:3]
    goals.orientation[a] = turn @ (np.ascontiguousarray(R0.T) @ hand)


@compiled
def hand_velocity(views: Views, arms: Arms, a: int, com: Floats, out: Floats) -> None:
    """Write the velocity of arm ``a``'s hand (6,), linear then angular, into out."""
    v = views.cvel[arms.site_body[a]]
    point = views.site_xpos[arms.site[a]]
    x, y, z = point[0] - com[0], point[1] - com[1], point[2] - com[2]
    out[0] = v[3] + v[1] * z - v[2] * y
    out[1] = v[4] + v[2] * x - v[0] * z
    out[2] = v[5] + v[0] * y - v[1] * x
    out[3], out[4], out[5] = v[0], v[1], v[2]


@compiled
def osc_torques(M: Floats, J: Floats, n: int, wrench: Floats, posture: Floats, bias: Floats, tau: Floats) -> None:
    """Write the torques (n,) of operational space control into tau.

    Args:
        M: (n, n) mass matrix.
        J: (6, n).
        wrench: (6,) the acceleration wanted of the hand, Kp e - Kd v.
        posture: (n,) p, the torque that keeps the posture.
        bias: (n,) h.
    """
    L = np.empty((n, n))
    A = np.empty((7, n))  # rows: J L⁻ᵀ, then p L⁻ᵀ
    A[:6] = J[:, :n]
    A[6] = posture[:n]
    if cholesky(M, n, L):
        for r in range(7):
            forward(L, n, A[r])
    else:
        A[:] = 0.0
    inverse = np.empty((6, 6))  # J M⁻¹ Jᵀ
    pull = np.empty(6)  # J M⁻¹ p
    for r in range(6):
        for c in range(r + 1):
            s = 0.0
            for i in range(n):
                s += A[r, i] * A[c, i]
            inverse[r, c] = s
            inverse[c, r] = s
        s = 0.0
        for i in range(n):
            s += A[r, i] * A[6, i]
        pull[r] = s
    force = wrench.copy()
    solve(inverse[:3, :3], 3, force[:3])
    solve(inverse[3:, 3:], 3, force[3:])
    solve(inverse, 6, pull)
    for i in range(n):
        s = bias[i] + posture[i]
        for r in range(6):
            s += J[r, i] * (force[r] - pull[r])
        tau[i] = s


@compiled
def hold_at(views: Views, arms: Arms, goals: Goals, a: int) -> None:
    """Hold arm ``a`` where it is from now on; where it is held already, where it was."""
    if not goals.held[a]:
        for i in range(arms.joints[a]):
            goals.anchor[a, i] = views.qpos[arms.qpos[a, i]]
        goals.held[a] = BRAKING


@compiled
def _believed(views: Views, nominal: NominalViews, arms: Arms, a: int, M: Floats, h: Floats) -> None:
    """Write mass matrix (n, n) and bias (n,) of arm ``a``, as the robot knows itself, into M and h."""
    n, dofs = arms.joints[a], arms.dofs[a]
    edited = nominal.model != 0
    mass_matrix(nominal.mass if edited else views.M, views, dofs, n, M)
    for i in range(n):
        h[i] = nominal.bias[dofs[i]] if edited else views.qfrc_bias[dofs[i]]


@compiled
def _command(views: Views, arms: Arms, a: int, tau: Floats) -> None:
    """Give the motors of arm ``a`` torques (n,), as far as they go."""
    for i in range(arms.joints[a]):
        m = arms.motors[a, i]
        views.ctrl[m] = min(max(tau[i], views.actuator_ctrlrange[m, 0]), views.actuator_ctrlrange[m, 1])


@compiled
def brake(views: Views, nominal: NominalViews, arms: Arms, goals: Goals, a: int) -> None:
    """Command the motors of arm ``a`` so that it is held at its anchor, which follows what presses too hard."""
    n, dofs = arms.joints[a], arms.dofs[a]
    M, h, J = np.empty((n, n)), np.empty(n), np.empty((6, n))
    off, spring, tau = np.empty(n), np.empty(n), np.empty(n)
    _believed(views, nominal, arms, a, M, h)
    jacobian(views, dofs, n, views.site_xpos[arms.site[a]], views.subtree_com[arms.root[a]], J)
    fastest = 0.0
    for i in range(n):
        off[i] = goals.anchor[a, i] - views.qpos[arms.qpos[a, i]]
        fastest = max(fastest, abs(views.qvel[dofs[i]]))
    if fastest < RESTING:
        goals.held[a] = YIELDING
    for again in range(2):
        for i in range(n):
            spring[i] = 0.0
            for j in range(n):
                spring[i] += M[i, j] * off[j]
            spring[i] *= HOLD_STIFFNESS
        if again or goals.held[a] != YIELDING:
            break
        slips = False
        for i in range(n):
            lever = np.sqrt(J[0, i] ** 2 + J[1, i] ** 2 + J[2, i] ** 2) + YIELD_LEVER
            most = YIELDS_AT * lever
            if abs(spring[i]) > most:
                off[i] *= most / abs(spring[i])
                goals.anchor[a, i] = views.qpos[arms.qpos[a, i]] + off[i]
                slips = True
        if not slips:
            break
    damping = 2.0 * np.sqrt(HOLD_STIFFNESS)
    for i in range(n):
        braked = 0.0
        for j in range(n):
            braked += M[i, j] * views.qvel[dofs[j]]
        tau[i] = spring[i] - damping * braked + h[i]
    _command(views, arms, a, tau)


@compiled
def control(views: Views, nominal: NominalViews, arms: Arms, goals: Goals, a: int) -> None:
    """Command the motors of arm ``a``."""
    if goals.held[a]:
        brake(views, nominal, arms, goals, a)
        return
    n, dofs = arms.joints[a], arms.dofs[a]
    M, h, p, tau = np.empty((n, n)), np.empty(n), np.empty(n), np.empty(n)
    _believed(views, nominal, arms, a, M, h)
    if arms.kind[a] == JOINT_POSITION:
        for i in range(n):
            error = goals.joints[a, i] - views.qpos[arms.qpos[a, i]]
            p[i] = arms.kp[a, i] * error - arms.kd[a, i] * views.qvel[dofs[i]]
        if arms.compensate[a]:
            tau[:] = M @ p + h
        else:
            tau[:] = p
    else:
        for i in range(n):
            p[i] = 10.0 * (arms.rest[a, i] - views.qpos[arms.qpos[a, i]]) - 2.0 * np.sqrt(10.0) * views.qvel[dofs[i]]
        site, com = arms.site[a], views.subtree_com[arms.root[a]]
        origin, R0 = _base(views, arms.base[a])
        hand = views.site_xmat[site].copy().reshape(3, 3)
        target = R0 @ goals.orientation[a]
        position = origin + R0 @ goals.position[a]
        velocity, wrench, J = np.empty(6), np.empty(6), np.empty((6, n))
        hand_velocity(views, arms, a, com, velocity)
        for i in range(3):
            wrench[i] = position[i] - views.site_xpos[site, i]
            j, k = (i + 1) % 3, (i + 2) % 3
            turn = 0.0
            for c in range(3):
                turn += hand[j, c] * target[k, c] - hand[k, c] * target[j, c]
            wrench[3 + i] = 0.5 * turn
        for r in range(6):
            wrench[r] = arms.kp[a, r] * wrench[r] - arms.kd[a, r] * velocity[r]
        jacobian(views, dofs, n, views.site_xpos[site], com, J)
        osc_torques(M, J, n, wrench, M @ p, h, tau)
    _command(views, arms, a, tau)
