"""Many environments side by side in one process, stepped on several threads."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from functools import partial
from queue import SimpleQueue
from threading import Thread
from typing import Any, TypeVar

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.vector.utils import concatenate, create_empty_array, iterate
from numpy.typing import NDArray

from asm_gym.tasks import TASKS
from asm_gym.validation import check_number

Result = TypeVar("Result")
Mask = NDArray[np.bool_]
Work = Callable[[list[int]], list[Any]]  # for members, by number
Answers = SimpleQueue[tuple[list[Any], BaseException | None]]


class ThreadedVectorEnv(SyncVectorEnv[Any, Any]):
    """Gymnasium's ``SyncVectorEnv`` on several threads, with the same digits whatever their number.

    Physics, control and sensors of a member run without Python's lock, so that the members of this package's tasks keep
    one core a thread busy. Any other environment may be a member too; pure Python gains nothing.

    A member, its wrappers included, is stepped, reset, called, rendered and closed on one thread for as long as the
    vector lives, as OpenGL needs it: the first members on the caller's, the rest on threads that ``close`` ends.

    Args:
        env_fns: functions that each make a member.
        threads: how many, the caller's included; by default the cores that this process may run on.
        autoreset_mode: when the episode after one that ended begins.

    Example:
        >>> import gymnasium as gym
        >>> from asm_gym import FaultInjection
        >>> from asm_gym.envs.vector import ThreadedVectorEnv
        >>> from asm_gym.faults import Push
        >>> push = Push(body="robot0_link5", newtons=20.0, onset=0)
        >>> envs = ThreadedVectorEnv([lambda: FaultInjection(gym.make("asm_gym/Lift-v0"), [push])] * 2)
        >>> observations, infos = envs.reset(seed=0)
        >>> *_, infos = envs.step(envs.action_space.sample())
        >>> infos["fault"].tolist()
        [('Push',), ('Push',)]
        >>> envs.close()
    """

    def __init__(
        self,
        env_fns: Sequence[Callable[[], gym.Env[Any, Any]]],
        threads: int | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
    ) -> None:
        if threads is None:
            threads = cores()
        check_number("threads", threads, low=1, whole=True)
        super().__init__(env_fns, copy=False, autoreset_mode=autoreset_mode)
        self.threads = min(threads, self.num_envs)
        parts = np.array_split(np.arange(self.num_envs), self.threads)
        # numbers of the members of each thread
        self._here, *others = (part.tolist() for part in parts)
        self._elsewhere = [_Worker(members) for members in others]

    def _of_each(self, what: Callable[[int], Result], which: Mask | None = None) -> list[Result]:
        """Return ``what`` of each member's number, or of those of ``which`` (n,), each on its member's thread.

        An exception is raised once every thread has come to its end.
        """

        def work(members: list[int]) -> list[Result]:
            return [what(i) for i in members if which is None or which[i]]

        queues = [worker.begin(work) for worker in self._elsewhere]
        try:
            results = work(self._here)
        finally:
            answers = [queue.get() for queue in queues]
        for more, error in answers:
            if error is not None:
                raise error
            results += more
        return results

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        n = self.num_envs
        options = dict(options or {})
        begun = np.asarray(options.pop("reset_mask", np.ones(n, bool)))
        if seed is None:
            seeds = [None] * n
        elif np.ndim(seed) == 0:
            seeds = [seed + i for i in range(n)]
        else:
            seeds = list(seed)
        is_mask = begun.dtype == bool and begun.shape == (n,)
        if len(seeds) != n or not is_mask:
            raise ValueError(
                f"seed and reset_mask must have {n} entries (one an environment), "
                f"got {seed} and {begun}"
            )
        never_reset = [observation is None for observation in self._env_obs]
        if np.any(never_reset & ~begun):
            raise gym.error.ResetNeeded("the first reset() must reset all environments")

        def start(i: int) -> tuple[int, Any, dict[str, Any]]:
            return (i, *self.envs[i].reset(seed=seeds[i], options=options or None))

        infos: dict[str, Any] = {}
        for i, observation, info in self._of_each(start, begun):
            self._env_obs[i] = observation
            infos = self._add_info(infos, info, i)
        self._autoreset_envs = self._autoreset_envs & ~begun
        return self._stacked(), infos

    def step(self, actions: Any) -> tuple[Any, NDArray[np.float64], Mask, Mask, dict[str, Any]]:
        given = list(iterate(self.action_space, actions))
        if len(given) != self.num_envs:
            raise ValueError(
                f"actions must have {self.num_envs} rows, one for each environment, "
                f"got {len(given)}"
            )
        outcomes = self._of_each(lambda i: self._outcome(i, given[i]))
        observations, rewards, terminated, truncated, infos = zip(*outcomes, strict=True)
        self._env_obs = list(observations)
        is_terminated = np.array(terminated, bool)
        is_truncated = np.array(truncated, bool)
        self._autoreset_envs = is_terminated | is_truncated
        returns = np.array(rewards, np.float64)
        return self._stacked(), returns, is_terminated, is_truncated, self._merged(infos)

    def _outcome(self, i: int, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step member ``i``, or begin its next episode."""
        env = self.envs[i]
        mode = self.autoreset_mode
        if self._autoreset_envs[i]:
            if mode == AutoresetMode.DISABLED:
                raise gym.error.ResetNeeded(
                    f"the episode of environment {i} has ended: reset it with reset_mask"
                )
            if mode == AutoresetMode.NEXT_STEP:
                observation, info = env.reset()
                return observation, 0.0, False, False, info
        observation, reward, terminated, truncated, info = env.step(action)
        if mode == AutoresetMode.SAME_STEP and (terminated or truncated):
            final = {"final_obs": observation, "final_info": info}
            observation, info = env.reset()
            info = info | final
        return observation, reward, bool(terminated), bool(truncated), info

    def _stacked(self) -> Any:
        """Return the members' observations in a batch of its own."""
        space = self.single_observation_space
        if isinstance(space, gym.spaces.Box):
            return np.array(self._env_obs, space.dtype)
        batch: Any = create_empty_array(space, self.num_envs, np.empty)
        return concatenate(space, self._env_obs, batch)

    def _merged(self, infos: Sequence[dict[str, Any]]) -> dict[str, Any]:
        """Return the infos of all members, as ``_add_info`` puts them together one by one."""
        merged: dict[str, Any] = {}
        for key in infos[0]:
            values = [info.get(key) for info in infos]
            if key != "final_obs" and _are_alike(values):
                merged[key] = np.array(values)
                merged[f"_{key}"] = np.ones(self.num_envs, bool)
        stacked = set(merged)
        for i, info in enumerate(infos):
            rest = {key: value for key, value in info.items() if key not in stacked}
            merged = self._add_info(merged, rest, i)
        return merged

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        def called(i: int) -> Any:
            attribute = self.envs[i].get_wrapper_attr(name)
            if callable(attribute):
                return attribute(*args, **kwargs)
            return attribute

        return tuple(self._of_each(called))

    def render(self) -> tuple[Any, ...]:
        return self.call("render")

    def close_extras(self, **kwargs: Any) -> None:
        if hasattr(self, "_elsewhere"):  # it was made
            try:
                self._of_each(lambda i: self.envs[i].close())
            finally:
                for worker in self._elsewhere:
                    worker.end()


class _Worker:
    """A thread that does work for its members until it is ended; a ``ThreadPoolExecutor`` takes four times as long."""

    def __init__(self, members: list[int]) -> None:
        self._members = members
        self._tasks: SimpleQueue[tuple[Work, Answers] | None] = SimpleQueue()
        self._thread = Thread(target=self._serve, daemon=True)
        self._thread.start()

    def begin(self, work: Work) -> Answers:
        """Begin work; return the queue that will hold its results, or its exception."""
        answers: Answers = SimpleQueue()
        self._tasks.put((work, answers))
        return answers

    def end(self) -> None:
        self._tasks.put(None)
        self._thread.join()

    def _serve(self) -> None:
        while (task := self._tasks.get()) is not None:
            work, answers = task
            try:
                answers.put((work(self._members), None))
            except BaseException as error:
                answers.put(([], error))


def cores() -> int:
    """Return how many cores this process may run on."""
    if hasattr(os, "sched_getaffinity"):  # of Linux
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _are_alike(values: list[Any]) -> bool:
    """Whether values of several members are numbers of one type, or arrays of one shape and type."""
    types = set(map(type, values))
    first = values[0]
    if len(types) > 1:
        return False
    if isinstance(first, np.ndarray):
        return all((v.shape, v.dtype) == (first.shape, first.dtype) for v in values)
    return isinstance(first, int | float | np.number)


def make(num_envs: int = 1, task: str = "Lift", **settings: Any) -> ThreadedVectorEnv:
    """Return what ``gym.make_vec("asm_gym/<task>-v0", num_envs)`` makes.

    Args:
        settings: ``threads`` and ``autoreset_mode`` of ``ThreadedVectorEnv``; the rest is of each environment.
    """
    ours = {key: settings.pop(key) for key in ("threads", "autoreset_mode") if key in settings}
    member = partial(gym.make, TASKS[task].id, **settings)
    return ThreadedVectorEnv([member] * num_envs, **ours)
