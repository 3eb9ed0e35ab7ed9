"""Records a live source for a memory to learn from, and says what the arm has shown and what it has not."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np

from asm_gym.data.channels import label_of
from asm_gym.data.clock_column import clock_among
from asm_gym.data.coverage import POSITION, Coverage
from asm_gym.data.live import SourceDied
from asm_gym.data.rtde import rtde_lines

EVERY_S = 15.0
"""How often it is said what was shown [s]."""

LEAST_S = 60.0
"""Before that nothing is enough [s]."""

SHOWN_JOINTS = 8


def rtde_source(place: str, channels: Sequence[str], rate: float | None, silence: float) -> Iterator[str]:
    """Rows of a controller, which has to be asked for outputs by name.

    Raises:
        ValueError: nobody said which, or how often.
    """
    if not channels or rate is None:
        raise ValueError(
            "a controller is asked for its outputs: say --channels actual_q actual_qd actual_current --rate 125"
        )
    return rtde_lines(place, channels, rate, silence)


def listen(lines: Iterable[str], to: Path, minutes: float, say: Callable[[str], None]) -> float:
    """Writes JSON lines to a file until the time is over, enough is heard, or the source died; returns how long [s].

    Raises:
        ValueError: a line is no object by channel, or nothing came.
    """
    to.parent.mkdir(parents=True, exist_ok=True)
    coverage: Coverage | None = None
    begun = told = 0.0
    rows, why = 0, "the source ended"
    with to.open("w", encoding="utf-8") as file:
        try:
            for line in lines:
                if not line.strip():
                    continue
                now = time.monotonic()
                numbers = _numbers(line)
                if coverage is None:
                    begun = told = now
                    names = [n for n in numbers if POSITION.fullmatch(n.partition("[")[0].lower())]
                    clock = clock_among(numbers)
                    coverage = Coverage(names or [n for n in numbers if clock is None or n != clock.column])
                rows += 1
                file.write(line.rstrip("\n") + "\n")
                stamp = now if clock is None else numbers[clock.column] * clock.unit_of(numbers[clock.column])
                coverage.see(stamp, [numbers.get(name, np.nan) for name in coverage.names])
                if now - told >= EVERY_S:
                    told = now
                    _tell(coverage, now - begun, say)
                    if now - begun >= LEAST_S and coverage.enough:
                        why = "enough was heard"
                        break
                if now - begun >= 60 * minutes:
                    why = "the time is over"
                    break
        except (SourceDied, TimeoutError) as error:
            why = f"the source has died, {error}"
    if coverage is None:
        raise ValueError("no row came")
    length = time.monotonic() - begun
    say(f"{why}: {rows} rows in {length:.0f} s, kept in {to}")
    _tell(coverage, length, say)
    return length


def _numbers(line: str) -> dict[str, float]:
    """The numbers of an object by their labels. Raises ValueError where it is none."""
    try:
        said = json.loads(line)
        if not isinstance(said, dict):
            raise ValueError(f"got {type(said).__name__}")
        found: dict[str, float] = {}
        for name, value in said.items():
            parts = value if isinstance(value, list) else [value]
            labels = [label_of(name)] if len(parts) == 1 else [f"{name}[{k}]" for k in range(len(parts))]
            found |= {label: float("nan" if v is None else v) for label, v in zip(labels, parts, strict=True)}
    except (ValueError, TypeError) as error:
        raise ValueError(f"a row to learn from must be an object of numbers by channel: {error}") from error
    return found


def _tell(coverage: Coverage, seconds: float, say: Callable[[str], None]) -> None:
    shown = coverage.shown()
    lacking = [joint for joint in shown if not joint.enough]
    say(f"{seconds:.0f} s: {len(shown) - len(lacking)} of {len(shown)} joints have shown enough")
    for joint in lacking[:SHOWN_JOINTS]:
        say(f"  {joint}")
