"""Collect what a reader put right or left out, to say it once to the user."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

UNREAD = "left out, for it cannot be read: "  # begins a note on a file
SHOWN_NAMES = 6  # names that a message lists


class LogWarning(UserWarning):
    """A log was read, and something of it was not as it should be."""


def note(message: str) -> None:
    """Warn the caller of a reader."""
    warnings.warn(message, LogWarning, stacklevel=2)


def listed(names: Sequence[str]) -> str:
    """Return the first names of a list, and how many others there are."""
    text = ", ".join(names[:SHOWN_NAMES])
    if len(names) > SHOWN_NAMES:
        text += f" and {len(names) - SHOWN_NAMES} others"
    return text


@contextmanager
def noted() -> Iterator[list[str]]:
    """Collect the notes of this block, each once, in order; other warnings pass."""
    notes: list[str] = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", LogWarning)
        yield notes
    for warning in caught:
        message = str(warning.message)
        if not issubclass(warning.category, LogWarning):
            warnings.warn_explicit(
                warning.message, warning.category, warning.filename, warning.lineno
            )
        elif message not in notes:
            notes.append(message)
