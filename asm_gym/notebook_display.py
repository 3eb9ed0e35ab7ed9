"""Small pictures for notebooks: lines over time as SVG, of nothing but text."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from typing import Any

import numpy as np
from numpy.typing import NDArray

WIDTH, HEIGHT, MOST = 320, 36, 8
"""Of one line [px], and how many are drawn."""
LINE = "#0072B2"


def lines_over_time(title: str, lines: Mapping[str, NDArray[Any]], dt: float = 0.0, marked: Any = None) -> str:
    """HTML with a line for each name, of (T,) numbers; the first ``MOST`` of them.

    Args:
        title: above them.
        dt: between two numbers [s]; 0 where nobody knows.
        marked: (T,) bool, where the background is red: faults, or alarms.
    """
    rows = [_row(name, np.asarray(values, np.float64), marked) for name, values in list(lines.items())[:MOST]]
    left = f"<div>… and {len(lines) - MOST} more</div>" if len(lines) > MOST else ""
    length = max((len(v) for v in lines.values()), default=0)
    until = f"<div>0 to {length * dt:.2f} s</div>" if dt else ""
    return f"<div><b>{escape(title)}</b><table>{''.join(rows)}</table>{until}{left}</div>"


def _row(name: str, values: NDArray[np.float64], marked: Any) -> str:
    finite = values[np.isfinite(values)]
    low, high = (float(finite.min()), float(finite.max())) if len(finite) else (0.0, 0.0)
    x = np.linspace(0, WIDTH, max(len(values), 2))[: len(values)]
    y = (
        HEIGHT
        - 2
        - (HEIGHT - 4) * (np.nan_to_num(values, nan=low, posinf=high, neginf=low) - low) / ((high - low) or 1.0)
    )
    points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True))
    width = WIDTH / max(len(values), 1)
    red = "".join(
        f'<rect x="{width * k:.1f}" width="{width:.1f}" height="{HEIGHT}" fill="#D55E0033"/>'
        for k in np.flatnonzero(np.zeros(0) if marked is None else np.asarray(marked)[: len(values)])
    )
    drawn = f'{red}<polyline points="{points}" fill="none" stroke="{LINE}"/>'
    svg = f'<svg xmlns="http://www.w3.org/2000/svg" width="{WIDTH}" height="{HEIGHT}" role="img">{drawn}</svg>'
    return f"<tr><td>{escape(name)}</td><td>{svg}</td><td>{low:.3g} … {high:.3g}</td></tr>"
