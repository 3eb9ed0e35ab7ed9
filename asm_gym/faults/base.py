"""The contract of a fault: a frozen description, and a generator that applies and undoes it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from asm_gym.envs.robosuite_env import RobosuiteEnv


@dataclass(frozen=True, kw_only=True)
class Fault(ABC):
    """Something that goes wrong for a while.

    Args:
        onset: the first control step it acts in; step 0 is the first one after reset.
        duration: how many control steps it lasts; to the end of the episode where None.
    """

    onset: int = 40
    duration: int | None = None

    def __post_init__(self) -> None:
        for name in ("onset", "duration", "joint"):
            value = getattr(self, name, None)
            if value is not None and (isinstance(value, bool) or not isinstance(value, int | np.integer)):
                raise ValueError(f"{name} must be a whole number, got {value!r}")
        if self.onset < 0:
            raise ValueError(f"onset must be >= 0, got {self.onset}")
        if self.duration is not None and self.duration < 1:
            raise ValueError(f"duration must be at least 1, got {self.duration}")

    @property
    def name(self) -> str:
        return type(self).__name__

    def active(self, step: int) -> bool:
        return self.onset <= step and (self.duration is None or step < self.onset + self.duration)

    @abstractmethod
    def check(self, env: RobosuiteEnv) -> None:
        """Raises ValueError, listing what exists, where the environment has nothing this fault could act on."""

    @abstractmethod
    def inject(self, env: RobosuiteEnv) -> Generator[None, None, None]:
        """A generator: runs on to its next ``yield`` before every control step in which the fault acts.

        Closing it must undo everything, exactly: put that in a ``finally``.
        """

    @abstractmethod
    def labels(self, env: RobosuiteEnv) -> frozenset[str]:
        """Elements of the stream in which an attentive observer would see this fault first."""


def model_of(env: RobosuiteEnv) -> mujoco.MjModel:
    return env.robosuite_env.sim.model._model


def data_of(env: RobosuiteEnv) -> mujoco.MjData:
    return env.robosuite_env.sim.data._data


def body_id(env: RobosuiteEnv, name: str) -> int:
    """The body called ``name``.

    Raises:
        ValueError: there is none; the message lists those that exist.
    """
    model = model_of(env)
    found: int = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name)
    if found < 0:
        names = [mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_BODY, i) for i in range(1, model.nbody)]
        raise ValueError(f"unknown body {name!r}; known bodies: {', '.join(names)}")
    return found


def check_joint(env: RobosuiteEnv, joint: int) -> None:
    """Raises ValueError unless the arm has a joint with this index."""
    count = env.measured_spec.slices["joint_position"]
    if not 0 <= joint < count.stop - count.start:
        raise ValueError(
            f"joint must be 0 to {count.stop - count.start - 1} for {env.measured_spec.source}, got {joint}"
        )


@contextmanager
def edited(array: NDArray[Any], index: Any, value: Any) -> Iterator[None]:
    """Holds ``array[index]`` at ``value``, and puts back what stood there before."""
    before = np.copy(array[index])
    array[index] = value
    try:
        yield
    finally:
        array[index] = before
