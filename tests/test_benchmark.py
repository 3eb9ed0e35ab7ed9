"""The benchmarks of watching: what they time is what they say."""

import socket
from contextlib import nullcontext
from dataclasses import replace
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
import torch
from rich.console import Console

from asm_gym.monitors import NeuralASM, make_monitor
from asm_gym.monitors.stream_model import model_outputs
from asm_gym.scripts.benchmark import main
from asm_gym.scripts.benchmark.experts import Attempt, _row, attempt
from asm_gym.scripts.benchmark.fit import errors, repeated
from asm_gym.scripts.benchmark.fleet import ROOM, Fleet, Inbox
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
    assert "ONNX Runtime" in shown
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


@pytest.mark.slow
def test_errors_of_both_learners_are_those_their_surprise_is_made_of():
    episodes = synthetic(10, 12)
    for monitor in (
        NeuralASM(episodes[0].spec, hidden_size=16, association_size=50, epochs=1),
        make_monitor("gru", episodes[0].spec),
    ):
        monitor.fit(episodes[:10])
        (off,) = errors(monitor.model, episodes[-1:])
        (run,) = model_outputs(monitor.model, episodes[-1:])
        ratio = run.errors[2:] / off  # 1/σ, whichever way the error went
        assert np.all(ratio > 0)
        assert off.shape == (len(episodes[-1]) - 2, 10)
    assert main(["fit", "--tasks", "Lift", "--episodes", "5", "--even-if-busy"]) == 0


def test_what_learning_costs_is_printed_of_repeated_episodes_and_on_a_quiet_machine_alone(capsys, monkeypatch):
    asked = ["fit", "--tasks", "Lift", "--episodes", "6", "--recorded", "4", "--no-rival"]
    assert main([*asked, "--even-if-busy"]) == 0
    shown = capsys.readouterr().out
    assert "6 episodes of Lift" in shown
    assert "4 episodes were recorded" in shown
    monkeypatch.setattr("asm_gym.scripts.benchmark.fit.os.getloadavg", lambda: (9.0, 9.0, 9.0))
    assert main(asked) == 1
    shown = capsys.readouterr().out
    assert "too busy to tell" in shown
    assert "median error" not in shown
    assert main(["fit", "--recorded", "61"]) == 2


def test_repeated_episodes_differ_by_the_noise_of_their_sensors():
    episodes = synthetic(5, 2)
    spec = episodes[0].spec
    made = repeated(episodes, 7, seed=0)
    assert [e.stream.shape for e in made] == [episodes[n % 2].stream.shape for n in range(7)]
    np.testing.assert_array_equal(made[1].stream, episodes[1].stream)
    off = made[6].stream - episodes[0].stream
    np.testing.assert_allclose(off[:, spec.sensory].std(), 0.01, rtol=0.2)  # what its channels declare
    assert not off[:, spec.motor].any()


def test_an_attempt_says_what_the_episode_was():
    made = attempt(3, "Lift", "Panda")
    assert made.solved
    assert made.held
    assert 20 < made.steps < 100
    assert 1 < made.force < 40
    assert 0.1 < made.room < 2
    assert attempt(3, "Lift", "Panda") == made


def test_a_row_counts_what_was_solved_held_and_how_long_it_took():
    made = [
        Attempt(True, True, 10, 1.0, 0.2),
        Attempt(True, False, 20, 70.0, 0.01),
        Attempt(False, False, 99, 90.0, 0.0),
    ]
    row = _row(made)
    assert row[0] == "2 of 3"
    assert row[2:] == ("1", "15", "70", "1", "1")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [(["--tasks", "Lit"], "Lift"), (["--robots", "Pandas"], "Panda"), (["--episodes", "0"], "0")],
)
def test_experts_refuse_what_they_do_not_know(arguments, message, capsys):
    assert main(["experts", *arguments]) == 2
    assert message in capsys.readouterr().err


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


def test_a_fleet_is_watched_as_each_robot_alone_is():
    episodes = synthetic(5, 12)
    asm = NeuralASM(episodes[0].spec, hidden_size=8, association_size=8, epochs=1).fit(episodes[:8])
    alone = [asm.score(e).value for e in episodes[8:]]
    fleet, found = Fleet(asm, 4), [[], [], [], []]
    waiting = [(robot, row) for t in range(60) for robot in range(4) for row in (episodes[8 + robot].stream[t],)]
    rng = np.random.default_rng(0)
    while waiting:  # some robots have several rows at a time, and some none
        now, waiting = waiting[: (n := int(rng.integers(1, 12)))], waiting[n:]
        robots = np.array([robot for robot, _ in now])
        for robot, value in zip(robots, fleet.observe(robots, np.array([row for _, row in now])), strict=True):
            found[robot].append(value)
    np.testing.assert_allclose(found, alone, rtol=1e-4)


def test_datagrams_are_read_in_their_order_as_far_as_there_is_room():
    inbox = Inbox(3)
    inbox.drain()
    assert len(inbox.taken()) == 0
    rows = np.zeros(5, inbox.kind)
    rows["stream"], rows["sent"], rows["row"] = np.arange(5), 0.5, np.arange(15).reshape(5, 3)
    robot = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    for row in rows:
        robot.sendto(row.tobytes(), inbox.socket.getsockname())
    inbox.drain()
    assert inbox.taken().tobytes() == rows.tobytes()
    for _ in range(2 * ROOM):
        robot.sendto(rows[3].tobytes(), inbox.socket.getsockname())
        inbox.drain()
    assert len(inbox.taken()) == ROOM  # the socket keeps the rest
    inbox.drain()
    assert (inbox.taken() == rows[3]).all()
    robot.close()
    inbox.socket.close()


def test_rows_are_timed_against_their_deadline(capsys):
    assert main(["deadline", "--rows", "10", "--rate", "200"]) == 0
    shown = capsys.readouterr().out
    assert shown.count("all cores busy") == 3
    assert "as it is" in shown
