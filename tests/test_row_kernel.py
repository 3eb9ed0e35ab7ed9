"""A row in one compiled call, against the same equations in NumPy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from threadpoolctl import threadpool_info

from asm_gym.blas import ONE_THREAD
from asm_gym.detection.evidence import (
    CONTEXT_GAIN,
    TAIL_INDEX,
    TINY,
    Evidence,
    bounded,
    pool,
    strength,
)
from asm_gym.detection.evidence_detection import EvidenceState
from asm_gym.detection.repetition import Repetition, evidence_steps
from asm_gym.memory.energy import activate
from asm_gym.memory.readout import KEPT, SMALLEST, certainty
from asm_gym.memory.recall import continued
from asm_gym.memory.temporal import UNSURE, MemoryState
from asm_gym.monitors import NeuralASM
from asm_gym.monitors.memory_model import MemoryModel
from asm_gym.monitors.memory_skills import name_skills, recall
from asm_gym.monitors.monitor_state import MonitorState
from tests.streams import sine_episodes, sine_spec


def expected_by(asm, state, rows):
    """The memory's errors (B, X) and its next state."""
    model, history = asm.model, state.history
    network, lag = model.network, model.lag
    reading = model.senses_.read(rows, *history.past(rows))
    due = history.steps % lag == 0
    carried, expected = state.carried.copy(), state.expected.copy()
    if due.any():
        read = reading.commands[due], reading.senses[due], reading.seen[due]
        step = network.follow(carried[due], *read)
        expected[due], carried[due] = activate(step.mu), step.carried
    a = network.association
    units = np.tanh(reading.inputs @ a.V.T)
    spread = np.clip(units @ a.W_S.T + a.b_S, *a.span_S)
    left = (reading.changes - reading.inputs @ a.D.T - units @ a.U.T) / a.remainder
    sure = np.where(history.steps < lag, 0.0, np.where(history.steps < 2 * lag, UNSURE, 1.0))
    errors = reading.whole * left * np.exp(-0.5 * spread) * sure[:, None]
    if len(a.R):
        steady, slope, most = a.leverage_scale
        far = np.minimum(leverages(a.R, reading.inputs, model.senses_), most)
        errors /= np.sqrt(steady + slope * far)
    skill = state.skill
    if asm.skills_:
        p = certainty(np.hstack([units, expected]), model.learned_["W_K"], model.learned_["b_K"])
        skill = KEPT * skill + np.log(p + SMALLEST)
    return errors, MemoryState(carried, expected, history.followed_by(rows), skill)


def leverages(R, inputs, senses):
    """Each group's inputs without its own changes, by an inverse of their own (B, X)."""
    order = np.arange(senses.inputs)
    places = order[senses.changes]
    order = np.r_[np.delete(order, places), places]
    root, C = np.linalg.inv(R.astype(np.float64)), np.zeros((len(R), len(R)))
    C[np.ix_(order, order)] = root @ root.T
    found = np.zeros((len(inputs), len(places)))
    for g in np.unique(senses.groups):
        others = np.setdiff1d(np.arange(len(C)), places[senses.groups == g])
        b = inputs[:, others].astype(np.float64)
        found[:, senses.groups == g] = np.sum(
            b * np.linalg.solve(C[np.ix_(others, others)], b.T).T, axis=1
        )[:, None]
    return found


def observed_by(asm, state, rows):
    """The value (B,), the attribution (B, D), and the next state."""
    errors, memory = expected_by(asm, state.model, rows)
    d, senses, (was, before) = asm.detection.detector_, asm.spec.sensory, state.detection
    white = bounded(errors, d.bound) @ d.whitening
    evidence = Evidence(
        vector=was.vector + d.gains[:, None] * (white[:, None] - was.vector),
        context=was.context + CONTEXT_GAIN * (memory.expected - was.context),
        steps=was.steps + 1,
    )
    ratios = (strength(evidence, d.gains) / d.ceiling) ** d.tail
    _, parts = pool(ratios.reshape(len(rows), -1))
    drive = (
        np.hstack([memory.expected, evidence.context]) @ d.context_quantile[:-1]
        + d.context_quantile[-1]
    )
    parts = (
        parts.reshape(ratios.shape).sum(axis=1) / np.exp(np.clip(drive, *d.context_range))[:, None]
    )

    counted = asm.learned_["repetition"]
    now = rows[:, senses]
    again, steps = now == before.row, evidence_steps(counted[:2])
    added = steps[before.again.astype(int), again.astype(int), np.arange(len(senses))]
    unlikely = np.clip(before.unlikely + added, 0.0, counted[2] + 27.0)
    repetition = Repetition(now, again, unlikely)
    attribution, stuck = np.zeros(rows.shape), np.zeros(rows.shape)
    ratios = np.where(unlikely > 0, np.exp(TAIL_INDEX * (unlikely - counted[2] - 3.0)), 0.0)
    attribution[:, senses], stuck[:, senses] = parts, ratios
    total = attribution.sum(axis=1, keepdims=True)
    pooled = pool(np.hstack([total, stuck]))[1]
    attribution = attribution * (pooled[:, :1] / np.maximum(total, TINY)) + pooled[:, 1:]
    finite = np.isfinite(rows)
    broken = ~finite.all(axis=1)
    attribution[broken] = np.where(finite[broken], 0.0, np.inf)
    return (
        attribution.sum(axis=1),
        attribution,
        MonitorState(memory, EvidenceState(evidence, repetition), state.excuses),
    )


def memory(dt=0.05, **settings):
    """A fitted memory, and rows (T, B, D) with which much is wrong."""
    spec = replace(sine_spec(), dt=dt)
    episodes = sine_episodes(12, spec=spec, steps=(60, 60))
    asm = NeuralASM(spec, hidden_size=16, association_size=30, epochs=1, **settings).fit(
        episodes[:8]
    )
    rows = np.stack([e.stream.astype(np.float64) for e in episodes[-4:] + episodes[:1]], axis=1)
    rows[20, 1, 3] = np.nan
    rows[30:32, 2] = -np.inf
    rows[40:46, 3, 4] = rows[40, 3, 4]
    rows[50, 4, 2] = 1e12
    return asm, rows, episodes


def leaves(state):
    return (
        [state]
        if isinstance(state, np.ndarray)
        else [leaf for part in state for leaf in leaves(part)]
    )


def both(asm, rows, start):
    """Runs both ways side by side, and compares after every row."""
    ours = theirs = start
    for t, row in enumerate(rows):
        ours, found = asm.observe(ours, row)
        value, attribution, theirs = observed_by(asm, theirs, row)
        np.testing.assert_allclose(found.value, value, rtol=1e-3, err_msg=f"row {t}")
        scale = np.where(np.isfinite(value), value, 1.0).max()
        np.testing.assert_allclose(found.attribution, attribution, rtol=5e-3, atol=1e-3 * scale)
        for mine, other in zip(leaves(ours), leaves(theirs), strict=True):
            assert mine.shape == other.shape
            np.testing.assert_allclose(mine, other, rtol=1e-3, atol=1e-4, err_msg=f"row {t}")
        theirs = ours  # rounding must not add up


@pytest.mark.parametrize("dt", [0.05, 0.02, 0.01])
@pytest.mark.parametrize("batch", [1, 5])
def test_one_call_gives_what_the_equations_give(dt, batch):
    asm, rows, _ = memory(dt)
    for first in range(0, 5, batch):
        both(asm, rows[:, first : first + batch], asm.initial_state(batch))


@pytest.mark.parametrize("dynamics", ["settling", "recurrent"])
def test_streams_that_began_at_different_times_and_named_skills_make_no_difference(dynamics):
    asm, rows, episodes = memory(0.01, dynamics=dynamics)
    name_skills(
        asm,
        [
            e.__class__(**{**vars(e), "info": {"skill": str(n % 2)}})
            for n, e in enumerate(episodes[:8])
        ],
    )
    state = asm.initial_state(5)
    history = state.model.history._replace(steps=np.array([0, 1, 2, 5, 11]))
    both(asm, rows, state._replace(model=state.model._replace(history=history)))


def test_without_habituation_the_context_is_not_computed_and_surprise_is_the_same():
    asm, rows, _ = memory(habituates=False)
    state = other = asm.initial_state(1)
    for row in rows[:, 0]:
        state, found = asm.observe(state, row[None])
        value, _, other = observed_by(asm, other, row[None])
    assert not state.model.expected.any()
    assert other.model.expected.any()
    np.testing.assert_allclose(found.value, value, rtol=1e-3)


def test_neither_the_rows_nor_the_state_are_written_to_and_later_changes_of_a_row_do_not_matter():
    asm, rows, _ = memory()
    state, _ = asm.observe(asm.initial_state(1), rows[0, :1])
    kept, row = [p.copy() for p in leaves(state)], rows[1, :1].copy()
    after, _ = asm.observe(state, row)
    for now, then in zip(leaves(state), kept, strict=True):
        np.testing.assert_array_equal(now, then)
    np.testing.assert_array_equal(row, rows[1, :1])
    row += 1.0
    np.testing.assert_array_equal(after.model.history.before[0, -1], rows[1, 0])


def test_what_was_learned_since_counts():
    asm, rows, episodes = memory()
    state = asm.initial_state(1)
    for row in rows[:10, :1]:
        state, _ = asm.observe(state, row)
    asm.fit(episodes[4:])
    both(asm, rows[:, :1], asm.initial_state(1))


def test_many_streams_leave_the_threads_of_blas_as_they_were():
    before = [pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"]
    inside = []
    with ONE_THREAD, ONE_THREAD:
        inside = [pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"]
    assert set(inside) == {1}
    assert [
        pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"
    ] == before


LAG = 3
FAST = replace(sine_spec(), dt=0.05 / LAG)


@pytest.fixture(scope="module")
def fast() -> NeuralASM:
    return NeuralASM(FAST, hidden_size=24, association_size=60, epochs=2).fit(
        sine_episodes(12, spec=FAST)
    )


@pytest.fixture(scope="module")
def slow(fast) -> MemoryModel:
    """The same weights, for a stream at the control rate."""
    asm = NeuralASM(sine_spec(), hidden_size=24, association_size=60, epochs=2)
    return asm.model.restore(fast.model.learned_)


def told(model: MemoryModel, stream: np.ndarray) -> np.ndarray:
    """(T, X) errors, row by row."""
    state, errors = model.start(1), []
    for row in stream.astype(np.float64):
        state, output = model.predict(state, row[None])
        errors.append(output.errors[0])
    return np.array(errors)


def test_every_third_row_feels_as_if_there_were_no_others(fast, slow):
    stream = sine_episodes(1, seed=3)[0].stream
    errors = told(fast.model, stream)
    for first in range(LAG):
        np.testing.assert_allclose(
            errors[first::LAG], told(slow, stream[first::LAG]), rtol=2e-5, atol=2e-6
        )
    assert np.abs(errors[2 * LAG :]).max() > 0.1


def test_recall_goes_on_with_every_third_row(fast, slow):
    cue = sine_episodes(1, seed=6)[0].stream[:16]
    rows = recall(fast, cue, 7)
    for turn in range(LAG):  # the cue's first row belongs to none of them
        expected = continued(slow.network, slow.senses_, cue[1 + turn :: LAG], 3)
        np.testing.assert_allclose(
            rows[turn::LAG], expected[: len(rows[turn::LAG])], rtol=1e-4, atol=1e-5
        )
    with pytest.raises(ValueError, match="at least 6 rows"):
        recall(fast, cue[:5], 1)


def test_episodes_too_short_to_have_a_change_are_refused():
    short = sine_episodes(1, spec=FAST, steps=(LAG, LAG))
    with pytest.raises(ValueError, match="episode 0 must be at least 4 steps long, got 3"):
        NeuralASM(FAST).fit(short)


def test_a_state_that_is_written_again_says_the_same_and_leaves_what_was_returned_before_alone():
    asm = NeuralASM(sine_spec(), hidden_size=8, association_size=8, epochs=1).fit(sine_episodes(4))
    rows, state, free = sine_episodes(1)[0].stream[:, None], asm.initial_state(1), None
    fresh, kept = state, []
    for t, row in enumerate(rows[:20]):
        fresh, expected = asm.observe(fresh, row)
        before, (state, found) = state, asm.observe(state, row, free)
        free = before if t else None  # the initial state stays as it is
        kept.append((expected, found))
    for expected, found in kept:
        np.testing.assert_array_equal(found.value, expected.value)
        np.testing.assert_array_equal(found.attribution, expected.attribution)
    np.testing.assert_array_equal(state.detection.evidence.vector, fresh.detection.evidence.vector)
