"""Orders of a person to a live watch: acknowledge a level shift, or snooze an incident.

    acknowledge [INCIDENT]          a line on standard input; the key a in a terminal
    snooze [SECONDS [INCIDENT]]     a line on standard input; the key s in a terminal

Without a number, the newest open incident is meant.
"""

from __future__ import annotations

import os
import stat
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from queue import Queue
from threading import Thread
from typing import IO

ACKNOWLEDGE = "acknowledge"
SNOOZE = "snooze"
SNOOZE_S = 600.0  # where no time is given [s]
KEYS = {"a": ACKNOWLEDGE, "s": SNOOZE}


@dataclass(frozen=True)
class Order:
    """What a person asks for."""

    kind: str  # ``ACKNOWLEDGE`` or ``SNOOZE``
    incident: int | None = None  # its number; None for the newest that is open
    seconds: float = SNOOZE_S  # of a snooze [s]
    problem: str = ""  # why the line cannot be obeyed


Orders = Queue[Order]


def order_in(line: str) -> Order | None:
    """Return the order in a line; None for any other line."""
    words = line.split()
    if not words or words[0].lower() not in (ACKNOWLEDGE, SNOOZE):
        return None
    kind = words[0].lower()
    most = {ACKNOWLEDGE: 1, SNOOZE: 2}[kind]
    rest = words[1:]
    try:
        if len(rest) > most:
            raise ValueError
        if kind == ACKNOWLEDGE:
            return Order(kind, incident=int(rest[0]) if rest else None)
        seconds = float(rest[0]) if rest else SNOOZE_S
        if not 0.0 < seconds < float("inf"):
            raise ValueError
        return Order(kind, incident=int(rest[1]) if len(rest) > 1 else None, seconds=seconds)
    except ValueError:
        usage = "acknowledge [INCIDENT], or snooze [SECONDS [INCIDENT]]"
        return Order(kind, problem=f"{line.strip()[:80]!r} cannot be obeyed: write {usage}")


def without_orders(lines: Iterable[str], orders: Orders) -> Iterator[str]:
    """Yield the lines of a source; an order among them is taken out, and leaves an empty line."""
    for line in lines:
        order = order_in(line)
        if order is None:
            yield line
        else:
            orders.put(order)
            yield ""


@contextmanager
def taken_from(file: IO[str] | None, orders: Orders) -> Iterator[None]:
    """Take orders while the block runs: keys of a terminal in whose foreground this runs, lines of a pipe."""
    number = _readable(file)
    if file is None or number is None:
        yield
        return
    if not file.isatty():
        Thread(target=_read_lines, args=(file, orders), daemon=True).start()
        yield
        return
    with _single_keys(number):
        Thread(target=_read_keys, args=(number, orders), daemon=True).start()
        yield


def _readable(file: IO[str] | None) -> int | None:
    """Return the descriptor of a pipe, or of a terminal in whose foreground this runs; None for all else."""
    if file is None:
        return None
    with suppress(OSError, ValueError, AttributeError):
        number = file.fileno()
        if file.isatty():
            is_foreground = hasattr(os, "tcgetpgrp") and os.tcgetpgrp(number) == os.getpgrp()
            return number if is_foreground else None
        if stat.S_ISFIFO(os.fstat(number).st_mode):
            return number
    return None


@contextmanager
def _single_keys(number: int) -> Iterator[None]:
    """Let a terminal hand over each key at once, and set it back."""
    try:
        import termios
        import tty
    except ImportError:  # Windows: keys come with the end of a line
        yield
        return
    before = termios.tcgetattr(number)
    try:
        tty.setcbreak(number)
        yield
    finally:
        termios.tcsetattr(number, termios.TCSADRAIN, before)


def _read_keys(number: int, orders: Orders) -> None:
    """Take each key that is an order."""
    with suppress(OSError):
        while key := os.read(number, 1).decode(errors="replace"):
            kind = KEYS.get(key.lower())
            if kind is not None:
                orders.put(Order(kind))


def _read_lines(file: IO[str], orders: Orders) -> None:
    """Take each line that is an order; say of any other that it is none."""
    with suppress(OSError, ValueError):
        for line in file:
            order = order_in(line)
            if order is not None:
                orders.put(order)
            elif line.strip():
                print(f"asm-gym: {line.strip()[:80]!r} is no order", file=sys.stderr)
