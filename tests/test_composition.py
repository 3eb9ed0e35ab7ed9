"""Monitors are a model under a detection: any two go together, with a threshold for every rate, and old files load."""

from __future__ import annotations

import json
import subprocess
import sys
import zipfile

import numpy as np
import pytest

from asm_gym.detection import EvidenceDetection, ModelOutput, conformal_threshold
from asm_gym.detection.scores import WINDOW, Largest, Mahalanobis, MovingMean, Squares
from asm_gym.monitors import (
    DETECTIONS,
    MONITORS,
    CalibratedMonitor,
    NeuralASM,
    load_monitor,
    make_monitor,
    monitor_class,
    register_monitor,
)
from tests.models import Persistence
from tests.streams import frozen, sine_episodes, sine_spec


@pytest.fixture
def persistence():
    register_monitor("persistence", Persistence, detection="mahalanobis")
    yield
    del MONITORS["persistence"], MONITORS["persistence+evidence"]


@pytest.fixture(scope="module")
def kalman():
    return make_monitor("kalman", sine_spec()).fit(sine_episodes(30)).calibrate(sine_episodes(60, 1), 0.05)


@pytest.mark.parametrize("detection", [d for d in DETECTIONS if d != "latent_threshold"])
def test_any_model_goes_under_any_detection(detection):
    monitor = make_monitor("kalman", sine_spec(), detection=detection).fit(sine_episodes(30))
    monitor.calibrate(sine_episodes(60, 1), 0.05)
    surprise = monitor.score(frozen(sine_episodes(1, 2)[0], 3, 20))
    np.testing.assert_allclose(surprise.attribution.sum(axis=1), surprise.value)
    alarms = np.mean([s.value.max() > monitor.threshold for s in monitor.score_episodes(sine_episodes(100, 3))])
    assert alarms < 0.05 + 3 * np.sqrt(0.05 * 0.95 * (1 / 60 + 1 / 100))


def test_a_name_with_a_plus_is_a_model_under_a_detection():
    for name, detection in (("kalman+evidence", "evidence"), ("force_limit+squares", "squares")):
        assert monitor_class(name).detection == detection
    assert make_monitor("kalman+evidence", sine_spec()).detection.name == "evidence"
    assert make_monitor("kalman", sine_spec(), detection="evidence").detection.name == "evidence"
    with pytest.raises(ValueError, match="unknown detection 'oracle'; known: evidence"):
        make_monitor("kalman+oracle", sine_spec())
    with pytest.raises(ValueError, match="unknown monitor 'oracle"):
        make_monitor("oracle+evidence", sine_spec())


def test_one_fit_serves_the_score_of_the_authors_and_the_evidence(kalman):
    evidence = kalman.with_detection("evidence")
    with pytest.raises(RuntimeError, match="no threshold"):
        _ = evidence.threshold
    fitted = make_monitor("kalman+evidence", sine_spec()).fit(sine_episodes(30))
    episode = sine_episodes(1, 4)[0]
    np.testing.assert_array_equal(evidence.score(episode).value, fitted.score(episode).value)
    assert kalman.detection.name == "mahalanobis"
    assert kalman.threshold > 0
    assert json.dumps(kalman.get_params()) == json.dumps(fitted.get_params())  # runs keep fitted monitors by these


def test_a_file_that_was_calibrated_for_one_detection_has_no_threshold_under_another(kalman, tmp_path):
    kalman.save(tmp_path / "k.asm")
    assert monitor_class("kalman").load(tmp_path / "k.asm").threshold == kalman.threshold
    other = monitor_class("kalman+evidence").load(tmp_path / "k.asm")
    with pytest.raises(RuntimeError, match="no threshold"):
        _ = other.threshold


def test_a_model_of_ones_own_is_registered_by_one_call(persistence, tmp_path):
    monitor = make_monitor("persistence+evidence", sine_spec(), margin=2.0, gains=(0.5,))
    monitor.fit(sine_episodes(30)).calibrate(sine_episodes(40, 1), 0.05).save(tmp_path / "p.asm")
    loaded = load_monitor(tmp_path / "p.asm")
    kept = {
        "margin": 2.0,
        "gains": (0.5,),
        "bound": 100.0,
        "shrinkage": 1e-3,
        "habituates": True,
        "tail_index": 0.3,
        "seed": 0,
    }
    assert loaded.get_params() == kept
    episode = sine_episodes(1, 2)[0]
    np.testing.assert_array_equal(loaded.score(episode).value, monitor.score(episode).value)
    with pytest.raises(ValueError, match="'persistence' already"):
        register_monitor("persistence", Persistence)
    with pytest.raises(ValueError, match="of the kind 'persistence', got the name 'other'"):
        register_monitor("other", Persistence)
    with pytest.raises(ValueError, match=r"'margins'.*did you mean 'margin'"):
        make_monitor("persistence", sine_spec(), margins=1.0)


def test_a_file_of_a_model_that_is_not_registered_says_so(tmp_path):
    monitor = CalibratedMonitor(Persistence(sine_spec()), Squares(sine_spec())).fit(sine_episodes(5))
    monitor.save(tmp_path / "p.asm")
    with pytest.raises(ValueError, match="unknown monitor 'persistence'; known: neural_asm"):
        load_monitor(tmp_path / "p.asm")


def test_two_parts_must_not_learn_arrays_of_one_name():
    class Careless(Persistence):
        def fit(self, episodes, rng, progress):
            return self.restore({"spread": np.ones(12), "tail": np.ones(12)})

    with pytest.raises(ValueError, match="tail"):
        CalibratedMonitor(Careless(sine_spec()), EvidenceDetection(sine_spec())).fit(sine_episodes(5))


def test_the_threshold_at_any_rate_is_the_conformal_rank_of_the_kept_maxima(kalman, tmp_path):
    maxima = np.array([s.value.max() for s in kalman.score_episodes(sine_episodes(60, 1))])
    kalman.save(tmp_path / "k.asm")
    for monitor in (kalman, load_monitor(tmp_path / "k.asm")):
        for rate in (0.02, 0.05, 0.3):
            assert monitor.threshold_at(rate) == conformal_threshold(maxima, rate)
        with pytest.raises(ValueError, match=r"rate of 0\.01 needs at least 99 nominal episodes, got 60"):
            monitor.threshold_at(0.01)
        with pytest.raises(ValueError, match=r"false_alarm_rate must be a number in \(0, 1\), got 2"):
            monitor.threshold_at(2.0)
    with pytest.raises(RuntimeError, match="call calibrate"):
        kalman.with_detection("evidence").threshold_at(0.05)


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


def test_a_copy_does_not_learn_on_the_job_of_its_original():
    asm = NeuralASM(sine_spec(), hidden_size=8, association_size=24, epochs=2).fit(sine_episodes(20))
    asm.calibrate(sine_episodes(20, 1), 0.05)
    copy, episode = asm.with_threshold(np.inf), sine_episodes(1, 2)[0]
    before, state = asm.score(episode).value, copy.initial_state()
    for row in episode.stream:
        last = state
        state, surprise = copy.observe(last, row[None])
        copy.adapt(last, row[None], surprise, rate=0.5)
    np.testing.assert_array_equal(asm.score(episode).value, before)
    assert np.abs(copy.score(episode).value[1:] / before[1:] - 1).max() > 0.01


def test_scores_of_the_literature_are_what_they_say():
    spec, place = sine_spec(2, 0), lambda parts: parts
    output = ModelOutput(np.array([[3.0, -4.0]], np.float32), np.zeros((1, 0)))
    rows = np.zeros((1, 2))
    assert Squares(spec).attribute_step((), output, rows, place)[1].tolist() == [[9.0, 16.0]]
    assert Largest(spec).attribute_step((), output, rows, place)[1].tolist() == [[0.0, 4.0]]
    white = Mahalanobis(spec).restore({"mahalanobis": np.diag([1.0, 0.5])})
    assert white.attribute_step((), output, rows, place)[1].tolist() == [[9.0, 4.0]]
    mean, state, said = MovingMean(spec), MovingMean(spec).start(1, 2), []
    for n in range(WINDOW + 1):
        state, parts = mean.attribute_step(state, ModelOutput(np.full((1, 2), n), output.contexts), rows, place)
        said.append(parts[0, 0])
    squares = np.arange(WINDOW + 1) ** 2
    np.testing.assert_allclose(said, [*(np.cumsum(squares) / np.arange(1, WINDOW + 2))[:WINDOW], squares[1:].mean()])


def test_errors_of_no_channel_are_shared_out_among_the_senses_alone(kalman):
    class Nowhere(Persistence):
        @property
        def error_columns(self):
            return np.array([0, *np.full(11, -1)])

    monitor = CalibratedMonitor(Nowhere(sine_spec()), Squares(sine_spec())).fit(sine_episodes(5))
    episode = sine_episodes(1, 3)[0]
    errors = np.diff(episode.stream[:, :12].astype(float), axis=0) / monitor.learned_["spread"]
    attribution = monitor.score(episode).attribution[1:]
    np.testing.assert_allclose(attribution[:, 1:12], (errors[:, 1:] ** 2).sum(axis=1)[:, None].repeat(11, 1) / 12)
    np.testing.assert_allclose(attribution.sum(axis=1), (errors**2).sum(axis=1))
    assert not attribution[:, 12:].any()


def test_a_file_keeps_the_maxima_beside_what_was_learned(kalman, tmp_path):
    kalman.save(tmp_path / "k.asm")
    with zipfile.ZipFile(tmp_path / "k.asm") as file:
        header = json.loads(file.read("header.json"))
    assert header["shapes"]["nominal_maxima"] == [60]
    assert header["detection"] == "mahalanobis"


def test_monitors_that_need_no_torch_do_not_import_it():
    code = (
        "import sys; from asm_gym.monitors import make_monitor; from tests.streams import sine_spec;"
        "make_monitor('neural_asm', sine_spec()); make_monitor('kalman+evidence', sine_spec());"
        "sys.exit(' '.join({'torch', 'sklearn', 'mujoco', 'robosuite'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stderr.strip() == ""
