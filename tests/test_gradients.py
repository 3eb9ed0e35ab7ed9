"""Local changes of weights, against the exact gradient and finite differences."""

from __future__ import annotations

import numpy as np
import pytest

from asm_gym.memory.inference import Weights, direct_synapses
from asm_gym.memory.learning import Batch
from asm_gym.memory.network import initial_weights
from asm_gym.scripts.reproduce.gradients import COMPARED, cosine, exact, local


def small_batch(steps: int, seed: int = 0) -> tuple[Weights, Batch]:
    rng = np.random.default_rng(seed)
    senses, commands = (rng.normal(size=(steps, 4, n)).astype(np.float32) for n in (5, 3))
    weights = initial_weights(7, 5, 2, rng)
    weights.W_F[:] = rng.normal(size=weights.W_F.shape)
    weights.W_D[:] = 0.1 * rng.normal(size=weights.W_D.shape) * direct_synapses(5, 2)
    return weights, Batch(senses, commands, np.full(steps, 4))


def test_the_differentiated_network_has_the_energy_and_the_errors_of_the_memory():
    weights, batch = small_batch(14)
    theirs = exact(weights, batch, 15, 3.0)
    assert theirs["energy"].energy == pytest.approx(local(weights, batch, 15, 3.0).energy, rel=1e-4)
    assert theirs["error"].error == pytest.approx(local(weights, batch, 15, 3.0).error, rel=1e-4)
    assert theirs["alone"].error == pytest.approx(local(weights, batch, 15, 3.0, alone=True).error, rel=1e-4)


def test_at_converged_inference_the_local_change_is_the_exact_gradient_of_the_energy():
    weights, batch = small_batch(6)  # along six steps: nothing has to come back through time
    ours, theirs = local(weights, batch, 400, 1.0), exact(weights, batch, 400, 1.0)["energy"]
    for name in COMPARED:
        np.testing.assert_allclose(ours.arrays[name], theirs.arrays[name], atol=1e-3)


def test_the_exact_gradient_is_that_of_finite_differences():
    weights, batch = small_batch(14)
    gradient = exact(weights, batch, 8, 1.0)
    for name, index in (("W_C", (2, 3)), ("W_F", (1, 4)), ("W_D", (0, 2)), ("W_D", (6, 5))):
        for target in ("error", "alone"):
            ends = []
            for step in (0.01, -0.01):
                moved = getattr(weights, name).copy()
                moved[index] += step
                ends.append(local(weights._replace(**{name: moved}), batch, 8, 1.0, target == "alone").error)
            slope = (ends[0] - ends[1]) / 0.02
            assert -gradient[target].arrays[name][index] == pytest.approx(slope, rel=0.05, abs=0.02)


def test_the_local_change_comes_closer_to_the_gradient_the_firmer_the_prior():
    weights, batch = small_batch(20)
    angles = []
    for pi_z in (1.0, 100.0):
        theirs = exact(weights, batch, 50, pi_z)
        angles.append(cosine(local(weights, batch, 50, pi_z), theirs["error"]))
        # What running on alone would need to send back through time is left out.
        assert 0.2 < cosine(local(weights, batch, 50, pi_z, alone=True), theirs["alone"]) < 0.999
    assert 0.5 < angles[0] < angles[1]
    assert angles[1] > 0.999
    ours = local(weights, batch, 5, 1.0)
    assert cosine(ours, ours) == pytest.approx(1.0)
    assert exact(weights, batch, 5, 1.0, ("error",))["error"].saved > 20 * ours.saved
