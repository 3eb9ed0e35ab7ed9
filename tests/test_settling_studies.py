"""The studies of the papers' network: closed forms, the Riccati equation, sequences that look alike, and an arm."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from asm_gym import NeuralASM
from asm_gym.memory.inference import STRIDE, iterations_within
from asm_gym.memory.settling import SettlingNetwork
from asm_gym.memory.settling_learning import initial_settling_weights
from asm_gym.memory.temporal import unassociated
from asm_gym.monitors import load_monitor
from asm_gym.scripts.reproduce import sequences, tracking
from asm_gym.scripts.reproduce.closed_loop import CUE, EVENT, PUSH, Memorised, written
from asm_gym.scripts.reproduce.handwriting import repertoire
from asm_gym.scripts.reproduce.lagging import LaggingNetwork
from asm_gym.scripts.reproduce.tracking import A, C, informed, kalman, recording, settled, squared, tracked
from asm_gym.scripts.reproduce.two_links import COMMAND, DT, ENCODERS, HAND, SPEC, demonstrations, hand, joints


@pytest.fixture(scope="module")
def run():
    return recording(1500, np.random.default_rng(0))


def test_the_kalman_filter_is_as_far_off_as_the_riccati_equation_says(run):
    prior = solve_discrete_are(A.T, C.T, np.eye(3), np.eye(3))
    after = prior - prior @ C.T @ np.linalg.inv(C @ prior @ C.T + np.eye(3)) @ C @ prior
    found, expected = kalman(run)
    assert squared(found, run.states) == pytest.approx(np.trace(after) / 3, rel=0.1)
    # Innovations of a Kalman filter are white: none tells of the next.
    new = run.observed - expected
    assert squared(new, 0 * new) == pytest.approx(np.trace(C @ prior @ C.T + np.eye(3)) / 3, rel=0.1)
    assert np.abs(np.mean(new[1:] * new[:-1], axis=0)).max() < 0.15 * np.mean(new**2)


def test_inference_comes_nearer_to_the_kalman_filter_step_by_step_and_ends_at_the_closed_form(run):
    best, end = kalman(run)[0], settled(run)
    found = {n: tracked(informed(n), run) for n in (1, 2, 4, 10, 1000)}
    errors = [squared(x, run.states) for x in found.values()]
    assert all(later < sooner for sooner, later in itertools.pairwise(errors[:4]))
    apart = [squared(x, best) for x in found.values()]
    assert apart[0] > 2 * apart[1] > 2 * apart[2] > apart[3]
    assert squared(found[1000], end) < 1e-4
    assert squared(best, run.states) < squared(end, run.states) < 2 * squared(best, run.states)


def test_steps_as_long_as_the_authors_end_where_theirs_do_and_begin_nearer(run):
    for length in (0.12, 0.32):
        theirs, ours = (
            {n: f(n) for n in (2, 30)}
            for f in (
                lambda n, x=length: tracking.as_published(run, n, x),
                lambda n, x=length: tracked(informed(n, x), run),
            )
        )
        assert squared(ours[2], run.states) < squared(theirs[2], run.states)
        assert squared(ours[30], theirs[30]) < 0.02


def test_what_is_missing_from_predictive_coding_is_how_sure_it_was(run):
    assert tracking.usual_variance() == pytest.approx(np.trace(solve_discrete_are(A.T, C.T, np.eye(3), np.eye(3))) / 3)
    best = squared(kalman(run)[0], run.states)
    assert (
        squared(settled(run, tracking.usual_variance()), run.states) - best < squared(settled(run), run.states) - best
    )


def test_a_network_learns_what_is_observed_next_nearly_as_the_kalman_filter_knows_it():
    rng, args = np.random.default_rng(0), tracking.Config(updates=8000)
    network, spread = tracking.learned([recording(tracking.LEARNED_STEPS, rng) for _ in range(64)], args, rng)
    fresh = [recording(tracking.LEARNED_STEPS, rng) for _ in range(8)]
    errors = [
        (
            squared(tracking.observations(network, spread, r)[200:], r.observed[200:]),
            squared(kalman(r)[1][200:], r.observed[200:]),
        )
        for r in fresh
    ]
    ours, best = np.mean(errors, axis=0)
    assert best < ours < 1.25 * best


def test_one_that_settles_recalls_what_comes_twice_and_one_layer_cannot():
    args, rng = sequences.Config(updates=1500), np.random.default_rng(0)
    sequence = sequences.patterns(3, 100, 0.0, rng)[list(sequences.ALIASED["A B C B A"])]
    found = sequences.by_network(sequence, "settling", args, rng)
    assert sequences.recalled(found, sequence)[0] == 1.0
    for other in (sequences.by_one_layer(sequence), sequences.by_correlation(sequence)):
        assert sequences.recalled(other, sequence)[0] < 1.0  # B is followed by C and by A


def test_patterns_like_a_template_are_like_each_other_and_confuse_correlation_alone():
    rng = np.random.default_rng(0)
    made = sequences.patterns(200, 400, 0.5, rng)
    assert np.mean(made[:100] * made[100:]) == pytest.approx(0.25, abs=0.05)  # b²
    sequence = sequences.patterns(16, 100, 0.5, rng)
    assert sequences.recalled(sequences.by_one_layer(sequence), sequence)[0] == 1.0
    assert sequences.recalled(sequences.by_correlation(sequence), sequence)[0] < 0.5
    off = sequence.copy()
    off[3, :10] *= -1
    assert sequences.recalled(off, sequence) == (14 / 15, pytest.approx(4 * 10 / 1500))


def test_units_that_cannot_jump_close_the_same_share_of_the_gap_in_each_step_and_end_where_the_others_do():
    rng = np.random.default_rng(0)
    jumping = SettlingNetwork(initial_settling_weights(6, 4, 2, rng), unassociated(), 3, 1.0, 1.0)
    lagging = LaggingNetwork.of(jumping)
    z, u = (rng.normal(size=(5, n)).astype(np.float32) for n in (6, 3))
    x, seen = rng.normal(size=(5, 4)).astype(np.float32), np.ones((5, 4), np.float32)
    # Alone F is ½ Π_z ‖z - μ‖², so that a step takes STRIDE Π_z / curvature of what is left.
    step, left = lagging.run_on(z), (1.0 - float(STRIDE / jumping.curvature)) ** 3
    np.testing.assert_allclose(step.z - step.mu, left * (z - step.mu), atol=1e-5)
    np.testing.assert_allclose(step.mu, jumping.run_on(z).mu, atol=1e-6)
    ours, theirs = (n.with_iterations(5000).follow(z, u, x, seen) for n in (lagging, jumping))
    np.testing.assert_allclose(ours.z, theirs.z, atol=1e-3)
    assert np.abs(lagging.follow(z, u, x, seen).z - z).max() < np.abs(jumping.follow(z, u, x, seen).z - z).max()


@pytest.fixture(scope="module")
def letters():
    rng = np.random.default_rng(0)
    two = repertoire(2, 2, rng)
    return demonstrations(two, 12, rng), demonstrations(two, 4, rng)


def test_a_budget_of_inference_is_so_many_steps_a_row_and_one_at_least(letters, tmp_path):
    assert [iterations_within(b, 0.05) for b in (20, 39, 40, 100.0)] == [1, 1, 2, 5]
    with pytest.raises(
        ValueError, match=r"^a budget of 19 steps of inference a second is less than one for each of 20"
    ):
        iterations_within(19, 0.05)
    with pytest.raises(ValueError, match=r"^budget must be .* above 0, got 0"):
        iterations_within(0, 0.05)
    asm = NeuralASM(SPEC, 8, 8, epochs=2, dynamics="settling").fit(letters[0]).calibrate(letters[0], 0.1)
    few = asm.with_budget(60)
    assert (few.iterations, few.model.network.iterations, few.threshold_) == (3, 3, None)
    assert (asm.iterations, asm.model.network.iterations) == (20, 20)
    few.save(tmp_path / "few.asm")
    cue = letters[1][0].stream[:20]
    np.testing.assert_array_equal(load_monitor(tmp_path / "few.asm").recall(cue, 9), few.recall(cue, 9))
    assert np.abs(few.recall(cue, 9) - asm.recall(cue, 9)).max() > 1e-4
    with pytest.raises(ValueError, match="less than one for each of 20 rows a second"):
        asm.with_budget(10)
    with pytest.raises(RuntimeError, match="has learned nothing yet"):
        NeuralASM(SPEC, 8, 8).with_budget(60)


def test_the_arm_is_where_its_joints_and_its_commands_say(letters):
    for e in letters[1]:
        rows = e.stream.astype(np.float64)
        assert np.abs(hand(rows[:, ENCODERS]) - rows[:, HAND]).max() < 0.25  # the noise of both
        moved = rows[0, ENCODERS] + DT * np.cumsum(rows[1:, COMMAND], axis=0)
        assert np.abs(moved - rows[1:, ENCODERS]).max() < 0.01
        np.testing.assert_allclose(hand(joints(rows[:, HAND])), rows[:, HAND], atol=1e-9)


class Replayed:
    """Commands what was commanded."""

    def __init__(self, cues):
        self.cues, self.t = cues, 0

    def command(self):
        return self.cues[self.t][:, COMMAND]

    def read(self, rows):
        self.t += 1
        self.last = rows
        return np.zeros(len(rows))


def test_what_is_commanded_as_it_was_writes_the_letter_unless_something_happens(letters):
    cues = np.stack([e.stream for e in letters[1]], axis=1).astype(np.float64)
    paths = {}
    for way in ("left alone", "pushed", "stuck"):
        drives = Replayed(cues)
        paths[way] = written(drives, cues, way, 0).path
    off = np.linalg.norm(paths["left alone"] - cues[:, :, HAND], axis=2)
    assert off.max() < 0.3
    np.testing.assert_array_equal(paths["pushed"][:EVENT], paths["left alone"][:EVENT])
    moved = np.abs(joints(paths["pushed"][EVENT + 2 :]) - joints(paths["left alone"][EVENT + 2 :]))
    np.testing.assert_allclose(moved, PUSH, atol=1e-6)
    np.testing.assert_allclose(drives.last[:, 0], joints(cues[EVENT - 1, :, HAND])[:, 0], atol=0.02)


def test_a_memory_writes_what_it_was_shown_and_is_surprised_by_a_push(letters):
    asm = NeuralASM(SPEC, 32, 32, epochs=400, free_running_probability=0.6).fit(letters[0]).calibrate(letters[0], 0.1)
    cues = np.stack([e.stream for e in letters[1]], axis=1).astype(np.float64)
    energy = asm.model.free_energy(letters[1])
    alone, pushed = (written(Memorised(asm, 8), cues, w, 0, energy, asm.threshold) for w in ("left alone", "pushed"))
    truth = cues[CUE:, :, HAND]
    off = np.linalg.norm(alone.path[CUE:] - truth, axis=2).mean()
    assert off < 0.5 * np.linalg.norm(truth - truth[0], axis=2).mean()
    assert (pushed.alarm < EVENT + 10).all()
    for what in ("surprise", "energy"):
        calm, found = (getattr(c, what)[EVENT : EVENT + 5].max(axis=0) for c in (alone, pushed))
        assert found.min() > calm.max()
