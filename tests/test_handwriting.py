"""Letters of lognormal strokes, against their closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest

from asm_gym.scripts.reproduce import splines
from asm_gym.scripts.reproduce.handwriting import (
    DT,
    NOISE,
    STEPS,
    Letter,
    Stroke,
    repertoire,
    velocity,
    written,
)

STROKE = Stroke(length=4.0, direction=0.3, turn=1.5, rise=0.0, onset=-0.05, sigma=0.3)


def test_a_stroke_ends_at_its_chord():
    time = (np.arange(200_000) + 0.5) * 2e-5
    end = (velocity(Letter("a", (STROKE,)), time) * 2e-5).sum(axis=0)
    # ∫_0^1 exp(i (θ + Δθ u)) du = (exp(i (θ + Δθ)) - exp(i θ)) / (i Δθ)
    chord = 4.0 * (np.exp(1j * 1.8) - np.exp(1j * 0.3)) / (1j * 1.5)
    np.testing.assert_allclose(end, [chord.real, chord.imag, 0.0], atol=1e-3)


def test_a_stroke_is_fastest_at_the_mode_of_its_lognormal():
    time = np.linspace(0.01, 1.0, 100_000)
    speed = np.linalg.norm(velocity(Letter("a", (STROKE,)), time), axis=1)
    assert time[speed.argmax()] == pytest.approx(-0.05 + math.exp(-1.75 - 0.3**2), abs=1e-4)


def test_the_pen_goes_where_its_commands_take_it():
    episode = written(repertoire(1, 3, np.random.default_rng(0))[0], 3, np.random.default_rng(1))
    gone = episode.stream[:, :3] - np.cumsum(episode.stream[:, 3:], axis=0) * DT
    assert episode.stream.shape == (STEPS, 6)
    assert gone.std() == pytest.approx(NOISE, rel=0.2)


def test_writing_twice_as_fast_goes_the_same_way_in_half_the_steps():
    letter = repertoire(1, 2, np.random.default_rng(0))[0]
    slow, fast = (written(letter, 2, np.random.default_rng(1), speed, wobble=0.0) for speed in (1.0, 2.0))
    assert len(fast) == len(slow) / 2
    np.testing.assert_allclose(fast.stream[:, :2], slow.stream[1::2, :2], atol=6 * NOISE)
    np.testing.assert_allclose(fast.stream[:, 2:], slow.stream[::2, 2:] + slow.stream[1::2, 2:], atol=0.05)  # [cm/s]


def test_a_spline_begins_at_the_origin_and_goes_as_far_as_its_knots():
    rng = np.random.default_rng(0)
    (spline,) = splines.repertoire(1, 3, rng)
    episodes = splines.copybook([spline], 200, rng)
    streams = np.stack([e.stream for e in episodes])
    assert {e.info["skill"] for e in episodes} == {"a"}
    # The noise of the pen averages out over writings, and so does the wobble of the knots.
    reached = streams[:, [STEPS // 4 - 1, STEPS // 2 - 1, -1], :3].mean(axis=0)
    np.testing.assert_allclose(reached, spline.knots[[1, 2, 4]] - spline.knots[0], atol=5 * 0.15 / np.sqrt(200))
    travelled = np.cumsum(streams[:, :, 3:], axis=1) * DT
    np.testing.assert_allclose(streams[:, :, :3] - travelled, 0.0, atol=6 * NOISE)


def test_a_spline_has_no_corners():
    (spline,) = splines.repertoire(1, 2, np.random.default_rng(1))
    speed = splines.written(spline, np.random.default_rng(2)).stream[:, 2:]
    assert np.abs(np.diff(speed, axis=0)).max() < 0.2 * np.abs(speed).max()
