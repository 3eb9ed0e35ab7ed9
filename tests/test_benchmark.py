"""The benchmarks print the ratios they promise, and the ratios are robust."""

import numpy as np
import pytest

from asm_gym.scripts.benchmark import main, ratio


def test_each_benchmark_prints_its_rivals_and_writes_them(tmp_path):
    assert main(["--quick", "--steps", "3", "--members", "2", "--out", str(tmp_path)]) == 0
    shown = (tmp_path / "benchmark.md").read_text()
    for rival in (
        "gru+evidence",
        "64 streams",
        "stream at 100 Hz",
        "vector of 2",
        "mujoco.rollout",
        "robosuite",
    ):
        assert rival in shown


def test_a_ratio_is_of_medians_and_its_spread_over_parts():
    one, other = np.repeat(np.arange(1.0, 11.0), 3), np.ones(30)
    one[::3] = 100.0  # a hiccup in each part
    found = ratio(one, other)
    assert found.mean == pytest.approx(5.5)
    assert found.sd == pytest.approx(np.std(np.arange(1, 11), ddof=1))


def test_an_unknown_benchmark_or_task_is_refused(capsys, tmp_path):
    assert main(["montor", "--out", str(tmp_path / "out")]) == 2
    assert "did you mean 'monitor'?" in capsys.readouterr().err
    assert main(["env", "--task", "Lfit", "--out", str(tmp_path / "out")]) == 2
    assert "'Lift'" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
