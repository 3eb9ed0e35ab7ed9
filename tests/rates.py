"""How often something has to succeed, where contacts make the outcome of one episode differ between processors.

A test that asserts one such outcome fails on a machine whose additions are ordered otherwise. A rate is asserted
instead: of n episodes, whose seeds are fixed, so many may fail as chance leaves in all but one of a thousand tests of a
rate that holds (the lower tail of the binomial distribution).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import binomtest

from asm_gym.policies import make_policy, rollout
from asm_gym.rollouts.run_trials import environment

CHANCE = 1e-3
"""With which a test of a rate that holds fails."""


def too_few(successes: int, n: int, rate: float) -> bool:
    """Whether ``rate`` leaves so few ``successes`` of ``n``, or fewer, less than once in a thousand times."""
    return bool(binomtest(successes, n, rate, alternative="less").pvalue < CHANCE)


def failures(
    trial: Callable[[int], str], seeds: Iterable[int], rate: float, first: int = 2
) -> list[str]:
    """What went wrong, where ``trial`` succeeds too seldom; empty where it may well succeed as often as ``rate``.

    Where the ``first`` few succeed the others are not tried: a rate that holds then fails no more often, and a test of
    what works takes no longer than it has to.

    Args:
        trial: of one seed; "" where it succeeded, otherwise what went wrong.
    """
    said = []
    for n, seed in enumerate(seeds, 1):
        said.append(trial(seed))
        if n == first and not any(said):
            return []
    wrong = [f"seed {seed}: {what}" for seed, what in zip(seeds, said, strict=True) if what]
    return wrong if too_few(len(said) - len(wrong), len(said), rate) else []


class Attempt(NamedTuple):
    """Outcome of one episode of a scripted expert."""

    solved: bool  # at some step
    held: bool  # at the last step, too


def attempt(seed: int, task: str, robot: str) -> Attempt:
    """Run the scripted expert's episode of ``seed``, which also seeds the expert."""
    env = environment(f"asm_gym/{task}-v0", (("robot", robot), ("stream", ())))
    success: list[bool] = []
    solved = rollout(
        env,
        make_policy("scripted", env, seed=seed),
        seed,
        lambda info: success.append(info["success"]),
    )
    return Attempt(bool(solved), bool(success[-1]))


def room_to_the_stops(env: Any) -> float:
    """Return the distance of the arm joint nearest to one of its stops [rad]; joints without stops are left out."""
    simulation = env.unwrapped.simulation
    names = [name for robot in env.unwrapped.robosuite_env.robots for name in robot.robot_joints]
    arms = [
        joint
        for joint in map(simulation.model.joint, names)
        if simulation.model.jnt_limited[joint.id]
    ]
    angles = np.array([simulation.data.joint(joint.name).qpos[0] for joint in arms])
    low, high = np.array([joint.range for joint in arms]).T
    return float(np.minimum(angles - low, high - angles).min())
