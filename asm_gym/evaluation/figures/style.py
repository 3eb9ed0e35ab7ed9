"""How figures look; nothing touches pyplot's state.

Colours are those of Okabe & Ito, chosen to be told apart with any colour vision; line styles and markers differ too.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence, Sized
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

BLUE, VERMILLION, GREEN, PURPLE, ORANGE, SKY, BLACK = (
    "#0072B2",
    "#D55E00",
    "#009E73",
    "#CC79A7",
    "#E69F00",
    "#56B4E9",
    "#000000",
)
_COLOURS = (BLUE, VERMILLION, GREEN, PURPLE, BLACK, SKY)
_LINES: tuple[Any, ...] = ("-", (0, (6, 2)), (0, (2, 1.5)), (0, (6, 2, 1, 2)), (0, (1, 1)), (0, (8, 2, 2, 2, 2, 2)))
_MARKERS = ("o", "s", "^", "D", "v", "P")
_WIDTH = 8.0  # [in]
_STYLE: dict[Any, Any] = {
    "font.size": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#555555",
    "axes.titlesize": 10,
    "axes.titlelocation": "left",
    "legend.frameon": False,
    "figure.facecolor": "white",
    "axes.facecolor": "white",
}


SAYS = "says: "
"""Begins the id of what is not seen, and says the rest where a pointer is over it."""

_MOST_SAID = 200


def says(ax: Axes, ends: NDArray[np.float64], texts: Sequence[str]) -> None:
    """What a report says where a pointer is over a panel: a text for each span of time, from ``ends[i]`` on.

    Of more than a few hundred, some are said.
    """
    every = max(1, len(texts) // _MOST_SAID)
    for i in range(0, len(texts), every):
        ax.axvspan(ends[i], ends[min(i + every, len(ends) - 1)], alpha=0, linewidth=0, gid=SAYS + texts[i])


@contextmanager
def figure(height: float, width: float = _WIDTH) -> Iterator[Figure]:
    """A figure in the style above, whatever the user's matplotlibrc says; sizes in [in]."""
    with mpl.rc_context():
        mpl.rcdefaults()
        mpl.rcParams.update(_STYLE)
        yield Figure(figsize=(width, height), layout="constrained")


def save(fig: Figure, path: str | Path) -> Path:
    """Writes a PNG at 150 dpi; the same figure gives the same bytes."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    fig.savefig(path, format="png", dpi=150, metadata={"Software": None})
    return path


def look(i: int) -> tuple[str, Any, str]:
    """Colour, line style and marker of the i-th curve."""
    n = len(_COLOURS)
    return _COLOURS[i % n], _LINES[(i + i // n) % n], _MARKERS[(i + i // n) % n]


def require_some(traces: Sized) -> None:
    """Raises ValueError where there are none."""
    if not len(traces):
        raise ValueError("there are no traces to draw")
