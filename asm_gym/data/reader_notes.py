"""What a reader put right or left out, said once to whoever reads."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager


class LogWarning(UserWarning):
    """A log was read, and something of it was not as it should be."""


def note(message: str) -> None:
    """Says so."""
    warnings.warn(message, LogWarning, stacklevel=2)


@contextmanager
def noted() -> Iterator[list[str]]:
    """What was said in this block, each thing once, in order; nothing of it is printed."""
    said: list[str] = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", LogWarning)
        yield said
        others = [w for w in caught if not issubclass(w.category, LogWarning)]
        said += dict.fromkeys(str(w.message) for w in caught if issubclass(w.category, LogWarning))
    for other in others:
        warnings.warn_explicit(other.message, other.category, other.filename, other.lineno)
