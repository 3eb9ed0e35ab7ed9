"""How far a model's prediction of each joint's torque is from the measured one.

    r_t = ε_t δ / (ε_t(x_t + δ) - ε_t)      ε: error of the torque x_t, linear in it, by a model that averages nothing

What a model averages over, the tenth of a second for one, residuals are averaged over here.
A model that predicts a torque from its own past has a small residual, and takes over a fault that lasts with that past.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from asm_gym.data.episode import Episode
from asm_gym.evaluation.tables import Table
from asm_gym.monitors import CalibratedMonitor, NeuralASM
from asm_gym.monitors.sight import RANGE
from asm_gym.monitors.stream_model import StreamModel
from asm_gym.monitors.torque.arm_features import torque_columns
from asm_gym.scripts.reproduce import kit
from asm_gym.scripts.reproduce.arm_recordings import ARMS
from asm_gym.scripts.reproduce.kit import Record

Floats = NDArray[np.float64]

RESIDUAL = "residual"  # kind of these records
SETTLED_S = 0.5  # of an episode after which its rows count [s]
NUDGE = 1e-3  # δ, of a torque's range
CHANGES = ", changes"  # ends the name of what a memory expects of changes


def residual_records(monitor: CalibratedMonitor, episodes: Sequence[Episode]) -> list[Record]:
    """Return the residual of each torque in nominal episodes, for each model of a monitor.

    It is the root of the mean square [% of the torque's range].
    """
    rows = np.concatenate([episode.stream for episode in episodes])
    torques = torque_columns(monitor.spec)
    low, high = np.quantile(rows[:, torques].astype(np.float64), RANGE, axis=0)
    models: dict[str, StreamModel] = {"": monitor.model}
    if isinstance(monitor, NeuralASM) and monitor.values_ is not None:
        models = {"": monitor.values_.monitor.model, CHANGES: monitor.model}
    records = []
    for ending, model in models.items():
        parts = [residuals(model, episode, torques, high - low) for episode in episodes]
        of_range = np.sqrt(np.nanmean(np.concatenate(parts) ** 2, axis=0)) / (high - low)
        for joint, share in enumerate(of_range, start=1):
            about = {"joint": str(joint), "residual": 100 * share}
            records.append({"kind": RESIDUAL, "model": ending, **about})
    return records


def residuals(
    model: StreamModel, episode: Episode, torques: NDArray[np.intp], ranges: Floats
) -> Floats:
    """Return the residuals (T', J) of torques (J,) of an episode in their units; NaN where none is predicted."""
    errors_of = np.searchsorted(model.error_columns, torques)
    window = getattr(model, "window", 1)
    model = copy.copy(model)
    vars(model)["window"] = 1
    joint = np.arange(len(torques))
    nudge = NUDGE * ranges
    state = model.start(len(torques))
    found = []
    for row in episode.stream.astype(np.float64):
        rows = np.tile(row, (len(torques), 1))
        nudged = rows.copy()
        nudged[joint, torques] += nudge
        _, output_of_nudged = model.predict(state, nudged)
        state, output = model.predict(state, rows)
        errors = np.asarray(output.errors, np.float64)[joint, errors_of]
        slope = (np.asarray(output_of_nudged.errors)[joint, errors_of] - errors) / nudge
        unknown = np.full_like(errors, np.nan)
        found.append(np.divide(errors, slope, out=unknown, where=slope != 0))
    first = round(SETTLED_S / episode.spec.dt)
    means: Floats = pd.DataFrame(found).rolling(window).mean().to_numpy()
    return means[first:]


def residual_table(records: pd.DataFrame) -> Table:
    """Return the residual of each torque of an arm by monitor [% of its range]."""
    rows = []
    own = records[records.kind == RESIDUAL]
    robot = ARMS[records.experiment.iloc[0]].robot
    for (monitor, model, _), part in own.groupby(["monitor", "model", "minutes"], sort=False):
        row = {"Monitor": f"{monitor}{model}", "learned [min]": f"{part.learned_min.mean():.3g}"}
        for joint, values in part.groupby("joint", sort=False):
            row[joint] = f"{values.residual.mean():.2g}"
        row["mean"] = f"{part.residual.mean():.2g}"
        rows.append(row)
    caption = (
        f"{robot}: residual of each joint's torque in tested pieces, in % of its range. "
        "Of changes, and by a GRU or a Kalman filter, a torque is predicted from its own last one."
    )
    return kit.table_of(caption, rows)
