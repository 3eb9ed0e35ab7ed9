"""The style of figures; nothing touches pyplot's state.

Colours are those of Okabe & Ito, distinct with any colour vision; line styles and markers differ too.
"""

from __future__ import annotations

from collections.abc import Iterator, Sized
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure

BLUE, VERMILLION, GREEN, PURPLE = "#0072B2", "#D55E00", "#009E73", "#CC79A7"
ORANGE, SKY, BLACK, GREY = "#E69F00", "#56B4E9", "#000000", "#888888"
DASHED = (0, (4, 2))
_COLOURS = (BLUE, VERMILLION, GREEN, PURPLE, BLACK, SKY)
_LINES: tuple[Any, ...] = ("-", (0, (6, 2)), (0, (2, 1.5)), (0, (6, 2, 1, 2)), (0, (1, 1)), (0, (8, 2, 2, 2, 2, 2)))
_MARKERS = ("o", "s", "^", "D", "v", "P")
_STYLE: dict[Any, Any] = {
    "font.size": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#555555",
    "axes.titlesize": 10,
    "axes.titlelocation": "left",
    "grid.color": "#dddddd",
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "figure.facecolor": "white",
    "axes.facecolor": "white",
}


@contextmanager
def figure(height: float, width: float = 8.0) -> Iterator[Figure]:
    """Make a figure in the style above, whatever the user's matplotlibrc says; sizes in [in]."""
    with mpl.rc_context():
        mpl.rcdefaults()
        mpl.rcParams.update(_STYLE)
        yield Figure(figsize=(width, height), layout="constrained")


def save(fig: Figure, path: str | Path) -> Path:
    """Write a PNG at 150 dpi; the same figure gives the same bytes."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    fig.savefig(path, format="png", dpi=150, metadata={"Software": None})
    return path


def look(i: int) -> tuple[str, Any, str]:
    """Return colour, line style and marker of the i-th curve."""
    n = len(_COLOURS)
    return _COLOURS[i % n], _LINES[(i + i // n) % n], _MARKERS[(i + i // n) % n]


def require_some(traces: Sized) -> None:
    """Raise ValueError where there are none."""
    if not len(traces):
        raise ValueError("there are no traces to draw")
