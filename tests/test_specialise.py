"""Going on from what a memory knows: a few episodes teach what is their own, and nothing else is forgotten."""

from dataclasses import replace

import numpy as np
import pytest

from asm_gym.detection import Promise, conformal_threshold
from asm_gym.episode import Episode
from asm_gym.memory.association import complete, hidden_units, synapses
from asm_gym.memory.specialise import specialise
from asm_gym.monitors import NeuralASM, make_monitor
from tests.streams import frozen, sine_episodes, sine_spec

SIZES = {"hidden_size": 8, "association_size": 24, "epochs": 2}


@pytest.fixture(scope="module")
def body():
    """A memory of sines, calibrated."""
    memory = NeuralASM(sine_spec(), **SIZES).fit(sine_episodes(40))
    memory.about = {"name": "sines"}
    return memory.calibrate(sine_episodes(40, seed=1), 0.1)


def worn(episodes: list[Episode], gain: float = 0.6) -> list[Episode]:
    """The same with a sense that says less than it did."""
    gains = np.where(np.arange(sine_spec().size) == 3, gain, 1.0).astype(np.float32)
    return [replace(e, stream=e.stream * gains) for e in episodes]


def rows(memory: NeuralASM, episodes: list[Episode]) -> tuple[np.ndarray, np.ndarray]:
    """Inputs (N, I) and changes (N, X)."""
    senses = memory.senses_
    inputs = np.concatenate([senses.read_episode(e.stream).inputs[1:] for e in episodes])
    return inputs, inputs[:, senses.changes]


def special(memory: NeuralASM, episodes: list[Episode]):
    inputs, changes = rows(memory, episodes)
    senses, each = memory.senses_, memory.association_size // (int(memory.senses_.groups.max()) + 1)
    known = memory.network_.association
    return specialise(known, inputs, changes, senses.groups, senses.changes, each), senses, each


def test_what_changed_is_learned_from_a_few_episodes_and_the_given_association_is_left_as_it_was(body):
    known = body.network_.association
    before = [array.copy() for array in known]
    now, senses, each = special(body, worn(sine_episodes(10, seed=2)))
    for array, old in zip(known, before, strict=True):
        np.testing.assert_array_equal(array, old)
    a, delta = rows(body, worn(sine_episodes(10, seed=3)))

    def left(association):
        f = hidden_units(a, association.V)
        return np.mean((delta - complete(f, a, association.U, association.D)) ** 2, axis=0)

    assert left(now)[3] < 0.3 * left(known)[3]
    assert left(now).sum() < 0.5 * left(known).sum()
    exists = synapses(senses.groups, senses.changes, senses.inputs, each)
    assert not (now.D * (1 - exists.D)).any()
    assert not (now.U * (1 - exists.U)).any()


def test_episodes_of_the_body_itself_leave_it_nearly_as_it_was(body):
    known = body.network_.association
    now, *_ = special(body, sine_episodes(10, seed=2))
    a, delta = rows(body, sine_episodes(40, seed=4))

    def left(association):
        f = hidden_units(a, association.V)
        return np.mean((delta - complete(f, a, association.U, association.D)) ** 2)

    assert left(now) < 1.1 * left(known)


def test_a_specialised_memory_is_quiet_where_the_body_was_not_and_still_finds_what_freezes(body):
    asm = body.with_threshold(body.threshold)  # a copy
    asm.fit(worn(sine_episodes(20, seed=5)), warm_start=True).calibrate(worn(sine_episodes(20, seed=6)), 0.1)
    fresh = worn(sine_episodes(30, seed=7))
    alarms = [(s.value > asm.threshold).any() for s in asm.score_episodes(fresh)]
    assert np.mean(alarms) < 0.35
    assert np.mean([(s.value > body.threshold).any() for s in body.score_episodes(fresh)]) > 0.8
    stuck = asm.score_episodes([frozen(e, 5, 20) for e in fresh])
    assert np.mean([(s.value[20:] > asm.threshold).any() for s in stuck]) > 0.9
    assert asm.about == {"name": "sines", "specialised_on": 20}
    assert body.about == {"name": "sines"}


def test_how_errors_become_evidence_is_not_learned_anew_from_a_few(body):
    asm = body.with_threshold(body.threshold).fit(worn(sine_episodes(10, seed=2)), warm_start=True)
    for name, learned in body.detection.learned_.items():
        np.testing.assert_array_equal(asm.detection.learned_[name], learned)
    with pytest.raises(RuntimeError, match="no threshold"):
        _ = asm.threshold


def test_only_what_knows_something_and_can_go_on_does(body):
    with pytest.raises(RuntimeError, match="has learned nothing yet"):
        NeuralASM(sine_spec(), **SIZES).fit(sine_episodes(4), warm_start=True)
    kalman = make_monitor("kalman", sine_spec()).fit(sine_episodes(4))
    with pytest.raises(TypeError, match="learns all anew: leave warm_start out"):
        kalman.fit(sine_episodes(4), warm_start=True)
    with pytest.raises(ValueError, match="at least one episode"):
        body.fit([], warm_start=True)


def test_a_promise_is_kept_on_average_and_nearly_always_below_its_bound():
    rng, n, rate = np.random.default_rng(0), 40, 0.05
    shares, promises = [], []
    for _ in range(4000):
        maxima = rng.random(n)
        threshold = conformal_threshold(maxima, rate)
        shares.append(1.0 - threshold)  # of fresh episodes, whose maxima are uniform too
        promises.append(Promise.of(maxima, threshold))
    assert {p.episodes for p in promises} == {n}
    assert np.mean(shares) == pytest.approx(promises[0].rate, abs=0.002)
    assert promises[0].rate <= rate
    assert np.mean(np.array(shares) <= promises[0].at_most) == pytest.approx(0.95, abs=0.015)


def test_twenty_episodes_promise_what_they_can_and_say_so(body):
    asm = body.with_threshold(body.threshold)
    with pytest.raises(
        ValueError, match=r"needs at least 99 nominal episodes, got 20, which can promise 0\.048 at best"
    ):
        asm.calibrate(sine_episodes(20, seed=8), 0.01)
    promise = asm.calibrate(sine_episodes(20, seed=8), 0.048).promise
    assert promise == Promise(20, pytest.approx(1 / 21), pytest.approx(1 - 0.05 ** (1 / 20)))
    with pytest.raises(RuntimeError, match="knows no calibration"):
        _ = NeuralASM(sine_spec(), **SIZES).promise
