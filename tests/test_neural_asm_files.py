"""The Neural ASM as a file: every bit of it comes back, and what is damaged or disarmed is refused."""

from __future__ import annotations

import json
import zipfile

import numpy as np
import pytest

from asm_gym.checkpoint import read_checkpoint, write_checkpoint
from asm_gym.monitors import NeuralASM
from asm_gym.monitors.weight_packing import unpacked
from tests.memories import learned_bytes, sine_memory
from tests.streams import sine_episodes


@pytest.fixture(scope="module")
def asm() -> NeuralASM:
    return sine_memory()


def test_save_and_load_keep_every_bit(asm, tmp_path):
    asm.save(tmp_path / "memory.asm")
    back = NeuralASM.load(tmp_path / "memory.asm")
    assert learned_bytes(back) == learned_bytes(asm)
    assert (back.spec, back.threshold, back.get_params()) == (
        asm.spec,
        asm.threshold,
        asm.get_params(),
    )
    episode = sine_episodes(1, seed=13)[0]
    assert back.score(episode).attribution.tobytes() == asm.score(episode).attribution.tobytes()
    back.save(tmp_path / "again.asm")
    with (
        zipfile.ZipFile(tmp_path / "memory.asm") as a,
        zipfile.ZipFile(tmp_path / "again.asm") as b,
    ):
        assert {n: a.read(n) for n in a.namelist()} == {n: b.read(n) for n in b.namelist()}


def rewritten(source, target, change) -> None:
    """Copies a checkpoint, with ``change(members)`` made to its {name: bytes}."""
    with zipfile.ZipFile(source) as file:
        members = {n: file.read(n) for n in file.namelist()}
    change(members)
    with zipfile.ZipFile(target, "w") as file:
        for name, data in members.items():
            file.writestr(name, data)


def without(*names):
    """A change for ``rewritten``: a checkpoint that never had these arrays."""

    def change(members):
        header = json.loads(members["header.json"])
        for name in names:
            del header["shapes"][name], header["arrays"][name], members[f"{name}.npy"]
        members["header.json"] = json.dumps(header).encode()

    return change


def tampered(asm, path, arrays=None, **header):
    """A checkpoint of ``asm`` in which something else is written."""
    asm.save(path)
    saved = read_checkpoint(path, asm.kind)
    write_checkpoint(path, asm.kind, saved.header | header, unpacked(saved.arrays) | (arrays or {}))
    return path


def test_a_checkpoint_without_what_the_detector_needs_is_refused(asm, tmp_path):
    asm.save(tmp_path / "m.asm")
    rewritten(tmp_path / "m.asm", tmp_path / "older.asm", without("tail"))
    with pytest.raises(ValueError, match="has no tail: make it anew"):
        NeuralASM.load(tmp_path / "older.asm")
    rewritten(tmp_path / "m.asm", tmp_path / "oldest.asm", without("remainder", "span_S"))
    older = "this memory has no span_S, remainder: make it anew, by asm-gym fit or asm-gym babble"
    with pytest.raises(ValueError, match=older):
        NeuralASM.load(tmp_path / "oldest.asm")


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"whitening": lambda a: 0 * a}, "no error can add up to evidence: at most 0"),
        ({"whitening": lambda a: 1e-9 * a}, "no error can add up to evidence"),
        ({"ceiling": lambda a: np.full_like(a, np.inf)}, "ceiling should be finite"),
        ({"ceiling": lambda a: np.full_like(a, 1e300)}, "no error can add up to evidence"),
        ({"ceiling": lambda a: -a}, r"ceiling of evidence must be in \(0, inf\]"),
        ({"tail": lambda a: 0 * a}, r"tail of evidence must be in \(0, 1\]"),
        ({"context_quantile": lambda a: a + 1000.0}, "no error can add up to evidence"),
        ({"W_C": lambda a: a * np.nan}, "W_C should be finite"),
        ({"extra": lambda _: np.zeros(3)}, "declares no extra"),
    ],
)
def test_weights_that_disarm_a_memory_are_refused(asm, tmp_path, arrays, message):
    changed = {name: change(asm.learned_.get(name)) for name, change in arrays.items()}
    with pytest.raises(ValueError, match=message):
        NeuralASM.load(tampered(asm, tmp_path / "m.asm", changed))


@pytest.mark.parametrize("threshold", [1e300, -1.0, True, "high", 10**400])
def test_a_threshold_that_nothing_exceeds_is_refused(asm, tmp_path, threshold):
    with pytest.raises(ValueError, match="threshold must be"):
        NeuralASM.load(tampered(asm, tmp_path / "m.asm", threshold=threshold))


@pytest.mark.parametrize("name", ["W_C", "whitening", "mean"])
def test_a_checkpoint_with_a_missing_or_misshapen_array_is_refused(asm, tmp_path, name):
    asm.save(tmp_path / "m.asm")
    with zipfile.ZipFile(tmp_path / "m.asm") as file:
        member = next(n for n in file.namelist() if n.startswith(f"{name}."))  # it may be packed
    rewritten(tmp_path / "m.asm", tmp_path / "missing.asm", lambda m: m.pop(member))
    with pytest.raises(ValueError, match="damaged"):
        NeuralASM.load(tmp_path / "missing.asm")
    rewritten(
        tmp_path / "m.asm", tmp_path / "shape.asm", lambda m: m.update({member: m["energy.npy"]})
    )
    with pytest.raises(ValueError, match="damaged"):
        NeuralASM.load(tmp_path / "shape.asm")


def test_a_file_of_an_older_version_is_refused_with_what_makes_it_anew(asm, tmp_path):
    with pytest.raises(ValueError, match=r"older version: make it anew with asm-gym fit"):
        NeuralASM.load(
            tampered(asm, tmp_path / "m.asm", {"W_C.planesf4": np.zeros((4, 8), np.uint8)})
        )
    with pytest.raises(ValueError, match=r"unknown dynamics 'traces'.*make it anew with asm-gym"):
        NeuralASM.load(
            tampered(
                asm, tmp_path / "m.asm", hyperparameters=asm.get_params() | {"dynamics": "traces"}
            )
        )
