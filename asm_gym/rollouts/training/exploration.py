"""Harmless exploration: what moving feels like to a robot that does not know its task yet, and breaks nothing.

A memory of an expert's episodes finds everything surprising that an untrained agent does. One of these episodes knows
every kind of moving, and is surprised by forces alone.

    a_t = clip(g e_t + s x_t),   x_t = ρ x_{t-1} + √(1 - ρ²) ξ_t   (e the expert's action, g 0 or 1, ξ white)
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from asm_gym.crashes import peak_torques
from asm_gym.episode import Episode, load_episode, save_episode
from asm_gym.policies import make_policy
from asm_gym.policies.base import Policy
from asm_gym.rollouts.staging import play, staged
from asm_gym.rollouts.trial import RolloutConfig, Trial
from asm_gym.wrappers import StreamRecorder

SMOOTHNESS = (0.0, 0.5, 0.9, 0.97)
"""ρ: from the noise by which agents explore to pushing on in one direction, as half-trained ones do."""
SHORTEST = 20
"""Steps that are worth keeping of an episode."""


class Explorer:
    """Acts at random, in half of the episodes around what the task's expert does, and pauses now and then.

    Args:
        env: one with a scripted expert.
        seed: of the expert and of the noise.
    """

    PAUSE, PAUSED = 0.02, 15  # probability in a step that it pauses, and for how many

    def __init__(self, env: gym.Env[Any, Any], seed: int) -> None:
        self._rng = np.random.default_rng([seed, 1])
        self._expert: Policy | None = make_policy("scripted", env, seed=seed) if self._rng.random() < 0.5 else None
        self._scale = self._rng.uniform(0.05, 1.0)
        self._smooth = float(self._rng.choice(SMOOTHNESS))
        self._noise = self._rng.standard_normal(env.action_space.shape or ())
        self._grip = list(getattr(env.unwrapped, "gripper_actions", ()))
        self._left = 0

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = False,
    ) -> tuple[NDArray[np.float32], Any]:
        """The next action (A,)."""
        fresh = self._rng.standard_normal(self._noise.shape)
        self._noise = self._smooth * self._noise + np.sqrt(1.0 - self._smooth**2) * fresh
        action = self._scale * self._noise  # (A,)
        if self._expert is not None:
            meant, state = self._expert.predict(observation, state, episode_start)
            action = action + meant
        self._left = self._left - 1 if self._left else self.PAUSED * (self._rng.random() < self.PAUSE)
        if self._left:
            # A reflex that holds keeps the grip and stops the rest.
            action = np.where(np.isin(np.arange(len(action)), self._grip), action, 0.0)
        return np.clip(action, -1.0, 1.0).astype(np.float32), state


class Gentle(NamedTuple):
    """Up to where exploration is harmless.

    Attributes:
        force: external, on an arm as a whole [N].
        torque: external, on a joint [N m]; it tells of what cancels in the force, as of an arm that hits itself, and of
            joints at their stops.
    """

    force: float
    torque: float


def until_contact(episode: Episode, forces: NDArray[np.floating[Any]], gentle: Gentle) -> Episode:
    """The episode up to the step before one that is not harmless.

    Args:
        forces: (T,) the largest external force of each step [N].
    """
    over = ~((forces <= gentle.force) & (peak_torques(episode) <= gentle.torque))
    end = int(np.argmax(over)) if over.any() else len(forces)
    kept = {name: getattr(episode, name)[:end] for name in ("stream", "actions", "rewards", "faults")}
    return replace(episode, observations=episode.observations[: end + 1], **kept)


def explore(seed: int, env_id: str, gentle: Gentle, folder: Path) -> Path:
    """Records the harmless part of an episode of exploration."""
    forces: list[float] = []
    trial, config = Trial(env_id, seed), RolloutConfig(partial(Explorer, seed=seed))
    with staged(trial, config) as env:
        recorder = StreamRecorder(env)
        play(trial, config, recorder, lambda info: forces.append(info["external_force"]))
    return save_episode(folder / f"{seed}.npz", until_contact(recorder.finish(), np.array(forces), gentle))


def harmless(files: list[Path]) -> list[Episode]:
    """Those of the recordings that are long enough to learn from."""
    return [e for e in map(load_episode, files) if len(e) >= SHORTEST]
