"""Commands: what is typed, what is refused, what an exit code means. Users run each in a process of its own."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import pytest

from asm_gym.scripts import cli, command, reproduce
from asm_gym.scripts.command import Checked, option

ROOT = Path(__file__).resolve().parents[1]
STUDIES = [f"reproduce {study}" for study in reproduce.STUDIES]
EVERY_COMMAND = [*cli.COMMANDS, *STUDIES]


def even(number: int) -> None:
    if number % 2:
        raise ValueError(f"sizes must be even, got {number}")


@dataclass(frozen=True)
class Options(Checked):
    """What a command of the tests takes."""

    folder: Path = option(Path("here"), positional=True, metavar="FOLDER")
    """Where to."""
    count: int = option(100, quick=4, least=1)
    """How many."""
    sizes: tuple[int, ...] = option((8, 16), quick=(2,), least=1, check=even)
    """How large."""
    fruit: tuple[str, ...] = option((), known=("apple", "pear"))
    """What to eat."""
    how: Literal["raw", "baked"] = option("raw")
    """How to eat."""
    rate: float | None = option(None, least=0, metavar="HZ")
    """How often."""
    quick: bool = False
    """Little."""
    hidden: int = option(50, quick=5, least=1)
    """How many are hidden."""


def run(*argv: str, work=lambda args, console: None) -> int:
    return command.run("try", Options, work, argv)


@pytest.mark.parametrize("name", EVERY_COMMAND)
def test_every_command_prints_its_help(name, capsys):
    assert cli.main([*name.split(), "--help"]) == 0
    shown = capsys.readouterr().out
    assert f"usage: asm-gym {name}" in shown
    assert "default: ''" not in shown
    assert "{None}" not in shown


@pytest.mark.parametrize("name", EVERY_COMMAND)
def test_an_unknown_option_is_refused(name, capsys):
    nonsense = "no_such_study" if name == "reproduce" else "--no-such-option"
    assert cli.main([*name.split(), nonsense]) == 2
    refused = capsys.readouterr()
    assert nonsense in refused.err or "Missing argument" in refused.err
    assert not refused.out


def test_help_names_defaults_choices_known_names_and_quick_values(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    assert run("--help") == 0
    shown = capsys.readouterr().out
    for part in (
        "default: 100; --quick: 4",
        "known: apple, pear",
        "{raw,baked}",
        "--rate",
        "HZ",
        "FOLDER",
        "How large.",
    ):
        assert part in shown


@pytest.mark.parametrize(
    ("typed", "near"),
    [
        ("docter", "doctor"),
        ("fti", "fit"),
        ("reproduce pandas", "panda"),
        ("watch --monitr x", "--monitor"),
    ],
)
def test_a_misspelt_command_or_option_is_answered_with_the_nearest_one(typed, near, capsys):
    assert cli.main(typed.split()) == 2
    assert f"did you mean '{near}'?" in capsys.readouterr().err


@pytest.mark.parametrize("argv", [("--rate",), ("--rate", "--quick")])
def test_an_option_without_its_value_is_told_what_it_needs(argv, capsys):
    assert run(*argv) == 2
    assert capsys.readouterr().err == "asm-gym try: --rate needs HZ\n"


@pytest.mark.parametrize(
    ("error", "code", "message"),
    [
        (ValueError("no such\n  a: missing\n  b: new"), 2, "no such a: missing; b: new"),
        (FileNotFoundError(2, "No such file", "x.asm"), 2, "x.asm: No such file"),
        (ImportError("needs the extra [data]"), 2, "needs the extra [data]"),
        (KeyboardInterrupt(), 130, "interrupted"),
        (command.Terminated(), 143, "interrupted"),
        (ValueError(), 2, "ValueError"),
    ],
)
def test_an_error_that_ends_a_command_is_one_line_and_an_exit_code(error, code, message, capsys):
    def work(args, console):
        raise error

    assert run(work=work) == code
    assert capsys.readouterr().err == f"asm-gym try: {message}\n"


def test_a_bug_is_no_refusal():
    def work(args, console):
        raise AssertionError("a bug")

    with pytest.raises(AssertionError, match="a bug"):
        run(work=work)


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["--count", "0"], "count must be at least 1, got 0"),
        (["--sizes"], "the number of sizes must be at least 1, got 0"),
        (["--sizes", "2", "3"], "sizes must be even, got 3"),
        (["--fruit", "aple"], "unknown fruit 'aple'; known: apple, pear; did you mean 'apple'?"),
        (["--rate", "-1"], "rate must be at least 0, got -1.0"),
    ],
)
def test_a_value_that_is_not_accepted_is_refused_in_one_line(argv, message, capsys):
    assert run(*argv) == 2
    assert capsys.readouterr().err == f"asm-gym try: {message}\n"


def test_work_is_handed_the_options_and_returns_the_exit_code():
    got = []
    assert run("--count", "7", work=lambda args, console: got.append(args)) == 0
    assert got == [Options(count=7)]
    before = signal.getsignal(signal.SIGTERM)
    assert run(work=lambda args, console: command.BAD_NEWS) == 1
    assert signal.getsignal(signal.SIGTERM) is before


def test_quick_changes_only_what_was_not_typed():
    def typed(*argv: str) -> Options:
        return command.parse("try", Options, argv)

    assert typed("x") == Options(Path("x"))
    quick = typed("x", "--quick", "--count", "100", "--sizes", "6", "8")
    assert (quick.count, quick.sizes, quick.hidden) == (100, (6, 8), 5)
    assert typed("--quick").sizes == (2,)
    with pytest.raises(ValueError, match="hidden must be at least 1, got 0"):
        Options(hidden=0)


INTERRUPTED = """
import signal, sys, time
from pathlib import Path
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell in the background ignores it
from asm_gym.rollouts.parallel import parallel_map
from asm_gym.scripts import command
from tests.test_commands import Options, wait

def work(args, console):
    parallel_map(wait, [args.folder / str(n) for n in range(2)], 2)

sys.exit(command.run("try", Options, work, [sys.argv[1]]))
"""


def wait(file: Path) -> None:
    """Says in a file which process waits, and waits."""
    file.write_text(str(os.getpid()), encoding="utf-8")
    time.sleep(60)


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_an_interrupted_command_says_one_line_and_leaves_no_process_behind(number, code, tmp_path):
    done = subprocess.Popen(
        [sys.executable, "-c", INTERRUPTED, str(tmp_path)],
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
    )
    deadline = time.monotonic() + 120
    while len(begun := [p for p in tmp_path.iterdir() if p.read_text()]) < 2:
        assert time.monotonic() < deadline
        assert done.poll() is None, done.stderr
        time.sleep(0.1)
    os.killpg(done.pid, number) if number == signal.SIGINT else os.kill(done.pid, number)
    said = done.communicate(timeout=60)[1]
    assert done.returncode == code
    assert said == "asm-gym try: interrupted\n"
    for worker in (int(p.read_text()) for p in begun):
        while running(worker):
            assert time.monotonic() < deadline, f"worker {worker} goes on"
            time.sleep(0.1)


def running(pid: int) -> bool:
    """A process of this number lives; one that has ended and that nobody asked after does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False
