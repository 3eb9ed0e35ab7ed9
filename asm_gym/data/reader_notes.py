"""Collect what a reader put right or left out, to say it once to the user."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager

UNREAD = "left out, for it cannot be read: "  # begins a note on a file


class LogWarning(UserWarning):
    """A log was read, and something of it was not as it should be."""


def note(message: str) -> None:
    """Warn the caller of a reader."""
    warnings.warn(message, LogWarning, stacklevel=2)


@contextmanager
def noted() -> Iterator[list[str]]:
    """Collect the notes of this block, each once, in order; other warnings pass."""
    notes: list[str] = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", LogWarning)
        yield notes
    for warning in caught:
        if issubclass(warning.category, LogWarning):
            notes += [str(warning.message)] if str(warning.message) not in notes else []
        else:
            warnings.warn_explicit(
                warning.message, warning.category, warning.filename, warning.lineno
            )
