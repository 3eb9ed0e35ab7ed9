"""The benchmarks of watching: what they time is what they say."""

from contextlib import nullcontext
from dataclasses import replace
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
import torch
from rich.console import Console

from asm_gym.monitors import NeuralASM
from asm_gym.scripts.benchmark import main
from asm_gym.scripts.benchmark.memory import PlainTorch, synthetic
from asm_gym.scripts.benchmark.turns import BusyError, Turns, check_quiet
from asm_gym.scripts.benchmark.vector import vector_table


@pytest.mark.parametrize("channels", [5, 23])
def test_the_torch_rival_computes_the_same_surprise(channels):
    episodes = synthetic(channels, 12)
    asm = NeuralASM(episodes[0].spec, hidden_size=32, association_size=50, epochs=2).fit(episodes[:10])
    plain = PlainTorch(asm)
    stream = episodes[-1].stream.copy()
    stream[40:43, 0] = stream[40, 0]  # repeats itself twice
    with torch.no_grad():
        values = [plain.observe(row.astype(np.float64)) for row in stream]
    np.testing.assert_allclose(values, asm.score(replace(episodes[-1], stream=stream)).value, rtol=2e-3)


def test_both_print_their_ratios(capsys):
    assert main(["memory", "--hidden", "16", "--channels", "10", "--steps", "5", "--no-sweep", "--even-if-busy"]) == 0
    assert main(["safety", "--steps", "3", "--members", "2", "--even-if-busy"]) == 0
    shown = capsys.readouterr().out
    assert shown.count("×") >= 5
    assert "plain torch" in shown
    assert "under the wrapper" in shown
    assert "2 side by side under one wrapper keep" in shown
    assert "warm" in shown
    assert "cores, of which this process kept" in shown


def test_a_busy_machine_prints_no_figures(capsys, monkeypatch):
    monkeypatch.setattr("asm_gym.scripts.benchmark.turns.os.getloadavg", lambda: (9.0, 9.0, 9.0))
    assert main(["memory", "--hidden", "16", "--channels", "10", "--steps", "5", "--no-sweep"]) == 1
    shown = capsys.readouterr().out
    assert "too busy to tell" in shown
    assert "×" not in shown


@pytest.mark.parametrize(("share", "load", "busy"), [(0.99, 1.1, False), (0.6, 1.0, True), (0.99, 3.5, True)])
def test_what_is_busy(share, load, busy):
    with pytest.raises(BusyError) if busy else nullcontext():
        check_quiet(share, load, cores=2)


def test_a_ratio_is_of_medians_and_its_spread_over_repetitions():
    one, other = np.repeat(np.arange(1.0, 11.0), 3), np.ones(30)
    one[::3] = 100.0  # a hiccup in each repetition
    found = Turns({"a": one, "b": other}, 1.0).ratio("a", "b")
    assert found.mean == pytest.approx(5.5)
    assert found.sd == pytest.approx(np.std(np.arange(1, 11), ddof=1))


@pytest.mark.slow  # two processes start
def test_vector_environments_are_compared_on_a_quiet_machine_alone(monkeypatch):
    make = partial(gym.make, "asm_gym/Lift-v0", horizon=10**6, disable_env_checker=True)
    table = vector_table(make, (2,), 2, Console(), even_if_busy=True)
    assert table.headings[2:4] == ("ThreadVectorEnv", "AsyncVectorEnv")
    (row,) = table.rows
    assert row[0] == "2"
    assert int(row[1]) > 0
    assert all(float(cell.split("(")[1].split(" ±")[0]) > 0 for cell in row[2:])
    monkeypatch.setattr("asm_gym.scripts.benchmark.vector.os.getloadavg", lambda: (9.0, 9.0, 9.0))
    with pytest.raises(BusyError):
        vector_table(make, (1,), 1, Console(), even_if_busy=False)
