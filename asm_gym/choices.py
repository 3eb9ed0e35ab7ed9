"""Refusing what does not exist, with what does."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from typing import Any

from asm_gym.checks import SHOWN, shown


def check_choice(what: str, got: Any, known: Iterable[Any]) -> None:
    """Raises ValueError unless ``got`` is one of ``known``, naming them all and the nearest."""
    names = list(known)
    try:
        if got in names:
            return
    except ValueError:  # of arrays, which compare number by number
        pass
    near = difflib.get_close_matches(got[:SHOWN], map(str, names), 1, 0.75) if isinstance(got, str) else []
    hint = f"; did you mean {near[0]!r}?" if near else ""
    raise ValueError(f"unknown {what} {shown(got)}; known: {', '.join(map(str, names))}{hint}")
