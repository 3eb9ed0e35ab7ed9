"""Weights of 8 bits: what rounding loses, and packing does not."""

import numpy as np
import pytest

from asm_gym import NeuralASM
from asm_gym.monitors.weight_packing import packed, rounded, unpacked
from tests.streams import sine_episodes, sine_spec


def weights(seed=0):
    rng = np.random.default_rng(seed)
    W = (rng.normal(size=(40, 30)) * np.exp(3 * rng.normal(size=(40, 1)))).astype(np.float32)
    W[3], W[4, 5:], W[6, 7] = 0, 0, 1e-12
    return {"V": W, "D": W.copy(), "mean": np.arange(3.0)}


@pytest.mark.parametrize("seed", range(5))
def test_rounding_moves_a_weight_by_half_a_step_at_most_and_packing_by_nothing(seed):
    before = weights(seed)
    after = rounded(before)
    step = np.abs(before["V"]).max(axis=1, keepdims=True) / 127 * 1.002
    assert (np.abs(after["V"] - before["V"]) <= np.where(after["V"] == before["V"], 0, step)).all()
    # but the faintest, which must stay
    assert np.mean(np.abs(after["V"] - before["V"]) <= step / 2) > 0.98
    np.testing.assert_array_equal(after["V"] == 0, before["V"] == 0)
    np.testing.assert_array_equal(after["D"], before["D"])
    kept = packed(after)
    assert set(kept) == {"V.bits", "V.scale", "mean", "D"}
    back = unpacked(kept)
    assert set(back) == set(after)
    for name, array in after.items():
        np.testing.assert_array_equal(back[name], array)
        assert back[name].dtype == array.dtype
    for name, array in rounded(after).items():
        np.testing.assert_array_equal(array, after[name])


@pytest.mark.parametrize("bad", [np.inf, -np.inf, np.nan])
def test_weights_that_no_integer_stands_for_are_refused_by_name_and_kept_as_they_are(bad):
    arrays = weights()
    arrays["V"][3, 4] = bad
    with pytest.raises(ValueError, match="V has weights that are not finite"):
        rounded(arrays)
    np.testing.assert_array_equal(unpacked(packed(arrays))["V"], arrays["V"])


def test_parts_that_do_not_fit_are_refused():
    with pytest.raises(
        ValueError, match="V of 8 bits should have a scale for each of its rows, got"
    ):
        unpacked({"V.bits": np.zeros((2, 2), np.int8)})


def test_a_rounded_memory_is_the_same_when_it_is_read_and_smaller(tmp_path):
    memory = NeuralASM(sine_spec(), hidden_size=64, association_size=64, epochs=1).fit(
        sine_episodes(40)
    )
    small = memory.rounded()
    assert small.threshold_ is None
    small.calibrate(sine_episodes(40, seed=1), 0.05)
    memory.calibrate(sine_episodes(40, seed=1), 0.05)
    for name, one in (("large", memory), ("small", small)):
        one.save(tmp_path / name)
        again, other = NeuralASM.load(tmp_path / name), sine_episodes(1, seed=2)[0]
        assert again.threshold == one.threshold
        np.testing.assert_array_equal(again.score(other).value, one.score(other).value)
    assert (tmp_path / "small").stat().st_size < (tmp_path / "large").stat().st_size
    assert small.threshold == pytest.approx(memory.threshold, rel=0.05)
