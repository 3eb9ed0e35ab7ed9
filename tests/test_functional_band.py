"""The band in time: its mean and width by hand, its coverage by exchangeable episodes, and what it alone can tell."""

from __future__ import annotations

import numpy as np
import pytest

from asm_gym.detection.base import ModelOutput, Nominal
from asm_gym.detection.functional_band import FunctionalBand, band, moving_score, padded
from asm_gym.monitors import load_monitor, make_monitor
from tests.streams import frozen, sine_episodes, sine_spec


def fitted(curves: list[np.ndarray], trimmed: float = 0.0) -> FunctionalBand:
    """A band of episodes of one error each, whose squares are ``curves``."""
    outputs = [ModelOutput(np.sqrt(c)[:, None], np.zeros((len(c), 0))) for c in curves]
    nominal = Nominal([], [], curves, lambda episodes: outputs)  # type: ignore[arg-type]
    return FunctionalBand(sine_spec(), trimmed).fit(nominal, np.random.default_rng(0))


def values(detection: FunctionalBand, squared: np.ndarray) -> np.ndarray:
    """What it makes of one episode (T,)."""
    state, found = detection.start(1, 1), []
    for s in squared:
        output = ModelOutput(np.sqrt([[s]]), np.zeros((1, 0)))
        state, shares = detection.attribute_step(state, output, np.zeros((1, 1)), lambda parts: parts)
        found.append(shares.sum())
    return np.array(found)


def test_a_score_is_the_mean_of_five_rows_of_summed_squares():
    squared = np.array([[1.0, 2.0], [3.0, 0.0], [0.0, 0.0], [6.0, 0.0], [0.0, 3.0], [9.0, 0.0]])
    np.testing.assert_allclose(moving_score(squared), [3, 3, 2, 3, 3, 21 / 5])


def test_the_band_is_the_mean_and_the_farthest_of_those_that_stray_least():
    scores = np.array([[1.0, 1.0, 1.0], [3.0, 2.0, 1.0], [2.0, 0.0, 1.0], [2.0, 1.0, 9.0]])
    mean, width = band(scores, trimmed=0.0)
    np.testing.assert_allclose(mean, [2, 1, 3])
    np.testing.assert_allclose(width, [1, 1, 6])
    _, width = band(scores, trimmed=0.4)  # rank ⌈5 · 0.6⌉ = 3 of 4: the last, which strays by 6, is left out
    np.testing.assert_allclose(width, [1, 1, 2])


def test_an_episode_that_ends_early_keeps_its_last_score():
    np.testing.assert_array_equal(padded([np.array([1.0, 2.0]), np.arange(4.0)]), [[1, 2, 2, 2], [0, 1, 2, 3]])


def test_a_value_is_how_many_widths_a_score_is_above_the_mean():
    detection = fitted([np.full(30, 1.0), np.full(30, 3.0)])  # mean 2, width 1
    found = values(detection, np.full(40, 5.0))
    np.testing.assert_allclose(found, 1 + 3.0)  # also after the last row of the band
    np.testing.assert_allclose(values(detection, np.full(4, 2.0)), 1.0)
    np.testing.assert_allclose(values(detection, np.full(4, 1.5)), 1 / 1.5)


def test_what_is_usual_late_is_an_alarm_early():
    rng = np.random.default_rng(0)
    ramp = np.linspace(1.0, 50.0, 60)
    detection = fitted([ramp * rng.uniform(0.8, 1.2) for _ in range(40)])
    calibration = [values(detection, ramp * rng.uniform(0.8, 1.2)).max() for _ in range(40)]
    early = np.where(np.arange(60) < 20, 20.0, ramp)  # no row is above what every episode comes to
    assert values(detection, early).max() > 2 * max(calibration)


@pytest.mark.parametrize("rate", [0.05, 0.2])
def test_exchangeable_episodes_stay_in_the_band_as_often_as_promised(rate):
    rng = np.random.default_rng(1)

    def episode() -> np.ndarray:
        return np.exp(rng.normal()) * (1 + np.sin(np.arange(30) / 5)) + rng.exponential(size=30)

    alarms = []
    for _ in range(40):
        detection = fitted([episode() for _ in range(20)], trimmed=0.05)
        maxima = np.sort([values(detection, episode()).max() for _ in range(39)])
        threshold = maxima[int(np.ceil(40 * (1 - rate))) - 1]
        alarms += [values(detection, episode()).max() > threshold for _ in range(25)]
    # Exactly the rate on average, for 40 · rate is whole; 40 calibrations of Beta-distributed rates, 25 episodes each.
    spread = np.sqrt(rate * (1 - rate) * (1 / 41 / 40 + 1 / 1000))
    assert abs(np.mean(alarms) - rate) < 4 * spread


def test_a_model_under_the_band_is_saved_with_it(tmp_path):
    monitor = make_monitor("kalman+band", sine_spec(), trimmed=0.1).fit(sine_episodes(30))
    monitor.calibrate(sine_episodes(60, 1), 0.05).save(tmp_path / "band.asm")
    loaded = load_monitor(tmp_path / "band.asm")
    assert loaded.detection.name == "band"
    assert loaded.get_params()["trimmed"] == 0.1
    broken = frozen(sine_episodes(1, 2)[0], 3, 20)
    np.testing.assert_array_equal(loaded.score(broken).value, monitor.score(broken).value)
    assert loaded.score(broken).value.max() > loaded.threshold


@pytest.mark.parametrize("trimmed", [-0.1, 1.0, np.nan])
def test_a_share_that_is_none_is_refused(trimmed):
    with pytest.raises(ValueError, match="trimmed"):
        FunctionalBand(sine_spec(), trimmed)


def test_a_band_that_does_not_fit_is_refused():
    with pytest.raises(ValueError, match="band"):
        FunctionalBand(sine_spec()).restore({"band_mean": np.ones(3), "band_width": np.zeros(3)})
