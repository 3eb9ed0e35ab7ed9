"""The campaign of ``make soak``, in small: whether it would notice."""

import importlib
import time
from pathlib import Path

import numpy as np
import pytest

from tests.soak import guard, kills, rest, verdicts
from tests.soak.targets import Good, public


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def refused(message):
    def call(size):
        raise ValueError(message)

    return call


@pytest.mark.parametrize(
    ("call", "value", "verdict"),
    [
        (lambda size: None, -1, "fine"),
        (refused("size must be at least 1"), -1, "clear"),
        (refused("nothing has -12345 rows"), -12345, "clear"),
        (refused("list index out of range"), -1, "raw"),
        (refused("resize first"), -1, "raw"),  # another word
        (lambda size: size.shape, -1, "raw"),
        (lambda size: [][size], -1, "raw"),
    ],
)
def test_an_error_is_clear_where_it_names_argument_or_value(call, value, verdict):
    assert verdicts.judge(call, {"size": value}, {"size": value})[0] == verdict


WORKER = """
import json, os, sys, time
area, seed, first, last = sys.argv[1:]
for i in range(int(first), int(last)):
    print(json.dumps({"begin": f"case {i}"}), flush=True)
    if i == 1:
        os.abort()
    if i == 3:
        time.sleep(600)
    print(json.dumps({"verdict": "fine", "said": ""}), flush=True)
"""


def test_a_process_that_dies_or_hangs_is_a_verdict_and_the_others_go_on(tmp_path, monkeypatch):
    monkeypatch.setattr(verdicts, "HANG_S", 5.0)
    (tmp_path / "worker.py").write_text(WORKER)
    found = list(verdicts.shard("calls", 0, 5, tmp_path, ["worker.py"]))
    assert [j.verdict for j in found] == ["fine", "crash", "fine", "hang", "fine"]
    assert [j.case for j in found] == [f"case {i}" for i in range(5)]
    assert verdicts.counted(found)[-1] == ("all", "5", "3", "0", "0", "0", "1", "1")


@pytest.mark.parametrize("careful", [True, False])
def test_what_a_kill_leaves_half_done_is_told_from_what_it_does_not(careful, tmp_path):
    def begin(folder: Path) -> int:
        for k in range(8):
            if careful and (folder / str(k)).exists():
                continue
            with (folder / "log").open("a") as log:
                log.write("x" * (not careful))
            time.sleep(0.1)
            (folder / str(k)).touch()
        return 0

    work = kills.Work("count", begin, lambda folder: (folder / "log").read_text())
    found = kills.killed_and_begun_again(work, tmp_path, 3, np.random.default_rng(0))
    assert found.times == 3
    assert found.ended[-9] == 3
    assert found.same == careful


@pytest.mark.slow
def test_every_public_name_of_four_rooms_is_called():
    called = public(Good())
    for room in ("monitors", "wrappers", "faults", "policies"):
        module = importlib.import_module(f"asm_gym.{room}")
        kinds = [target for target, _ in called.values()]
        for name in module.__all__:
            made = getattr(module, name)
            plain = not callable(made) or getattr(made, "_is_protocol", False) or issubclass(type(made), tuple)
            assert plain or name in called or made in kinds or name in UNCALLED, f"{room}.{name}"


UNCALLED = {
    *("CalibratedMonitor", "NeuralASM", "Surprise", "PolicyState", "Fault"),  # made by what is called
    *("pretrained", "RerunView", "WandbWriter"),  # a module of its name; need extras
}


@pytest.mark.slow
def test_every_call_takes_its_arguments_as_they_should_be():
    for name, (call, arguments) in public(Good()).items():
        try:
            call(**arguments())
        except Exception as error:
            raise AssertionError(name) from error


@pytest.mark.slow
@pytest.mark.parametrize("made", [guard.arm, guard.lift])
@pytest.mark.filterwarnings("ignore:.*the action must be finite:UserWarning")  # which is said of a policy gone mad
def test_a_guard_lets_nothing_through_in_a_few_steps(made):
    found = guard.guarded(made(), 150)
    assert found.steps == 150
    assert found.failures > 0
    assert (found.missed, found.let_through) == (0, 0)
    assert len(found.sizes) == 10


def test_an_arm_at_rest_raises_no_alarm_and_a_push_on_it_does():
    monitor = rest.learned(40, 0.05)
    assert rest.watched(monitor, 30.0, 1_000_000) == (0, True)
