"""Rivals in surprise on the Panda: beliefs row by row against all rows at once, and energy without its parts."""

from __future__ import annotations

import numpy as np
import pytest

from asm_gym.data.episode import Episode
from asm_gym.detection.detector import BOUND
from asm_gym.detection.evidence import POWER
from asm_gym.scripts.reproduce import workspace
from asm_gym.scripts.reproduce.expression import fit_reader
from asm_gym.scripts.reproduce.group_energy import WHOLE, GroupEnergy
from asm_gym.scripts.reproduce.skill_envelope import Belief, SkillDistribution, SkillEnvelope

ROWS = 60


def test_a_belief_row_by_row_is_the_conditional_distribution_of_all_rows_at_once():
    rng = np.random.default_rng(0)
    T, N, R = 6, 4, 3
    skill = SkillDistribution(
        mean=rng.normal(size=(T, N)),
        modes=rng.normal(size=(T, N, R)),
        variance=rng.uniform(0.1, 1.0, size=(T, N)),
    )
    rows = rng.normal(size=(T - 1, N))
    belief = Belief(skill)
    for t, row in enumerate(rows):
        belief.add(t, row)
    mean, variance = belief.expected(T - 1)

    flat = skill.modes.reshape(T * N, R)
    joint = flat @ flat.T + np.diag(skill.variance.ravel())
    seen = (T - 1) * N
    gain = joint[seen:, :seen] @ np.linalg.inv(joint[:seen, :seen])
    unexpected = (rows - skill.mean[:-1]).ravel()
    np.testing.assert_allclose(mean, skill.mean[-1] + gain @ unexpected, rtol=1e-6)
    left = joint[seen:, seen:] - gain @ joint[:seen, seen:]
    np.testing.assert_allclose(variance, np.diag(left), rtol=1e-6)


def moving(skill: int, size: float, seed: int) -> Episode:
    """A stream of the Panda's senses that goes a way of its skill, as far as it is large."""
    rng = np.random.default_rng(seed)
    phase = np.linspace(0.0, 1.0, ROWS)[:, None] * np.pi + np.arange(workspace.SPEC.size)
    way = size * (np.sin(phase) if skill else np.cos(2 * phase))
    stream = way + 0.01 * rng.normal(size=way.shape)
    return Episode.from_stream(stream, workspace.SPEC, info={"skill": "ab"[skill]})


@pytest.fixture(scope="module")
def demonstrations() -> list[Episode]:
    rng = np.random.default_rng(1)
    return [moving(n % 2, rng.uniform(0.8, 1.2), n) for n in range(24)]


@pytest.mark.parametrize("skill", [0, 1])
def test_a_promp_goes_on_from_the_first_rows_in_the_right_skill_and_size(demonstrations, skill):
    model = SkillEnvelope(fit_reader(demonstrations), demonstrations, modes=3).after(10)
    wanted = moving(skill, 1.1, 99).stream.astype(np.float64)
    for t in range(40):
        row = wanted[t] if t < 10 else np.full(workspace.SPEC.size, 7.0)
        model._step(row)
    np.testing.assert_allclose(model.command(), wanted[40, workspace.SPEC.motor], atol=0.15)


def test_an_envelope_is_surprised_by_a_size_that_the_promp_takes_in(demonstrations):
    reader = fit_reader(demonstrations)
    larger = moving(0, 1.2, 50).stream
    errors = {}
    for modes in (0, 3):
        model = SkillEnvelope.learned(reader, demonstrations, modes)
        errors[modes] = np.square(model.errors(larger)[10:]).mean()
        stuck = larger.astype(np.float64)
        stuck[40:, workspace.JOINTS] = stuck[40, workspace.JOINTS]
        energy = model.read_stream(stuck).energy[40:].max(axis=0)
        assert energy.argmax() == workspace.GROUPS.index("joint")
    assert errors[3] < errors[0]


def test_energy_without_calibration_and_evidence_is_of_the_squared_errors_of_the_row():
    rng = np.random.default_rng(2)
    errors = rng.normal(size=(30, 5))
    members = np.array([[True, True, False, False, False], [False, False, True, True, True]])
    parts = WHOLE._replace(calibrated=False, gains=(1.0,))
    energy = GroupEnergy([errors], members, parts)
    energy.begin()
    for error in errors:
        found = energy.add(error, np.ones(5, np.bool_))
        squares = error**2 / (1 + error**2 / BOUND**2)
        wanted = [np.sum(squares[own] ** POWER) ** (1 / POWER) for own in members]
        np.testing.assert_allclose(found, wanted)
