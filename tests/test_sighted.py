"""Channels that hardly move make no threshold that nothing else could pass, or are named where they do."""

from __future__ import annotations

import numpy as np
import pytest

from asm_gym.episode import Episode
from asm_gym.monitors import make_monitor
from asm_gym.monitors.calibration import blind_to
from asm_gym.scaling import StreamScaler


def episode(seed: int, fan: float = 0.0, rows: int = 120) -> Episode:
    """Two joints that follow a command, and a temperature that hardly moves."""
    rng = np.random.default_rng(seed)
    command = np.sin(np.outer(np.arange(rows) / 50, [2.0, 3.0]) + rng.uniform(0, 6, 2))
    temperature = 30 + 0.0625 * np.rint(np.arange(rows) / 40 + rng.random())
    still = np.zeros(rows)
    still[rows // 2 :] = fan
    columns = {"q": command + 0.01 * rng.normal(size=command.shape), "temperature": temperature, "fan": still}
    return Episode.from_table(columns | {"action": command}, rate=50.0, success=True)


def test_a_rounded_channel_changes_by_no_less_than_its_rounding():
    spec = episode(0).spec
    rng = np.random.default_rng(0)
    long = np.zeros((20_000, spec.size), np.float32)
    long[:, :2] = np.cumsum(rng.normal(size=(20_000, 2)), axis=0)
    long[:, 2] = 30 + 0.0625 * np.floor(np.arange(20_000) / 500)
    scaler = StreamScaler.fit(spec, [long])
    assert scaler.change[2] == pytest.approx(np.sqrt(2 / 12) * 0.0625, rel=0.01)
    assert np.diff(long[:, 2]).std() < 0.2 * scaler.change[2]


@pytest.mark.parametrize("name", ["association_linear+evidence", "neural_asm"])
def test_a_channel_that_moves_for_the_first_time_while_calibrating_is_named(name):
    settings = {"epochs": 2, "hidden_size": 16, "association_size": 32} if name == "neural_asm" else {}
    monitor = make_monitor(name, episode(0).spec, **settings).fit([episode(n) for n in range(40)])
    quiet = [episode(n) for n in range(100, 130)]
    threshold = monitor.calibrate(quiet, 0.05).threshold
    assert threshold < 1e3
    assert blind_to(monitor.detection, monitor.model.error_columns, monitor.spec, threshold) == []
    before = monitor.threshold
    wild = [episode(n, fan=1e6) for n in range(100, 130)]
    try:
        monitor.calibrate(wild, 0.05)
    except ValueError as error:
        refused = str(error)
        assert "no fault of" in refused
        assert "q[0]" in refused
        assert monitor.threshold == before
    else:
        assert monitor.threshold < 1e6  # what it was set by, a fault in any channel passes too
        assert blind_to(monitor.detection, monitor.model.error_columns, monitor.spec, monitor.threshold) == []


def test_a_threshold_that_no_fault_could_pass_names_the_channels():
    monitor = make_monitor("association_linear+evidence", episode(0).spec).fit([episode(n) for n in range(40)])
    columns = monitor.model.error_columns
    reach = monitor.detection.reach_of(np.arange(len(columns)))
    middle = float(np.sort(reach)[len(reach) // 2])
    blind = blind_to(monitor.detection, columns, monitor.spec, middle)
    assert set(blind) == {monitor.spec.labels[columns[k]] for k in range(len(columns)) if reach[k] <= middle}
    assert blind_to(object(), columns, monitor.spec, 1e9) == []  # a detection that does not know
