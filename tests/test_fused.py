"""A row in one compiled call, against the same kernels put together in Python."""

import numpy as np
import pytest
from threadpoolctl import threadpool_info

from asm_gym.monitors import NeuralASM
from asm_gym.monitors.fused import _ONE_THREAD, A_THREAD
from asm_gym.monitors.monitor import CalibratedMonitor
from asm_gym.scripts.benchmark import synthetic


def memory(dt=0.05, **settings):
    """A fitted memory, and rows (T, B, D) with which much is wrong."""
    episodes = synthetic(13, 10, skills=2, dt=dt)
    asm = NeuralASM(episodes[0].spec, hidden_size=16, association_size=30, epochs=1, **settings).fit(episodes[:8])
    rows = np.stack([e.stream.astype(np.float64) for e in episodes[-2:] + episodes[:3]], axis=1)
    rows[20, 1, 3] = np.nan
    rows[30:32, 2] = -np.inf
    rows[40:46, 3, 4] = rows[40, 3, 4]
    rows[50, 4, 2] = 1e12
    return asm, rows, episodes


def parts(state):
    return (*state.model, *state.detection.evidence, *state.detection.repetition)


def both(asm, rows, start):
    """Runs both ways side by side, and compares after every row."""
    ours = theirs = start
    for t, row in enumerate(rows):
        ours, found = asm.observe(ours, row)
        theirs, oracle = CalibratedMonitor.observe(asm, theirs, row)
        np.testing.assert_allclose(found.value, oracle.value, rtol=1e-5, err_msg=f"row {t}")
        scale = np.where(np.isfinite(oracle.value), oracle.value, 1.0).max()
        np.testing.assert_allclose(found.attribution, oracle.attribution, rtol=1e-5, atol=1e-6 * scale)
        for mine, other in zip(parts(ours), parts(theirs), strict=True):
            assert (mine.dtype, mine.shape) == (other.dtype, other.shape)
            np.testing.assert_allclose(mine, other, rtol=1e-4, atol=1e-5, err_msg=f"row {t}")


@pytest.mark.parametrize("dt", [0.05, 0.02, 0.01])
@pytest.mark.parametrize("batch", [1, 5])
def test_one_call_says_what_its_parts_say(dt, batch):
    asm, rows, _ = memory(dt)
    for first in range(0, 5, batch):
        both(asm, rows[:, first : first + batch], asm.initial_state(batch))


def test_streams_that_began_at_different_times_and_named_skills_make_no_difference():
    asm, rows, episodes = memory(0.01)
    asm.name_skills([e.__class__(**{**vars(e), "info": {"skill": str(n % 2)}}) for n, e in enumerate(episodes[:8])])
    state = asm.initial_state(5)
    state = state._replace(model=state.model._replace(steps=np.array([0, 1, 2, 5, 11])))
    both(asm, rows, state)


def test_streams_by_the_hundred_on_threads_say_what_each_would_alone():
    asm, rows, _ = memory()
    many = np.tile(rows[:12], (1, 2 * A_THREAD // 5 + 7, 1))
    assert many.shape[1] > 2 * A_THREAD
    both(asm, many, asm.initial_state(many.shape[1]))


def test_without_habituation_the_context_is_not_computed_and_surprise_is_the_same():
    asm, rows, _ = memory(habituates=False)
    state = asm.initial_state(1)
    for row in rows[:, 0]:
        state, found = asm.observe(state, row[None])
    assert not state.model.expected.any()
    values = [found.value[0]]
    state = asm.initial_state(1)
    for row in rows[:, 0]:
        state, found = CalibratedMonitor.observe(asm, state, row[None])
    assert state.model.expected.any()
    np.testing.assert_allclose(values, found.value, rtol=1e-5)


def test_neither_the_rows_nor_the_state_are_written_to_and_later_changes_of_a_row_do_not_matter():
    asm, rows, _ = memory()
    state, _ = asm.observe(asm.initial_state(1), rows[0, :1])
    kept, row = [p.copy() for p in parts(state)], rows[1, :1].copy()
    after, _ = asm.observe(state, row)
    for now, then in zip(parts(state), kept, strict=True):
        np.testing.assert_array_equal(now, then)
    np.testing.assert_array_equal(row, rows[1, :1])
    row += 1.0
    np.testing.assert_array_equal(after.model.before[0, -1], rows[1, 0])


def test_what_was_learned_since_counts():
    asm, rows, episodes = memory()
    state = asm.initial_state(1)
    for row in rows[:10, :1]:
        state, before = asm.observe(state, row)
    asm.fit(episodes[4:])
    both(asm, rows[:, :1], asm.initial_state(1))
    other = asm.with_threshold(1.0)
    other.adapt(state, rows[10, :1], before._replace(value=np.zeros(1)), rate=1.0)
    both(other, rows[:, :1], other.initial_state(1))


def test_many_streams_leave_the_threads_of_blas_as_they_were():
    before = [pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"]
    inside = []
    with _ONE_THREAD, _ONE_THREAD:
        inside = [pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"]
    assert set(inside) == {1}
    assert [pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"] == before
