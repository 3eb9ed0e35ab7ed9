"""A vector environment whose members step at the same time, on threads of one process.

Physics, control and sensors of a control step are one compiled call, during which other threads run Python. So members
share one process and its memory, where Gymnasium's ``AsyncVectorEnv`` starts a process for each.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from functools import partial
from typing import Any

import gymnasium as gym
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.vector.utils import iterate


class ThreadVectorEnv(SyncVectorEnv[Any, Any]):
    """Gymnasium's ``SyncVectorEnv``, with each member on a thread of its own: the same results to the last bit.

    Args:
        env_fns: one function for each member, which makes it.
        arguments: those of ``SyncVectorEnv``.

    Raises:
        Exception: whatever a member raises, once all of them have finished their step.
    """

    def __init__(self, env_fns: Sequence[Callable[[], gym.Env[Any, Any]]], **arguments: Any) -> None:
        super().__init__([partial(ThreadedEnv, make) for make in env_fns], **arguments)
        self._members = [env for env in self.envs if isinstance(env, ThreadedEnv)]

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step every member, or reset it where its episode had ended, as the mode of autoreset has it."""
        each = list(iterate(self.action_space, actions))
        if len(each) != self.num_envs:
            raise ValueError(f"{self.num_envs} environments need as many actions, got {len(each)}")
        try:
            for member, action, ended in zip(self._members, each, self._autoreset_envs, strict=True):
                if not ended or self.autoreset_mode is AutoresetMode.SAME_STEP:
                    member.begun = member.thread.submit(member.env.step, action)
            return super().step(actions)
        finally:
            wait([member.begun for member in self._members if member.begun is not None])
            for member in self._members:
                member.begun = None


class ThreadedEnv(gym.Wrapper[Any, Any, Any, Any]):
    """One environment, made, stepped, rendered and closed on one thread, as graphics contexts require."""

    def __init__(self, make: Callable[[], gym.Env[Any, Any]]) -> None:
        self.thread = ThreadPoolExecutor(1)
        super().__init__(self.thread.submit(make).result())
        self.begun: Future[Any] | None = None
        """The step that its thread does or has done."""

    def step(self, action: Any) -> Any:
        """Return the outcome of the step that was begun, or of one that is done now."""
        begun, self.begun = self.begun or self.thread.submit(self.env.step, action), None
        return begun.result()

    def reset(self, **arguments: Any) -> Any:
        return self.thread.submit(self.env.reset, **arguments).result()

    def render(self) -> Any:
        return self.thread.submit(self.env.render).result()

    def close(self) -> None:
        """Close the environment and end its thread; may be called more than once."""
        try:
            self.thread.submit(self.env.close).result()
        except RuntimeError:  # the thread has ended already
            return
        self.thread.shutdown()
