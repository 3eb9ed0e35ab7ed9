"""Commands: what is typed, what is refused, what an exit code means. Each is a process of its own for its users."""

from __future__ import annotations

import ast
import importlib
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from asm_gym.scripts import cli, command, reproduce
from asm_gym.scripts.options import rows as options_of

ROOT = Path(__file__).resolve().parents[1]
STUDIES = [f"reproduce {study}" for study in ("all", *reproduce.STUDIES)]
MEASURES = [f"benchmark {what}" for what in ("env", "memory", "safety")]
EVERY_COMMAND = [*cli.COMMANDS, *STUDIES, *MEASURES]


@dataclass(frozen=True)
class Options:
    """What a command of the tests takes."""

    steps: int = 3
    """Steps to take."""
    folder: Path = Path("here")
    """Where to."""

    def __post_init__(self) -> None:
        if self.steps < 1:
            raise ValueError(f"steps must be at least 1 in {self.folder}, got {self.steps}")


def lines(text: str) -> list[str]:
    return text.strip().splitlines()


@pytest.mark.parametrize("name", EVERY_COMMAND)
def test_help_is_plain_text_that_fits_a_terminal(name, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    assert cli.main([*name.split(), "--help"]) == 0
    shown = capsys.readouterr().out
    assert shown.startswith("usage: asm-gym")
    assert "`" not in shown
    assert max(map(len, lines(shown))) <= 80


@pytest.mark.parametrize("name", EVERY_COMMAND)
def test_nonsense_is_refused_in_one_line(name, capsys):
    nonsense = ["--no-such-option", "3"]
    if name == "reproduce":
        nonsense = ["no_such_study"]
    assert cli.main([*name.split(), *nonsense]) == 2
    said = capsys.readouterr().err
    assert len(lines(said)) == 1
    assert said.startswith("asm-gym ")


def test_a_person_can_hold_the_options_of_all_commands_that_are_used():
    shared = {"--workers", "--seed", "--out", "--quick"}
    own = {}
    for name, what in cli.GROUPS["Use it"].items():
        kind = importlib.import_module(what.module).Args
        own[name] = [row.name for row in options_of(kind) if row.name.split()[0] not in shared]
    names = {row.split()[0] for rows in own.values() for row in rows}
    assert len(names | shared) <= 60, own  # what is to be learned: --rate is the same in inspect, fit and watch
    assert sum(map(len, own.values())) + len(shared) <= 75, own


@pytest.mark.parametrize("name", EVERY_COMMAND)
def test_help_has_no_marks_of_the_parser(name, capsys):
    assert cli.main([*name.split(), "--help"]) == 0
    said = capsys.readouterr().out
    assert "{None}" not in said
    assert "(default" not in said


def test_help_says_what_will_do_and_what_is_shortened(capsys):
    assert cli.main(["train", "--help"]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "--algorithm NAME How it learns" in said
    assert "One of sac, td3, ppo. Default: sac." in said
    assert "Unless asked otherwise: steps 300, demonstrations 4" in said
    assert cli.main(["demo", "--help"]) == 0
    assert "--on-alarm {graded,hold,terminate}" in capsys.readouterr().out


def test_the_shell_completes_commands_studies_and_options(capsys):
    assert cli.main(["completion"]) == 0
    script = capsys.readouterr().out

    def completed(*typed: str) -> list[str]:
        ask = f"{script}\nCOMP_WORDS=({' '.join(map(repr, typed))}); COMP_CWORD={len(typed) - 1}; _asm_gym; "
        ask += 'printf "%s " "${COMPREPLY[@]}"'
        done = subprocess.run(["/bin/bash", "-c", ask], capture_output=True, text=True, check=True)
        return done.stdout.split()

    assert completed("asm-gym", "do") == ["doctor"]
    assert completed("asm-gym", "reproduce", "tra") == ["tracking"]
    assert completed("asm-gym", "reproduce", "tracking", "--it") == ["--iterations"]
    assert completed("asm-gym", "evaluate", "--mon") == ["--monitors"]
    assert completed("asm-gym", "evaluate", "--monitors", "--no") == ["--nominal-episodes", "--no-video"]


def test_the_commands_fit_a_terminal(capsys):
    for asked in (["--help"], ["reproduce", "--help"]):
        assert cli.main(asked) == 0
        assert max(map(len, lines(capsys.readouterr().out))) <= 80


@pytest.mark.parametrize(
    ("typed", "near"), [("docter", "doctor"), ("colect", "collect"), ("reproduce trackin", "tracking")]
)
def test_a_slip_of_the_finger_is_told_what_was_meant(typed, near, capsys):
    assert cli.main(typed.split()) == 2
    assert f"did you mean '{near}'?" in capsys.readouterr().err


def test_all_studies_check_the_options_of_all_before_the_first_runs(capsys, monkeypatch):
    first, last = (importlib.import_module(f"asm_gym.scripts.reproduce.{name}") for name in ("tracking", "failure"))
    ran: list[str] = []
    for module in (first, last):
        monkeypatch.setattr(module, "run", lambda config, name=module.__name__: ran.append(name))
    monkeypatch.setattr(last, "Config", Options)  # which has no --seeds
    monkeypatch.setattr(reproduce, "INDEPENDENT", ("tracking", "failure"))
    assert cli.main(["reproduce", "all", "--seeds", "2"]) == 2
    assert "--seeds" in capsys.readouterr().err
    assert not ran
    monkeypatch.undo()
    assert not [name for name in reproduce.INDEPENDENT if reproduce.STUDIES[name].needs_a_run]


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [
        (ValueError("no such\n  a: missing\n  b: new"), 2, "no such a: missing; b: new"),
        (FileNotFoundError(2, "No such file", "x.asm"), 2, "x.asm: No such file"),
        (ImportError("needs the extra [data]"), 2, "needs the extra [data]"),
        (KeyboardInterrupt(), 130, "interrupted"),
        (command.Terminated(), 143, "interrupted"),
        (ValueError(), 2, "ValueError"),
    ],
)
def test_what_ends_a_command_is_one_line_and_an_exit_code(error, code, said, capsys):
    def work(args, console):
        raise error

    assert command.run("try", Options, work, []) == code
    assert capsys.readouterr().err == f"asm-gym try: {said}\n"


def test_a_fault_of_ours_is_no_refusal():
    def work(args, console):
        raise AssertionError("a bug")

    with pytest.raises(AssertionError, match="a bug"):
        command.run("try", Options, work, [])


@pytest.mark.parametrize(
    ("argv", "said"),
    [
        (["--steps", "0"], "steps must be at least 1 in here, got 0"),
        (["--steps", "0", "--folder", "/very" * 60], f"steps must be at least 1 in {'/very' * 60}, got 0"),
        (["--steps", "many"], "--steps: invalid literal for int() with base 10: 'many'"),
        (["--step", "3"], "Unrecognized options: --step, 3; did you mean --steps?"),
    ],
)
def test_options_that_make_no_sense_are_named_exactly(argv, said, capsys):
    assert command.run("try", Options, lambda args, console: None, argv) == 2
    assert capsys.readouterr().err == f"asm-gym try: {said}\n"


def test_work_is_handed_the_options_and_its_answer_is_the_exit_code():
    got = []
    assert command.run("try", Options, lambda args, console: got.append(args), ["--steps", "7"]) == 0
    assert got == [Options(7)]
    assert command.run("try", Options, lambda args, console: command.BAD_NEWS, []) == 1


def test_the_signal_handler_of_a_caller_is_left_as_it_was():
    before = signal.getsignal(signal.SIGTERM)
    command.run("try", Options, lambda args, console: None, [])
    assert signal.getsignal(signal.SIGTERM) is before


INTERRUPTED = """
import signal, sys, time
from pathlib import Path
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell in the background ignores it
from asm_gym.rollouts.parallel import parallel_map
from asm_gym.scripts import command
from tests.test_commands import Options, wait

def work(args, console):
    parallel_map(wait, [args.folder / str(n) for n in range(2)], 2)

sys.exit(command.run("try", Options, work, ["--folder", sys.argv[1]]))
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


def options() -> Iterator[tuple[str, str]]:
    """Where, and what is said of each option of each command."""
    for path in sorted((ROOT / "scripts").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ClassDef) and any(isinstance(d, ast.Call | ast.Name) for d in node.decorator_list):
                for field, said in zip(node.body, node.body[1:], strict=False):
                    match field, said:
                        case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str(text))):
                            yield f"{path.relative_to(ROOT)} {node.name}.{name}", text


@pytest.mark.parametrize(("where", "said"), list(options()))
def test_an_option_is_said_to_be_something(where, said):
    fragment = re.match(r"(Of|In which|The same of|Others|In the|By) ", said)
    assert not fragment, f"{where}: {said}"
    assert "`" not in said, f"{where}: {said}"
    assert said[0].isupper() or said.split()[0].rstrip(",") in {"nominal", "loky", "sac"}, f"{where}: {said}"
    assert said.endswith("."), f"{where}: {said}"
