"""Map work over items in order: processes on this machine, or a running Dask or Ray cluster."""

from __future__ import annotations

import os
import pickle
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeVar

import cloudpickle
from threadpoolctl import threadpool_limits

from asm_gym.extras import require
from asm_gym.registries import added, knowing
from asm_gym.validation import check_choice, check_number, typed

Item = TypeVar("Item")
Result = TypeVar("Result")
Progress = Callable[[int, int], None]
"""Is called as (done, total)."""
Submit = Callable[[bytes, Any], "Future[Any]"]
"""Runs a pickled task on an item, as ``concurrent.futures.Executor.submit`` does."""

MOST_WORKERS = 1000
IDLE_S = 300.0
"""A process without work ends after this time [s]."""
_LIBRARIES = ("OMP_NUM", "OPENBLAS_NUM", "MKL_NUM", "BLIS_NUM", "NUMBA_NUM", "NUMEXPR_NUM", "VECLIB_MAXIMUM")
ONE_THREAD = {f"{library}_THREADS": "1" for library in _LIBRARIES}
"""Environment of each worker: more threads would compete for the same cores."""


@dataclass(frozen=True)
class ParallelConfig:
    """Who does the work.

    Args:
        workers: processes; 1 with ``loky`` stays in this one. A cluster decides by itself.
        backend: ``loky`` for processes on this machine; ``dask`` or ``ray`` for a running cluster, whose workers have
            this package and share the folder of the results.
        address: of the cluster, such as ``tcp://host:8786``; Ray finds one on this machine by itself.
    """

    workers: int = 2
    backend: str = "loky"
    address: str | None = None

    def __post_init__(self) -> None:
        check_number("workers", self.workers, low=1, high=MOST_WORKERS, whole=True)
        check_choice("backend", self.backend, BACKENDS)
        if self.backend == "dask" and self.address is None:
            raise ValueError("backend='dask' needs the address of its scheduler, such as tcp://host:8786")
        if self.backend == "loky" and self.address is not None:
            raise ValueError(f"an address is for a cluster: backend must be dask or ray, got loky with {self.address}")

    @classmethod
    def named(cls, workers: str) -> ParallelConfig:
        """Parse a number of processes, ``dask:ADDRESS``, ``ray`` or ``ray:ADDRESS``.

        Raises:
            ValueError: it is none of these.
        """
        if workers.lstrip("-").isdecimal():
            return cls(int(workers))
        backend, _, address = workers.partition(":")
        if backend not in BACKENDS or backend == "loky":
            raise ValueError(f"workers must be a number, dask:ADDRESS or ray:ADDRESS, got {workers!r}")
        return cls(backend=backend, address=address or None)


@typed
def parallel_map(
    task: Callable[[Item], Result],
    items: Sequence[Item],
    parallel: ParallelConfig | int = 2,
    progress: Progress | None = None,
) -> list[Result]:
    """Return ``[task(item) for item in items]``, computed by workers; a number is that many processes here.

    Processes stay alive between calls, and end with this one. A cluster repeats the task of a lost worker.

    Raises:
        ValueError: fewer than one worker, or more than ``MOST_WORKERS``. What a task raises is raised here.
        TypeError: the task cannot be sent to another process.
        ConnectionError: there is no cluster at the address.
        ChildProcessError: a process was killed.
    """
    parallel = parallel if isinstance(parallel, ParallelConfig) else ParallelConfig(parallel)
    report = progress or (lambda done, total: None)
    found: dict[int, Result] = {}
    if parallel.backend == "loky" and parallel.workers == 1:
        for index, item in enumerate(items):
            found[index] = task(item)
            report(len(found), len(items))
    elif items:
        pickled = _pickled(task)
        with BACKENDS[parallel.backend](parallel, len(items)) as submit:
            index_of = {submit(pickled, item): index for index, item in enumerate(items)}
            for future in as_completed(index_of):
                found[index_of[future]] = future.result()
                report(len(found), len(items))
    return [found[index] for index in range(len(items))]


def _pickled(task: Callable[[Any], Any]) -> bytes:
    try:
        rows = added()
        made: bytes = cloudpickle.dumps(partial(knowing, rows, task) if rows else task)
    except Exception as error:  # whatever a foreign __reduce__ raises
        raise TypeError(
            f"the work cannot be sent to another process ({type(error).__name__}: {error}): make what it needs in the "
            "worker, by a name, a path or a factory, or set workers to 1"
        ) from error
    return made


def _call(task: bytes, item: Any) -> Any:
    """Run in a worker: every item gets the task as the parent pickled it."""
    return pickle.loads(task)(item)


_ONE_AT_A_TIME = threading.Lock()


def _call_on_cluster(task: bytes, item: Any) -> Any:
    """Run in a worker that may have several threads: an environment serves one at a time."""
    with _ONE_AT_A_TIME, threadpool_limits(1):
        return _call(task, item)


@contextmanager
def _loky(parallel: ParallelConfig, items: int) -> Iterator[Submit]:
    get_reusable_executor = require("loky", what="running episodes in several processes").get_reusable_executor
    workers = min(parallel.workers, items)  # an executor starts all of them at once
    how = {"timeout": IDLE_S, "initializer": _end_with_parent, "initargs": (os.getpid(),), "env": ONE_THREAD}
    executor = get_reusable_executor(workers, **how)
    try:
        yield partial(executor.submit, _call)
    except BrokenProcessPool as error:
        raise ChildProcessError(f"a worker process was killed, perhaps for want of memory: {error}") from error
    except BaseException:
        executor.shutdown(wait=True, kill_workers=True)  # after an error or a Ctrl-C nothing runs on
        raise


def _end_with_parent(parent: int) -> None:
    """End this worker soon after its parent has ended, and leave Ctrl-C to it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def wait() -> None:
        while os.getppid() == parent:
            time.sleep(1.0)
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


@contextmanager
def _dask(parallel: ParallelConfig, items: int) -> Iterator[Submit]:
    distributed = require("distributed", what="backend='dask'")
    try:
        client = distributed.Client(parallel.address, timeout=10)
    except OSError as error:
        raise ConnectionError(f"no dask scheduler answers at {parallel.address}: {error}") from error
    with client:  # closing it cancels what still runs
        yield partial(client.get_executor(pure=False).submit, _call_on_cluster)


@contextmanager
def _ray(parallel: ParallelConfig, items: int) -> Iterator[Submit]:
    ray = require("ray", what="backend='ray'")
    joined = not ray.is_initialized()
    if joined:
        ray.init(address=parallel.address or "auto", log_to_driver=False, logging_level="ERROR")
    try:
        remote = ray.remote(_call_on_cluster)
        yield lambda task, item: remote.remote(task, item).future()
    finally:
        if joined:
            ray.shutdown()


BACKENDS = {"loky": _loky, "dask": _dask, "ray": _ray}
"""Each is a context that gives a function to submit a pickled task with an item."""
