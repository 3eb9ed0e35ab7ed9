"""Hands work out and takes the results back in order: processes here, a running Dask or Ray cluster elsewhere."""

from __future__ import annotations

import ctypes
import os
import pickle
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, TypeVar

import cloudpickle
from loky import get_reusable_executor
from threadpoolctl import threadpool_limits

from asm_gym.choices import check_choice
from asm_gym.extras import require

Item = TypeVar("Item")
Result = TypeVar("Result")
Progress = Callable[[int, int], None]
"""Is called as (done, total)."""
Submit = Callable[[bytes, Any], "Future[Any]"]
"""Hands a pickled task and one item to a worker."""

BACKENDS = ("loky", "dask", "ray")
IDLE_S = 300.0
"""How long a process waits for more work before it ends [s]."""
ONE_THREAD = dict.fromkeys(
    (
        *("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "BLIS_NUM_THREADS"),
        *("VECLIB_MAXIMUM_THREADS", "NUMBA_NUM_THREADS", "NUMEXPR_NUM_THREADS"),
    ),
    "1",
)
"""Of each worker: more threads would fight over the same cores."""


@dataclass(frozen=True)
class ParallelConfig:
    """Who does the work.

    Args:
        workers: processes; 1 with ``loky`` stays in this one. A cluster has as many as it has.
        backend: ``loky`` for processes on this machine; ``dask`` or ``ray`` for a cluster that is running already,
            whose workers have this package and share the folder that results go to.
        address: where the cluster is, such as ``tcp://host:8786``; Ray finds one on this machine by itself.
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


TWO_PROCESSES, THIS_PROCESS = ParallelConfig(), ParallelConfig(1)


def parallel_map(
    task: Callable[[Item], Result],
    items: Sequence[Item],
    parallel: ParallelConfig | int = 2,
    progress: Progress | None = None,
) -> list[Result]:
    """``[task(item) for item in items]``, done by workers; a number stands for that many processes here.

    Processes stay alive between calls, and end with this one, however it ends. A cluster runs a task again whose
    worker was lost.

    Raises:
        ValueError: fewer than one worker. What a task raises is raised here.
        TypeError: the task cannot be sent to another process.
        ConnectionError: there is no cluster at the address.
        ChildProcessError: a process was killed.
    """
    parallel = ParallelConfig(parallel) if isinstance(parallel, int) else parallel
    tell = progress or (lambda done, total: None)
    if parallel.backend == "loky" and parallel.workers == 1:
        results = []
        for item in items:
            results.append(task(item))
            tell(len(results), len(items))
        return results
    if not items:
        return []
    sent = _pickled(task)
    with _WORKERS[parallel.backend](parallel) as submit:
        futures = [submit(sent, item) for item in items]
        for done, future in enumerate(as_completed(futures), 1):
            future.result()  # raises what the task raised, before the others have ended
            tell(done, len(items))
        return [future.result() for future in futures]


def _pickled(task: Callable[[Any], Any]) -> bytes:
    try:
        made: bytes = cloudpickle.dumps(task)
    except Exception as error:  # whatever a foreign __reduce__ raises
        raise TypeError(
            f"the work cannot be sent to another process ({type(error).__name__}: {error}): make what it needs in the "
            "worker, by a name, a path or a factory, or set workers to 1"
        ) from error
    return made


def _call(task: bytes, item: Any) -> Any:
    """In a process of this machine; every item meets the task as it was sent."""
    return pickle.loads(task)(item)


_ONE_AT_A_TIME = threading.Lock()


def _call_on_cluster(task: bytes, item: Any) -> Any:
    """In a worker that may have threads, of its own and of its libraries: an environment can be used by one alone."""
    with _ONE_AT_A_TIME, threadpool_limits(1):
        return _call(task, item)


@contextmanager
def _loky(parallel: ParallelConfig) -> Iterator[Submit]:
    # A process that another thread starts would end with that thread.
    here = threading.current_thread() is threading.main_thread()
    executor = get_reusable_executor(
        parallel.workers, timeout=IDLE_S, initializer=_end_with_parent, initargs=(os.getpid(), here), env=ONE_THREAD
    )
    try:
        yield lambda task, item: executor.submit(_call, task, item)
    except BrokenProcessPool as error:
        raise ChildProcessError(f"a worker process was killed, perhaps for want of memory: {error}") from error
    except BaseException:
        executor.shutdown(wait=True, kill_workers=True)  # of an error or a Ctrl-C nothing is left running
        raise


def _end_with_parent(parent: int, by_signal: bool) -> None:
    """Ends this worker as soon as its parent has ended, and leaves Ctrl-C to it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if by_signal and sys.platform == "linux":
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(1.0)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


@contextmanager
def _dask(parallel: ParallelConfig) -> Iterator[Submit]:
    distributed = require("distributed", what="backend='dask'")
    try:
        client = distributed.Client(parallel.address, timeout=10)
    except OSError as error:
        raise ConnectionError(f"no dask scheduler answers at {parallel.address}: {error}") from error
    with client:  # tasks that nobody waits for any more are dropped when it closes
        executor = client.get_executor(pure=False)
        yield lambda task, item: executor.submit(_call_on_cluster, task, item)


@contextmanager
def _ray(parallel: ParallelConfig) -> Iterator[Submit]:
    ray = require("ray", what="backend='ray'")
    joined = not ray.is_initialized()
    if joined:
        ray.init(address=parallel.address or "auto", log_to_driver=False, logging_level="ERROR")
    kept: dict[bytes, Any] = {}
    remote = ray.remote(_call_on_cluster)

    def submit(task: bytes, item: Any) -> Future[Any]:
        if task not in kept:
            kept[task] = ray.put(task)  # it is sent once to each machine
        future: Future[Any] = remote.remote(kept[task], item).future()
        return future

    try:
        yield submit
    finally:
        if joined:
            ray.shutdown()


_WORKERS = {"loky": _loky, "dask": _dask, "ray": _ray}
