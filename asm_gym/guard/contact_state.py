"""How hard an arm presses: contact force, what it adds up to, for how long the arm leans, how fast its hand goes.

F = max(max_w |f_w - g_w|, max_j |τ_j| / LEVER)    f: force at a wrist; g: its hand's weight; τ: external torque
I ← I + (F - FREE_FORCE)₊ dt                       impulse of an episode [N s]
t ← t + dt (1 + (F - FREE_FORCE)/SLOW_FORCE)       leaning: the second part with a slow hand, which feels no inertia
t ← t - dt                                         where F is under FREE_FORCE: a moment below does not end it
presses: a limit was passed within the step, or t > LEANS_S / (1 + SOONER · strikes), or I ends the episode
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.compilation import compiled, inner
from asm_gym.detection.contact_limits import FREE_FORCE, LEANS_S
from asm_gym.guard.robot_facts import columns_ending
from asm_gym.guard.robot_table import MOST_WRISTS
from asm_gym.spec import Channel, StreamSpec

LEVER = 0.5  # how far from a joint's axis an arm is touched, about [m]

SOONER = 4.0  # each time that the policy has pressed too hard before shortens that by as many times
SLOW_HAND = 0.1  # a hand slower than this feels no inertia [m/s]
SLOW_FORCE = 15.0  # with a slow hand time counts twice so far beyond ``FREE_FORCE`` [N]

HEAVIEST = 15.0  # a wrist bears at most so much without a contact: its hand's weight [N]
WEIGHED_S = 5.0  # time over which that is averaged [s]

BLOW = 2900.0
"""First blow on a table for each m/s of the hand [N s/m]; measured 2,500 to 3,100, on a bin 4,100."""

FASTEST_HEALTHY = 0.35  # no healthy hand is faster [m/s]

Floats = NDArray[np.float64]
Columns = NDArray[np.intp]


class ContactColumns(NamedTuple):
    """Columns that say how hard an arm presses: of what it feels in physics substeps, and of its rows."""

    felt_wrists: Columns  # (W, 3) forces at wrists
    felt_torques: Columns  # (J,) external torques
    wrists: Columns  # (W', 3)
    torques: Columns  # (J',)
    hands: Columns  # (H, 3) velocities of hands, of rows alone


def contact_columns(felt: Sequence[Channel], spec: StreamSpec) -> ContactColumns:
    """Return the columns of the channels that arms feel within steps, and of their streams.

    Raises:
        ValueError: more wrists than the table of robots weighs.
    """
    felt_wrists = columns_ending(felt, "wrist_force", 3).reshape(-1, 3)
    wrists = columns_ending(spec.channels, "wrist_force", 3).reshape(-1, 3)
    most = max(len(felt_wrists), len(wrists))
    if most > MOST_WRISTS:
        raise ValueError(f"a robot may have {MOST_WRISTS} channels of a wrist's force, got {most}")
    return ContactColumns(
        felt_wrists=felt_wrists,
        felt_torques=columns_ending(felt, "external_torque"),
        wrists=wrists,
        torques=columns_ending(spec.channels, "external_torque"),
        hands=columns_ending(spec.channels, "hand_velocity", 3).reshape(-1, 3),
    )


def no_load(count: int, size: int) -> Floats:
    """Return the load (n, 2 + F) of arms that feel nothing within a step.

    A load is the largest share of a contact limit in the physics substeps, when in the step a limit was passed [s], and
    the mean of what was felt, in the order of ``RobotFacts.felt_channels`` [N], [N m].
    """
    return np.full((count, 2 + size), np.nan)


def severity_info(robot: Any) -> dict[str, Any]:
    """Return what ``info["asm"]["severity"]`` says of a robot, by its record."""
    speed = float(robot["hand_speed"])
    return {
        "load": float(robot["load"]),
        "presses": bool(robot["presses"]),
        "force": float(robot["contact_force"]),
        "impulse": float(robot["pressed_impulse"]),
        "speed": speed,
        "predicted_force": BLOW * speed,  # of the blow if the hand met something stiff now [N]
        "held": bool(robot["held"]),
        "left_s": float(robot["limit_passed_s"]),
    }


@compiled
def measure_contacts(
    robots: Any, rows: Any, load: Any, columns: Any, dt: float, most_impulse: float
) -> None:
    """Write the contact state of robots (n,) by their rows (n, D) and loads (n, 2 + F).

    Args:
        columns: ``ContactColumns``.
        dt: period of the rows [s].
        most_impulse: that an arm may press with in an episode [N s].
    """
    for n in range(len(robots)):
        measure_contact(robots[n], rows[n], load[n], columns, dt, most_impulse)


@inner
def measure_contact(
    robot: Any, row: Any, load: Any, columns: Any, dt: float, most_impulse: float
) -> None:
    """Write the contact state of one robot."""
    robot.load = load[0]
    robot.limit_passed_s = load[1]
    robot.contact_force = contact_force(robot, row, load[2:], columns, WEIGHED_S / dt)
    robot.hand_speed = fastest_hand(row, columns.hands)

    force = robot.contact_force
    excess = 0.0
    if np.isfinite(force):
        excess = max(force - FREE_FORCE, 0.0)
    robot.pressed_impulse += excess * dt
    lean(robot, excess, dt)

    longest = LEANS_S / (1.0 + SOONER * robot.strikes)
    leans = robot.leaning_time > longest
    passed = robot.load > 1.0 or np.isfinite(robot.limit_passed_s)
    robot.presses = passed or leans or robot.pressed_impulse > most_impulse


@inner
def lean(robot: Any, excess: float, dt: float) -> None:
    """Take a force ``excess`` [N] beyond the free one into the time that the arm has leant on something."""
    time = -dt
    if excess > 0.0:
        time = dt
        if robot.hand_speed < SLOW_HAND:
            time += dt * excess / SLOW_FORCE
    robot.leaning_time = min(max(robot.leaning_time + time, 0.0), 2.0 * LEANS_S)


@inner
def contact_force(robot: Any, row: Any, felt: Any, columns: Any, steps: float) -> float:
    """Return the contact force on an arm [N]; not a number where nothing says.

    What the arm feels itself is not what a faulty sensor says of it; where it feels nothing, the row says.
    """
    wrist = wrist_force(felt, columns.felt_wrists, robot.felt_wrists, steps)
    force = np.fmax(wrist, joint_force(felt, columns.felt_torques))
    if np.isnan(force):
        wrist = wrist_force(row, columns.wrists, robot.sensed_wrists, steps)
        force = np.fmax(wrist, joint_force(row, columns.torques))
    return force


@inner
def wrist_force(numbers: Any, wrists: Any, weighed: Any, steps: float) -> float:
    """Return the largest force at wrists (W, 3) less the weight of their hands [N]; NaN where one is, or without any.

    Args:
        weighed: records of ``WEIGHED_WRIST``, which move on.
        steps: over which the weight is averaged.
    """
    if len(wrists) == 0:
        return np.nan
    largest = 0.0
    for w in range(len(wrists)):
        hand = weighed[w]
        weight = hand.force
        x = float(numbers[wrists[w, 0]])
        y = float(numbers[wrists[w, 1]])
        z = float(numbers[wrists[w, 2]])
        if x * x + y * y + z * z < HEAVIEST * HEAVIEST:
            hand.steps = min(hand.steps + 1.0, steps)
            weight[0] += (x - weight[0]) / hand.steps
            weight[1] += (y - weight[1]) / hand.steps
            weight[2] += (z - weight[2]) / hand.steps
        pressing = norm(x - weight[0], y - weight[1], z - weight[2])
        largest = np.maximum(largest, pressing)
    return largest


@inner
def joint_force(numbers: Any, torques: Any) -> float:
    """Return the largest external torque over its lever [N]; NaN where one is, or without any."""
    if len(torques) == 0:
        return np.nan
    largest = 0.0
    for column in torques:
        largest = np.maximum(largest, abs(float(numbers[column])))
    return largest / LEVER


@inner
def fastest_hand(row: Any, hands: Any) -> float:
    """Return the speed of the fastest hand (H, 3) [m/s]; NaN where one is, or without any."""
    if len(hands) == 0:
        return np.nan
    largest = 0.0
    for h in range(len(hands)):
        vx = float(row[hands[h, 0]])
        vy = float(row[hands[h, 1]])
        vz = float(row[hands[h, 2]])
        largest = np.maximum(largest, norm(vx, vy, vz))
    return largest


@inner
def norm(x: float, y: float, z: float) -> float:
    """Return the length of a vector."""
    return np.sqrt(x * x + y * y + z * z)
