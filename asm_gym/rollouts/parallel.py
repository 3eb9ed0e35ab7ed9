"""Map work over items in order, in processes of this machine."""

from __future__ import annotations

import io
import os
import pickle
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, contextmanager, redirect_stderr, redirect_stdout
from functools import partial
from typing import Any, TypeVar

import cloudpickle

from asm_gym.extras import require
from asm_gym.registries import added, knowing
from asm_gym.validation import check_number, typed

Item = TypeVar("Item")
Result = TypeVar("Result")
Progress = Callable[[int, int], None]  # is called as (done, total)

MOST_WORKERS = 1000
IDLE_S = 300.0  # a process without work ends after this time [s]
_LIBRARIES = (
    "OMP_NUM",
    "OPENBLAS_NUM",
    "MKL_NUM",
    "BLIS_NUM",
    "NUMBA_NUM",
    "NUMEXPR_NUM",
    "VECLIB_MAXIMUM",
)
ONE_THREAD = {f"{library}_THREADS": "1" for library in _LIBRARIES}
"""Environment of each worker: more threads would compete for the same cores."""


@typed
def parallel_map(
    task: Callable[[Item], Result],
    items: Sequence[Item],
    workers: int = 2,
    progress: Progress | None = None,
) -> list[Result]:
    """Return ``[task(item) for item in items]``, computed by so many processes, 1 of which is this one.

    Processes stay alive between calls, and end with this one.

    Raises:
        ValueError: fewer than one worker, or more than ``MOST_WORKERS``. What a task raises is raised here.
        TypeError: the task cannot be sent to another process.
        ChildProcessError: a process was killed.
        OSError: /dev/shm cannot be written to, or is full.
    """
    check_number("workers", workers, low=1, high=MOST_WORKERS, whole=True)
    report = progress or (lambda done, total: None)
    total = len(items)
    results: dict[int, Result] = {}
    if workers == 1:
        for index, item in enumerate(items):
            results[index] = task(item)
            report(len(results), total)
    elif items:
        pickled = _pickled(task)
        with _streams_to_flush(), _loky(min(workers, total)) as executor:
            futures = {executor.submit(_call, pickled, item): n for n, item in enumerate(items)}
            for future in as_completed(futures):
                results[futures[future]] = future.result()
                report(len(results), total)
    return [results[index] for index in range(total)]


def _pickled(task: Callable[[Any], Any]) -> bytes:
    try:
        rows = added()
        if rows:
            task = partial(knowing, rows, task)
        return cloudpickle.dumps(task)
    except Exception as error:  # whatever a foreign __reduce__ raises
        raise TypeError(
            f"the work cannot be sent to another process ({type(error).__name__}: {error}): make "
            "what it needs in the worker, by a name, a path or a factory, or set workers to 1"
        ) from error


def _call(task: bytes, item: Any) -> Any:
    """Run in a worker: every item gets the task as the parent pickled it."""
    return pickle.loads(task)(item)


@contextmanager
def _loky(workers: int) -> Iterator[Any]:
    loky = require("loky", what="running episodes in several processes")
    with semaphores_needed():
        executor = loky.get_reusable_executor(
            workers,
            timeout=IDLE_S,
            initializer=_end_with_parent,
            initargs=(os.getpid(),),
            env=ONE_THREAD,
        )
    try:
        yield executor
    except BrokenProcessPool as error:
        raise ChildProcessError(
            f"a worker process was killed, perhaps for want of memory: {error}"
        ) from error
    except BaseException:
        # after an error or a Ctrl-C nothing runs on
        executor.shutdown(wait=True, kill_workers=True)
        raise


@contextmanager
def _streams_to_flush() -> Iterator[None]:
    """Stand in for standard streams that are closed: loky flushes both before it starts a process."""
    unread = io.StringIO()
    with ExitStack() as stack:
        if sys.stdout is None:
            stack.enter_context(redirect_stdout(unread))
        if sys.stderr is None:
            stack.enter_context(redirect_stderr(unread))
        yield


@contextmanager
def semaphores_needed() -> Iterator[None]:
    """Say what is missing where a block cannot make the semaphores of worker processes."""
    try:
        yield
    except OSError as error:
        raise OSError(
            f"worker processes need semaphores in /dev/shm, and none can be made there ({error}): "
            "mount it writable and not full, or set workers to 1"
        ) from error


def _end_with_parent(parent: int) -> None:
    """End this worker soon after its parent has ended, and leave Ctrl-C to it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def wait() -> None:
        while os.getppid() == parent:
            time.sleep(1.0)
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()
