"""The contract of a fault: a frozen description, and a context that applies and undoes it."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, fields
from typing import Any, ClassVar

import mujoco
import numpy as np
from numpy.typing import NDArray

from asm_gym.envs.robosuite_env import RobosuiteEnv

SHAPES = ("constant", "pulse", "ramp", "periodic", "random_walk")

Apply = Callable[[float], None]
"""Gives a fault an intensity in [0, 1] for the next control step."""


@dataclass(frozen=True, kw_only=True)
class Fault(ABC):
    """Something that goes wrong for a while.

    Args:
        onset: the first control step it acts in; step 0 is the first one after reset.
        duration: how many control steps it lasts; to the end of the episode where None.
        shape: how its intensity goes with time: ``constant``; ``pulse``, up and down again over the duration; ``ramp``,
            up over the duration, or over ``period`` where it has none; ``periodic``, up and down every ``period``;
            ``random_walk`` between 0 and 1.
        period: [control steps].
        seed: of whatever the fault draws. It draws nothing from the environment's own generator, so that an episode
            with it and one without have the same sensor noise.
    """

    onset: int = 40
    duration: int | None = None
    shape: str = "constant"
    period: int = 20
    seed: int = 0

    graded: ClassVar[bool] = True
    """Whether there is a little of it; what is all or nothing takes the shape ``constant`` alone."""
    harmless: ClassVar[bool] = False
    """A variation that should raise no alarm."""

    def __post_init__(self) -> None:
        for name in ("onset", "duration", "joint", "period", "steps", "axis", "seed"):
            value = getattr(self, name, None)
            if value is not None and (isinstance(value, bool) or not isinstance(value, int | np.integer)):
                raise ValueError(f"{name} must be a whole number, got {value!r}")
        if self.onset < 0:
            raise ValueError(f"onset must be >= 0, got {self.onset}")
        for name in ("duration", "period", "steps"):
            value = getattr(self, name, None)
            if value is not None and value < 1:
                raise ValueError(f"{name} must be at least 1, got {value}")
        for field in fields(self):
            value = getattr(self, field.name)
            if field.type == "float" and not (isinstance(value, int | float | np.number) and math.isfinite(value)):
                raise ValueError(f"{field.name} must be a finite number, got {value!r}")
        if self.shape not in SHAPES:
            raise ValueError(f"unknown shape {self.shape!r}; known: {', '.join(SHAPES)}")
        if self.shape != "constant" and not self.graded:
            raise ValueError(f"{self.name} is all or nothing: its shape must be 'constant', got {self.shape!r}")
        if self.shape == "pulse" and self.duration is None:
            raise ValueError("a pulse needs a duration")

    @property
    def name(self) -> str:
        return type(self).__name__

    def active(self, step: int) -> bool:
        return self.onset <= step and (self.duration is None or step < self.onset + self.duration)

    def intensity(self, k: int) -> float:
        """In [0, 1], at the k-th control step since the onset."""
        if self.shape == "pulse":
            return math.sin(math.pi * (k + 0.5) / (self.duration or 1)) ** 2
        if self.shape == "ramp":
            return min(1.0, (k + 1) / (self.duration or self.period))
        if self.shape == "periodic":
            return 0.5 * (1.0 - math.cos(2 * math.pi * (k + 1) / self.period))
        if self.shape == "random_walk":
            walk = 0.5 + np.cumsum(self.rng(0).normal(0.0, 0.15, k + 1))[k]
            return float(1.0 - abs((walk % 2.0) - 1.0))  # thrown back at 0 and at 1
        return 1.0

    def rng(self, purpose: int = 1) -> np.random.Generator:
        """A generator of the fault's own."""
        return np.random.default_rng([self.seed, purpose])

    @abstractmethod
    def check(self, env: RobosuiteEnv) -> None:
        """Raises ValueError, listing what exists, where the environment has nothing this fault could act on."""

    @abstractmethod
    def applied(self, env: RobosuiteEnv) -> AbstractContextManager[Apply]:
        """Applies the fault; leaving the context undoes everything, exactly."""

    @abstractmethod
    def labels(self, env: RobosuiteEnv) -> frozenset[str]:
        """Elements of the stream in which an attentive observer would see this fault first."""

    def holds(self, env: RobosuiteEnv) -> frozenset[str]:
        """What it sets to a value of its own, so that no other fault can: two of the same are a contradiction."""
        return frozenset()

    def inject(self, env: RobosuiteEnv) -> Generator[None, None, None]:
        """Runs on to its next ``yield`` before every control step in which the fault acts; closing it undoes it."""
        with self.applied(env) as apply:
            k = 0
            while True:
                apply(self.intensity(k))
                yield
                k += 1


def model_of(env: RobosuiteEnv) -> mujoco.MjModel:
    return env.simulation.model


def data_of(env: RobosuiteEnv) -> mujoco.MjData:
    return env.simulation.data


@contextmanager
def held(env: RobosuiteEnv, array: NDArray[Any], *indices: Any) -> Iterator[Callable[[Callable[[Any], Any]], None]]:
    """Entries of an array that are changed alike; yields the function that says how."""
    holds = [env.edits.hold(array, index) for index in indices]

    def change(rule: Callable[[Any], Any]) -> None:
        for hold in holds:
            hold.change(rule)

    try:
        yield change
    finally:
        for hold in holds:
            hold.release()


@contextmanager
def listed(items: list[Any], item: Any) -> Iterator[None]:
    """``item`` stands in the list while the block runs."""
    items.append(item)
    try:
        yield
    finally:
        # By identity: two faults of one description have functions of their own.
        del items[next(i for i, other in enumerate(items) if other is item)]


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
    """Raises ValueError unless the arms have a joint with this index, counted through both where there are two."""
    count = len(env.motors)
    if not 0 <= joint < count:
        raise ValueError(f"joint must be 0 to {count - 1} for {env.measured_spec.source}, got {joint}")


def joint_labels(env: RobosuiteEnv, joint: int, *names: str) -> frozenset[str]:
    """The elements of the channels called ``names`` that belong to a joint, counted through both arms."""
    prefixes = [c.name.removesuffix("joint_position") for c in env.measured_spec.channels if "joint_position" in c.name]
    sizes = [c.size for c in env.measured_spec.channels if "joint_position" in c.name]
    for prefix, size in zip(prefixes, sizes, strict=True):
        if joint < size:
            return frozenset(f"{prefix}{name}[{joint}]" for name in names)
        joint -= size
    return frozenset()


def group_labels(env: RobosuiteEnv, *groups: str) -> frozenset[str]:
    """Every element of these channel groups."""
    return frozenset(label for c in env.measured_spec.channels if c.group in groups for label in c.labels)
