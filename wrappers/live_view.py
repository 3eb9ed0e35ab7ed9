"""A watched environment, written to a recording for Rerun's viewer as it runs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol, SupportsFloat, runtime_checkable

import gymnasium as gym
import numpy as np
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import NDArray

from asm_gym.evaluation.rerun_view import LiveView
from asm_gym.spec import control_period
from asm_gym.stream_source import StreamSource
from asm_gym.wrappers.safety import NeuralASMSafety


@runtime_checkable
class Simulated(Protocol):
    """An environment of this package, whose robots' links can be looked up."""

    simulation: Any
    robosuite_env: Any


def links_of(env: Simulated) -> NDArray[np.float64]:
    """(n, 2, 3) where each body of the robots is, and its parent [m]."""
    from asm_gym.envs.robots import bodies

    model, data = env.simulation.model, env.simulation.data
    ids = np.concatenate([bodies(model, robot) for robot in env.robosuite_env.robots])
    ids = ids[model.body_parentid[ids] > 0]  # what stands on the ground has no link to it
    both: NDArray[np.float64] = np.stack([data.xpos[model.body_parentid[ids]], data.xpos[ids]], axis=1)
    return both


class RerunView(gym.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Writes every step to a ``.rrd`` file: senses, expectations, surprise, threshold, cause, robot, and pictures.

    Args:
        env: ``NeuralASMSafety`` around an environment; with ``render_mode="rgb_array"`` its pictures are kept too.
        path: of the file. ``close`` completes it.
        channels: names of those that are drawn; all by default.

    Raises:
        TypeError: ``env`` is not ``NeuralASMSafety``.
        ImportError: rerun-sdk is not installed.
    """

    def __init__(self, env: gym.Env[Any, Any], path: str | Path, channels: Sequence[str] | None = None) -> None:
        RecordConstructorArgs.__init__(self, path=path, channels=channels)
        gym.Wrapper.__init__(self, env)
        if not isinstance(env, NeuralASMSafety):
            raise TypeError(f"RerunView goes directly around NeuralASMSafety, got {env}")
        self._source = StreamSource(env.env)
        model = getattr(env.monitor, "model", None)
        self.view = LiveView(path, self._source.spec, model, channels)
        self._dt, self._seconds = control_period(env), 0.0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        self.view.begin()
        return self.env.reset(seed=seed, options=options)

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        asm = info["asm"]
        self._seconds += self._dt
        picture: Any = self.env.render() if self.env.render_mode == "rgb_array" else None
        shares = np.array(list(asm["attribution"].values()))
        row = self._source.row(observation, asm["executed_action"], info)
        inner: Any = self.unwrapped
        links = links_of(inner) if isinstance(inner, Simulated) else None
        self.view.row(self._seconds, row, asm["surprise"], asm["threshold"], shares, asm.get("cause"), picture, links)
        return observation, reward, terminated, truncated, info

    def close(self) -> None:
        self.view.close()
        super().close()
