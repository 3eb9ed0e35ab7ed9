"""Many guarded steps under sensors that fail and policies that talk nonsense, and what the process grows to.

The reflex is to hold. The robot is a synthetic arm, whose memory is fitted here and whose steps cost nearly nothing, or
a Panda at Lift with the memory that is shipped.
"""

from __future__ import annotations

import resource
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from asm_gym.monitors import NeuralASM
from asm_gym.policies import make_policy
from asm_gym.rollouts import collect
from asm_gym.wrappers import NeuralASMSafety

HOSTILE = 0.02
"""Share of steps in which a sensor or the policy fails."""
ARM, LIFT = "asm_gym/SyntheticArm-v0", "asm_gym/Lift-v0"


class Guarded(NamedTuple):
    """What became of so many steps."""

    steps: int
    episodes: int
    alarms: int  # steps in alarm
    failures: int  # steps in which a sensor failed, or the policy while it was asked
    missed: int  # of those, steps without an alarm
    let_through: int  # actions that were not finite or out of the box, and reached the environment
    sizes: list[float]  # resident memory by tenths [MB]

    @property
    def growth(self) -> float:
        """From the end of the first tenth to that of the last [%]."""
        return 100 * (self.sizes[-1] / self.sizes[0] - 1)


class Broken(gym.Wrapper[Any, Any, Any, Any]):
    """Counts actions that should not have come, and spoils a number of the stream where it is told to."""

    let_through = 0
    spoiled: tuple[int, float] | None = None  # column and value in the coming step

    def step(self, action: Any) -> Any:
        space: Any = self.action_space
        self.let_through += not bool(np.all((action >= space.low) & (action <= space.high)))  # nor is NaN
        observation, reward, terminated, truncated, info = self.env.step(action)
        if self.spoiled is not None:
            column, bad = self.spoiled
            info["stream"] = info["stream"].copy()
            info["stream"][..., column] = bad
        return observation, reward, terminated, truncated, info


def arm() -> tuple[gym.Env[Any, Any], str, NeuralASM]:
    """A synthetic arm that sways, with a memory of it."""
    episodes = collect(ARM, "sway", 20, workers=1, horizon=100)
    memory = NeuralASM(episodes[0].spec, hidden_size=32, association_size=64, epochs=3)
    return gym.make(ARM, horizon=100), "sway", memory.fit(episodes[:8]).calibrate(episodes[8:], 0.1)


def lift() -> tuple[gym.Env[Any, Any], str, None]:
    """A Panda that its expert lifts with; its memory is found."""
    return gym.make(LIFT, horizon=100), "scripted", None


def guarded(
    made: tuple[gym.Env[Any, Any], str, NeuralASM | None],
    steps: int,
    seed: int = 0,
    tick: Callable[[int, float], None] = lambda done, size: None,
) -> Guarded:
    """So many steps under the wrapper.

    Args:
        made: environment, policy and memory, as ``arm`` and ``lift`` make them.
        tick: is called after each tenth with the steps that are done and the process's size [MB].
    """
    inner, acts, memory = Broken(made[0]), made[1], made[2]
    env = NeuralASMSafety(inner, memory, on_alarm="hold")
    rng, sizes, done = np.random.default_rng(seed), [], 0
    size = env.get_wrapper_attr("stream_spec").size
    alarms = failures = missed = episodes = 0
    while done < steps:
        observation, _ = env.reset(seed=int(rng.integers(2**31)) if episodes % 20 == 0 else None)
        policy, over, relieved = make_policy(acts, env, seed=episodes), False, False
        episodes += 1
        while not over and done < steps:
            action = np.clip(policy.predict(observation)[0], env.action_space.low, env.action_space.high)
            fails = int(rng.integers(2)) if rng.random() < HOSTILE else None
            bad = (np.nan, np.inf, -np.inf)[int(rng.integers(3))]
            if fails == 0:
                action = np.full_like(action, bad)
            inner.spoiled = (int(rng.integers(size)), bad) if fails == 1 else None
            observation, _, terminated, truncated, info = env.step(action)
            failed = fails == 1 or (fails == 0 and not relieved)
            alarms, failures = alarms + info["asm"]["alarm"], failures + failed
            missed += failed and not info["asm"]["alarm"]
            relieved = {"override": True, "release": False}.get(info["asm"]["transition"], relieved)
            over, done = terminated or truncated, done + 1
            if done % max(1, steps // 10) == 0:
                sizes.append(_resident())
                tick(done, sizes[-1])
    env.close()
    return Guarded(done, episodes, alarms, failures, missed, inner.let_through, sizes)


def _resident() -> float:
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() / 1e6
