"""Code that was just compiled, against the same code loaded from the disk."""

import os
import subprocess
import sys

import pytest

from tests.needs import needs
from tests.wheel import ROOT

INFER = """
import numpy as np
from asm_gym.compilation import must_compile
from asm_gym.memory import energy

rng = np.random.default_rng(0)
mu, x, W = (rng.standard_normal(shape).astype(np.float32) for shape in ((64, 256), (64, 107), (107, 256)))
precision = np.ones_like(x)
print(must_compile(energy.infer), end=" ")
z = energy.infer(np.tanh(mu), x, 0.04 * W, precision, energy.Inference(30.0, 1.0, 60.0, 20))
print(*(part.tobytes().hex()[:100_000] for part in (z, energy.activate(z))))
"""
LOADED_FIRST = INFER.replace("z = inf", "energy.activate(mu)\nz = inf")


@pytest.mark.slow
def test_the_process_that_compiles_computes_the_same_to_the_last_bit(tmp_path):
    said = []
    for code in (INFER, INFER, LOADED_FIRST):
        env = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path), "OPENBLAS_NUM_THREADS": "1"}
        done = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, env=env, check=True
        )
        said.append(done.stdout.split())
    compiles, *numbers = zip(*said, strict=True)
    assert compiles == ("True", "False", "False")
    assert all(len(set(each)) == 1 for each in numbers)


NOWHERE = """
import numba.core.caching as caching
for locator in (caching.InTreeCacheLocator, caching.UserWideCacheLocator):
    locator.ensure_cache_path = lambda self: (_ for _ in ()).throw(OSError("read-only"))
from asm_gym import compilation
from asm_gym.memory import energy
print(compilation.kept_in(energy.activate))
"""


def test_code_is_kept_in_a_temporary_folder_where_neither_install_nor_home_can_be_written_to_unless_one_is_named(
    tmp_path,
):
    (tmp_path / "tmp").mkdir()
    env = {k: v for k, v in os.environ.items() if k not in ("NUMBA_CACHE_DIR", "HOME")}
    for named, kept in (
        ({"TMPDIR": str(tmp_path / "tmp")}, str(tmp_path / "tmp" / "asm-gym-numba-")),
        ({"NUMBA_CACHE_DIR": str(tmp_path)}, str(tmp_path)),
    ):
        run = [sys.executable, "-c", NOWHERE]
        done = subprocess.run(
            run, capture_output=True, text=True, env=env | named, check=True, cwd=ROOT
        )
        assert done.stdout.startswith(kept)
    assert not any((tmp_path / "tmp").iterdir())


OF_A_TYPE = """
from typing import NamedTuple
from asm_gym.compilation import compiled, must_compile

class TYPE(NamedTuple):
    x: float

@compiled
def twice(of):
    return 2 * of.x

print(must_compile(twice), twice(TYPE(2.0)))
"""


def test_code_that_was_kept_for_a_type_that_is_gone_is_compiled_anew(tmp_path):
    said, env = (
        [],
        os.environ | {"NUMBA_CACHE_DIR": str(tmp_path), "PYTHONPATH": f"{tmp_path}:{ROOT}"},
    )
    for name in ("Before", "After", "After"):
        (tmp_path / "arm.py").write_text(OF_A_TYPE.replace("TYPE", name))
        run = [sys.executable, "-c", "import arm"]
        said.append(
            subprocess.run(
                run, capture_output=True, text=True, env=env, check=True, cwd=tmp_path
            ).stdout
        )
    assert said == ["True 4.0\n", "True 4.0\n", "False 4.0\n"]


def test_code_that_another_processor_compiled_is_none(tmp_path):
    (tmp_path / "arm.py").write_text(OF_A_TYPE.replace("TYPE", "Arm"))
    said, env = (
        [],
        os.environ | {"NUMBA_CACHE_DIR": str(tmp_path), "PYTHONPATH": f"{tmp_path}:{ROOT}"},
    )
    generic = {"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": ""}
    for processor in ({}, generic, generic, {}):
        run, own = [sys.executable, "-c", "import arm"], env | processor
        said.append(
            subprocess.run(
                run, capture_output=True, text=True, env=own, check=True, cwd=tmp_path
            ).stdout
        )
    assert said == ["True 4.0\n", "True 4.0\n", "False 4.0\n", "False 4.0\n"]


ROBOSUITE_NOWHERE = """
import numba.core.caching as caching
kept = caching.InTreeCacheLocator.ensure_cache_path
def ensured(self):
    if "robosuite" in self.get_cache_path() or isinstance(self, caching.UserWideCacheLocator):
        raise OSError("read-only")
    return kept(self)
for locator in (caching.InTreeCacheLocator, caching.UserWideCacheLocator):
    locator.ensure_cache_path = ensured
from asm_gym.compilation import kept_in
from asm_gym.envs.robosuite_backend import import_robosuite
print(kept_in(import_robosuite().utils.transform_utils.quat2mat))
"""


def test_robosuites_code_is_kept_in_the_temporary_folder_too(tmp_path):
    needs("robosuite")
    env = {k: v for k, v in os.environ.items() if k != "NUMBA_CACHE_DIR"} | {
        "TMPDIR": str(tmp_path)
    }
    run = [sys.executable, "-c", ROBOSUITE_NOWHERE]
    done = subprocess.run(run, capture_output=True, text=True, env=env, check=True, cwd=ROOT)
    assert done.stdout.startswith(f"{tmp_path}/asm-gym-numba-")
    assert "NUMBA_CACHE_DIR" in done.stderr
