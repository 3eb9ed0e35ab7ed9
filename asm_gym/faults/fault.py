"""The contract of a fault: a frozen description, and a context that applies and undoes it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import Field, dataclass, field, fields
from typing import Any, ClassVar, dataclass_transform

import mujoco
import numpy as np
from numpy.typing import NDArray

from asm_gym.envs.robosuite_env import RobosuiteEnv
from asm_gym.validation import check_choice, check_number, check_numbers, check_text

Vector3 = tuple[float, float, float]  # in the world's axes
Floats = NDArray[np.float64]
LARGEST_PARAMETER = 1e9  # so that nothing overflows
LONGEST_DELAY = 10_000  # [control steps]

Interface = Any
"""What faults of sensors and actions act on: ``RobosuiteEnv``, or the ``FaultyInterface`` of any other environment."""


@dataclass
class Clock:
    """Counts the control steps since a fault's onset."""

    steps: int = 0


def within(
    default: Any,
    *,
    low: float | None = -LARGEST_PARAMETER,
    high: float = LARGEST_PARAMETER,
    above: float | None = None,
) -> Any:
    """Declare a parameter of a fault: a dataclass field with bounds, which ``low`` and ``high`` include."""
    if above is not None:  # takes the place of ``low``
        low = None
    return field(default=default, metadata={"low": low, "high": high, "above": above})


@dataclass_transform(frozen_default=True, kw_only_default=True)
@dataclass(frozen=True, kw_only=True)
class Fault(ABC):
    """Describe a temporary malfunction; every subclass is a frozen dataclass.

    Args:
        onset: the first control step of the fault; step 0 is the first one after reset.
        duration: number of control steps; None until the end of the episode.
        seed: of the random draws of the fault. It never uses the environment's generator, so an episode with the fault
            has the same sensor noise as one without.

    Example:
        >>> from asm_gym.faults import Push
        >>> Push(body="robot0_link5", newtons=20.0, onset=40, duration=10).active(45)
        True
    """

    onset: int = within(40, low=0)
    duration: int | None = within(None, low=1)
    seed: int = within(0, low=0, high=2**63)

    anywhere: ClassVar[bool] = False  # whether it needs no more than an ``Interface``
    groups: ClassVar[tuple[str, ...]] = ()  # groups of channels in which it shows first

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        dataclass(frozen=True, kw_only=True)(cls)

    def __post_init__(self) -> None:
        for parameter in fields(self):
            _check_parameter(parameter, getattr(self, parameter.name))

    @property
    def name(self) -> str:
        return type(self).__name__

    def active(self, step: int) -> bool:
        """Whether the fault acts in a control step."""
        if self.duration is None:
            return self.onset <= step
        return self.onset <= step < self.onset + self.duration

    def rng(self, purpose: int = 1) -> np.random.Generator:
        """Return a generator of the fault's own."""
        return np.random.default_rng([self.seed, purpose])

    def check(self, env: RobosuiteEnv) -> None:
        """Raise ValueError, listing what exists, where the environment has nothing this fault could act on."""
        return

    @abstractmethod
    def applied(self, env: RobosuiteEnv, clock: Clock) -> AbstractContextManager[None]:
        """Apply the fault; leaving the context undoes everything, exactly."""

    def labels(self, env: Interface) -> frozenset[str]:
        """Return the stream elements in which this fault shows first; all where the environment is not robosuite's."""
        every = not isinstance(env, RobosuiteEnv)
        labels: set[str] = set()
        for channel in env.measured_spec.channels:
            if every or channel.group in self.groups:
                labels.update(channel.labels)
        return frozenset(labels)

    def inject(self, env: RobosuiteEnv) -> Generator[None, None, None]:
        """Apply the fault while the generator is open; closing it undoes the fault.

        It must be advanced once before every control step in which the fault acts.
        """
        clock = Clock()
        with self.applied(env, clock):
            while True:
                yield
                clock.steps += 1


Edit = tuple[NDArray[Any], list[Any], Callable[[Any], Any]]
"""An array of the simulator, the indices to edit, and a function from nominal to edited value."""


class EditingFault(Fault):
    """One that edits numbers of the simulator."""

    @abstractmethod
    def edits(self, env: RobosuiteEnv) -> list[Edit]:
        """Return what to edit at the onset."""

    @contextmanager
    def applied(self, env: RobosuiteEnv, clock: Clock) -> Iterator[None]:
        with ExitStack() as stack:
            for array, indices, edited_value in self.edits(env):
                set_change = stack.enter_context(env.edits.edit(array, *indices))
                set_change(edited_value)
            yield


class HookedFault(Fault):
    """One that adds a function to a list of the environment: ``corruptions``, ``deliveries`` or ``substep_hooks``."""

    hooks: ClassVar[str]  # name of the list

    @abstractmethod
    def hook(self, env: Any, clock: Clock) -> Callable[[Any], Any]:
        """Return the function, which may read the time since the onset from ``clock``."""

    @contextmanager
    def applied(self, env: Any, clock: Clock) -> Iterator[None]:
        functions = getattr(env, self.hooks)
        function = self.hook(env, clock)
        functions.append(function)
        try:
            yield
        finally:
            functions.remove(function)


class JointFault(Fault):
    """One that acts on a ``joint``, counted from the base, 0 first; a second arm's go on after the first one's."""

    joint: int = 3
    # channels in which the fault shows first
    channels: ClassVar[tuple[str, ...]] = ("joint_position", "joint_velocity")

    def check(self, env: RobosuiteEnv) -> None:
        check_number(
            f"joint of {env.measured_spec.source}",
            self.joint,
            low=0,
            high=len(env.simulation.motors) - 1,
            whole=True,
        )

    def labels(self, env: Interface) -> frozenset[str]:
        labels = env.measured_spec.labels
        return frozenset(labels[self.element(env, name)] for name in self.channels)

    def element(self, env: Interface, channel: str) -> int:
        """Return the index of the joint's number of a channel in a measured row."""
        indices: list[int] = []
        for name, span in env.measured_spec.slices.items():
            if name.endswith(channel):
                indices += range(span.start, span.stop)
        return indices[self.joint]


def _check_parameter(parameter: Field[Any], value: Any) -> None:
    """Raise ValueError unless a parameter is of its type and within its bounds."""
    name = parameter.name
    annotation = parameter.type  # a string, as annotations are not evaluated
    bounds = parameter.metadata or {
        "low": -LARGEST_PARAMETER,
        "high": LARGEST_PARAMETER,
        "above": None,
    }
    if annotation == "float":
        check_number(name, value, **bounds)
    elif annotation == "int" or (annotation == "int | None" and value is not None):
        check_number(name, value, whole=True, **bounds)
    elif annotation == "Vector3":
        check_numbers(name, value, 3, low=bounds["low"], high=bounds["high"])
        if name == "direction" and not np.linalg.norm(value) > 0:
            raise ValueError(f"direction must not be all zero, got {value}")
    elif annotation == "str":
        is_empty = isinstance(value, str) and not value  # the default: none is named
        if not is_empty:
            check_text(name, value)


def steady_force(env: RobosuiteEnv, body: int, newtons: float, direction: Vector3) -> Edit:
    """Return the edit that pushes a body along a direction in the world's axes."""
    along = np.asarray(direction, np.float64)
    force = newtons * (along / float(np.linalg.norm(along)))
    forces = env.simulation.data.xfrc_applied
    return forces, [(body, slice(0, 3))], lambda other_forces: other_forces + force


def delayed(now: Any, steps: int, memory: list[Any]) -> Any:
    """Add ``now`` to ``memory``; return what was given ``steps`` calls ago, or the first that it holds."""
    memory.append(now)
    if len(memory) > steps:
        return memory.pop(0)
    return memory[0]


def graded(
    kind: type[Fault], drawn: Mapping[str, str] | None = None, unit: str = "", **parameters: Any
) -> Callable[[Any, int], Fault]:
    """Return a function that makes the fault of a kind for an episode and a severity, 0 to 2.

    Args:
        kind: of the fault.
        drawn: for parameters that are drawn for the episode, the attribute of what was drawn.
        unit: the attribute that graded parameters are multiplied by; none where empty.
        parameters: all others. A tuple is a graded parameter: a value for each severity.
    """

    def make(episode: Any, severity: int) -> Fault:
        values = {name: getattr(episode, attribute) for name, attribute in (drawn or {}).items()}
        for name, value in parameters.items():
            if isinstance(value, tuple):
                value = value[severity]
                if unit:
                    value *= getattr(episode, unit)
            values[name] = value
        return kind(**values)

    return make


def body_id(env: RobosuiteEnv, name: str) -> int:
    """Return the body called ``name``; raise ValueError, listing those that exist, where there is none."""
    model = env.simulation.model
    # A dict of our own, as MuJoCo ends the process if it is asked for a name that is no string.
    bodies = {
        mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_BODY, i): i for i in range(1, model.nbody)
    }
    check_choice("body", check_text("body", name), bodies)
    return bodies[name]
