"""Hands work out to processes and takes the results back in order: the one way this package uses several cores."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any, TypeVar

import gymnasium as gym
import joblib

import asm_gym  # noqa: F401  (registers the environments in every worker)

Item = TypeVar("Item")
Result = TypeVar("Result")
Progress = Callable[[int, int], None]
"""Is called as (done, total)."""


def dispatch(
    task: Callable[[Item], Result], items: Sequence[Item], workers: int = 2, progress: Progress | None = None
) -> list[Result]:
    """``[task(item) for item in items]`` in ``workers`` processes; 1 stays in this process.

    Workers stay alive between calls, each with one BLAS thread: more of them would fight over the same cores.

    Raises:
        ValueError: fewer than one worker. What a task raises is raised here.
    """
    if workers < 1:
        raise ValueError(f"workers must be at least 1, got {workers}")
    if workers == 1:
        return _gather(map(task, items), len(items), progress)
    with joblib.parallel_config(backend="loky", inner_max_num_threads=1):
        parallel = joblib.Parallel(n_jobs=workers, return_as="generator", batch_size=1)
        return _gather(parallel(joblib.delayed(task)(item) for item in items), len(items), progress)


def _gather(results: Any, total: int, progress: Progress | None) -> list[Any]:
    gathered = []
    for result in results:
        gathered.append(result)
        if progress is not None:
            progress(len(gathered), total)
    return gathered


@lru_cache(maxsize=1)
def environment(env_id: str, settings: tuple[tuple[str, Any], ...] = ()) -> gym.Env[Any, Any]:
    """This process's environment: making one costs as much as an episode, and a seeded reset forgets the last one.

    Args:
        settings: what ``gym.make`` is given besides, as sorted pairs.
    """
    return gym.make(env_id, **dict(settings))
