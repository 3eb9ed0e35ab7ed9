"""Variations that are no faults: a monitor that alarms at these cries wolf.

Other seeds, and the same task done slower or faster, are the caller's to make: they are other episodes.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.envs.robosuite_env import RobosuiteEnv
from asm_gym.faults.base import Apply, Fault, listed, model_of, within
from asm_gym.faults.body import Push
from asm_gym.faults.object import ObjectFault


@dataclass(frozen=True, kw_only=True)
class Touch(Push):
    """Somebody touches the arm.

    Args:
        body: where.
        newtons: how hard; 2 N is the most that is harmless.
        direction: in the world's axes; its length does not matter.
    """

    harmless = True

    newtons: float = 1.5

    def __post_init__(self) -> None:
        super().__post_init__()
        if abs(self.newtons) > 2.0:
            raise ValueError(f"a touch has at most 2 N, got {self.newtons}: that is a Push")


@dataclass(frozen=True, kw_only=True)
class ObjectMass(ObjectFault):
    """The object's mass differs from the usual.

    Args:
        object: its name; the first of the task where empty.
        factor: what its mass is multiplied by.
    """

    harmless = True

    factor: float = within(1.1, above=0, high=100)

    @contextmanager
    def applied(self, env: RobosuiteEnv) -> Iterator[Apply]:
        with env.edits.edit(model_of(env).body_mass, self.body_of(env)) as change:
            yield lambda i: change(lambda mass: mass * (1.0 + i * (self.factor - 1.0)))


@dataclass(frozen=True, kw_only=True)
class ObjectFriction(ObjectFault):
    """The object's friction differs from the usual.

    Args:
        object: its name; the first of the task where empty.
        factor: what its friction is multiplied by.
    """

    harmless = True

    factor: float = within(0.9, low=0, high=100)

    @contextmanager
    def applied(self, env: RobosuiteEnv) -> Iterator[Apply]:
        entries = [(g, slice(0, 1)) for g in self.geoms_of(env)]
        with env.edits.edit(model_of(env).geom_friction, *entries) as change:
            yield lambda i: change(lambda mu: mu * (1.0 + i * (self.factor - 1.0)))


@dataclass(frozen=True, kw_only=True)
class _Anywhere(Fault):
    """One that every environment can have."""

    harmless = True

    def check(self, env: RobosuiteEnv) -> None:
        pass

    def labels(self, env: RobosuiteEnv) -> frozenset[str]:
        return frozenset()


@dataclass(frozen=True, kw_only=True)
class NoisySensors(_Anywhere):
    """All sensors are noisier than usual.

    Args:
        factor: what the standard deviation of their noise is multiplied by.
    """

    factor: float = within(2.0, low=1, high=1e3)

    @contextmanager
    def applied(self, env: RobosuiteEnv) -> Iterator[Apply]:
        share, k = 0.0, -1
        usual = env.measured_spec.noise * env.sensor_noise

        def add(row: NDArray[Any]) -> None:
            extra = np.sqrt((1.0 + share * (self.factor - 1.0)) ** 2 - 1.0)
            row += extra * usual * self.rng(2 + k).standard_normal(len(row))

        def apply(intensity: float) -> None:
            nonlocal share, k
            share, k = intensity, k + 1

        with listed(env.corruptions, add):
            yield apply


@dataclass(frozen=True, kw_only=True)
class Lighting(_Anywhere):
    """The lamps are brighter or darker.

    Args:
        factor: what their light is multiplied by.
    """

    factor: float = within(0.7, low=0, high=100)

    @contextmanager
    def applied(self, env: RobosuiteEnv) -> Iterator[Apply]:
        light = model_of(env).light_diffuse
        with env.edits.edit(light, *range(len(light))) as change:
            yield lambda i: change(lambda colour: colour * (1.0 + i * (self.factor - 1.0)))


@dataclass(frozen=True, kw_only=True)
class CameraShift(_Anywhere):
    """The cameras have been knocked a little.

    Args:
        metres: how far, in a direction drawn from the seed [m].
    """

    metres: float = within(0.01, low=-10, high=10)

    @contextmanager
    def applied(self, env: RobosuiteEnv) -> Iterator[Apply]:
        cameras = model_of(env).cam_pos
        direction = self.rng().standard_normal(3)
        shift = self.metres * direction / np.linalg.norm(direction)
        with env.edits.edit(cameras, *range(len(cameras))) as change:
            yield lambda i: change(lambda position: position + i * shift)
