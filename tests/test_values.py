"""Monitors that judge a joint's values beside its changes, on a pendulum of two joints."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from asm_gym.data.episode import Episode
from asm_gym.data.training_selection import pieces
from asm_gym.detection.scores import Largest
from asm_gym.monitors import CalibratedMonitor, NeuralASM, load_monitor, make_monitor
from asm_gym.monitors.baselines.friction_rule import FrictionRule
from asm_gym.monitors.monitor_protocol import Surprise
from asm_gym.monitors.stream_model import model_outputs
from asm_gym.monitors.torque.arm_features import judged_by_values, motion_columns, torque_columns
from asm_gym.monitors.torque.speed_precision import running_mean, speed_weights, usual_errors
from asm_gym.monitors.torque.value_association import ValueAssociation
from asm_gym.monitors.torque.value_judge import ValueJudge
from asm_gym.scripts.cli import main
from asm_gym.spec import Channel
from asm_gym.synthetic_arm import SyntheticArm
from tests.streams import pendulum_columns


def test_torques_are_predicted_by_friction_and_weight():
    whole = Episode.from_table(pendulum_columns())
    model = ValueAssociation(whole.spec)
    model.fit(pieces(whole, 1.0), np.random.default_rng(0), lambda done, total: None)
    assert model.learned_["R2_values"][4:6].min() > 0.99


def test_a_held_push_is_found_by_values_and_explained_away_by_changes():
    whole = Episode.from_table(pendulum_columns())
    cut = pieces(whole, 1.0)
    faulty = [pushed(piece, 1.0) for piece in cut[45:]]
    found = {}
    for name in ("association_values+evidence", "association_linear+evidence"):
        monitor = make_monitor(name, whole.spec).fit(cut[:30]).calibrate(cut[30:45], 0.07)
        scores = monitor.score_episodes(faulty)
        found[name] = np.mean([(s.value[90:] > monitor.threshold).any() for s in scores])
    assert found["association_values+evidence"] > 0.9
    assert found["association_linear+evidence"] < found["association_values+evidence"]


def pushed(piece: Episode, size: float) -> Episode:
    """From its middle on the first torque is so much more [N m], in a fifth of a second."""
    stream, half = piece.stream.copy(), len(piece) // 2
    stream[half:, 4] += size * np.minimum(1.0, np.arange(len(piece) - half) / 20)
    return Episode.from_stream(stream, piece.spec)


def test_errors_are_averaged_over_a_tenth_of_a_second_each_over_its_own_largest_in_unseen_rows():
    cut = pieces(Episode.from_table(pendulum_columns(3000)), 1.0)
    model = ValueAssociation(cut[0].spec).fit(
        cut[:20], np.random.default_rng(0), lambda done, total: None
    )
    state, found, left = model.start(1), [], []
    for row in cut[25].stream.astype(np.float64):
        state, output = model.predict(state, row[None])
        left.append(state.errors[0, -1])
        found.append(output.errors[0])
    padded = np.vstack([np.zeros((9, 2)), left])
    expected = [padded[t : t + 10].sum(axis=0) / 10 / model.learned_["largest"] for t in range(100)]
    np.testing.assert_allclose(found, expected, atol=1e-12)
    np.testing.assert_allclose(
        running_mean(np.array(left), 10), np.array(expected) * model.learned_["largest"], atol=1e-12
    )
    most = [np.abs(o.errors).max(axis=0) for o in model_outputs(model, cut[:20])]
    # The largest cross-fitted error is about that of rows that it has learned from.
    assert (np.max(most, axis=0) < 1.1).all()


def test_errors_count_for_less_at_speeds_at_which_they_are_usually_larger():
    rng = np.random.default_rng(0)
    squares = rng.uniform(size=(4000, 2, 3))
    squares[:, 1] = 0.0  # of a value that no joint's speed belongs to
    spread = np.exp(1.2 * (squares[:, 0, 1] - 0.5))
    errors = rng.normal(size=(4000, 2))
    errors[:, 0] *= spread
    usual = usual_errors(speed_weights(errors, squares), squares)
    assert np.corrcoef(np.log(usual[:, 0]), np.log(spread))[0, 1] > 0.99
    assert 0.7 < np.log(usual[:, 0]).std() / np.log(spread).std() <= 1.0
    assert abs(np.log(usual[:, 0]).mean()) < 1e-9
    np.testing.assert_array_equal(usual[:, 1], 1.0)


def test_a_torque_is_judged_by_how_far_its_errors_go_at_the_speed_of_its_joint(tmp_path):
    columns = pendulum_columns(6000)
    speed = columns["velocity"][:, 0]
    is_slow = np.abs(speed) < 0.1 * speed.std()
    noise = np.random.default_rng(1).normal(size=6000)
    columns["effort"] = columns["effort"].copy()
    columns["effort"][:, 0] += np.where(is_slow, 1.0, 0.1) * noise
    cut = pieces(Episode.from_table(columns), 1.0)
    model = ValueAssociation(cut[0].spec).fit(
        cut[:50], np.random.default_rng(0), lambda done, total: None
    )
    model.window = 1
    ratio = []
    for by_speed in (model.learned_["by_speed"], None):
        learned = {**model.learned_, "by_speed": by_speed}
        if by_speed is None:  # as a file of an earlier version is
            del learned["by_speed"]
        model.restore(learned)
        errors = np.concatenate(
            [output.errors[10:, 0] for output in model_outputs(model, cut[50:])]
        )
        slow = np.concatenate([part[10:] for part in np.split(is_slow[5000:6000], 10)])
        ratio.append(np.std(errors[slow]) / np.std(errors[~slow]))
    assert ratio[0] < 0.5 * ratio[1]


TWO_NUMBERS = Episode.from_table({"q": np.zeros((9, 2))}, rate=10.0).spec


class Drawn:
    """A monitor whose surprise of each episode, of one row, is drawn before."""

    def __init__(self, values):
        self.spec = TWO_NUMBERS
        self.scores = surprises(values)

    def score_episodes(self, episodes):
        return self.scores


def surprises(values):
    """Return surprise of one row for each value."""
    return [Surprise(np.array([value]), np.zeros((1, 2))) for value in values]


@settings(deadline=None)
@given(
    centre=st.tuples(st.floats(-3, 3), st.floats(-3, 3)),
    spread=st.tuples(st.floats(0.2, 1.0), st.floats(0.2, 1.0)),
    expected=st.floats(2, 40),
    seed=st.integers(0, 99),
)
def test_values_pass_the_threshold_as_often_as_changes_do(centre, spread, expected, seed):
    rng = np.random.default_rng(seed)
    changes, values = (
        np.exp(c + s * rng.normal(size=400)) for c, s in zip(centre, spread, strict=True)
    )
    judge = ValueJudge(Drawn(values), np.zeros((0, 0)))
    now = judge.balanced(surprises(changes), [], expected)
    weighted = now.balance * values**now.power
    half = int(expected / 2)
    threshold = np.sort(changes)[-half]
    assert (weighted >= threshold * (1 - 1e-9)).sum() == half
    if spread[0] < 2.5 * spread[1]:
        assert np.log(weighted).std() == pytest.approx(np.log(changes).std(), rel=0.1)


@pytest.mark.parametrize("tail", ["normal", "exponential", "heavy", "alike"])
@pytest.mark.parametrize(("episodes", "expected"), [(6, 1), (11, 1), (11, 3), (30, 1)])
def test_values_and_changes_together_raise_no_more_than_is_promised(tail, episodes, expected):
    rng = np.random.default_rng(episodes)
    fresh = []
    for _ in range(1000):
        spread = {
            "normal": rng.normal(size=(2, episodes + 1)),
            "exponential": rng.exponential(size=(2, episodes + 1)),
            "heavy": rng.standard_t(4, size=(2, episodes + 1)),
            "alike": rng.normal(size=episodes + 1) + 0.5 * rng.normal(size=(2, episodes + 1)),
        }[tail]
        changes, values = np.exp([[0.3], [0.15]] * spread)
        judge = ValueJudge(Drawn(values[:-1]), np.zeros((0, 0)))
        judge = judge.balanced(surprises(changes[:-1]), [], expected)
        joined = np.maximum(changes, judge.balance * values**judge.power)
        raised = [score.value[0] for score in judge.raised(surprises(joined[:-1]))]
        fresh.append(joined[-1] > np.sort(raised)[-expected])
    promised = expected / (episodes + 1)
    error = np.sqrt(promised * (1 - promised) / len(fresh))
    assert np.mean(fresh) < 1.1 * promised + 2 * error


def test_torques_are_judged_however_well_they_are_told_and_where_an_arm_may_go_is_not():
    columns = pendulum_columns(3000)
    columns["effort"][:, 1] = 0.05 * np.random.default_rng(1).normal(size=3000)  # nothing tells it
    cut = pieces(Episode.from_table(columns), 1.0)
    model = ValueAssociation(cut[0].spec).fit(
        cut, np.random.default_rng(0), lambda done, total: None
    )
    assert torque_columns(cut[0].spec).tolist() == model.error_columns.tolist() == [4, 5]
    assert motion_columns(cut[0].spec).tolist() == [0, 1, 2, 3]
    assert model.learned_["R2_values"][5] < 0.5


def test_a_memory_judges_values_beside_changes_and_keeps_both(tmp_path):
    cut = pieces(Episode.from_table(pendulum_columns()), 1.0)
    faulty = [pushed(piece, 1.0) for piece in cut[45:]]
    found = {}
    for values in (False, True):
        asm = NeuralASM(cut[0].spec, hidden_size=16, association_size=32, epochs=2, values=values)
        asm.fit(cut[:30]).calibrate(cut[30:45], 0.07)
        found[values] = np.mean(
            [(s.value[90:] > asm.threshold).any() for s in asm.score_episodes(faulty)]
        )
        asm.save(tmp_path / "x.asm")
        again = load_monitor(tmp_path / "x.asm")
        np.testing.assert_array_equal(again.score(faulty[0]).value, asm.score(faulty[0]).value)
    assert found[True] > 0.9 > found[False]
    score = asm.score(faulty[0])
    np.testing.assert_allclose(score.attribution.sum(axis=1), score.value)
    assert np.argmax(score.attribution[-1]) == 4
    values = asm.values_
    assert values is not None
    nominal = asm.score_episodes(cut[30:45])
    largest = max(score.value.max() for score in nominal)
    assert asm.threshold == pytest.approx(values.margin * largest)  # one alarm is allowed
    assert values.margin > 1
    body = values.balance * values.monitor.score(faulty[0]).value ** values.power
    assert (score.value >= body - 1e-9).all()


def test_changes_count_for_less_as_the_variance_of_a_regression_in_a_fresh_row_says():
    cut = pieces(Episode.from_table(pendulum_columns(3000)), 1.0)
    values = ValueJudge.learned(cut[:20], seed=0)
    assert values is not None
    senses = values.monitor.model.senses_
    z = [
        np.hstack([senses.read_episode(e.stream).inputs, np.ones((len(e), 1))])
        for e in (*cut[:20], cut[25])
    ]
    shown, asked = np.concatenate(z[:-1]).astype(np.float64), z[-1].astype(np.float64)
    inverse = np.linalg.inv(shown.T @ shown + 1e-3 * len(shown) * np.eye(shown.shape[1]))
    h, usual = (np.einsum("ni,ij,nj->n", rows, inverse, rows) for rows in (asked, shown))
    # a tenth of a second is 10 rows
    root = np.sqrt(np.maximum(1.0, (1.0 + 10 * h) / (1.0 + 10 * np.median(usual))))
    one = Surprise(np.ones(1), np.full((1, 6), 1 / 6))
    state, found = values.monitor.initial_state(1), []
    for row in cut[25].stream.astype(np.float64):
        found.append(values.spread(state, row[None])[0])
        state, judged = values.join(state, row[None], one, np.ones(1))
        assert judged.value[0] >= 1 / found[-1] - 1e-12
    lag = senses.lag
    np.testing.assert_allclose(found[:lag], 1.0)  # no change is known yet
    np.testing.assert_allclose(found[lag:], root[lag:], rtol=1e-4)
    again = ValueJudge.restored(cut[0].spec, values.arrays, seed=0)
    np.testing.assert_array_equal(again.leverage, values.leverage)
    with pytest.raises(ValueError, match="the leverage of values should be of shape"):
        ValueJudge.restored(cut[0].spec, values.arrays | {"values.leverage": np.eye(3)}, seed=0)
    old = {name: array for name, array in values.arrays.items() if name != "values.far"}
    with pytest.raises(ValueError, match="has no far: make it anew"):
        ValueJudge.restored(cut[0].spec, old, seed=0)


def test_a_whole_episode_is_scored_as_row_by_row():
    cut = pieces(Episode.from_table(pendulum_columns()), 1.0)
    asm = NeuralASM(cut[0].spec, hidden_size=8, association_size=16, epochs=1)
    asm.fit(cut[:30]).calibrate(cut[30:45], 0.07)
    assert asm.values_ is not None
    episodes = [pushed(cut[45], 1.0), replace(cut[46], stream=cut[46].stream[:37].copy())]
    episodes[1].stream[20, 1] = np.nan
    episodes[0].stream[70, 1] = 99.0  # misread, for a row
    episodes[0].stream[80:, 2] = -99.0
    for episode, score in zip(episodes, asm.score_episodes(episodes), strict=True):
        state = asm.initial_state()
        for t, row in enumerate(episode.stream):
            state, surprise = asm.observe(state, row[None])
            assert score.value[t] == pytest.approx(surprise.value[0], rel=1e-6)
            assert np.isinf(score.value[t]) == (
                t in ((70, 80) if episode is episodes[0] else (20,))
            )
            np.testing.assert_allclose(
                score.attribution[t], surprise.attribution[0], rtol=1e-5, atol=1e-6
            )


def test_the_rule_takes_friction_from_torque_and_needs_a_speed():
    columns = pendulum_columns()
    columns["effort"] -= 5 * np.sin(columns["position"])  # gravity is none of its business
    whole = Episode.from_table(columns)
    cut = pieces(whole, 1.0)
    monitor = CalibratedMonitor(FrictionRule(whole.spec), Largest(whole.spec)).fit(cut[:30])
    quiet = max(float(s.value.max()) for s in monitor.score_episodes(cut[30:]))
    stream = cut[40].stream.copy()
    stream[50:, 4] += 5.0
    score = monitor.score(Episode.from_stream(stream, whole.spec))
    assert score.value[:50].max() <= quiet < score.value[70:].min()
    assert np.argmax(score.attribution[-1]) == 4
    with pytest.raises(
        ValueError, match="a rule of friction needs a torque and a speed of each joint"
    ):
        FrictionRule(Episode.from_table({"q": np.zeros((9, 2))}, rate=10).spec)


def test_values_are_judged_where_torques_are_measured_and_a_simulation_does_not_feel_contact():
    arm = SyntheticArm.stream_spec
    assert judged_by_values(arm)
    felt = replace(
        arm, channels=(*arm.channels, Channel("external_torque", 7, "N m", group="torque"))
    )
    assert not judged_by_values(felt)
    assert judged_by_values(replace(felt, source="table"))
    assert not judged_by_values(Episode.from_table({"position": np.eye(9)}, rate=10.0).spec)


@pytest.mark.parametrize("with_torques", [True, False])
def test_python_and_the_command_judge_values_alike(with_torques, tmp_path):
    columns = pendulum_columns(3000)
    if not with_torques:
        del columns["effort"]
    cut = pieces(Episode.from_table(columns), 1.0)
    small = {"hidden_size": 8, "association_size": 16, "epochs": 1}
    made = [NeuralASM(cut[0].spec, **small), make_monitor("neural_asm", cut[0].spec, **small)]
    fitted = [monitor.fit(cut[:10]) for monitor in made]

    for number, piece in enumerate(cut):
        table = pd.DataFrame(piece.stream, columns=piece.spec.labels)
        table.insert(0, "time", np.arange(len(piece)) * piece.spec.dt)
        table.to_csv(tmp_path / f"{number}.csv", index=False)
    file = tmp_path / "memory.asm"
    command = ["fit", str(tmp_path), "--out", str(file), "--false-alarm-rate", "0.1", "--quick"]
    assert main(command) == 0
    fitted.append(load_monitor(file))

    for monitor in fitted:
        assert monitor.get_params()["values"] is with_torques
        assert (monitor.values_ is not None) is with_torques
    fitted[0].save(file)
    again = load_monitor(file)
    assert again.get_params() == fitted[0].get_params()
    assert (again.values_ is not None) is with_torques
