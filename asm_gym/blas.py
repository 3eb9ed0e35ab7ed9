"""Matrix products on one thread."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from threading import Lock
from typing import Any

from threadpoolctl import ThreadpoolController


class _OneThread(AbstractContextManager[None]):
    """Limit BLAS to one thread: several are slower at small products, and differ in the last bits of sums.

    Only where it has several: ``threadpoolctl.limit`` takes as long as a row.
    """

    def __init__(self) -> None:
        self._lock = Lock()
        self._inside = 0  # how many blocks are open
        self._libraries: list[Any] = []
        self._threads: list[int] = []  # of each library outside of the blocks

    def __enter__(self) -> None:
        with self._lock:
            if self._inside == 0:
                if not self._libraries:  # looks through all libraries, once
                    controller = ThreadpoolController().select(user_api="blas")
                    self._libraries = controller.lib_controllers
                self._threads = [library.num_threads for library in self._libraries]
                self._set([1] * len(self._threads))
            self._inside += 1

    def __exit__(self, *error: object) -> None:
        with self._lock:
            self._inside -= 1
            if self._inside == 0:
                self._set(self._threads)

    def _set(self, threads: list[int]) -> None:
        """Give each library its number of threads, unless all of them always have one."""
        for library, usual, wanted in zip(self._libraries, self._threads, threads, strict=True):
            if usual != 1:
                library.set_num_threads(wanted)


ONE_THREAD = _OneThread()


def one_thread_for(rows: int) -> AbstractContextManager[None]:
    """Return ``ONE_THREAD`` for several rows of a memory, and no limit for one row, which calls no BLAS."""
    if rows > 1:
        return ONE_THREAD
    return nullcontext()
