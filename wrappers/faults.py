"""Makes things go wrong on time, says so in ``info["fault"]``, and puts everything back at reset."""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Sequence
from typing import Any, SupportsFloat

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import NDArray

from asm_gym.checks import as_float32, shown
from asm_gym.envs.robosuite_env import RobosuiteEnv
from asm_gym.faults import Fault
from asm_gym.stream import MOTOR, StreamSpec, flat
from asm_gym.typed import typed
from asm_gym.wrappers.recording import StreamSource


class FaultyInterface(gym.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Where faults of senses and actions reach an environment that is not robosuite's; an ``Interface`` of theirs.

    What is sensed is the observation, and ``info["stream"]`` where the environment has one, whose senses must then be
    the numbers of the observation. An action that a fault has changed is clipped to its space.

    Args:
        env: takes Box actions, and observes a Box or a dict of such.

    Raises:
        TypeError: other spaces.
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        RecordConstructorArgs.__init__(self)
        gym.Wrapper.__init__(self, env)
        if not isinstance(env.action_space, spaces.Box) or not _boxes(env.observation_space):
            raise TypeError(
                f"faults are injected where actions and senses are Boxes, got {env.action_space} and "
                f"{env.observation_space}"
            )
        self._source = StreamSource(env)
        spec = self._source.spec
        self.measured_spec = StreamSpec(tuple(c for c in spec.channels if c.group != MOTOR), spec.dt, spec.source)
        self.corruptions: list[Callable[[NDArray[np.float64]], None]] = []
        self.deliveries: list[Callable[[NDArray[np.float32]], NDArray[np.float32]]] = []
        self.measured = np.zeros(self.measured_spec.size)
        self.gripper_actions: tuple[int, ...] = ()
        self.horizon = getattr(env.spec, "max_episode_steps", None)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        observation, info = self.env.reset(seed=seed, options=options)
        if self._source.own:
            sensed = np.asarray(info["stream"])[self._source.spec.sensory]
            if not np.allclose(sensed, flat(self.observation_space, observation), equal_nan=True):
                raise ValueError(
                    "the senses in this environment's stream are not its observation: no fault can be both"
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
            info["stream"][self._source.spec.motor] = np.ravel(action)  # as commanded: nobody tells what became of it
        return self._sensed(observation, info), reward, terminated, truncated, info

    def _sensed(self, observation: Any, info: dict[str, Any]) -> Any:
        """What reaches the policy of ``observation``, and ``info``'s stream likewise."""
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


class FaultInjection(gym.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Injects timed faults.

    ``info["fault"]`` is a tuple of the names of the faults that were active during the step: the ground truth;
    ``info["variation"]`` the same for harmless variations. Wrappers around one another add up.

    Args:
        env: a robosuite environment of this package, wrapped or not; for faults of senses and actions, any with Boxes.
        faults: what goes wrong in every episode.

    Raises:
        TypeError: the environment has other spaces, or ``faults`` is not a sequence of them.
        ValueError: a fault that this environment cannot have (an unknown body or joint, an onset past the horizon), or
            two that contradict each other.
    """

    @typed
    def __init__(self, env: gym.Env[Any, Any], faults: Sequence[Fault]) -> None:
        RecordConstructorArgs.__init__(self, faults=faults)
        theirs = env.unwrapped
        inner: Any = theirs if isinstance(theirs, RobosuiteEnv) else FaultyInterface(env)
        gym.Wrapper.__init__(self, env if inner is theirs else inner)
        if not isinstance(faults, Sequence):
            raise TypeError(f"faults must be a sequence, got {shown(faults)}")
        for fault in faults:
            if not isinstance(fault, Fault):
                raise TypeError(f"faults must be asm_gym.faults.Fault objects, got {shown(fault)}")
            if inner is not theirs and not fault.anywhere:
                raise ValueError(f"{fault.name} happens in robosuite environments of asm_gym, and this is {theirs}")
            fault.check(inner)
            if inner.horizon is not None and fault.onset >= inner.horizon:
                raise ValueError(f"{fault} starts at or after the horizon of {inner.horizon} steps")
        before = env.get_wrapper_attr("every_fault") if env.has_wrapper_attr("every_fault") else ()
        self.every_fault: tuple[Fault, ...] = (*before, *faults)
        """The faults of this wrapper and of those inside it."""
        _check_contradictions(self.every_fault, inner)
        self.faults = tuple(faults)
        self._inner = inner
        self._running: dict[int, Generator[None, None, None]] = {}
        self._step = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        self.undo_faults()  # before the reset: a hard one replaces the model, a soft one keeps it
        self._step = 0
        observation, info = self.env.reset(seed=seed, options=options)
        info.setdefault("fault", ())
        info.setdefault("variation", ())
        return observation, info

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        for k, fault in enumerate(self.faults):
            if fault.active(self._step):
                next(self._running.setdefault(k, fault.inject(self._inner)))
            elif k in self._running:
                self._running.pop(k).close()
        observation, reward, terminated, truncated, info = self.env.step(action)
        active = [self.faults[k] for k in self._running]
        info["fault"] = (*info.get("fault", ()), *(f.name for f in active if not f.harmless))
        info["variation"] = (*info.get("variation", ()), *(f.name for f in active if f.harmless))
        self._step += 1
        return observation, reward, terminated, truncated, info

    def close(self) -> None:
        self.undo_faults()
        super().close()

    def undo_faults(self) -> None:
        """Ends every fault that acts now and puts back what it changed, as ``reset`` and ``close`` do."""
        while self._running:
            self._running.popitem()[1].close()
        if self.env.has_wrapper_attr("undo_faults"):
            self.env.get_wrapper_attr("undo_faults")()


def _check_contradictions(faults: Sequence[Fault], env: Any) -> None:
    """Raises ValueError where two faults give one thing a value of their own at the same time."""
    for i, first in enumerate(faults):
        for second in faults[i + 1 :]:
            ends = [math.inf if f.duration is None else f.onset + f.duration for f in (first, second)]
            both = first.holds(env) & second.holds(env)
            if both and max(first.onset, second.onset) < min(ends):
                raise ValueError(
                    f"{first} and {second} contradict each other: both decide over {', '.join(sorted(both))}"
                )
