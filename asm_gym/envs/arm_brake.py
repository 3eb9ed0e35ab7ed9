"""Slow an arm down beneath its controller, by how fast it moves, whatever was commanded.

Of its present motion q̇ an arm may have the share s, the least of

    L / fastest point                     L: the speed that its action was slowed down to
    what its hand may have of its twist   see ``detection.hand_speed``

where the momentum p is the largest of the impulses |Λ v| that stop a point of a link which is near something
(``obstacles``), as far as it counts. Such an impulse is what a link pushes with that meets something hard and does not
slide, be it a forearm on the robot's own pedestal. Λ⁻¹ = J M⁻¹ Jᵀ, without the joints that are at their stops, for
these do not give way. v is the point's velocity after another hundredth of a second of what the motors do now, since
they drive the arm on while it is stopped. At a distance g, approached with the speed c, an impulse counts

    min(1, T c / g)                       T: what it takes to brake

since a point that would not touch within T can still be braked. It counts in full also where it only grazes: MuJoCo's
friction answers to all of its speed. Links but the hand never slide along things in healthy episodes, and theirs
count in full within a millimetre of something; they are limited as where no healthy hand was. Beyond its share the
motors slow the arm down,

    τ ← τ - w (τ - h) - K (1 - s) M q̇       w ← max(5 (1 - s), 0.97 w), at most 1

so that nothing drives it on, and for a moment nothing pushes with full force on what has stopped it. While a link but
the hand touches something w is at least 0.95: near its base an arm presses hardest, and its wrist feels nothing of it.
A motor that delivers less torque than it was commanded is commanded so much more while it brakes.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import numpy as np

from asm_gym.compilation import inner
from asm_gym.detection.hand_speed import SpeedLimit, paced_share, usual_share
from asm_gym.envs.controllers import (
    backward,
    cholesky,
    command,
    forward,
    inner_products,
    length,
    multiply,
    solve,
    velocity_at,
)
from asm_gym.envs.mujoco_views import (
    EVERYWHERE,
    Ahead,
    Arm,
    Floats,
    Goal,
    SubstepLimits,
    Views,
    Work,
)
from asm_gym.envs.obstacles import LOOK_AGAIN_EVERY, look_again

SOON_S = 0.03  # T
DRIVEN_S = 0.01  # motors drive an arm on for so long while it is stopped [s]
SURE_GAP = 2e-3  # curved surfaces may be nearer by so much than their nearest points were [m]
LEAST_GAP = 1e-4  # no distance is divided by less [m]
GRAZES = 1e-3  # a link but the hand that is so near to something may touch it [m]
SLIDES = 0.005  # a point that comes nearer, or goes away, by less slides along [m/s]
REACHES = 0.15  # from fingers to the far end of what they hold, and from links to joints [m]
SLOWING = 200.0  # K: share of the speed beyond its limit that an arm loses in a second [1/s]
ALL_DRIVE = 5.0  # an arm a fifth too fast is driven no further
DRIVE_LOST_KEPT = 0.97  # share of w from substep to substep: half of it in 45 ms
LEANING_DRIVE_LOST = 0.95  # while a link but the hand touches something
LEAST_DRIVE_LOST = 0.02  # w from which on an arm counts as braked
STUCK = 1e6  # inertia of a joint at its stop [kg m²]
LEAST_SPEED = 1e-9  # no speed is divided by less [m/s]
LEAST_TORQUE = 1e-9  # nothing is divided by less [N m]
LEAST_INVERSE_MASS = 1e-4  # of a point that some directions cannot move [1/kg]

# Nearer to the axis of its own base a hand goes half as fast, for its mount is hard [m].
BESIDE_BASE = 0.3


class Approach(NamedTuple):
    """How near an arm is to touching something."""

    soon: float  # how soon a point does: 1 for within T, 0 for never
    momentum: float  # p of the hand, the largest that counts [N s]
    link_momentum: float  # the same of the other links [N s]
    leans: bool  # a link but the hand touches something already


@partial(inner, inlined=True)
def is_beside_base(views: Views, arm: Arm) -> bool:
    """Whether an arm's hand is near the axis of its own base."""
    hand = views.site_xpos[arm.site]
    base = views.xpos[arm.root]
    x = hand[0] - base[0]
    y = hand[1] - base[1]
    return np.hypot(x, y) < BESIDE_BASE


@inner
def twist_speed(twist: Floats) -> float:
    """Return how fast the furthest point of a hand can go [m/s]."""
    return length(twist[:3]) + REACHES * length(twist[3:])


@inner
def point_speed(motion: Floats, place: Floats, origin: Floats) -> float:
    """Return how fast the furthest point about a place (3,) may go [m/s]; see ``velocity_at``."""
    x, y, z = velocity_at(motion, place, origin)
    speed = np.sqrt(x * x + y * y + z * z)
    return speed + REACHES * length(motion[:3])


@partial(inner, inlined=True)
def place_of(views: Views, arm: Arm, n: int) -> Floats:
    """Return (3,) the origin of an arm's link; between the fingers for the first, its hand."""
    if n == 0:
        return views.site_xpos[arm.site]
    return views.xpos[arm.links[n]]


@partial(inner, inlined=True)
def fastest_point(views: Views, arm: Arm) -> float:
    """Return the greatest speed of any point within ``REACHES`` of the hand or of a link's origin [m/s]."""
    origin = views.subtree_com[arm.root]  # at which MuJoCo's velocities of bodies are
    fastest = 0.0
    n = 0
    while arm.links[n] >= 0:
        place = place_of(views, arm, n)
        speed = point_speed(views.cvel[arm.links[n]], place, origin)
        fastest = max(fastest, speed)
        n += 1
    return fastest


@partial(inner, inlined=True)
def approach_of(views: Views, arm: Arm, a: int, ahead: Ahead, work: Work) -> Approach:
    """Return how arm ``a`` approaches obstacles in its present motion.

    ``work.factor`` is the arm's; see ``write_factor``.
    """
    soonest = 0.0
    of_hand = 0.0
    of_links = 0.0
    leans = False
    n = 0
    while arm.links[n] >= 0:
        hardest = 0.0
        if ahead.counts[a, n] == EVERYWHERE:
            soonest = 1.0
            place = place_of(views, arm, n)
            hardest = point_momentum(views, arm, n, place, work)
        for k in range(ahead.counts[a, n]):
            point = ahead.points[a, n, k]
            gap = present_gap(views, arm.links[n], point, work.place)
            leans = leans or (n > 0 and gap <= 0.0)
            origin = views.subtree_com[arm.root]
            x, y, z = velocity_at(views.cvel[arm.links[n]], work.place, origin)
            closing = closing_speed(point.way, x, y, z)
            soon = how_soon(closing, gap)
            if n > 0 and gap < GRAZES and abs(closing) < SLIDES:
                soon = 1.0
            if soon > 0.0:
                momentum = point_momentum(views, arm, n, work.place, work)
                soonest = max(soonest, soon)
                hardest = max(hardest, soon * momentum)
        if n == 0:
            of_hand = hardest
        else:
            of_links = max(of_links, hardest)
        n += 1
    return Approach(soon=soonest, momentum=of_hand, link_momentum=of_links, leans=leans)


@partial(inner, inlined=True)
def present_gap(views: Views, link: int, point: Any, place: Floats) -> float:
    """Write where a point of a link is now into ``place`` (3,); return how far it is from what does not move [m]."""
    gap = point.gap
    for axis in range(3):
        place[axis] = views.xpos[link, axis]
        for k in range(3):
            place[axis] += views.xmat[link, 3 * axis + k] * point.in_link[k]
        gap -= point.way[axis] * (place[axis] - point.place[axis])
    return gap


@inner
def closing_speed(way: Floats, x: float, y: float, z: float) -> float:
    """Return how fast a point that moves so fast comes nearer along a unit vector (3,) [m/s]."""
    return way[0] * x + way[1] * y + way[2] * z


@inner
def how_soon(closing: float, gap: float) -> float:
    """Return how soon a point touches what is ``gap`` away [m] and comes nearer so fast [m/s]; see ``Approach``."""
    if closing < SLIDES:
        return 0.0
    return min(1.0, SOON_S * closing / max(gap - SURE_GAP, LEAST_GAP))


@partial(inner, inlined=True)
def point_momentum(views: Views, arm: Arm, n: int, place: Floats, work: Work) -> float:
    """Return |Λ v|, what stops a link at a place (3,) a moment on [N s]."""
    origin = views.subtree_com[arm.root]
    velocity = work.momentum
    x, y, z = velocity_at(views.cvel[arm.links[n]], place, origin)
    velocity[0] = x
    velocity[1] = y
    velocity[2] = z

    rows = work.weighted  # J L⁻ᵀ
    for i in range(arm.joint_count):
        for axis in range(3):
            rows[axis, i] = 0.0
        if i < arm.link_joints[n]:
            x, y, z = velocity_at(views.cdof[arm.dofs[i]], place, origin)
            rows[0, i] = x
            rows[1, i] = y
            rows[2, i] = z
            for axis in range(3):
                velocity[axis] += rows[axis, i] * work.gained[i]
    for axis in range(3):
        forward(work.factor, arm.joint_count, rows[axis])
    inner_products(rows, 3, arm.joint_count, work.products)
    return stopping_impulse(work.products, work.inverse_mass, velocity)


@inner
def stopping_impulse(inverse_mass: Floats, factor: Floats, velocity: Floats) -> float:
    """Return |Λ v| [N s], and write Λ v into ``velocity`` (3,).

    Args:
        inverse_mass: (3, 3) or more Λ⁻¹ = J M⁻¹ Jᵀ, up to the diagonal; written to [1/kg].
        factor: scratch of that shape.
        velocity: (3,) v [m/s].
    """
    for axis in range(3):
        inverse_mass[axis, axis] += LEAST_INVERSE_MASS
    solve(inverse_mass, 3, factor, velocity)
    return length(velocity)


@partial(inner, inlined=True)
def share_at(
    views: Views, arm: Arm, a: int, limit: SpeedLimit, twist: Floats, approach: Approach
) -> float:
    """Return the share that arm ``a`` may have of a motion of its hand, a twist (6,), where the hand is now."""
    momentum = max(approach.momentum, approach.link_momentum)
    share = usual_share(limit, twist_speed(twist), approach.soon, momentum)
    upright = -views.site_xmat[arm.site, 8]  # 1 for a hand that points down
    if limit.grid.size > 0 and upright >= limit.least_upright:
        place = views.site_xpos[arm.site]
        share = paced_share(limit, a, place, twist, share, approach.momentum)
    return min(share, limit.momentum / max(approach.link_momentum, LEAST_SPEED))


@partial(inner, inlined=True)
def write_twist(arm: Arm, work: Work) -> None:
    """Write the present twist of an arm's hand."""
    for axis in range(6):
        work.twist[axis] = 0.0
        for i in range(arm.joint_count):
            work.twist[axis] += work.jacobian[axis, i] * work.velocities[i]


@partial(inner, inlined=True)
def write_factor(arm: Arm, work: Work) -> None:
    """Write the Cholesky factor of the mass matrix of an arm whose joints at their stops cannot turn."""
    n = arm.joint_count
    for i in range(n):
        work.gained[i] = work.mass[i, i]
        if not arm.lowest[i] < work.angles[i] < arm.highest[i]:
            work.mass[i, i] = STUCK
    cholesky(work.mass, n, work.factor)
    for i in range(n):
        work.mass[i, i] = work.gained[i]


@partial(inner, inlined=True)
def write_gained(views: Views, arm: Arm, goal: Goal, work: Work) -> None:
    """Write the speed that the motors add to the joints within ``DRIVEN_S``, by the factor of their mass matrix."""
    n = arm.joint_count
    for i in range(n):
        drive = views.ctrl[arm.motors[i]] - work.bias[i]
        work.gained[i] = DRIVEN_S * (1.0 - goal.drive_lost) * drive
    forward(work.factor, n, work.gained)
    backward(work.factor, n, work.gained)


@partial(inner, inlined=True)
def slow_down(
    views: Views, arm: Arm, goal: Goal, a: int, limits: SubstepLimits, work: Work
) -> bool:
    """Brake arm ``a`` along its own motion while it passes its limits.

    Mass, bias, Jacobian and velocities of ``work`` are those of the arm.

    Returns:
        Whether the arm is braked.
    """
    speed_limit = limits.speed_limits[a]
    if speed_limit == np.inf:
        return False
    speed = max(fastest_point(views, arm), LEAST_SPEED)
    limit = limits.motion[0]
    if is_beside_base(views, arm):
        limit = limits.motion[1]
    write_twist(arm, work)
    approach = Approach(soon=1.0, momentum=0.0, link_momentum=0.0, leans=False)
    if limit.momentum < np.inf:
        write_factor(arm, work)
        write_gained(views, arm, goal, work)
        if limits.status[0].substeps % LOOK_AGAIN_EVERY == 0:
            look_again(views, arm, a, limits.ahead, work.ends)
        approach = approach_of(views, arm, a, limits.ahead, work)
    share = share_at(views, arm, a, limit, work.twist, approach)
    share = min(share, speed_limit / speed)
    excess = max(0.0, 1.0 - share)
    goal.drive_lost = max(min(1.0, ALL_DRIVE * excess), DRIVE_LOST_KEPT * goal.drive_lost)
    if approach.leans:
        goal.drive_lost = max(goal.drive_lost, LEANING_DRIVE_LOST)
    if excess == 0.0 and goal.drive_lost < LEAST_DRIVE_LOST:
        return False
    brake_motion(views, arm, goal, excess, work)
    return True


@partial(inner, inlined=True)
def brake_motion(views: Views, arm: Arm, goal: Goal, excess: float, work: Work) -> None:
    """Command the motors of an arm less of what drives it, and less along its motion.

    Where a motor can deliver only a share of its part all brake by that share, lest the others drive the arm another
    way. One that cannot even bear the arm is left out of this.

    Args:
        excess: share of the motion that is too much.
    """
    n = arm.joint_count
    multiply(work.mass, n, work.velocities, work.torques)
    possible = 1.0
    for i in range(n):
        work.torques[i] *= SLOWING * excess
        undriven = driven_less(views, arm, goal, i, work)
        least, most = views.actuator_ctrlrange[arm.motors[i]]
        spare = undriven - goal.strengths[i] * least
        if work.torques[i] < 0.0:
            spare = goal.strengths[i] * most - undriven
        wanted = max(abs(work.torques[i]), LEAST_TORQUE)
        if spare > 0.0:
            possible = min(possible, spare / wanted)
    for i in range(n):
        torque = driven_less(views, arm, goal, i, work) - possible * work.torques[i]
        command(views, arm.motors[i], torque / goal.strengths[i])


@partial(inner, inlined=True)
def driven_less(views: Views, arm: Arm, goal: Goal, i: int, work: Work) -> float:
    """Return the torque of a motor without the lost share of what drives joint ``i`` [N m]."""
    commanded = views.ctrl[arm.motors[i]]
    return commanded - goal.drive_lost * (commanded - work.bias[i])
