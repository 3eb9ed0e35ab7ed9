"""Who learns to act from demonstrations: a memory without a gradient through time, and a GRU with one.

    GRU    h_t = cell(h_{t-1}, m_t)     â_{t+1} = A h_t + b       Σ ‖a_{t+1} - â_{t+1}‖², the action that was intended

The expert is disturbed while it shows: noise is added to what it does, but what is learned is what it intended, so that
learners see how to recover (DART: Laskey et al. 2017, CoRL). Both read the same ``m_t``, as ``memory.motor`` says.

Sources: Pomerleau 1991 (Neural Computation 3(1)) for cloning; Cho et al. 2014 (EMNLP) for the cell.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from asm_gym.episode import Episode
from asm_gym.memory.motor import fineness, lessons, situation
from asm_gym.monitors.baselines.torch_model import adam, descend, padded
from asm_gym.policies import make_policy
from asm_gym.policies.grip import CommandReadout, Grip
from asm_gym.policies.memory_policy import StreamReader, common_spec, require_motor
from asm_gym.policies.scripted.base import Style
from asm_gym.rollouts.staging import environment
from asm_gym.scaling import StreamScaler
from asm_gym.spec import StreamSpec

GROUPS = ("hand", "gripper", "object", "action")
"""Of the streams that are learned from."""

SETTINGS = (("terminate_on_success", True),)
CONSISTENT = Style(noise=0.0, speed_spread=0.0, spread=0.0)
"""The same way every time: what differs between episodes for no visible reason can only be learned by heart."""

DISTURBANCE = 0.3
"""Largest standard deviation of the noise added to the hand's commands; that of an episode is drawn below it."""

FORGETS = 0.78
"""Share of a step's disturbance that is left in the next."""


def stream_of(tasks: Sequence[str]) -> StreamSpec:
    """One layout for the streams of all tasks."""
    return common_spec([environment(f"asm_gym/{t}-v0", SETTINGS).unwrapped.measured_spec for t in tasks], GROUPS)  # type: ignore[attr-defined]


def demonstrate(lesson: tuple[str, int], spec: StreamSpec) -> Episode | None:
    """The expert's episode of (task, seed), disturbed: the stream says what was done, the actions what was intended.

    The first row is that of the reset, before which nothing was commanded. None where the expert did not succeed.
    """
    task, seed = lesson
    env = environment(f"asm_gym/{task}-v0", SETTINGS)
    read, rng = StreamReader(spec, env), np.random.default_rng([seed, 1])
    expert: Any = make_policy("scripted", env, seed=seed, style=CONSISTENT)
    observation, info = env.reset(seed=seed)
    action = np.zeros(len(spec.motor), np.float32)
    rows, actions = [read(observation, action)], [action]
    free = np.setdiff1d(np.arange(len(action)), env.unwrapped.gripper_actions)  # type: ignore[attr-defined]
    size, drift, state, ended = DISTURBANCE * rng.random(), np.zeros(len(free)), None, False
    while not ended:
        intended, state = expert.predict(observation, state, deterministic=True)
        drift = FORGETS * drift + size * np.sqrt(1 - FORGETS**2) * rng.standard_normal(len(free))
        done = intended.copy()
        done[free] = np.clip(done[free] + drift, -1.0, 1.0)
        observation, _, terminated, truncated, info = env.step(done)
        ended = terminated or truncated
        rows.append(read(observation, done))
        actions.append(intended)
    if not info["success"]:
        return None
    return Episode.from_stream(np.stack(rows), spec, seed=seed, actions=np.stack(actions), info={"skill": task})


class Cloned(nn.Module):
    """A cell and a readout of the command.

    Args:
        inputs: numbers read.
        hidden: units.
        motor: numbers commanded.
    """

    def __init__(self, inputs: int, hidden: int, motor: int) -> None:
        super().__init__()
        self.cell = nn.GRU(inputs, hidden, batch_first=True)
        self.act = nn.Linear(hidden, motor)

    def forward(self, m: Tensor, state: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """â (B, T, A), standardised, and the last state, for situations (B, T, I)."""
        h, state = self.cell(m, state)
        return self.act(h), state


class CloneState(NamedTuple):
    """Where a clone is."""

    hidden: Tensor | None
    action: NDArray[np.float32]  # (A,) commanded last
    grip: Grip | None


class Clone:
    """A GRU that was trained to do as the expert does; ``bound`` to an environment it is a policy."""

    def __init__(
        self, senses: StreamScaler, module: Cloned, mean: NDArray[np.float32], spread: NDArray[np.float32]
    ) -> None:
        self.senses, self.module, self.mean, self.spread = senses, module, mean, spread

    @classmethod
    def learned(
        cls, episodes: Sequence[Episode], hidden: int, updates: int, rng: np.random.Generator, rate: float = 3e-3
    ) -> Clone:
        """By backpropagation through whole episodes, 16 at a time."""
        torch.set_num_threads(1)
        senses = StreamScaler.fit(episodes[0].spec, [e.stream for e in episodes])
        taught = [lessons(senses, [e]) for e in episodes]
        every = np.concatenate([a for _, a in taught])
        mean, spread = every.mean(axis=0), every.std(axis=0)
        spread = np.where(spread > 0, spread, 1).astype(np.float32)
        inputs = int(np.count_nonzero(fineness(senses.spec))) + 1
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(int(rng.integers(2**31)))
            module = Cloned(inputs, hidden, every.shape[1])
        optimiser, schedule = adam(module, updates, rate)
        for _ in range(updates):
            chosen = rng.choice(len(taught), min(16, len(taught)), replace=False)
            rows, real = padded([np.hstack([taught[i][0], (taught[i][1] - mean) / spread]) for i in chosen])
            said, _ = module(rows[..., :inputs])
            error = ((said - rows[..., inputs:]) ** 2).sum(-1)
            descend((error * real).sum() / real.sum(), optimiser, schedule)
        return cls(senses, module.eval().requires_grad_(False), mean, spread)

    def bound(self, env: gym.Env[Any, Any]) -> ClonePolicy:
        return ClonePolicy(self, env)


class ClonePolicy:
    """A clone in an environment; see ``NeuralASMPolicy``."""

    def __init__(self, clone: Clone, env: gym.Env[Any, Any]) -> None:
        self._clone, self._readout = clone, CommandReadout(env)
        self._size = require_motor(clone.senses.spec, env)
        self._read = StreamReader(clone.senses.spec, env)

    def predict(
        self,
        observation: Any,
        state: CloneState | None = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = False,
    ) -> tuple[NDArray[np.float32], CloneState]:
        """The action (A,), and the state to pass in next time."""
        if state is None or (episode_start is not None and np.any(episode_start)):
            state = CloneState(None, np.zeros(self._size, np.float32), None)
        clone = self._clone
        m = situation(clone.senses, self._read(observation, state.action)[None])
        said, hidden = clone.module(torch.from_numpy(m)[None], state.hidden)
        action, grip = self._readout(clone.mean + clone.spread * said[0, 0].numpy(), state.grip)
        return action, CloneState(hidden, action, grip)
