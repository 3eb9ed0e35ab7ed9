"""Refusing what does not exist, with what does."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from typing import Any


def check_choice(what: str, got: Any, known: Iterable[Any]) -> None:
    """Raises ValueError unless ``got`` is one of ``known``, naming them all and the nearest."""
    names = list(known)
    if got in names:
        return
    near = difflib.get_close_matches(str(got), [str(n) for n in names], 1, 0.75)
    hint = f"; did you mean {near[0]!r}?" if near else ""
    raise ValueError(f"unknown {what} {got!r}; known: {', '.join(map(str, names))}{hint}")
