"""Studies of the memory: their instruments against oracles, and the direction of each claim on small data."""

from __future__ import annotations

import numpy as np
import pytest

from asm_gym.data.episode import Episode
from asm_gym.memory.learning import Schedule, Trajectory
from asm_gym.memory.recurrent_learning import (
    Eligibility,
    RecurrentLearner,
    initial_recurrent_weights,
)
from asm_gym.memory.settling import learn_settling
from asm_gym.scaling import StreamScaler
from asm_gym.scripts.reproduce import closed_loop, memorise_and_recall, skill_measures, workspace
from asm_gym.scripts.reproduce.backpropagation import Training, expected, side_by_side
from asm_gym.scripts.reproduce.backpropagation import train as train_recurrent
from asm_gym.scripts.reproduce.expression import (
    Backpropagated,
    ExpressionMemory,
    LocalTraining,
    mean_demonstrations,
    recalled,
    trajectories,
)
from asm_gym.scripts.reproduce.handwriting import (
    DT,
    NOISE,
    STEPS,
    copybook,
    repertoire,
    written,
)
from asm_gym.scripts.reproduce.repertoire import OneStepLearner


def test_the_pen_goes_where_its_commands_take_it_at_any_speed():
    letter = repertoire(1, np.random.default_rng(0))[0]
    episode = written(letter, np.random.default_rng(1))
    noise = episode.stream[:, :2] - np.cumsum(episode.stream[:, 2:], axis=0) * DT
    assert noise.std() == pytest.approx(NOISE, rel=0.2)
    slow, fast = (
        written(letter, np.random.default_rng(1), speed, wobble=0.0) for speed in (1.0, 2.0)
    )
    assert len(fast) == len(slow) / 2
    np.testing.assert_allclose(fast.stream[:, :2], slow.stream[1::2, :2], atol=6 * NOISE)


def letters_of(count: int, each: int = 6) -> tuple[list, list]:
    rng = np.random.default_rng(0)
    letters = repertoire(count, rng)
    return copybook(letters, each, rng), copybook(letters, 3, rng)


def test_the_recurrent_rival_offline_reads_its_own_predictions():
    train, tests = letters_of(2)
    model = Backpropagated.learned(train, Training(hidden=16, updates=5), np.random.default_rng(0))
    streams = np.stack([e.stream for e in tests], axis=1).astype(np.float64)
    offline, row = model.express(streams, 20), np.arange(STEPS)[:, None, None]
    np.testing.assert_allclose(offline[:20], model.express(streams, STEPS)[:20], atol=1e-5)
    np.testing.assert_array_equal(offline, model.express(np.where(row < 20, streams, 9.0), 20))


def test_the_memory_recalls_each_letter_from_its_cue():
    train, tests = letters_of(2, each=8)
    memory = ExpressionMemory.learned(train, LocalTraining(32, 4000), np.random.default_rng(0))
    error, right = recalled(memory, tests, mean_demonstrations(train), 20)
    streams = np.stack([e.stream for e in tests], axis=1)
    still = np.linalg.norm(streams[20:, :, :2] - streams[19, :, :2], axis=2).mean()
    assert right >= 5 / 6
    assert error < 0.5 * still


def test_the_network_as_published_memorises_what_it_reads_side_by_side(monkeypatch):
    monkeypatch.setattr(memorise_and_recall, "PUBLISHED_UNITS", 32)
    monkeypatch.setattr(memorise_and_recall, "PUBLISHED_RATE", 3e-3)
    train = copybook(repertoire(2, np.random.default_rng(0)), 1, np.random.default_rng(1))
    means, errors = mean_demonstrations(train), {}
    for epochs in (1, 120):
        models = [
            memorise_and_recall.as_published(train, epochs, np.random.default_rng(seed))
            for seed in (2, 3, 4)
        ]
        assert models[0].network.hidden_size == 32
        errors[epochs] = np.median([recalled(model, train, means, STEPS)[0] for model in models])
    assert errors[120] < 0.5 * errors[1]


def test_recurrent_units_cut_to_one_step_are_eligible_for_the_last_row_alone():
    rng = np.random.default_rng(0)
    schedule = Schedule(1, 4, 1e-3, 5, 1.0, 1.0, 0.0)
    weights = initial_recurrent_weights(8, 3, 2, rng)
    first, last = rng.normal(size=(2, 4, 6)).astype(np.float32)
    cut, whole, late = (
        kind(weights, schedule, rng)
        for kind in (OneStepLearner, RecurrentLearner, RecurrentLearner)
    )
    state = cut.at_rest(4)
    for learner in (cut, whole):
        learner.mark_eligible(state, first)
        learner.mark_eligible(state + 1, last)
    late.mark_eligible(state + 1, last)
    for name in Eligibility._fields:
        of_last = getattr(late.eligible, name)
        np.testing.assert_allclose(getattr(cut.eligible, name), of_last, atol=1e-6)
    assert np.abs(whole.eligible.B_re - late.eligible.B_re).max() > 0.01


def test_the_rival_learns_from_episodes_of_different_lengths():
    train, _ = letters_of(2)
    reader = StreamScaler.fit(train[0].spec, [e.stream for e in train])
    taught = trajectories(reader, train)
    cut = [
        Trajectory(t.senses[:n], t.commands[:n], t.inputs)
        for t, n in zip(taught, (40, 60) * 6, strict=True)
    ]
    batch = side_by_side(cut)
    assert batch.senses.shape[0] == 60
    assert np.isnan(batch.senses[40:, 0]).all()
    assert np.isfinite(batch.senses[:, 1]).all()
    whole = side_by_side(taught)
    for cell in ("GRU", "LSTM"):
        errors = []
        for updates in (1, 60):
            training = Training(cell, hidden=16, updates=updates)
            network = train_recurrent(cut, training, np.random.default_rng(0))
            errors.append(np.mean((expected(network, whole, STEPS).senses - whole.senses) ** 2))
        assert errors[1] < 0.7 * errors[0]


def wandering(seed: int, rows: int = 80) -> Episode:
    """A stream of the Panda's senses in which each wanders on its own way round."""
    rng = np.random.default_rng(seed)
    angle = (
        rng.uniform(0, 2 * np.pi) + 0.1 * np.arange(rows)[:, None] + np.arange(workspace.SPEC.size)
    )
    return Episode.from_stream(np.sin(angle) + 0.01 * rng.normal(size=angle.shape), workspace.SPEC)


def test_a_sense_that_sticks_is_alone_over_its_ceiling_and_counts_no_more_once_left_out():
    train = [wandering(n, 60) for n in range(8)]
    reader = StreamScaler.fit(workspace.SPEC, [e.stream for e in train])
    schedule = Schedule(25, 16, 6e-3, 8, 1.0, 1.0, 0.0)
    rng = np.random.default_rng(0)
    trained = learn_settling(trajectories(reader, train), 64, schedule, rng, lambda: None)
    model = closed_loop.LocalNetwork(reader, trained.network, train)
    assert np.mean([model.read_stream(e.stream)[1] ** 2 for e in train]) == pytest.approx(
        1.0, abs=0.1
    )
    model.ceiling = 1.5 * max(
        model.read_stream(wandering(n).stream)[2][3:].max() for n in range(20, 24)
    )
    stuck = wandering(30).stream.astype(np.float64)
    stuck[40:, workspace.JOINTS] = stuck[40, workspace.JOINTS]
    energies = model.read_stream(stuck)[2][42:48].max(axis=0)
    assert energies.argmax() == list(workspace.GROUPS).index("joint")
    assert energies[0] > 1.0
    stuck[40:, workspace.JOINTS] = np.nan
    assert model.read_stream(stuck)[2][50:, 0].max() < 1e-3


def test_every_task_is_seen_by_the_same_senses(lift):
    work = workspace.Workspace(lift)
    work.reset(3)
    _, row, _ = work.step(np.zeros(7))  # in which the cube comes to lie on the table
    command = np.array([0.2, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0])
    _, after, solved = work.step(command)
    thing, goal = (workspace.SPEC.slices[name] for name in ("hand_to_thing", "thing_to_goal"))
    np.testing.assert_allclose(row[goal], [0.0, 0.0, 0.11], atol=5e-3)
    np.testing.assert_allclose(after[workspace.SPEC.motor], command, atol=1e-6)
    moved = after[workspace.HAND] - row[workspace.HAND]
    np.testing.assert_allclose(after[thing] - row[thing], -moved, atol=2e-3)
    assert not solved


def test_a_name_counts_from_when_it_is_right_for_good():
    assert skill_measures.rows_until(np.array([False, True, False, True, True])) == 4
    assert skill_measures.rows_until(np.ones(5, np.bool_)) == 1
    assert skill_measures.rows_until(np.zeros(5, np.bool_)) == 6
