"""Scriptable stand-ins: an environment that plays back a stream, and a monitor that is surprised on cue."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple, Self

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from asm_gym.data.episode import Episode
from asm_gym.monitors import Surprise
from asm_gym.spec import MOTOR, Channel, StreamSpec

SPEC = StreamSpec((Channel("position", 2, "m"), Channel("action", 3, group=MOTOR)), dt=0.05)


class FakeEnv(gym.Env[NDArray[np.float32], NDArray[np.float32]]):
    """Runs for ``length`` steps; in step t it senses ``first`` + t, and it keeps every action it was given."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012
    dt = 0.05

    def __init__(self, length: int = 20, own_stream: bool = True, first: int = 0) -> None:
        self.observation_space = spaces.Box(-100.0, 100.0, (2,), np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (3,), np.float32)
        self.gripper_actions = (2,)
        self.action_means = "delta"
        self.length, self.actions = length, []  # type: tuple[int, list[NDArray[np.float32]]]
        self.first = first
        self.render_mode = "rgb_array"
        if own_stream:
            self.stream_spec = SPEC

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.t = 0
        self.actions = []
        return self._out(np.zeros(3, np.float32))

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.t += 1
        self.actions.append(np.array(action))
        observation, info = self._out(action)
        return observation, 1.0, False, self.t >= self.length, info

    def _out(self, action: Any) -> tuple[NDArray[np.float32], dict[str, Any]]:
        sensed = np.full(2, self.first + self.t, np.float32)
        info: dict[str, Any] = {"success": False}
        if hasattr(self, "stream_spec"):
            info["stream"] = np.concatenate([sensed, action]).astype(np.float32)
        return sensed, info

    def render(self) -> NDArray[np.uint8]:
        return np.zeros((64, 64, 3), np.uint8)


class CueMonitor:
    """Surprised (value 10, threshold 1) in the steps of ``cue``; keeps every row it was shown."""

    def __init__(
        self, cue: Sequence[int] = (), spec: StreamSpec = SPEC, threshold: float | None = 1.0
    ) -> None:
        self.spec, self.cue, self._threshold = spec, frozenset(cue), threshold
        self.rows: list[NDArray[np.float32]] = []

    @property
    def threshold(self) -> float:
        if self._threshold is None:
            raise RuntimeError("not calibrated: call calibrate()")
        return self._threshold

    def fit(self, episodes: Sequence[Episode]) -> Self:
        return self

    def calibrate(self, episodes: Sequence[Episode], false_alarm_rate: float = 0.01) -> Self:
        return self

    def initial_state(self, batch: int = 1) -> int:
        return 0

    def observe(self, state: int, stream: NDArray[Any]) -> tuple[int, Surprise]:
        self.spec.check_row(stream)
        self.rows.append(stream[0])
        attribution = np.zeros((1, self.spec.size))
        attribution[0, 0] = 10.0 if state in self.cue else 0.5
        return state + 1, Surprise(attribution.sum(axis=1), attribution)

    def save(self, path: str | Path) -> None:
        raise NotImplementedError


class Remembered(NamedTuple):
    """A state with rows, as those of the real monitors are."""

    evidence: NDArray[np.float64]  # (B,)
    steps: NDArray[np.int64]  # (B,)


class FadingMonitor(CueMonitor):
    """Watches many streams: what it senses of ``cue`` surprises it by 2 (threshold 1), which fades by a third a step.

    It grows bored as well, so that a state which outlives its episode shows.
    """

    def initial_state(self, batch: int = 1) -> Remembered:
        return Remembered(np.zeros(batch), np.zeros(batch, np.int64))

    def observe(self, state: Remembered, stream: NDArray[Any]) -> tuple[Remembered, Surprise]:
        self.spec.check_row(stream)
        evidence = (
            state.evidence * 2 / 3
            + 2.0 * np.isin(stream[:, 0], list(self.cue))
            + 0.001 * state.steps
        )
        attribution = np.zeros((len(stream), self.spec.size))
        attribution[:, 0] = evidence
        return Remembered(evidence, state.steps + 1), Surprise(evidence, attribution)

    def reset_evidence(self, state: Remembered) -> Remembered:
        return state._replace(evidence=0.5 * state.evidence)
