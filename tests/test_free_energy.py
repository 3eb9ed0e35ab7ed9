"""One energy: its slopes against differences, and what descends it."""

from __future__ import annotations

import numpy as np
import pytest

from asm_gym import Channel, Episode, NeuralASM, StreamSpec
from asm_gym.memory.free_energy import FreeEnergy

SPEC = StreamSpec(
    (
        Channel("angle", 2, "rad", group="arm"),
        Channel("hand", 2, "m", group="hand"),
        Channel("action", 2, group="action"),
    ),
    dt=0.05,
)


def episode(rng: np.random.Generator, rows: int = 80) -> Episode:
    """Two joints that do as commanded, and a hand that is where they put it."""
    t = np.arange(rows) * 0.05
    phase = rng.uniform(0, 2 * np.pi)
    u = np.stack([np.sin(2 * t + phase), np.cos(3 * t + phase)], axis=1)
    q = 0.05 * np.cumsum(u, axis=0) + rng.normal(0, 0.001, (rows, 2))
    hand = np.stack([np.cos(q[:, 0]) + np.cos(q.sum(1)), np.sin(q[:, 0]) + np.sin(q.sum(1))], axis=1)
    return Episode.from_stream(np.hstack([q, hand + rng.normal(0, 0.001, (rows, 2)), u]), SPEC)


@pytest.fixture(scope="module", params=["traces", "settling"])
def known(request):
    rng = np.random.default_rng(0)
    healthy = [episode(rng) for _ in range(30)]
    asm = NeuralASM(SPEC, hidden_size=24, association_size=16, epochs=10, dynamics=request.param).fit(healthy[:20])
    return asm.model.free_energy(healthy[20:24]), healthy[24:]


def test_its_slope_is_that_of_finite_differences(known):
    energy, fresh = known
    moment, row = energy.moments(fresh[0].stream)[20]
    rng = np.random.default_rng(1)
    z = energy.inferred(moment, row) + 0.1 * rng.standard_normal(energy.network.hidden_size)
    row = row + 0.3 * energy.senses.change * rng.standard_normal(len(row))
    (_, slope, slope_z), spread, tiny = energy._of(energy._given(moment), row, z), energy.senses.spread, 1e-6

    def risen(part: np.ndarray, at: int, by: float) -> float:
        moved = part.copy()
        moved[at] += by
        where = (moved, z) if part is row else (row, moved)
        return energy.terms(moment, *where).total

    by_row = [
        (risen(row, i, tiny * spread[i]) - risen(row, i, -tiny * spread[i])) / (2 * tiny) for i in range(len(row))
    ]
    by_z = [(risen(z, i, tiny) - risen(z, i, -tiny)) / (2 * tiny) for i in range(len(z))]
    np.testing.assert_allclose(slope, by_row, rtol=1e-4, atol=1e-3)
    np.testing.assert_allclose(slope_z, by_z, rtol=1e-4, atol=1e-3)


def test_it_rises_where_a_sense_leaves_what_is_expected(known):
    energy, fresh = known
    healthy = [energy.terms(m, row, energy.inferred(m, row)).total for m, row in energy.moments(fresh[0].stream)]
    broken = fresh[0].stream.copy()
    broken[40:, 0] = broken[40, 0]  # a frozen encoder
    found = [energy.terms(m, row, energy.inferred(m, row)).total for m, row in energy.moments(broken)]
    assert np.max(found[40:]) > np.max(healthy) + 5.0


def test_what_is_missing_is_completed_by_descending_it(known):
    energy, fresh = known
    free = np.array([True, False, False, False, False, False])
    own, last = [], []
    for moment, row in energy.moments(fresh[1].stream)[10:40]:
        asked = row.copy()
        asked[0] = moment.before[0, 0]
        settled, terms = energy.settled(moment, asked, free)
        assert terms.total <= energy.terms(moment, asked, energy.inferred(moment, asked)).total + 1e-6
        np.testing.assert_array_equal(settled[1:], row[1:])
        own.append(settled[0] - row[0])
        last.append(asked[0] - row[0])
    assert np.sqrt(np.mean(np.square(own))) < 0.3 * np.sqrt(np.mean(np.square(last)))


def test_the_command_that_lets_it_be_lowest_is_one_that_is_commanded_here(known):
    energy, fresh = known
    told, found = [], []
    for moment, row in energy.moments(fresh[2].stream)[10:30]:
        told.append(row[SPEC.motor])
        found.append(energy.reaction(moment))
    off, usual = np.sqrt(np.mean((np.array(found) - told) ** 2)), np.std(told)
    assert off < 0.7 * usual


def test_spreads_of_no_row_are_refused(known):
    energy, fresh = known
    with pytest.raises(ValueError, match="no healthy row"):
        FreeEnergy.of(energy.network, energy.senses, [fresh[0].stream[:2]])
