"""Code that was just compiled, against the same code loaded from the disk."""

import os
import subprocess
import sys

import pytest

INFER = """
import numpy as np
from asm_gym.compilation import must_compile
from asm_gym.memory import energy, inference

rng = np.random.default_rng(0)
mu, x, W = (rng.standard_normal(shape).astype(np.float32) for shape in ((64, 256), (64, 107), (107, 256)))
precision = np.ones_like(x)
print(must_compile(inference.infer), end=" ")
z = inference.infer(np.tanh(mu), x, 0.04 * W, 30.0, precision, 60.0, 20)
bend = energy.energy_gradient(z, np.tanh(mu), x, 0.04 * W, 30.0, precision)
print(z.tobytes().hex()[:100_000], *(part.tobytes().hex()[:100_000] for part in bend))
"""
LOADED_FIRST = INFER.replace("z = inf", "energy.energy_gradient(mu, mu, x, W, 30.0, precision)\nz = inf")


@pytest.mark.slow
def test_the_process_that_compiles_computes_the_same_to_the_last_bit(tmp_path):
    said = []
    for code in (INFER, INFER, LOADED_FIRST):
        env = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path), "OPENBLAS_NUM_THREADS": "1"}
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=env, check=True)
        said.append(done.stdout.split())
    compiles, *numbers = zip(*said, strict=True)
    assert compiles == ("True", "False", "False")
    assert all(len(set(each)) == 1 for each in numbers)
