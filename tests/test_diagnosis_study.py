"""The study of causes: which class a kind belongs to, and what every family counts."""

import numpy as np

from asm_gym.faults.suite import KINDS
from asm_gym.monitors.diagnosis import CLASSES, EVIDENCE, Readout
from asm_gym.scripts.reproduce.diagnosis import FAMILY, Examples, class_of, main


def test_every_kind_of_the_suite_has_a_class_and_nothing_else_has():
    named = {kind: list(CLASSES)[class_of(kind)] for kind in KINDS}
    assert "unknown" not in named.values()
    assert (named["wrist_bias"], named["encoder_drift"], named["push"]) == ("force sensor", "sensor", "contact")
    assert list(CLASSES)[class_of("harmless")] == "unknown"


def test_families_kinds_and_episodes_count_alike_however_many_rows_they_have():
    classes = np.array([class_of(k) for k in ("push", "push", "push", "payload", "slip")])
    kinds = np.array(["push", "push", "push", "payload", "slip"])
    weight = Examples(np.zeros((5, 2)), classes, kinds, np.array([0, 0, 1, 2, 3])).weight
    np.testing.assert_allclose(weight, [0.125, 0.125, 0.25, 0.5, 1.0])


def test_the_shipped_readout_fits_what_is_weighed():
    readout = Readout.shipped()
    assert readout.weights.shape == (len(CLASSES), len(EVIDENCE))
    assert readout(np.zeros((3, len(EVIDENCE)))).shape == (3, len(CLASSES))
    assert len(FAMILY) == len(CLASSES)


def test_a_run_without_recordings_is_refused(tmp_path, capsys):
    assert main(["--run", str(tmp_path), "--out", str(tmp_path / "out")]) == 2
    assert "run asm-gym evaluate first" in capsys.readouterr().err.replace("\n", " ")
