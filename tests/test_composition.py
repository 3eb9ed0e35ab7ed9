"""Monitors are a model under a detection: any two go together, with a threshold for every rate, and old files load."""

from __future__ import annotations

import numpy as np
import pytest

from asm_gym.checkpoint import read_checkpoint
from asm_gym.data.episode import Episode
from asm_gym.detection import EvidenceDetection, ModelOutput
from asm_gym.detection.conformal import episode_threshold
from asm_gym.detection.scores import AVERAGED_ROWS, Largest, Mahalanobis, MovingMean, Squares
from asm_gym.monitors import (
    DETECTIONS,
    MONITORS,
    CalibratedMonitor,
    load_monitor,
    make_monitor,
    monitor_class,
    register_monitor,
)
from asm_gym.monitors.calibration import blind_to
from asm_gym.scaling import StreamScaler
from tests.models import Persistence
from tests.streams import frozen, sine_episodes, sine_spec


@pytest.fixture
def persistence():
    register_monitor("persistence", Persistence, detection="mahalanobis")
    yield
    del MONITORS["persistence"], MONITORS["persistence+evidence"]


@pytest.fixture(scope="module")
def kalman():
    return (
        make_monitor("kalman", sine_spec())
        .fit(sine_episodes(30))
        .calibrate(sine_episodes(60, 1), 0.05)
    )


def uncalibrated(monitor):
    return make_monitor("kalman", sine_spec()).restore_learned(monitor.learned_)


@pytest.mark.parametrize("detection", DETECTIONS)
def test_any_model_goes_under_any_detection(detection):
    monitor = make_monitor(f"kalman+{detection}", sine_spec()).fit(sine_episodes(30))
    monitor.calibrate(sine_episodes(60, 1), 0.05)
    surprise = monitor.score(frozen(sine_episodes(1, 2)[0], 3, 20))
    np.testing.assert_allclose(surprise.attribution.sum(axis=1), surprise.value)
    alarms = np.mean(
        [s.value.max() > monitor.threshold for s in monitor.score_episodes(sine_episodes(100, 3))]
    )
    assert alarms < 0.05 + 3 * np.sqrt(0.05 * 0.95 * (1 / 60 + 1 / 100))


def test_a_name_with_a_plus_is_a_model_under_a_detection():
    for name, detection in (("kalman+evidence", "evidence"), ("kalman+squares", "squares")):
        assert monitor_class(name).detection == detection
    assert make_monitor("kalman+evidence", sine_spec()).detection.name == "evidence"
    with pytest.raises(ValueError, match="unknown detection 'oracle'; known: evidence"):
        make_monitor("kalman+oracle", sine_spec())
    with pytest.raises(ValueError, match="unknown monitor 'oracle"):
        make_monitor("oracle+evidence", sine_spec())


def test_a_monitor_that_is_more_than_a_model_keeps_its_detection():
    assert make_monitor("neural_asm+evidence", sine_spec()).detection.name == "evidence"
    with pytest.raises(ValueError, match="unknown detection of neural_asm 'squares'"):
        make_monitor("neural_asm+squares", sine_spec())


def test_a_model_of_ones_own_is_registered_by_one_call(persistence, tmp_path):
    monitor = make_monitor("persistence+evidence", sine_spec(), margin=2.0, gains=(0.5,))
    monitor.fit(sine_episodes(30)).calibrate(sine_episodes(40, 1), 0.05).save(tmp_path / "p.asm")
    loaded = load_monitor(tmp_path / "p.asm")
    assert loaded.get_params() == monitor.get_params()
    episode = sine_episodes(1, 2)[0]
    np.testing.assert_array_equal(loaded.score(episode).value, monitor.score(episode).value)
    with pytest.raises(ValueError, match="'persistence' already"):
        register_monitor("persistence", Persistence)
    with pytest.raises(ValueError, match="of the kind 'persistence', got the name 'other'"):
        register_monitor("other", Persistence)
    with pytest.raises(ValueError, match=r"'margins'.*did you mean 'margin'"):
        make_monitor("persistence", sine_spec(), margins=1.0)


def test_a_file_of_a_model_that_is_not_registered_says_so(tmp_path):
    monitor = CalibratedMonitor(Persistence(sine_spec()), Squares(sine_spec())).fit(
        sine_episodes(5)
    )
    monitor.save(tmp_path / "p.asm")
    with pytest.raises(ValueError, match="unknown monitor 'persistence'; known: neural_asm"):
        load_monitor(tmp_path / "p.asm")


def test_two_parts_must_not_learn_arrays_of_one_name():
    class Careless(Persistence):
        def fit(self, episodes, rng, progress):
            return self.restore({"spread": np.ones(12), "tail": np.ones(12)})

    with pytest.raises(ValueError, match="tail"):
        CalibratedMonitor(Careless(sine_spec()), EvidenceDetection(sine_spec())).fit(
            sine_episodes(5)
        )


def test_the_threshold_at_any_rate_is_that_of_the_kept_maxima(kalman, tmp_path):
    maxima = np.array([s.value.max() for s in kalman.score_episodes(sine_episodes(60, 1))])
    kalman.save(tmp_path / "k.asm")
    for monitor in (kalman, load_monitor(tmp_path / "k.asm")):
        for rate in (0.02, 0.05, 0.3):
            assert monitor.threshold_at(rate) == episode_threshold(maxima, rate)
        with pytest.raises(
            ValueError, match=r"rate of 0\.01 needs at least 99 nominal episodes, got 60"
        ):
            monitor.threshold_at(0.01)
        with pytest.raises(
            ValueError, match=r"false_alarm_rate must be a number in \(0, 1\), got 2"
        ):
            monitor.threshold_at(2.0)
    with pytest.raises(RuntimeError, match="call calibrate"):
        uncalibrated(kalman).threshold_at(0.05)


def test_another_threshold_and_another_fit_leave_the_first_monitor_as_it_is(kalman):
    episode = sine_episodes(1, 5)[0]
    threshold, before = kalman.threshold, kalman.score(episode).value
    other = kalman.with_threshold(np.inf)
    assert (other.threshold, kalman.threshold) == (np.inf, threshold)
    assert other.threshold_at(0.05) == kalman.threshold_at(0.05)
    other.fit(sine_episodes(8, 9))
    np.testing.assert_array_equal(kalman.score(episode).value, before)
    with pytest.raises(ValueError, match="threshold must be a number, got nan"):
        kalman.with_threshold(np.nan)


def test_a_copy_is_described_on_its_own(kalman):
    other = kalman.with_threshold(np.inf)
    other.about["tasks"] = ["Lift"]
    assert "tasks" not in kalman.about


def test_a_file_without_a_threshold_leaves_none_of_another_calibration(kalman, tmp_path):
    calibrated = kalman.with_threshold(3.0)
    uncalibrated(kalman).save(tmp_path / "other.asm")
    calibrated.restore(read_checkpoint(tmp_path / "other.asm", "kalman"))
    assert calibrated.threshold_ is None
    assert calibrated.maxima_ is None
    assert calibrated.with_threshold(3.0).restore_learned(kalman.learned_).threshold_ is None


def test_scores_of_the_literature_are_what_they_say():
    spec, place = sine_spec(2, 0), lambda parts: parts
    output = ModelOutput(np.array([[3.0, -4.0]], np.float32), np.zeros((1, 0)))
    rows = np.zeros((1, 2))
    assert Squares(spec).attribute_step((), output, rows, place)[1].tolist() == [[9.0, 16.0]]
    assert Largest(spec).attribute_step((), output, rows, place)[1].tolist() == [[0.0, 4.0]]
    white = Mahalanobis(spec).restore({"mahalanobis": np.diag([1.0, 0.5])})
    assert white.attribute_step((), output, rows, place)[1].tolist() == [[9.0, 4.0]]
    mean, state, said = MovingMean(spec), MovingMean(spec).start(1, 2), []
    for n in range(AVERAGED_ROWS + 1):
        state, parts = mean.attribute_step(
            state, ModelOutput(np.full((1, 2), n), output.contexts), rows, place
        )
        said.append(parts[0, 0])
    squares = np.arange(AVERAGED_ROWS + 1) ** 2
    np.testing.assert_allclose(
        said,
        [
            *(np.cumsum(squares) / np.arange(1, AVERAGED_ROWS + 2))[:AVERAGED_ROWS],
            squares[1:].mean(),
        ],
    )


def test_units_of_any_size_make_no_difference():
    episodes, units, values = sine_episodes(12), np.ones(sine_spec().size), []
    units[[0, 1]] = 1e-6, 1e6
    for factor in (1.0, units):
        scaled = [Episode.from_stream(e.stream * factor, e.spec) for e in episodes]
        monitor = make_monitor("association_linear+evidence", sine_spec()).fit(scaled[:10])
        values.append(np.concatenate([s.value for s in monitor.score_episodes(scaled[10:])]))
    np.testing.assert_allclose(values[1], values[0], rtol=0.2)


# ------------------------------------------------------------------ channels that hardly move


def episode(seed: int, fan: float = 0.0, rows: int = 120) -> Episode:
    """Two joints that follow a command, and a temperature that hardly moves."""
    rng = np.random.default_rng(seed)
    command = np.sin(np.outer(np.arange(rows) / 50, [2.0, 3.0]) + rng.uniform(0, 6, 2))
    temperature = 30 + 0.0625 * np.rint(np.arange(rows) / 40 + rng.random())
    still = np.zeros(rows)
    still[rows // 2 :] = fan
    columns = {
        "q": command + 0.01 * rng.normal(size=command.shape),
        "temperature": temperature,
        "fan": still,
    }
    return Episode.from_table(
        columns | {"action": command}, channels=tuple(columns), rate=50.0, success=True
    )


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
    settings = (
        {"epochs": 2, "hidden_size": 16, "association_size": 32} if name == "neural_asm" else {}
    )
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
        assert (
            blind_to(
                monitor.detection, monitor.model.error_columns, monitor.spec, monitor.threshold
            )
            == []
        )


def test_a_threshold_that_no_fault_could_pass_names_the_channels():
    monitor = make_monitor("association_linear+evidence", episode(0).spec).fit(
        [episode(n) for n in range(40)]
    )
    columns = monitor.model.error_columns
    reach = monitor.detection.reach_of(np.arange(len(columns)))
    middle = float(np.sort(reach)[len(reach) // 2])
    blind = blind_to(monitor.detection, columns, monitor.spec, middle)
    assert set(blind) == {
        monitor.spec.labels[columns[k]] for k in range(len(columns)) if reach[k] <= middle
    }
    assert blind_to(object(), columns, monitor.spec, 1e9) == []  # a detection that does not know


class NoModel:
    """Has none of a model's methods."""


def returning(name, change):
    """Return a class of models whose ``predict`` gives ``change(state, output)``."""

    def predict(self, state, rows):
        return change(*Persistence.predict(self, state, rows))

    return type(name, (Persistence,), {"kind": name, "predict": predict})


Lopsided = returning(
    "lopsided", lambda state, output: (state, output._replace(errors=output.errors[:, 1:]))
)
Stateless = returning("stateless", lambda state, output: output)
NotFinite = returning(
    "not_finite", lambda state, output: (state, output._replace(errors=output.errors * np.nan))
)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("NoModel", "is no model: derive from"),
        ("Lopsided", r"predict of lopsided must give errors \(\d+, 12\), got \(\d+, 11\)"),
        ("Stateless", "must give a state and a ModelOutput, got ModelOutput"),
        ("NotFinite", "must give errors that are finite where the rows are"),
    ],
)
def test_a_class_that_is_no_proper_model_is_refused_in_a_line(name, message):
    before = dict(MONITORS)
    try:
        with pytest.raises(ValueError, match=message):
            make_monitor(f"tests.test_composition:{name}", sine_spec()).fit(sine_episodes(20))
    finally:
        MONITORS.clear()
        MONITORS.update(before)
