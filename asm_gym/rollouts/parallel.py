"""Hands work out to processes and takes the results back in order: the one way this package uses several cores."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, TypeVar

import gymnasium as gym
import joblib

import asm_gym  # noqa: F401  (registers the environments in every worker)
from asm_gym.choices import check_choice
from asm_gym.extras import require

Item = TypeVar("Item")
Result = TypeVar("Result")
Progress = Callable[[int, int], None]
"""Is called as (done, total)."""


BACKENDS = ("loky", "dask", "ray")


@dataclass(frozen=True)
class ParallelConfig:
    """Who does the work.

    Args:
        workers: processes; 1 with ``loky`` stays in this one.
        backend: ``loky`` for processes on this machine; ``dask`` or ``ray`` for a cluster that is running already,
            whose workers have this package and share the folder that results go to.
        address: where the cluster is, such as ``tcp://host:8786``.
    """

    workers: int = 2
    backend: str = "loky"
    address: str | None = None

    def __post_init__(self) -> None:
        if self.workers < 1:
            raise ValueError(f"workers must be at least 1, got {self.workers}")
        check_choice("backend", self.backend, BACKENDS)
        if self.backend == "dask" and self.address is None:
            raise ValueError("backend='dask' needs the address of its scheduler, such as tcp://host:8786")
        if self.backend == "loky" and self.address is not None:
            raise ValueError(f"an address is for a cluster: backend must be dask or ray, got loky with {self.address}")


def parallel_map(
    task: Callable[[Item], Result],
    items: Sequence[Item],
    crew: ParallelConfig | int = 2,
    progress: Progress | None = None,
) -> list[Result]:
    """``[task(item) for item in items]``, done by a crew; a number stands for that many processes.

    Workers stay alive between calls, each with one BLAS thread: more of them would fight over the same cores.

    Raises:
        ValueError: fewer than one worker. What a task raises is raised here.
        ConnectionError: there is no cluster at the address.
    """
    crew = ParallelConfig(crew) if isinstance(crew, int) else crew
    if crew.backend == "loky" and crew.workers == 1:
        return _gather(map(task, items), len(items), progress)
    with _cluster(crew):
        # A cluster has as many workers as it has, and hands results back as they come only in order.
        n_jobs = crew.workers if crew.backend == "loky" else -1
        parallel = joblib.Parallel(n_jobs=n_jobs, return_as="generator", batch_size=1)
        return _gather(parallel(joblib.delayed(task)(item) for item in items), len(items), progress)


@contextmanager
def _cluster(crew: ParallelConfig) -> Iterator[None]:
    if crew.backend == "loky":
        with joblib.parallel_config(backend="loky", inner_max_num_threads=1):
            yield
    elif crew.backend == "dask":
        distributed = require("distributed", what="backend='dask'")
        try:
            client = distributed.Client(crew.address, timeout=10)
        except OSError as error:
            raise ConnectionError(f"no dask scheduler answers at {crew.address}: {error}") from error
        with client, joblib.parallel_config(backend="dask"):
            yield
    else:
        ray = require("ray", what="backend='ray'")
        ray.init(address=crew.address or "auto", ignore_reinit_error=True)
        require("ray.util.joblib", what="backend='ray'").register_ray()
        with joblib.parallel_config(backend="ray"):
            yield


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
