"""Faults in any environment with Box spaces: where they act on it, and each kind at three severities.

A sensor is wrong by so many σ: its declared noise, or else its spread in a nominal episode.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple, SupportsFloat

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import NDArray

from asm_gym.faults import action, sensor
from asm_gym.faults.base import Fault, Interface
from asm_gym.faults.suite import SEVERITIES
from asm_gym.spec import MOTOR, StreamSpec, flat
from asm_gym.stream_source import StreamSource
from asm_gym.validation import as_float32, check_choice


class FaultyInterface(gym.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """The ``Interface`` of an environment that is not robosuite's, with Box actions and observations in Boxes.

    The readings are the observation, and ``info["stream"]`` where the environment has one, whose sensors must then be
    the numbers of the observation. An action that a fault has changed is clipped to its space.
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        RecordConstructorArgs.__init__(self)
        gym.Wrapper.__init__(self, env)
        if not isinstance(env.action_space, spaces.Box) or not _boxes(env.observation_space):
            raise TypeError(
                f"faults need Box spaces of actions and observations, got {env.action_space} and "
                f"{env.observation_space}"
            )
        self._source = StreamSource(env)
        spec = self._source.spec
        self.measured_spec = StreamSpec(
            tuple(c for c in spec.channels if c.group != MOTOR), spec.dt, spec.source
        )
        self.corruptions: list[Callable[[NDArray[np.float64]], None]] = []
        self.deliveries: list[Callable[[NDArray[np.float32]], NDArray[np.float32]]] = []
        self.measured = np.zeros(self.measured_spec.size)
        self.gripper_actions: tuple[int, ...] = ()
        self.horizon = getattr(env.spec, "max_episode_steps", None)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        observation, info = self.env.reset(seed=seed, options=options)
        if self._source.own:
            sensed = np.asarray(info["stream"])[self._source.spec.sensory]
            if not np.allclose(sensed, flat(self.observation_space, observation), equal_nan=True):
                raise ValueError(
                    "this environment's stream does not hold its observation: a fault cannot be in both"
                )
        return self._sensed(observation, info), info

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        box: Any = self.action_space
        delivered = action
        for deliver in self.deliveries:
            changed = deliver(np.ravel(as_float32(delivered))).reshape(box.shape)
            delivered = np.clip(changed, box.low, box.high)
        observation, reward, terminated, truncated, info = self.env.step(delivered)
        if self._source.own and self.deliveries:
            info["stream"] = np.array(info["stream"])
            info["stream"][self._source.spec.motor] = np.ravel(action)  # as commanded
        return self._sensed(observation, info), reward, terminated, truncated, info

    def _sensed(self, observation: Any, info: dict[str, Any]) -> Any:
        """Return the observation with its faults, and put them into ``info``'s stream."""
        row = flat(self.observation_space, observation).astype(np.float64)
        for corrupt in self.corruptions:
            corrupt(row)
        self.measured = row
        if not self.corruptions:
            return observation
        if self._source.own:
            info["stream"] = np.array(info["stream"])
            info["stream"][self._source.spec.sensory] = row
        return spaces.unflatten(self.observation_space, row)


def _boxes(space: gym.Space[Any]) -> bool:
    parts = space.values() if isinstance(space, spaces.Dict) else ()
    return all(map(_boxes, parts)) if parts else isinstance(space, spaces.Box)


class Target(NamedTuple):
    """What is drawn for an episode: the sensor and the action axis that a fault acts on."""

    channel: str
    element: int
    sigma: float  # of that sensor
    axis: int  # of the action
    half: float  # of that axis's range
    everything: tuple[str, ...]  # channels

    @property
    def sensor(self) -> dict[str, Any]:
        return {"channel": self.channel, "element": self.element}


Kind = Callable[[Target, int], tuple[Fault, ...]]


def _all(d: Target, kind: type[sensor.SensorFault], **how: Any) -> tuple[Fault, ...]:
    """Return the same fault of every channel."""
    return tuple(kind(channel=name, element=None, **how) for name in d.everything)


KINDS: dict[str, Kind] = {
    "frozen_sense": lambda d, s: (sensor.Freeze(**d.sensor, duration=(5, 15, None)[s]),),
    "sense_offset": lambda d, s: (sensor.Bias(**d.sensor, amount=(1, 3, 10)[s] * d.sigma),),
    "sense_drift": lambda d, s: (sensor.Drift(**d.sensor, rate=(0.05, 0.2, 0.8)[s] * d.sigma),),
    "sense_noise": lambda d, s: (sensor.Noise(**d.sensor, std=(0.3, 1, 3)[s] * d.sigma),),
    "sense_scale": lambda d, s: (sensor.Scale(**d.sensor, factor=(1.05, 1.15, 1.5)[s]),),
    "sense_dropout": lambda d, s: (sensor.Dropout(**d.sensor, probability=(0.05, 0.2, 0.5)[s]),),
    "sense_delay": lambda d, s: (sensor.Delay(**d.sensor, steps=(1, 3, 6)[s]),),
    "late_rows": lambda d, s: _all(d, sensor.Delay, steps=(1, 3, 6)[s]),
    "lost_rows": lambda d, s: _all(d, sensor.Freeze, duration=(1, 5, 15)[s]),
    "action_scale": lambda d, s: (action.ActionScale(factor=(0.9, 0.75, 0.5)[s]),),
    "action_delay": lambda d, s: (action.ActionDelay(steps=(1, 3, 6)[s]),),
    "action_drop": lambda d, s: (action.ActionDrop(probability=(0.1, 0.3, 0.7)[s]),),
    "action_repeat": lambda d, s: (action.ActionRepeat(steps=(2, 4, 8)[s]),),
    "action_bias": lambda d, s: (
        action.ActionBias(axis=d.axis, amount=(0.05, 0.15, 0.4)[s] * min(d.half, 5.0)),
    ),
    "sign_flip": lambda d, s: (action.SignFlip(axis=d.axis, duration=(3, 10, None)[s]),),
}
"""Faults of each kind for an episode, at severity 0 to 2. Lost rows: every sensor keeps its last value meanwhile."""


def sigmas(env: Interface, streams: list[NDArray[np.float32]]) -> NDArray[np.float64]:
    """Return (X,) σ of each sensor: its noise, or its spread in the nominal stream (T, X) where it moves least.

    A sensor that stays as it is has 0.
    """
    spread = np.min([np.std(stream, axis=0, dtype=np.float64) for stream in streams], axis=0)
    noise = env.measured_spec.noise
    return np.where(spread > 0, np.where(noise > 0, noise, spread), 0.0)


def faults_anywhere(
    kind: str, env: Interface, sigma: NDArray[np.float64], severity: str, onset: int, seed: int
) -> tuple[Fault, ...]:
    """Return the faults of one kind and severity for the episode with this seed, by ``sigmas`` (X,) of the sensors."""
    check_choice("kind of fault", kind, KINDS)
    check_choice("severity", severity, SEVERITIES)
    moving = np.flatnonzero(sigma > 0)
    if not len(moving):
        raise ValueError(
            "no sensor reading of this environment changes, so no sensor can be faulty"
        )
    rng = np.random.default_rng([seed, 2])
    spec, struck = env.measured_spec, int(rng.choice(moving))
    name, place = next(
        (n, span) for n, span in spec.slices.items() if span.start <= struck < span.stop
    )
    # (A,)
    halves = np.ravel(0.5 * (env.action_space.high - env.action_space.low)).astype(np.float64)
    axis = int(rng.integers(len(halves)))
    element, spread, half = struck - place.start, float(sigma[struck]), float(halves[axis])
    drawn = Target(name, element, spread, axis, half, tuple(spec.slices))
    return tuple(
        replace(fault, onset=onset, seed=seed)
        for fault in KINDS[kind](drawn, SEVERITIES.index(severity))
    )
