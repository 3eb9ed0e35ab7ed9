"""Names of skills: what single moments say, added up, from the units of association and from the state."""

from __future__ import annotations

import numpy as np

from asm_gym.memory.readout import KEPT, add_up, certainty, learn_readout


def streams(rng: np.random.Generator, count: int, steps: int = 20) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Units (N, T, 3) that say nothing of the skill, a state (N, T, 2) that hints at it, and the skill (N,)."""
    skill = np.arange(count) % 2
    units = rng.normal(size=(count, steps, 3)).astype(np.float32)
    state = (0.5 * (2 * skill[:, None, None] - 1) + rng.normal(size=(count, steps, 2))).astype(np.float32)
    return units, state, skill


def test_what_moments_say_adds_up_and_is_forgotten():
    rng = np.random.default_rng(0)
    L, units, state = (rng.normal(size=(4, n)).astype(np.float32) for n in (2, 3, 5))
    W_K, b_K = rng.normal(size=(2, 8)).astype(np.float32), rng.normal(size=2).astype(np.float32)
    drive = np.hstack([units, state]) @ W_K.T + b_K
    p = np.exp(drive) / np.exp(drive).sum(axis=1, keepdims=True)
    np.testing.assert_allclose(add_up(L, units, state, W_K, b_K), KEPT * L + np.log(p + 1e-6), atol=1e-4)


def test_names_that_were_learned_from_the_units_alone_do_not_look_at_the_state():
    rng = np.random.default_rng(0)
    L, units = np.zeros((4, 2), np.float32), rng.normal(size=(4, 3)).astype(np.float32)
    W_K, b_K = rng.normal(size=(2, 3)).astype(np.float32), np.zeros(2, np.float32)
    named = [add_up(L, units, rng.normal(size=(4, 5)).astype(np.float32), W_K, b_K) for _ in range(2)]
    np.testing.assert_array_equal(*named)
    np.testing.assert_allclose(named[0], np.log(certainty(units, W_K, b_K) + 1e-6), atol=1e-4)


def test_a_skill_that_only_the_state_tells_is_named_in_the_end():
    rng = np.random.default_rng(1)
    units, state, skill = streams(rng, 200)
    told = np.concatenate([units, state], axis=2).reshape(-1, 5)
    W_K, b_K = learn_readout(told.__getitem__, np.repeat(skill, 20), 2, rng, updates=300)
    units, state, skill = streams(rng, 200)
    L, right = np.zeros((200, 2), np.float32), []
    for t in range(20):
        L = add_up(L, units[:, t], state[:, t], W_K, b_K)
        right.append(np.mean(L.argmax(axis=1) == skill))
    assert right[-1] > 0.95
    assert right[-1] > right[0] + 0.1
