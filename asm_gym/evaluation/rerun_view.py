"""Write scored episodes for Rerun's viewer: senses and predictions, surprise, threshold, shares and alarms.

    senses/<channel>/sensed, expected, low, high     each number; the band is two standard deviations wide on each side
    surprise, threshold                              an alarm is a surprise above the threshold
    shares/<channel>                                 what each channel adds to surprise
    log                                              the alarms

Open it by ``rerun FILE.rrd``. Predictions are those of the memory's completion, each sense from all others.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from asm_gym.evaluation.alarms import alarms_of
from asm_gym.evaluation.scored_episode import ScoredEpisode
from asm_gym.extras import require
from asm_gym.memory.completion import Completion
from asm_gym.spec import StreamSpec

BAND = 2.0
"""Standard deviations."""


def write_rerun(path: Path, spec: StreamSpec, traces: Sequence[ScoredEpisode], model: object = None) -> None:
    """Write episodes, one after another, to a ``.rrd`` file, in place of what is there.

    Raises:
        ImportError: rerun-sdk is not installed.
    """
    rr = require("rerun", what="a recording for Rerun's viewer")
    completion: Completion | None = getattr(model, "completion_", None)
    path.parent.mkdir(parents=True, exist_ok=True)
    recording = rr.RecordingStream("asm-gym")
    recording.save(path)
    begin = 0.0
    for trace in traces:
        assert trace.detail is not None
        assert trace.detail.stream is not None
        index = rr.TimeColumn("time", duration=begin + (np.arange(len(trace)) + 1) * trace.dt)
        stream = trace.detail.stream.astype(np.float64)
        lines = {"sensed": stream} | (_predicted(completion, stream) if completion else {})
        columns = {"surprise": trace.surprise, "threshold": np.full(len(trace), trace.threshold)}
        for channel in spec.channels:
            place = spec.slices[channel.name]
            columns |= {f"senses/{channel.name}/{what}": values[:, place] for what, values in lines.items()}
            columns[f"shares/{channel.name}"] = trace.detail.attribution[:, place].sum(axis=1)
        for entity, values in columns.items():
            rr.send_columns(entity, [index], rr.Scalars.columns(scalars=values), recording=recording)
        for alarm in alarms_of(trace):
            recording.set_time("time", duration=begin + alarm.start)
            what = f"alarm: {alarm.channel or alarm.why}, {alarm.excess:.2f} thresholds"
            recording.log("log", rr.TextLog(what, level="WARN"))
        begin += len(trace) * trace.dt
    recording.flush()
    recording.disconnect()


def _predicted(completion: Completion, stream: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
    """Return prediction and band of every number (T, D); actions are their own prediction."""
    expected, band = stream.copy(), np.zeros_like(stream)
    sensory, spread = completion.spec.sensory, completion.senses.spread[completion.spec.sensory]
    expected[:, sensory] -= completion.unexplained(completion.lift(stream)) * spread
    band[:, sensory] = BAND * completion.error[sensory] * spread
    return {"expected": expected, "low": expected - band, "high": expected + band}
