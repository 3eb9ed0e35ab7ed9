"""Inject timed faults, name them in ``info["fault"]``, and undo them at reset."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from typing import Any, SupportsFloat

import gymnasium as gym
from gymnasium.utils import RecordConstructorArgs

from asm_gym.envs.robosuite_env import RobosuiteEnv
from asm_gym.faults import Fault
from asm_gym.faults.foreign_faults import FaultyInterface
from asm_gym.stream_source import stepped
from asm_gym.validation import short_repr, typed


class FaultInjection(gym.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Inject timed faults into every episode.

    ``info["fault"]`` is a tuple of the names of the faults that were active during the step: the
    ground truth. Faults of nested wrappers add up.

    Args:
        env: a robosuite environment of this package, wrapped or not; for sensor and action faults,
            any with Box spaces.
        faults: the faults of an episode, with their onsets and durations in control steps.

    Raises:
        TypeError: the environment has other spaces, or ``faults`` is not a sequence of faults.
        ValueError: a fault that this environment cannot have: an unknown body or joint, an onset
            past the horizon.

    Example:
        >>> import gymnasium as gym
        >>> from asm_gym import FaultInjection
        >>> from asm_gym.faults import Push
        >>> push = Push(body="robot0_link5", newtons=20.0, onset=1, duration=2)
        >>> env = FaultInjection(gym.make("asm_gym/Lift-v0"), [push])
        >>> observation, info = env.reset(seed=0)
        >>> [env.step(0.0 * env.action_space.sample())[-1]["fault"] for _ in range(3)]
        [(), ('Push',), ('Push',)]
    """

    @typed
    def __init__(self, env: gym.Env[Any, Any], faults: Sequence[Fault]) -> None:
        RecordConstructorArgs.__init__(self, faults=faults)
        self._inner: Any = env.unwrapped  # what faults act on
        if not isinstance(self._inner, RobosuiteEnv):
            env = FaultyInterface(env)
            self._inner = env
        gym.Wrapper.__init__(self, env)
        if not isinstance(faults, Sequence):
            raise TypeError(f"faults must be a sequence, got {short_repr(faults)}")
        for fault in faults:
            self._check(fault)
        self.faults = tuple(faults)
        self._running: dict[int, Generator[None, None, None]] = {}  # by place in ``faults``
        self._step = 0

    def _check(self, fault: Fault) -> None:
        """Raise TypeError or ValueError for a fault that this environment cannot have."""
        if not isinstance(fault, Fault):
            raise TypeError(f"faults must be asm_gym.faults.Fault objects, got {short_repr(fault)}")
        if isinstance(self._inner, FaultyInterface) and not fault.anywhere:
            needs = f"{fault.name} needs a robosuite environment of asm_gym"
            raise ValueError(f"{needs}, got {self.unwrapped}")
        fault.check(self._inner)
        horizon = self._inner.horizon
        if horizon is not None and fault.onset >= horizon:
            raise ValueError(f"{fault} starts at or after the horizon of {horizon} steps")

    def reset(
        self,
        *,
        seed: int | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Any, dict[str, Any]]:
        self.undo_faults()  # before the reset: a hard one replaces the model, a soft one keeps it
        self._step = 0
        observation, info = self.env.reset(seed=seed, options=options)
        info.setdefault("fault", ())
        return observation, info

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        for place, fault in enumerate(self.faults):
            if fault.active(self._step):
                next(self._running.setdefault(place, fault.inject(self._inner)))
            elif place in self._running:
                self._running.pop(place).close()
        observation, reward, terminated, truncated, info = stepped(self.env, action)
        active = [self.faults[place].name for place in self._running]
        info["fault"] = (*info.get("fault", ()), *active)
        self._step += 1
        return observation, reward, terminated, truncated, info

    def close(self) -> None:
        self.undo_faults()
        super().close()

    def undo_faults(self) -> None:
        """End and undo every active fault, as ``reset`` and ``close`` do."""
        while self._running:
            _, injection = self._running.popitem()
            injection.close()
        if self.env.has_wrapper_attr("undo_faults"):
            self.env.get_wrapper_attr("undo_faults")()
