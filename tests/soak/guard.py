"""Many guarded steps under sensors that fail and policies that talk nonsense, and what the process grows to.

The robot is a Panda at Lift, the memory the one that is shipped, the reflex to hold.
"""

from __future__ import annotations

import resource
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from asm_gym.policies import make_policy
from asm_gym.wrappers import NeuralASMSafety

HOSTILE = 0.02
"""Share of steps in which a sensor or the policy fails."""


class Guarded(NamedTuple):
    """What became of so many steps."""

    steps: int
    episodes: int
    alarms: int  # steps in alarm
    failures: int  # steps in which a sensor failed, or the policy while it was asked
    missed: int  # of those, steps without an alarm
    let_through: int  # actions that were not finite or out of the box, and reached the environment
    sizes: list[float]  # resident memory by tenths [MB]


def guarded(steps: int, seed: int = 0) -> Guarded:
    """So many steps under the wrapper."""
    inner = gym.make("asm_gym/Lift-v0", horizon=100)
    robot: Any = inner.unwrapped
    env = NeuralASMSafety(inner, on_alarm="hold")
    watched, step_of = [0], robot.step

    def step(action: NDArray[np.float32]) -> Any:
        watched[0] += not (np.isfinite(action).all() and (np.abs(action) <= 1.0).all())
        return step_of(action)

    robot.step = step
    rng, sizes, done = np.random.default_rng(seed), [], 0
    alarms = failures = missed = episodes = 0
    while done < steps:
        observation, _ = env.reset(seed=int(rng.integers(2**31)) if episodes % 20 == 0 else None)
        policy, over, relieved = make_policy("scripted", env, seed=episodes), False, False
        episodes += 1
        while not over and done < steps:
            action = np.clip(policy.predict(observation)[0], -1.0, 1.0)
            fails = int(rng.integers(2)) if rng.random() < HOSTILE else None
            if fails == 0:
                action = np.full_like(action, (np.nan, np.inf)[int(rng.integers(2))])
            elif fails == 1:
                where, bad = int(rng.integers(20)), (np.nan, np.inf, -np.inf)[int(rng.integers(3))]
                robot.corruptions.append(lambda row, where=where, bad=bad: row.__setitem__(where, bad))
            observation, _, terminated, truncated, info = env.step(action)
            robot.corruptions.clear()
            failed = fails == 1 or (fails == 0 and not relieved)
            alarms, failures = alarms + info["asm"]["alarm"], failures + failed
            missed += failed and not info["asm"]["alarm"]
            relieved = {"override": True, "release": False}.get(info["asm"]["transition"], relieved)
            over, done = terminated or truncated, done + 1
            if done % max(1, steps // 10) == 0:
                sizes.append(_resident())
    env.close()
    return Guarded(done, episodes, alarms, failures, missed, watched[0], sizes)


def _resident() -> float:
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() / 1e6
