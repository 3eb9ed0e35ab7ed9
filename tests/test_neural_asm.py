"""The Neural ASM as a monitor: what it promises to whoever watches a robot with it."""

from __future__ import annotations

import pickle
import re
from dataclasses import replace

import numpy as np
import pytest

from asm_gym.data.episode import Episode
from asm_gym.monitors import NeuralASM, make_monitor
from asm_gym.spec import Channel, StreamSpec
from tests.memories import SMALL, learned_bytes, sine_memory
from tests.streams import frozen, sine_episodes, sine_spec


@pytest.fixture(scope="module")
def asm() -> NeuralASM:
    return sine_memory()


def test_a_frozen_sense_is_detected_and_attributed_to_its_channel(asm):
    hits, named = [], []
    for n, episode in enumerate(sine_episodes(24, seed=2)):
        column = n % 12
        surprise = asm.score(frozen(episode, column, onset=20))
        alarms = np.flatnonzero(surprise.value[20:] > asm.threshold)
        hits.append(alarms.size > 0)
        if alarms.size:
            named.append(np.argmax(surprise.attribution[20 + alarms[0]]) == column)
    assert np.mean(hits) > 0.9
    assert np.mean(named) > 0.9


def test_movements_far_from_all_that_was_learned_are_an_alarm_though_the_body_can_do_them(asm):
    """Twice as fast, and about another place: the channels go together as they always do."""
    mixing = np.random.default_rng(12345).normal(size=(6, 12))  # that of the sines
    faster = [replace(e, stream=e.stream[::2]) for e in sine_episodes(20, seed=7, steps=(80, 100))]
    elsewhere = [
        replace(e, stream=e.stream + np.r_[3.0 * mixing[0], 0, 0])
        for e in sine_episodes(20, seed=8)
    ]
    for far in (faster, elsewhere):
        assert np.mean([s.value.max() > asm.threshold for s in asm.score_episodes(far)]) >= 0.95


def test_the_action_as_commanded_is_used_to_predict(asm):
    episode = sine_episodes(1, seed=6)[0]
    stream = episode.stream.copy()
    stream[20:, asm.spec.motor] *= -1  # the robot does something else than it was told
    reversed_action = asm.score(replace(episode, stream=stream))
    assert reversed_action.value[20:].mean() > 3 * asm.score(episode).value[20:].mean()


def test_observing_changes_neither_weights_nor_state_nor_row(asm):
    before = learned_bytes(asm)
    rows = np.stack([e.stream[0] for e in sine_episodes(3, seed=7)])
    state = asm.initial_state(3)
    state, _ = asm.observe(state, rows)
    kept = [pickle.dumps(state), rows.tobytes()]
    asm.observe(state, rows)
    assert [pickle.dumps(state), rows.tobytes()] == kept
    assert learned_bytes(asm) == before


def test_a_batch_is_as_good_as_its_members_alone(asm):
    episodes = sine_episodes(7, seed=8)
    together, alone = asm.score_episodes(episodes), [asm.score(e) for e in episodes]
    for a, b in zip(together, alone, strict=True):
        np.testing.assert_allclose(a.value, b.value, rtol=1e-3, atol=1e-4)
        np.testing.assert_allclose(a.attribution, b.attribution, rtol=1e-2, atol=1e-3)


@pytest.mark.parametrize("broken", [np.nan, np.inf, -np.inf])
def test_a_number_that_is_not_finite_is_an_alarm_and_passes(asm, broken):
    episode = sine_episodes(1, seed=10)[0]
    stream = episode.stream.copy()
    stream[20, [3, 12]] = broken  # one sense, one action
    surprise = asm.score(replace(episode, stream=stream))
    assert surprise.value[20] == np.inf > asm.threshold
    assert np.array_equal(np.isinf(surprise.attribution[20]), np.isin(np.arange(14), [3, 12]))
    assert np.all(surprise.attribution[20][np.isfinite(surprise.attribution[20])] == 0)
    clean = asm.score(episode).value
    np.testing.assert_array_equal(surprise.value[:20], clean[:20])
    np.testing.assert_allclose(surprise.value[35:], clean[35:], rtol=0.3, atol=0.3)


@pytest.mark.parametrize("huge", [1e30, -3e38, 1.7e308])
def test_a_huge_number_is_a_finite_alarm_on_its_channel(asm, huge):
    rows = sine_episodes(1, seed=12)[0].stream.astype(np.float64)
    state = asm.initial_state()
    for row in rows[:10]:
        state, _ = asm.observe(state, row[None])
    row = rows[10].copy()
    row[5] = huge
    state, surprise = asm.observe(state, row[None])
    assert asm.threshold < surprise.value[0] < np.inf
    assert np.argmax(surprise.attribution[0]) == 5
    for row in rows[11:]:
        state, surprise = asm.observe(state, row[None])
        assert np.isfinite(surprise.value[0])


@pytest.mark.parametrize("value", [1e3, 1e6, 1e30])
@pytest.mark.parametrize("sense", [slice(None), 3, 10], ids=["all", "one", "another"])
@pytest.mark.parametrize("rows", [1, 2, 25])
def test_an_episode_that_begins_with_absurd_numbers_alarms_within_five_rows(
    asm, value, sense, rows
):
    """Nothing came before the first row, so that no change in it can be judged.

    Where all are so absurd that they are read as the same, it is rest that alarms: of fifty episodes, in the fifth row.
    """
    stream = sine_episodes(1, seed=3)[0].stream[:25].astype(np.float64)
    stream[:rows, sense] = value
    state, alarms = asm.initial_state(), []
    for row in stream:
        state, surprise = asm.observe(state, row[None])
        alarms.append(surprise.value[0] > asm.threshold)
    assert any(alarms[: 5 if rows == 25 else 3])


def test_one_seed_gives_one_memory_and_another_seed_another():
    episodes, spec = sine_episodes(6), sine_spec()
    a, b, c = (NeuralASM(spec, hidden_size=16, epochs=2, seed=s).fit(episodes) for s in (3, 3, 4))
    assert learned_bytes(a) == learned_bytes(b)
    assert learned_bytes(a) != learned_bytes(c)


def test_constant_and_copied_channels_are_no_trouble():
    episodes = []
    for e in sine_episodes(12):
        stream = e.stream.copy()
        stream[:, 1], stream[:, 2] = stream[:, 0], 0.1
        episodes.append(replace(e, stream=stream))
    asm = NeuralASM(sine_spec(), hidden_size=24, epochs=5).fit(episodes)
    assert asm.senses_.spread[2] == 1.0
    assert np.isfinite(asm.score(episodes[0]).value).all()
    moved = episodes[0].stream.copy()
    moved[20:, 2] += 1.0
    assert np.argmax(asm.score(replace(episodes[0], stream=moved)).attribution[20]) == 2


def test_an_interrupted_fit_leaves_the_memory_as_it_was():
    asm = (
        NeuralASM(sine_spec(), **SMALL)
        .fit(sine_episodes(8))
        .calibrate(sine_episodes(19, seed=1), 0.05)
    )
    episode, threshold = sine_episodes(1, seed=13)[0], asm.threshold
    before, weights = asm.score(episode).value.tobytes(), learned_bytes(asm)

    def interrupt(done, total):
        if done > total // 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        asm.fit(sine_episodes(8, seed=5), interrupt)
    assert asm.threshold == threshold
    assert (asm.score(episode).value.tobytes(), learned_bytes(asm)) == (before, weights)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("hidden_size", 1.5),
        ("iterations", 0),
        ("learning_rate", np.nan),
        ("sensory_precision", np.inf),
        ("free_running_probability", 1.5),
        ("shrinkage", -0.1),
        ("seed", -1),
    ],
)
def test_a_bad_hyperparameter_is_named_with_what_was_given(name, value):
    with pytest.raises(ValueError, match=f"{name} must be .* got {re.escape(str(value))}"):
        make_monitor("neural_asm", sine_spec(), **{name: value})


def test_bad_episodes_are_refused_by_fit_and_calibrate(asm):
    good = sine_episodes(3)
    other = StreamSpec(
        (Channel("joint_position", 11, "rad", group="joint"), Channel("wrench", 3, "N")), dt=0.05
    )
    nan = good[1].stream.copy()
    nan[7, 4] = np.nan
    wild = good[1].stream.copy()
    wild[7, 4] = 1e25
    cases = [
        ([], "at least one episode"),
        (
            [good[0], replace(good[1], stream=good[1].stream[:1])],
            "episode 1 must be at least 2 steps long, got 1",
        ),
        (
            [good[0], replace(good[1], stream=nan)],
            r"episode 1, step 7, joint_position\[4\] must be finite, got nan",
        ),
        (
            [good[0], replace(good[1], stream=wild)],
            r"episode 1, step 7, joint_position\[4\] is 1e\+25, where 98 % of all",
        ),
        (
            [*good, Episode.from_stream(np.zeros((5, 14)), other)],
            "(?s)episode 3 does not fit.*command.*wrench",
        ),
    ]
    for episodes, message in cases:
        with pytest.raises(ValueError, match=message):
            NeuralASM(sine_spec()).fit(episodes)
        with pytest.raises(ValueError, match=message):
            asm.calibrate(episodes, 0.5)


def test_rows_of_the_wrong_shape_are_refused(asm):
    for shape in ((1, 13), (14,), (2, 14), (1, 1, 14)):
        with pytest.raises(ValueError, match="shape"):
            asm.observe(asm.initial_state(1), np.zeros(shape))
    with pytest.raises(ValueError, match="batch must be a whole number of at least 1, got 0"):
        asm.initial_state(0)
