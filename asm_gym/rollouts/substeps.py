"""Episodes as the arm feels them in every physics substep, for a band on what it should feel."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from asm_gym.monitors.contact_band import FeltEpisode
from asm_gym.policies import rollout
from asm_gym.protocols import FeelsWithinSteps
from asm_gym.rollouts.staging import policy_for
from asm_gym.rollouts.trial import PolicySource


def felt_episodes(
    env: gym.Env[Any, Any], seeds: Sequence[int], policy: PolicySource = "scripted", steps: int | None = None
) -> list[FeltEpisode]:
    """Nominal episodes for ``ContactBand``; those that a policy of this package failed in are left out.

    Args:
        env: of this package, with one row of the stream a control step.
        seeds: one an episode.
        policy: what acts.
        steps: where to leave an episode, which then need not be solved.

    Raises:
        ValueError: the environment does not feel within control steps.
    """
    arm = env.unwrapped
    if not isinstance(arm, FeelsWithinSteps):
        raise ValueError(f"{arm} does not feel within control steps: record what its controller logs instead")
    kept = []
    for seed in seeds:
        rows: list[Any] = []
        felt: list[Any] = []

        def keep(info: dict[str, Any], rows: list[Any] = rows, felt: list[Any] = felt) -> None:
            rows.append(info["stream"])
            felt.append(arm.felt.astype(np.float32))

        solved = rollout(env, policy_for(policy, env, seed), seed, keep, steps)
        if solved or steps is not None:
            kept.append(FeltEpisode(np.stack(rows), np.stack(felt)))
    return kept
