"""Records what every episode of learning came to: reward, success, contact and what a guard did."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium.vector import VectorWrapper
from numpy.typing import NDArray

from asm_gym.evaluation.defaults import TRANSIENT

SUMS = ("reward", "harm", "blows", "overridden", "slowed", "cost", "joint_stops", "self_contacts")
"""What is added up over the steps of an episode."""
PEAKS = ("success", "peak")
"""That of which the largest value counts."""
SMALLEST = 1e-4  # difference of an action that counts as slowed


class LearningRecord(VectorWrapper):
    """Keeps a row of numbers for each episode of a vector of this package's environments.

    ``episodes`` are dicts of: ``step``, the steps of all members when it ended; ``member``; ``length`` in steps;
    ``reward``; ``success``; ``harm``, contact force beyond 40 N summed over physics substeps [N s]; ``peak``, the
    largest contact force in any substep [N]; ``blows``, contacts beyond 280 N; steps ``overridden``, ``slowed`` by the
    speed limit (NaN without a guard), and in alarm (``cost``); ``joint_stops`` and ``self_contacts``, summed over
    steps.

    Args:
        env: a vector of this package's environments, guarded or not, without autoreset.
    """

    def __init__(self, env: Any) -> None:
        super().__init__(env)
        self.episodes: list[dict[str, float]] = []
        self.steps = 0  # of all members
        self._sums = np.zeros((self.num_envs, len(SUMS)))
        self._peaks = np.zeros((self.num_envs, len(PEAKS)))
        self._lengths = np.zeros(self.num_envs, np.int64)
        self._was_hard = np.zeros(self.num_envs, bool)  # the step before was one of a blow

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> Any:
        begun = np.ones(self.num_envs, bool)
        if options is not None and "reset_mask" in options:
            begun = np.array(options["reset_mask"])
        self._sums[begun] = 0.0
        self._peaks[begun] = 0.0
        self._lengths[begun] = 0
        self._was_hard[begun] = False
        return self.env.reset(seed=seed, options=options)

    def step(self, actions: Any) -> Any:
        proposed = np.array(actions)
        observations, rewards, terminated, truncated, infos = self.env.step(actions)
        self._note(proposed, np.asarray(rewards, np.float64), infos)
        for member in np.flatnonzero(terminated | truncated):
            self._end(int(member))
        return observations, rewards, terminated, truncated, infos

    def _note(self, proposed: NDArray[Any], rewards: NDArray[np.float64], infos: Any) -> None:
        """Add a step of every member."""
        nothing = np.zeros(self.num_envs)
        force = np.nan_to_num(np.asarray(infos["contact_force"], np.float64))
        is_hard = force > TRANSIENT
        overridden = np.asarray(infos.get("overridden", nothing), bool)
        slowed = np.full(self.num_envs, np.nan)  # only a guard tells
        if "asm" in infos:
            change = np.abs(infos["asm"]["executed_action"] - proposed)
            slowed = np.any(change > SMALLEST, axis=1) & ~overridden
        self.steps += self.num_envs
        self._lengths += 1
        self._sums += np.column_stack(
            [
                rewards,
                np.nan_to_num(np.asarray(infos["contact_impulse"], np.float64)),
                is_hard & ~self._was_hard,
                overridden,
                slowed,
                np.asarray(infos.get("cost", nothing)),
                infos["joint_stops"],
                infos["self_contacts"],
            ]
        )
        peaks = np.column_stack([infos["success"], force])
        self._peaks = np.maximum(self._peaks, peaks)
        self._was_hard = is_hard

    def _end(self, member: int) -> None:
        """Keep the episode of a member, which has ended."""
        sums = dict(zip(SUMS, self._sums[member].tolist(), strict=True))
        peaks = dict(zip(PEAKS, self._peaks[member].tolist(), strict=True))
        episode = {
            "step": self.steps,
            "member": member,
            "length": int(self._lengths[member]),
        }
        self.episodes.append(episode | sums | peaks)
