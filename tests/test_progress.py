"""A reader of a pipe hears at least every ten seconds how far a stage has come."""

import io
import time

import pytest
from rich.console import Console

from asm_gym.rollouts import progress


def test_in_a_pipe_a_line_comes_at_least_every_so_often(monkeypatch):
    assert progress.EVERY_S <= 10
    monkeypatch.setattr(progress, "EVERY_S", 0.05)
    out, seconds = io.StringIO(), {}
    with progress.stage("recording [all]", Console(file=out), seconds) as tell:
        tell(3, 12)
        time.sleep(0.3)
        tell(12, 12)
    *before, last = out.getvalue().splitlines()
    assert before[:3] == 3 * ["recording [all]: 3 of 12, 0 s"]
    assert not any("done" in line for line in before)
    assert last == "recording [all]: 12 of 12, done in 0 s"
    assert seconds["recording [all]"] >= 0.3


def test_in_a_terminal_there_is_a_bar():
    out = io.StringIO()
    with progress.stage("recording", Console(file=out, force_terminal=True, width=80), {}) as tell:
        tell(3, 12)
    assert "12/12" in out.getvalue()
    assert "done in" not in out.getvalue()


def test_no_line_follows_an_error():
    out = io.StringIO()
    with pytest.raises(ZeroDivisionError), progress.stage("recording", Console(file=out), {}):
        raise ZeroDivisionError
    assert "done" not in out.getvalue()
