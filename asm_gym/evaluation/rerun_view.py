"""Write a recording for Rerun's viewer: senses and predictions, surprise, threshold and cause.

    senses/<channel>/sensed, expected, low, high     each number; the band is two standard deviations wide on each side
    surprise, threshold                              what an alarm is raised by
    shares/<channel>                                 what each channel adds to surprise
    log                                              when an alarm began, and its cause

Open it by ``rerun FILE.rrd``. Predictions are those of the memory's completion, each sense from all others.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from asm_gym.extras import require
from asm_gym.memory.completion import Completion
from asm_gym.spec import StreamSpec

BAND = 2.0
"""Standard deviations."""


@runtime_checkable
class Completes(Protocol):
    """A model that predicts each sense from all others."""

    completion_: Completion | None


class LiveView:
    """Write a recording row by row; closing it, or leaving its context, completes the file.

    Args:
        path: of the ``.rrd`` file; in place of what is there.
        spec: of the stream.
        model: of the memory, for its predictions; None, or one that has none, for senses alone.
        channels: names of those that are drawn; all by default.

    Raises:
        ValueError: an unknown channel; the message lists what exists.
        ImportError: rerun-sdk is not installed.
    """

    def __init__(
        self, path: str | Path, spec: StreamSpec, model: object = None, channels: Sequence[str] | None = None
    ) -> None:
        self._rr = require("rerun", what="a live view")
        unknown = [name for name in channels or () if name not in spec.slices]
        if unknown:
            raise ValueError(f"unknown channel {unknown[0]!r}; known: {', '.join(spec.slices)}")
        self.path, self.spec = Path(path), spec
        self._drawn = [c for c in spec.channels if channels is None or c.name in channels]
        self._completion = model.completion_ if isinstance(model, Completes) else None
        self.begin()
        self.path.parent.mkdir(parents=True, exist_ok=True)
        os.environ.setdefault("RERUN_FLUSH_TICK_SECS", "1")  # read by the next line: by default 0.008, a chunk a row
        self._stream = self._rr.RecordingStream("asm-gym")
        self._stream.save(self.path, default_blueprint=self._blueprint())
        for channel in self._drawn:
            for what in ("sensed", "expected", "low", "high") if self._completion else ("sensed",):
                names = [f"{label} {what}" for label in channel.labels]
                self._stream.log(f"senses/{channel.name}/{what}", self._rr.SeriesLines(names=names), static=True)

    def _blueprint(self) -> Any:
        """How the viewer shows it at first."""
        views = require("rerun.blueprint", what="a live view")
        bare = views.PlotLegend(visible=False)  # dozens of names would cover the lines
        senses = [views.TimeSeriesView(name=c.name, origin=f"/senses/{c.name}", plot_legend=bare) for c in self._drawn]
        return views.Blueprint(
            views.Grid(
                views.TimeSeriesView(name="surprise", origin="/", contents=["/surprise", "/threshold"]),
                views.TimeSeriesView(name="shares", origin="/shares", plot_legend=bare),
                views.TextLogView(name="log", origin="/log"),
                *senses,
            )
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def begin(self) -> None:
        """Begin a new episode."""
        self._before: NDArray[np.float64] | None = None
        self._alarm = False

    def row(
        self,
        seconds: float,
        row: NDArray[np.floating[Any]],
        surprise: float,
        threshold: float,
        shares: NDArray[np.floating[Any]],
        cause: Mapping[str, Any] | None = None,
    ) -> None:
        """Write one row and its surprise.

        Args:
            seconds: when it was sensed.
            row: (D,) senses and actions.
            surprise: of the row.
            threshold: that an alarm is over.
            shares: (D,) what each number adds to surprise.
            cause: of an alarm, as in ``info["asm"]["cause"]``.
        """
        rr, log = self._rr, self._stream.log
        self._stream.set_time("time", duration=seconds)
        sensed = np.asarray(row, np.float64)
        lines = {"sensed": sensed} | self._predicted(sensed)
        for channel in self._drawn:
            place = self.spec.slices[channel.name]
            for what, values in lines.items():
                log(f"senses/{channel.name}/{what}", rr.Scalars(values[place]))
            log(f"shares/{channel.name}", rr.Scalars(float(np.sum(shares[place]))))
        log("surprise", rr.Scalars(surprise))
        log("threshold", rr.Scalars(threshold))
        alarm = bool(surprise > threshold)
        if alarm and not self._alarm:
            what = f"alarm: {self.spec.labels[int(np.argmax(shares))]}, {surprise / threshold:.2f} thresholds"
            log("log", rr.TextLog(what + _in_words(cause or {}), level="WARN"))
        self._alarm = alarm

    def _predicted(self, row: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
        """Prediction and band of every number (D,); actions are their own prediction."""
        before, self._before = self._before, row
        memory = self._completion
        if memory is None:
            return {}
        y = memory.lift(np.stack([row if before is None else before, row]))[1:]
        expected, band = row.copy(), np.zeros(len(row))
        sensory, spread = self.spec.sensory, memory.senses.spread
        expected[sensory] = row[sensory] - memory.unexplained(y)[0] * spread[sensory]
        band[sensory] = BAND * memory.error[sensory] * spread[sensory]
        return {"expected": expected, "low": expected - band, "high": expected + band}

    def close(self) -> None:
        """Complete the file."""
        self._stream.flush()
        self._stream.disconnect()


def _in_words(cause: Mapping[str, Any]) -> str:
    """The cause of an alarm; empty where it is unknown."""
    if cause.get("family") in (None, "", "unknown"):
        return ""
    return f"; {' '.join(filter(None, (cause['family'], cause.get('part'))))}, {cause.get('probability', 0.0):.0%}"
