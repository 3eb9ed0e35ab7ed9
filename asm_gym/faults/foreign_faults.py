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
from asm_gym.faults.fault import Fault, Interface, graded
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
        sensed = tuple(c for c in spec.channels if c.group != MOTOR)
        self.measured_spec = StreamSpec(sensed, spec.dt, spec.source)
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
            observed = flat(self.observation_space, observation)
            if not np.allclose(sensed, observed, equal_nan=True):
                raise ValueError(
                    "this environment's stream does not hold its observation: "
                    "a fault cannot be in both"
                )
        return self._sensed(observation, info), info

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        box: Any = self.action_space
        delivered = action
        for deliver in self.deliveries:
            commanded = np.ravel(as_float32(delivered))
            changed = deliver(commanded).reshape(box.shape)
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
    if isinstance(space, spaces.Dict) and space.spaces:
        return all(map(_boxes, space.values()))
    return isinstance(space, spaces.Box)


class Target(NamedTuple):
    """What is drawn for an episode: the sensor and the action axis that a fault acts on."""

    channel: str
    element: int | None  # None for the whole channel
    sigma: float  # of that sensor
    axis: int  # of the action
    reach: float  # half of that axis's range, at most ``FARTHEST_REACH``


FARTHEST_REACH = 5.0  # [action units]

_ON_SENSOR = {"channel": "channel", "element": "element"}
_ON_AXIS = {"axis": "axis"}

KINDS: dict[str, Callable[[Target, int], Fault]] = {
    "frozen_sense": graded(sensor.Freeze, _ON_SENSOR, duration=(5, 15, None)),
    "sense_offset": graded(sensor.Bias, _ON_SENSOR, unit="sigma", amount=(1, 3, 10)),
    "sense_drift": graded(sensor.Drift, _ON_SENSOR, unit="sigma", rate=(0.05, 0.2, 0.8)),
    "sense_noise": graded(sensor.Noise, _ON_SENSOR, unit="sigma", std=(0.3, 1, 3)),
    "sense_scale": graded(sensor.Scale, _ON_SENSOR, factor=(1.05, 1.15, 1.5)),
    "sense_dropout": graded(sensor.Dropout, _ON_SENSOR, probability=(0.05, 0.2, 0.5)),
    "sense_delay": graded(sensor.Delay, _ON_SENSOR, steps=(1, 3, 6)),
    "late_rows": graded(sensor.Delay, _ON_SENSOR, steps=(1, 3, 6)),
    "lost_rows": graded(sensor.Freeze, _ON_SENSOR, duration=(1, 5, 15)),
    "action_scale": graded(action.ActionScale, factor=(0.9, 0.75, 0.5)),
    "action_delay": graded(action.ActionDelay, steps=(1, 3, 6)),
    "action_drop": graded(action.ActionDrop, probability=(0.1, 0.3, 0.7)),
    "action_repeat": graded(action.ActionRepeat, steps=(2, 4, 8)),
    "action_bias": graded(action.ActionBias, _ON_AXIS, unit="reach", amount=(0.05, 0.15, 0.4)),
    "sign_flip": graded(action.SignFlip, _ON_AXIS, duration=(3, 10, None)),
}
"""The fault of each kind for an episode, at severity 0 to 2."""

# Of these kinds, every channel has the fault: lost rows keep the last value of every sensor.
_OF_EVERY_CHANNEL = ("late_rows", "lost_rows")


def sigmas(env: Interface, streams: list[NDArray[np.float32]]) -> NDArray[np.float64]:
    """Return (X,) σ of each sensor: its noise, or its spread in the nominal stream (T, X) where it moves least.

    A sensor that stays as it is has 0.
    """
    spread = np.min([np.std(stream, axis=0, dtype=np.float64) for stream in streams], axis=0)
    noise = env.measured_spec.noise
    sigma = np.where(noise > 0, noise, spread)
    return np.where(spread > 0, sigma, 0.0)


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
    target = _drawn(env, sigma, int(rng.choice(moving)), rng)
    targets = [target]
    if kind in _OF_EVERY_CHANNEL:
        channels = env.measured_spec.slices
        targets = [target._replace(channel=name, element=None) for name in channels]
    level = SEVERITIES.index(severity)
    faults = [KINDS[kind](each, level) for each in targets]
    return tuple(replace(fault, onset=onset, seed=seed) for fault in faults)


def _drawn(
    env: Interface, sigma: NDArray[np.float64], number: int, rng: np.random.Generator
) -> Target:
    """Return the target that holds one number of the measured row; its axis of the action is drawn."""
    ranges = env.action_space.high - env.action_space.low
    halves = np.ravel(0.5 * ranges)  # (A,)
    axis = int(rng.integers(len(halves)))
    slices = env.measured_spec.slices
    channel = next(name for name, span in slices.items() if number < span.stop)
    return Target(
        channel=channel,
        element=number - slices[channel].start,
        sigma=float(sigma[number]),
        axis=axis,
        reach=min(float(halves[axis]), FARTHEST_REACH),
    )
