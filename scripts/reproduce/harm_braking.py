"""How far and for how long an arm goes on after it is told to hold: what ISO 10218 calls stopping distance and time."""

from __future__ import annotations

from typing import Any

import numpy as np

from asm_gym.envs.backend import PHYSICS_FREQ
from asm_gym.evaluation.tables import Column, Table, tabulate
from asm_gym.policies.holding import Hold
from asm_gym.rollouts.staging import environment
from asm_gym.rollouts.trial import RolloutConfig
from asm_gym.scripts.reproduce.kit import Record
from asm_gym.tasks import env_id

ROBOTS = ("Panda", "Sawyer", "IIWA")

DIRECTIONS = {"up": (0.0, 0.0, 1.0), "aside": (0.0, 1.0, 0.0), "up and aside": (0.0, 1.0, 1.0)}
"""Where nothing is in the way."""

SPEEDS = (1.0, 0.5, 0.25)
"""Shares of the full action."""

MOVES, HELD = 10, 10
"""Control steps before the hold, and in it."""

RESTS = 0.01
"""A hand slower than this has stopped [m/s]."""


def braking(robot: str) -> list[Record]:
    """One arm, held from every speed in every direction."""
    env = environment(env_id("Lift"), RolloutConfig(robot=robot).settings)
    arm: Any = env.unwrapped
    hold, found = Hold(env), []
    for speed in SPEEDS:
        for seed, direction in enumerate(DIRECTIONS.values()):
            env.reset(seed=5000 + seed)
            action = np.zeros(env.action_space.shape or (), np.float32)
            action[:3] = speed * np.array(direction)
            for _ in range(MOVES):
                env.step(action)
            places: list[Any] = [_place(arm)]
            arm.substep_hooks.append(lambda substep, places=places: places.append(_place(arm)))
            state: Any = hold.begin(action)
            for _ in range(HELD):
                stay, state = hold.predict(None, state)
                env.step(stay)
            arm.substep_hooks.clear()
            hand, joints = (np.array(own) for own in zip(*places, strict=True))
            velocity = np.linalg.norm(np.diff(hand, axis=0), axis=1) * PHYSICS_FREQ
            moving = np.flatnonzero(velocity > RESTS)
            found.append(
                {
                    "robot": robot,
                    "speed": speed,
                    "hand": float(velocity[0]),
                    "further": float(np.linalg.norm(hand - hand[0], axis=1).max()),
                    "turned": float(np.abs(joints - joints[0]).max()),
                    "rests_s": float((moving[-1] + 1) / PHYSICS_FREQ) if moving.size else 0.0,
                }
            )
    return found


def _place(arm: Any) -> tuple[Any, Any]:
    """Of the hand [m] and of the joints [rad]."""
    robot, data = arm.robosuite_env.robots[0], arm.simulation.data
    return data.site_xpos[robot.eef_site_id["right"]].copy(), data.qpos[robot._ref_joint_pos_indexes].copy()


def braking_table(records: list[Record]) -> Table:
    """By arm and speed, the most of all directions."""

    def most(value: str, scale: float, digits: int, key: tuple[str, float]) -> str:
        own = [r[value] for r in records if (r["robot"], r["speed"]) == key]
        return f"{scale * max(own):.{digits}f}"

    columns: list[Column[tuple[str, float]]] = [Column("arm, share of full speed", lambda key: f"{key[0]}, {key[1]:g}")]
    for name, value, scale, digits in (
        ("hand [m/s]", "hand", 1.0, 2),
        ("goes further [mm]", "further", 1e3, 1),
        ("a joint turns further [rad]", "turned", 1.0, 3),
        ("until it rests [s]", "rests_s", 1.0, 3),
    ):
        columns.append(Column(name, lambda key, v=value, s=scale, d=digits: most(v, s, d, key)))  # type: ignore[misc]
    keys = list(dict.fromkeys((r["robot"], r["speed"]) for r in records))
    return tabulate("A hold from motion, the most of three directions", columns, keys)
