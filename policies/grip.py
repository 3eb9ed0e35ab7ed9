"""When a gripper is told to open or to close: once there is enough evidence for it.

    E_t = exp(-Δt/τ) E_{t-1} + Δt p_t      p_t: how surely the other command is expected, from 0 to 1
    E_t > θ:  the other command is given, and E = 0

What is expected is a mean over all that was shown in situations like this one. Just before a gripper lets go, most of
them say that it holds on, and a hand that stands still there would, by the sign of the mean, hold on for ever. So
evidence is summed: what is expected one time in five is done about five times as late. What is expected without a doubt
waits too, for fingers that let go press on for a while, and what is sensed meanwhile would have them close again.

There is no evidence for the command that is given already, so what is expected one time in five all along is done now
and then: this is for expectations that a situation brings about and its end takes back.

Source: Usher and McClelland 2001 (Psychological Review 108(3)) for leaky evidence that is summed up to a bound; their
mutual inhibition is left out.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from asm_gym.spec import control_period

FORGETS = 1.6
"""τ [s]."""

ENOUGH = 0.15
"""θ: so long a command must be expected without a doubt [s]."""


class Grip(NamedTuple):
    """What the G grippers are told; a value."""

    high: NDArray[np.bool_]  # (G,) told the upper end of the action's range, else the lower
    evidence: NDArray[np.float64]  # (G,) E [s]


class CommandReadout:
    """Makes actions of what is expected to be commanded: kept in the space, and each gripper at one end of its range.

    Args:
        env: whose actions they are; its ``gripper_actions`` say which of them are grippers'.
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        self._space: Any = env.action_space
        self._grip = np.asarray(getattr(env.unwrapped, "gripper_actions", ()), dtype=int)
        self._dt = control_period(env)
        # However long a step lasts, one must not be enough for what is less likely than not.
        self._enough = max(ENOUGH, 0.5 * self._dt)

    def __call__(self, expected: NDArray[np.float32], before: Grip | None) -> tuple[NDArray[np.float32], Grip]:
        """The action (A,) for what is expected (A,), and the grip to pass in next time; None before the first."""
        low, high = self._space.low, self._space.high
        action = np.clip(np.nan_to_num(expected), low, high).astype(np.float32)
        g = self._grip
        share = ((action - low)[g] / (high - low)[g]).astype(np.float64)  # (G,) 1 where the upper end is certain
        grip = self._decided(share, Grip(share > 0.5, np.zeros(len(share))) if before is None else before)
        action[self._grip] = np.where(grip.high, high[self._grip], low[self._grip])
        return action, grip

    def _decided(self, share: NDArray[np.float64], before: Grip) -> Grip:
        other = np.where(before.high, 1.0 - share, share)
        evidence = np.exp(-self._dt / FORGETS) * before.evidence + self._dt * other
        changes = evidence > self._enough
        return Grip(before.high ^ changes, np.where(changes, 0.0, evidence))
