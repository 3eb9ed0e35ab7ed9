"""Hands the policy what a faulty sense should say: completed from all others, the command and the past."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, SupportsFloat

import gymnasium as gym
import numpy as np
from gymnasium.utils import RecordConstructorArgs

from asm_gym.guard.checks import check_monitor, diagnosis_of
from asm_gym.guard.engine import Engine
from asm_gym.guard.options import TRUST_S, GuardOptions
from asm_gym.monitors import Monitor
from asm_gym.stream_source import StreamSource
from asm_gym.validation import as_float32, short_repr, typed
from asm_gym.wrappers.robots import robots_of


class CompletedObservation(gym.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Hands on the observation and the stream with the numbers that a sense at fault should say.

    Where the monitor alarms and names a sensor as the cause, that sensor is not believed until it has said what was
    expected for a second; numbers that are not finite are never believed. ``info["completed"]`` names the sensors that
    are completed, and ``info["completion_trusted"]`` is False from the moment on that a sense which no other sense
    tells of has been missing for longer than ``trust_s``. It completes, and does nothing else: ``NeuralASMSafety`` with
    ``on_alarm="graded"`` does the same, and acts on all other causes.

    Args:
        env: one of this package's, or any whose observation and action are Boxes.
        monitor: a fitted and calibrated memory.
        sensors: names of sensors that are not believed from the first row on, such as ``encoder[3]``.
        trust_s: how long a sense that no other sense tells of is completed, by its last good value [s].

    Raises:
        ValueError: the monitor knows no completion, watches another stream, or it is not known where the stream stands
            in the observation; an unknown sensor (the message lists those that exist).
    """

    @typed
    def __init__(
        self, env: gym.Env[Any, Any], monitor: Monitor, sensors: Sequence[str] = (), trust_s: float = TRUST_S
    ) -> None:
        RecordConstructorArgs.__init__(self, _disable_deepcopy=True, monitor=monitor, sensors=sensors, trust_s=trust_s)
        gym.Wrapper.__init__(self, env)
        self._source = StreamSource(env)
        if self._source.rows_per_step > 1:
            raise ValueError("a stream is completed at its control rate: make the environment without stream_freq")
        check_monitor(monitor, self._source.spec)
        diagnosis = diagnosis_of(monitor)
        if diagnosis is None:
            raise ValueError(f"{short_repr(monitor)} knows no completion: fit it anew")
        known = dict(diagnosis.completion.sensors)
        for name in sensors:
            if name not in known:
                raise ValueError(f"unknown sensor {short_repr(name)}; known: {', '.join(known)}")
        self._never = np.concatenate([np.zeros(0, np.intp), *(known[name] for name in sensors)]).astype(np.intp)
        robots, places = robots_of(env, monitor.spec)
        if places is None:
            raise ValueError(robots.refused["complete"])
        self._places, options = places, GuardOptions("monitor", completes=True, trust_s=trust_s, contact_limits=None)
        self._engine = Engine(robots, monitor, options, never=self._never)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        observation, info = self.env.reset(seed=seed, options=options)
        self._engine.begin()
        self._engine.read(as_float32(self._source.first(observation, info))[None])
        return self._completed(observation, info)

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        row = as_float32(self._source.row(observation, action, info))
        self._engine.judge(row[None], as_float32(action).reshape(1, -1))
        observation, info = self._completed(observation, info)
        return observation, reward, terminated, truncated, info

    def _completed(self, observation: Any, info: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
        """Return observation and info with what the last row should say."""
        repaired = self._engine.repaired
        if repaired:
            row, missing = repaired[0]
            observation = self._places.repaired(observation, row, missing)
            if "stream" in info:
                info["stream"] = row.copy()
        info["completed"] = self._engine.completed.get(0, ())
        info["completion_trusted"] = bool(self._engine.trusted[0])
        return observation, info
