"""The contract of a fault: a frozen description, and a context that applies and undoes it."""

from __future__ import annotations

import math
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import Field, dataclass, field, fields
from functools import partial
from typing import Any, ClassVar, Protocol, cast, dataclass_transform

import gymnasium as gym
import mujoco
import numpy as np
from numpy.typing import NDArray

from asm_gym.envs.robosuite_env import RobosuiteEnv
from asm_gym.spec import StreamSpec
from asm_gym.validation import check_choice, check_number, check_numbers, check_text, short_repr

SHAPES = ("constant", "pulse", "ramp", "periodic", "random_walk")

Vector3 = tuple[float, float, float]
"""In the world's axes."""

Floats = NDArray[np.float64]

Apply = Callable[[float], None]
"""Gives a fault an intensity in [0, 1] for the next control step."""

FAULTS: dict[str, type[Fault]] = {}
"""Every fault and harmless variation by its name in lower case; a class of yours is added where it is defined."""

MOST = 1e9
"""No parameter is larger, so that nothing overflows."""

LONGEST = 10_000
"""The longest delay [control steps]."""


class Interface(Protocol):
    """What faults of sensors and actions act on; any environment with Box spaces has one."""

    measured_spec: StreamSpec
    corruptions: list[Callable[[Floats], None]]
    """Each edits the measured row in place."""
    deliveries: list[Callable[[NDArray[np.float32]], NDArray[np.float32]]]
    """Each replaces the commanded action."""

    @property
    def measured(self) -> Floats:
        """The row measured last, laid out as ``measured_spec`` says; a copy."""
        ...

    @property
    def gripper_actions(self) -> tuple[int, ...]:
        """Indices of the action that command grippers."""
        ...

    @property
    def action_space(self) -> gym.Space[Any]: ...


def within(default: Any, *, low: float | None = None, high: float | None = None, above: float | None = None) -> Any:
    """Declare a parameter of a fault, and its bounds."""
    return field(default=default, metadata={"low": low, "high": high, "above": above})


@dataclass_transform(frozen_default=True, kw_only_default=True)
@dataclass(frozen=True, kw_only=True)
class Fault(ABC):
    """Something that goes wrong for a while.

    Args:
        onset: the first control step it acts in; step 0 is the first one after reset.
        duration: how many control steps it lasts; to the end of the episode where None.
        shape: its intensity over time: ``constant``; ``pulse``, up and down again over the duration; ``ramp``, up over
            the duration, or over ``period`` where it has none; ``periodic``, up and down every ``period``;
            ``random_walk`` between 0 and 1.
        period: [control steps].
        seed: of whatever the fault draws. It draws nothing from the environment's own generator, so that an episode
            with it and one without have the same sensor noise.
    """

    onset: int = within(40, low=0)
    duration: int | None = within(None, low=1)
    shape: str = "constant"
    period: int = within(20, low=1)
    seed: int = within(0, low=0, high=2**63)

    graded: ClassVar[bool] = True
    """Whether its intensity can vary; a fault that is all or nothing takes the shape ``constant`` alone."""
    harmless: ClassVar[bool] = False
    """A variation that should raise no alarm."""
    anywhere: ClassVar[bool] = False
    """Whether it needs no more than an ``Interface``."""

    def __init_subclass__(cls, **kwargs: Any) -> None:
        """Make every fault a frozen dataclass, and register those that can be made: ``weak_joint`` is ``WeakJoint``."""
        super().__init_subclass__(**kwargs)
        dataclass(frozen=True, kw_only=True)(cls)
        # The list of abstract methods is not there yet.
        abstract = any(getattr(getattr(cls, n, None), "__isabstractmethod__", False) for n in dir(cls))
        if not abstract and not cls.__name__.startswith("_"):
            FAULTS[re.sub(r"(?<!^)(?=[A-Z])", "_", cls.__name__).lower()] = cls

    def __post_init__(self) -> None:
        for parameter in fields(self):
            _check(parameter, getattr(self, parameter.name))
        check_choice("shape", self.shape, SHAPES)
        if self.shape != "constant" and not self.graded:
            raise ValueError(f"{self.name} is all or nothing: its shape must be 'constant', got {self.shape!r}")
        if self.shape == "pulse" and self.duration is None:
            raise ValueError("a pulse needs a duration")

    @property
    def name(self) -> str:
        return type(self).__name__

    def active(self, step: int) -> bool:
        """Whether the fault acts in a control step."""
        return self.onset <= step and (self.duration is None or step < self.onset + self.duration)

    def intensity(self, k: int) -> float:
        """Return the intensity in [0, 1] at the k-th control step since the onset."""
        if self.shape == "pulse":
            return math.sin(math.pi * (k + 0.5) / (self.duration or 1)) ** 2
        if self.shape == "ramp":
            return min(1.0, (k + 1) / (self.duration or self.period))
        if self.shape == "periodic":
            return 0.5 * (1.0 - math.cos(2 * math.pi * (k + 1) / self.period))
        if self.shape == "random_walk":
            walk = 0.5 + np.cumsum(self.rng(0).normal(0.0, 0.15, k + 1))[k]
            return float(1.0 - abs((walk % 2.0) - 1.0))  # reflected at 0 and at 1
        return 1.0

    def rng(self, purpose: int = 1) -> np.random.Generator:
        """Return a generator of the fault's own."""
        return np.random.default_rng([self.seed, purpose])

    @abstractmethod
    def check(self, env: RobosuiteEnv) -> None:
        """Raise ValueError, listing what exists, where the environment has nothing this fault could act on."""

    @abstractmethod
    def applied(self, env: RobosuiteEnv) -> AbstractContextManager[Apply]:
        """Apply the fault; leaving the context undoes everything, exactly."""

    @abstractmethod
    def labels(self, env: RobosuiteEnv) -> frozenset[str]:
        """Return the stream elements in which this fault shows first."""

    def holds(self, env: RobosuiteEnv) -> frozenset[str]:
        """Return what the fault sets to a value of its own: two faults of the same contradict each other."""
        return frozenset()

    def inject(self, env: RobosuiteEnv) -> Generator[None, None, None]:
        """Run on to the next ``yield`` before every control step in which the fault acts; closing undoes it."""
        with self.applied(env) as apply:
            k = 0
            while True:
                apply(self.intensity(k))
                yield
                k += 1


Edit = tuple[NDArray[Any], list[Any], Callable[[float, Any], Any]]
"""An array of the simulator, the indices that are edited, and their value by intensity and nominal value."""


class EditingFault(Fault):
    """One that edits numbers of the simulator."""

    @abstractmethod
    def edits(self, env: RobosuiteEnv) -> list[Edit]:
        """Return the edits."""

    @contextmanager
    def applied(self, env: RobosuiteEnv) -> Iterator[Apply]:
        with ExitStack() as stack:
            edits = self.edits(env)
            changes = [stack.enter_context(env.edits.edit(array, *indices)) for array, indices, _ in edits]

            def apply(intensity: float) -> None:
                for change, (_, _, rule) in zip(changes, edits, strict=True):
                    change(partial(rule, intensity))

            yield apply


def make_fault(name: str, **parameters: Any) -> Fault:
    """Make the fault called ``name``.

    Raises:
        ValueError: an unknown name or parameter; the message lists what exists.
    """
    check_choice("fault", check_text("fault", name), FAULTS)
    known = [f.name for f in fields(FAULTS[name])]
    for parameter in parameters:
        if parameter not in known:
            raise ValueError(f"fault {name!r} has no parameter {parameter!r}; it has: {', '.join(known)}")
    return FAULTS[name](**parameters)


def _check(parameter: Field[Any], value: object) -> None:
    """Raise ValueError unless a parameter is of its type and within its bounds."""
    low, high, above = (parameter.metadata.get(bound) for bound in ("low", "high", "above"))
    low = -MOST if low is None and above is None else low
    high = MOST if high is None else high
    if value is None and parameter.type == "int | None":
        return
    match parameter.type:
        case "float":
            check_number(parameter.name, value, low=low, high=high, above=above)
        case "int" | "int | None":
            check_number(parameter.name, value, low=low, high=high, whole=True)
        case "Vector3":
            check_numbers(parameter.name, cast(Vector3, value), 3, low=low, high=high)
            if parameter.name == "direction" and not np.linalg.norm(cast(Vector3, value)) > 0:
                raise ValueError(f"direction must not be all zero, got {value}")
        case "str":
            if not isinstance(value, str):
                raise ValueError(f"{parameter.name} must be a name, got {short_repr(value)}")


def along(direction: Vector3) -> Floats:
    """Return a direction (3,) at length 1."""
    way = np.asarray(direction, np.float64)
    unit: Floats = way / float(np.linalg.norm(way))
    return unit


def model_of(env: RobosuiteEnv) -> mujoco.MjModel:
    return env.simulation.model


def data_of(env: RobosuiteEnv) -> mujoco.MjData:
    return env.simulation.data


@contextmanager
def listed(items: list[Any], item: Any) -> Iterator[None]:
    """Keep ``item`` in the list while the block runs."""
    items.append(item)
    try:
        yield
    finally:
        # By identity: two faults of one description have functions of their own.
        del items[next(i for i, other in enumerate(items) if other is item)]


def body_id(env: RobosuiteEnv, name: str) -> int:
    """Return the body called ``name``.

    Raises:
        ValueError: there is none; the message lists those that exist.
    """
    model = model_of(env)
    # By a table of our own: asked for what is no string, MuJoCo ends the process.
    bodies = {mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_BODY, i): i for i in range(1, model.nbody)}
    check_choice("body", check_text("body", name), bodies)
    return bodies[name]


def check_joint(env: RobosuiteEnv, joint: int) -> None:
    """Raise ValueError unless the arms have a joint with this index, counted through both where there are two."""
    count = len(env.motors)
    if not 0 <= joint < count:
        raise ValueError(f"joint must be 0 to {count - 1} for {env.measured_spec.source}, got {joint}")


def joint_labels(env: RobosuiteEnv, joint: int, *names: str) -> frozenset[str]:
    """Return the elements of the channels ``names`` that belong to a joint, counted through both arms."""
    for channel in env.measured_spec.channels:
        if channel.name.endswith("joint_position"):
            if joint < channel.size:
                prefix = channel.name.removesuffix("joint_position")
                return frozenset(f"{prefix}{name}[{joint}]" for name in names)
            joint -= channel.size
    return frozenset()


def group_labels(env: Interface, *groups: str) -> frozenset[str]:
    """Return every element of these channel groups; of all, in an environment that is not robosuite's."""
    every = not isinstance(env, RobosuiteEnv)
    return frozenset(label for c in env.measured_spec.channels if every or c.group in groups for label in c.labels)
