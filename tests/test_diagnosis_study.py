"""The study of causes: which class a kind belongs to, and what every family counts."""

import numpy as np
import pytest

from asm_gym.faults.suite import KINDS
from asm_gym.monitors.diagnosis import CLASSES, EVIDENCE, FAMILIES, Readout, averaged
from asm_gym.scripts.cli import main
from asm_gym.scripts.reproduce.diagnosis import FAMILY, Examples, asked, class_of


def test_every_kind_of_the_suite_has_a_class_and_nothing_else_has():
    named = {kind: list(CLASSES)[class_of(kind)] for kind in KINDS}
    assert "unknown" not in named.values()
    assert (named["wrist_bias"], named["encoder_drift"], named["push"]) == ("force sensor", "sensor", "contact")
    assert list(CLASSES)[class_of("harmless")] == "unknown"


def rows_of(classes, kinds, episodes):
    n = len(classes)
    return Examples(np.zeros((n, 2)), np.asarray(classes), np.asarray(kinds), np.asarray(episodes), np.zeros(n, int))


def test_families_kinds_and_episodes_count_alike_however_many_rows_they_have():
    classes = np.array([class_of(k) for k in ("push", "push", "push", "payload", "slip")])
    kinds = np.array(["push", "push", "push", "payload", "slip"])
    weight = rows_of(classes, kinds, np.array([0, 0, 1, 2, 3])).weight
    np.testing.assert_allclose(weight, [0.125, 0.125, 0.25, 0.5, 1.0])


def test_what_is_believed_is_the_mean_of_an_episodes_diagnoses_and_a_half_sure_one_is_unknown():
    sensor, contact = (list(CLASSES).index(name) for name in ("sensor", "contact"))
    told = np.eye(len(CLASSES))[[sensor, contact, contact, contact]]
    rows = rows_of([contact] * 4, ["push"] * 4, [0, 0, 0, 1])
    made = asked(lambda evidence: told, rows, "seeds", 0)
    assert [r["p"] for r in made] == [1.0, 0.5, pytest.approx(2 / 3), 1.0]
    assert [r["right"] for r in made] == [False, False, True, True]
    vague = np.full((1, len(CLASSES)), 1 / len(CLASSES))
    (one,) = asked(lambda evidence: vague, rows.of(np.arange(4) == 3), "seeds", 0)
    assert one["unknown"]
    assert not one["right"]


def test_the_shipped_readout_fits_what_is_weighed():
    readout = Readout.shipped()
    assert readout.weights.shape == (len(CLASSES), len(EVIDENCE))
    assert readout(np.zeros((3, len(EVIDENCE)))).shape == (3, len(CLASSES))
    assert len(FAMILY) == len(CLASSES)


def test_a_run_without_recordings_is_refused(tmp_path, capsys):
    assert main(["reproduce", "diagnosis", "--run", str(tmp_path), "--out", str(tmp_path / "out")]) == 2
    assert "run asm-gym evaluate first" in capsys.readouterr().err.replace("\n", " ")


def test_a_belief_that_is_sure_stays_and_one_that_is_not_is_the_mean():
    sensor, contact = np.eye(len(FAMILIES))[:2]
    belief = np.zeros(len(FAMILIES))
    for n in (1, 2, 3):
        belief = averaged(belief, 0.95 * sensor + 0.05 * contact, n)
    np.testing.assert_array_equal(averaged(belief, contact, 4), belief)
    doubtful = 0.8 * sensor + 0.2 * contact
    np.testing.assert_allclose(averaged(doubtful, contact, 4), doubtful + (contact - doubtful) / 4)
    np.testing.assert_allclose(averaged(sensor, contact, 2), (sensor + contact) / 2)  # one diagnosis makes nobody sure
