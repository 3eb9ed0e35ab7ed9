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
        self._lock, self._inside = Lock(), 0
        self._libraries: list[Any] = []
        self._limited: list[tuple[Any, int]] = []

    def __enter__(self) -> None:
        with self._lock:
            if self._inside == 0:
                # Looks through all libraries, once.
                self._libraries = (
                    self._libraries
                    or ThreadpoolController().select(user_api="blas").lib_controllers
                )
                self._limited = [
                    (library, n) for library in self._libraries if (n := library.num_threads) != 1
                ]
                self._set([(library, 1) for library, _ in self._limited])
            self._inside += 1

    def __exit__(self, *error: object) -> None:
        with self._lock:
            self._inside -= 1
            if self._inside == 0:
                self._set(self._limited)

    @staticmethod
    def _set(threads: list[tuple[Any, int]]) -> None:
        for library, n in threads:
            library.set_num_threads(n)


ONE_THREAD = _OneThread()


def one_thread_for(rows: int) -> AbstractContextManager[None]:
    """Return ``ONE_THREAD`` for several rows of a memory, and no limit for one row, which calls no BLAS."""
    if rows > 1:
        return ONE_THREAD
    return nullcontext()
