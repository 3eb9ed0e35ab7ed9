"""Calibration: the law of alarms, promises by the hour, crashes, and episodes learned from."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import betabinom

from asm_gym.data.crashes import crashes
from asm_gym.data.episode import Episode, EpisodeLabel
from asm_gym.detection import conformal_threshold
from asm_gym.detection.conformal import episode_threshold
from asm_gym.monitors import CalibratedMonitor, load_monitor, make_monitor
from asm_gym.spec import MOTOR, Channel, StreamSpec

SPEC = StreamSpec((Channel("sense", 3, group="a"), Channel("action", 2, group=MOTOR)), dt=0.05)


def episode(seed: int, steps: int = 120) -> Episode:
    rng = np.random.default_rng(seed)
    course = np.cumsum(rng.normal(size=(steps, 5)), axis=0)
    return Episode.from_stream(course + rng.normal(size=(steps, 5)), SPEC)


@pytest.fixture(scope="module")
def monitor() -> CalibratedMonitor:
    return make_monitor("association_linear+evidence", SPEC).fit([episode(n) for n in range(30)])


NOMINAL = [episode(1000 + n, 600) for n in range(120)]  # one hour
HOUR = 120 * 600 * SPEC.dt / 3600


def test_a_promise_by_the_hour_is_kept_saved_and_loaded(monitor, tmp_path):
    asm = monitor.calibrate(NOMINAL, false_alarms_per_hour=3.0)
    assert HOUR == 1.0
    maxima = np.sort([s.value.max() for s in asm.score_episodes(NOMINAL)])
    # three of 120 are few: by their tail
    assert asm.threshold == pytest.approx(episode_threshold(maxima, 3.0 / 120))
    assert asm.promise[:2] == (120, pytest.approx(3.0))
    assert asm.promise.modelled
    assert (asm.promise.per, asm.promise.hours) == ("hour", pytest.approx(1.0))
    asm.save(tmp_path / "by_hour.asm")
    again = load_monitor(tmp_path / "by_hour.asm")
    assert (again.threshold, again.promise) == (asm.threshold, asm.promise)
    # five may exceed it: 5 + 1 <= 6 * 1 h
    assert again.threshold_at(false_alarms_per_hour=6.0) == maxima[-6]
    assert again.threshold_at(0.05) == asm.threshold_at(false_alarm_rate=0.05)
    assert monitor.calibrate(NOMINAL, 0.05).promise.per == "episode"


@pytest.mark.parametrize(
    ("episodes", "asked", "message"),
    [
        (NOMINAL, {}, "give either false_alarm_rate .* or false_alarms_per_hour .*, got neither"),
        (
            NOMINAL,
            {"false_alarm_rate": 0.1, "false_alarms_per_hour": 1.0},
            "give either .* got both",
        ),
        (
            NOMINAL[:30],
            {"false_alarms_per_hour": 1.0},
            "got 0.25: record 0.75 hours more, or promise 4",
        ),
        (
            NOMINAL,
            {"false_alarms_per_hour": -2.0},
            r"must be a number in \[1e-06, 1e\+06\], got -2",
        ),
        ([*NOMINAL, NOMINAL[7]], {"false_alarms_per_hour": 1.0}, "episodes 120, .* episodes 7"),
        ([*NOMINAL, NOMINAL[7], NOMINAL[7]], {"false_alarm_rate": 0.1}, "episodes 120, 121"),
        ([*NOMINAL, episode(3)], {"false_alarms_per_hour": 1.0}, "learned from.* episodes 120"),
        ([episode(3), *NOMINAL, episode(4)], {"false_alarm_rate": 0.1}, "from.* episodes 0, 121"),
    ],
)
def test_what_cannot_be_promised_is_refused_in_a_line_and_nothing_changes(
    monitor, episodes, asked, message
):
    monitor.calibrate(NOMINAL, false_alarms_per_hour=2.0)
    before = monitor.threshold, monitor.promise
    with pytest.raises(ValueError, match=message) as refused:
        monitor.calibrate(episodes, **asked)
    assert "\n" not in str(refused.value)
    assert (monitor.threshold, monitor.promise) == before


def test_episodes_that_were_learned_from_are_refused_after_saving_too(monitor, tmp_path):
    monitor.calibrate(NOMINAL, 0.1).save(tmp_path / "saved.asm")
    again = load_monitor(tmp_path / "saved.asm")
    with pytest.raises(ValueError, match="learned from"):
        again.calibrate([*NOMINAL, episode(3)], 0.1)
    assert again.calibrate(NOMINAL[1:], 0.1).promise.episodes == 119

    again.learned_from_ = None  # as in a file from before hashes were kept
    again.save(tmp_path / "old.asm")
    old = load_monitor(tmp_path / "old.asm")
    assert old.calibrate([*NOMINAL, episode(3)], 0.1).promise.episodes == 121


ARM = StreamSpec((Channel("joint", 2, "rad"), Channel("external_torque", 2, "N m")), dt=0.05)
ROWS = 40


def pressing(seed: int, force: float | None = None, task: str = "") -> Episode:
    """Two joints that wander, and torques of about 1 N m."""
    rng = np.random.default_rng(seed)
    stream = np.hstack(
        [np.cumsum(rng.normal(size=(ROWS, 2)), axis=0), rng.normal(size=(ROWS, 2)).clip(-2, 2)]
    )
    felt = {} if force is None else {"contact_force": np.full(ROWS, force, np.float32)}
    return Episode.from_stream(
        stream, ARM, label=EpisodeLabel(task, "nominal") if task else None, **felt
    )


CALM = [pressing(100 + n) for n in range(40)]


def test_what_presses_twice_as_hard_as_usual_is_a_crash_in_its_own_task():
    light, heavy = (
        [pressing(n, force=10, task="Lift") for n in range(5)],
        [pressing(9, force=50, task="Nut")] * 5,
    )
    hit = pressing(7, force=45, task="Lift")
    tasks = [e.labelled.task for e in [*light, *heavy, hit]]
    assert crashes([*light, *heavy, hit], tasks) == {10: pytest.approx(4.5)}
    assert crashes([*light, *heavy], tasks[:-1]) == {}
    assert crashes(CALM, [""] * 40) == {}  # no force was measured


RATES = (0.01, 0.05, 0.2)


def surprise(rng: np.random.Generator, episodes: int) -> np.ndarray:
    """(episodes,) the largest of some heavy-tailed, dependent values in each."""
    walks = rng.standard_t(2, size=(episodes, 30)).cumsum(axis=1)
    return np.abs(walks).max(axis=1)


@pytest.mark.parametrize("rate", RATES)
def test_the_number_of_alarms_is_beta_binomial_whatever_the_surprise(rate):
    rng, n, fresh = np.random.default_rng(0), 199, 300
    counts = []
    for _ in range(1500):
        threshold = conformal_threshold(surprise(rng, n), rate)
        counts.append(int((surprise(rng, fresh) > threshold).sum()))
    law = betabinom(fresh, rate * (n + 1), (1 - rate) * (n + 1))
    spread = law.std() / np.sqrt(len(counts))
    assert np.mean(counts) / fresh == pytest.approx(rate, abs=4 * spread / fresh)
    for quantile in (0.1, 0.5, 0.9):
        at_most = np.mean(np.array(counts) <= law.ppf(quantile))
        assert at_most == pytest.approx(
            law.cdf(law.ppf(quantile)), abs=4 * np.sqrt(0.25 / len(counts))
        )
