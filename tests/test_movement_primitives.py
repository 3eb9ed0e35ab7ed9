"""Movement primitives: what they were shown is what they recall."""

from __future__ import annotations

import numpy as np
import pytest

from asm_gym.scripts.reproduce.movement_primitives import DMP, ProMP

DT = 1 / 60
TIME = np.linspace(0.0, 1.0, 61)


def demonstrations(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Two skills of six demonstrations each, which differ in how large they are."""
    paths = []
    for curve in (np.sin(3 * TIME), np.cos(4 * TIME)):
        shape = np.stack([3 * TIME**2, curve - curve[0]], axis=1)
        paths += [size * shape for size in 1 + 0.1 * rng.standard_normal(6)]
    return np.array(paths), np.repeat(["a", "b"], 6)


@pytest.mark.parametrize("skill", [0, 1])
def test_a_promp_infers_skill_and_size_from_the_cue(skill: int) -> None:
    paths, skills = demonstrations(np.random.default_rng(0))
    wanted = 1.1 * paths[6 * skill]
    recalled = ProMP(paths, skills, noise=1e-3).recall(wanted[:30])
    assert np.abs(recalled[30:] - wanted[30:]).max() < 0.05


@pytest.mark.parametrize("skill", [0, 1])
def test_a_dmp_follows_the_mean_demonstration(skill: int) -> None:
    paths, skills = demonstrations(np.random.default_rng(1))
    mean = paths[6 * skill : 6 * skill + 6].mean(axis=0)
    recalled = DMP(paths, skills, DT).recall(mean[:30])
    assert np.abs(recalled[30:] - mean[30:]).max() < 0.05 * np.ptp(mean)
