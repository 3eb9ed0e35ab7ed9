"""Every block of code in README and docs runs, page by page; every command in them is one that its parser takes."""

from __future__ import annotations

import ast
import re
import runpy
import shlex
import subprocess
import sys
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from asm_gym.faults import FAULTS
from asm_gym.monitors import MONITORS
from asm_gym.scripts import command as command_of
from asm_gym.scripts.cli import main
from asm_gym.tasks import OWN
from tests import documents

README = documents.ROOT / "README.md"


def takes_long(page: Path) -> bool:
    """It records robots and fits memories; README does so too, and is what people try first."""
    return page != README and any("collect(" in b.text for b in documents.blocks(page) if b.language == "python")


PYTHON = [
    pytest.param(page, marks=pytest.mark.slow if takes_long(page) else (), id=documents.name(page))
    for page in documents.written()
    if any(block.language == "python" for block in documents.blocks(page))
]
SHELL = [p for p in documents.written() if any(b.language == "sh" for b in documents.blocks(p))]
RESULTS = [p for p in documents.written() if p.parent.name == "results" and p.name != "index.md"]

RECORDER = "".join(
    f'{name}() {{ printf "%q " {name} "$@"; printf "\\n"; }}; ' for name in ("asm-gym", "make", "python")
)
RECORDER += "apt-get() { :; }; pip() { :; }\n"
"""Instead of commands: what they would have been given."""


class Parsed(Exception):  # noqa: N818 (it is no error)
    """The arguments make sense; nothing need run."""


@pytest.fixture
def registries():
    """Faults and monitors that a page adds are gone afterwards."""
    kept = [(registry, dict(registry)) for registry in (FAULTS, MONITORS, OWN)]
    yield
    for registry, before in kept:
        registry.clear()
        registry.update(before)


def is_there(module: str) -> bool:
    """It is installed. A library that is there and broken is for the block to find out."""
    package, _, rest = module.partition(".")
    return find_spec(package) is not None and (not rest or find_spec(module) is not None)


@pytest.mark.parametrize("page", PYTHON)
@pytest.mark.usefixtures("registries")
def test_the_code_of_a_page_runs_from_top_to_bottom(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    module = ModuleType("page")
    monkeypatch.setitem(sys.modules, "page", module)
    for block in documents.blocks(page):
        if block.language == "python" and all(map(is_there, block.needs)):
            below = "\n" * (block.line - 1) + block.text  # so that tracebacks name the lines of the page
            exec(compile(below, str(page), "exec", dont_inherit=True), vars(module))


def commands(script: str) -> list[str]:
    """What a script of a shell would call, a line each, with its variables filled in; no program is run."""
    done = subprocess.run(["/bin/bash", "-euc", RECORDER + script], env={"PATH": ""}, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


def check(command: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Fails unless the command exists and takes these arguments, where the libraries that they name are installed."""
    program, *argv = shlex.split(command)
    if not all(map(is_there, re.findall(r" (\w+):[\w/-]+", command))):
        return  # of an environment that an extra brings, as in gymnasium_robotics:FetchReach-v4
    if program == "make":
        targets = re.findall(r"^([a-z-]+):", (documents.ROOT / "Makefile").read_text(), re.M)
        assert argv[0] in targets
        return
    if program == "python" and argv == ["-"]:
        return  # of what it reads from standard input the names are asked for
    if program == "python" and argv[0].startswith("docs/checks/"):
        assert argv[1] in runpy.run_path(str(documents.ROOT / argv[0]))["RUNS"], command
        return
    if program == "python":
        assert argv[0] == "-m", command
        return
    called = partial(main, argv)
    parse = command_of.parse

    def dry(*args: Any, **kwargs: Any) -> Any:
        parse(*args, **kwargs)
        raise Parsed

    monkeypatch.setattr(command_of, "parse", dry)
    try:
        code = called()
    except Parsed:
        return
    except SystemExit as stopped:
        code = stopped.code
    finally:
        monkeypatch.setattr(command_of, "parse", parse)
    assert code == 0, command


@pytest.mark.parametrize("page", SHELL, ids=documents.name)
def test_the_commands_of_a_page_exist_and_take_their_arguments(page: Path, monkeypatch: pytest.MonkeyPatch):
    for block in documents.blocks(page):
        if block.language == "sh":
            for command in commands(block.text):
                check(command, monkeypatch)


@pytest.mark.parametrize("page", RESULTS, ids=documents.name)
def test_the_command_of_a_page_of_results_can_be_given_again(page: Path, monkeypatch: pytest.MonkeyPatch):
    script = documents.tool("pages").Page.read(page).meta["command"]
    given = commands(script)
    assert given
    for command in given:
        check(command, monkeypatch)
    for program in re.findall(r"^python - <<'END'\n(.*?)^END$", script, re.M | re.S):
        for each in ast.walk(ast.parse(program)):
            if isinstance(each, ast.ImportFrom) and each.module and all(map(is_there, [each.module])):
                assert not [n.name for n in each.names if not hasattr(import_module(each.module), n.name)], each.module


def test_a_command_with_a_wrong_argument_is_found(monkeypatch: pytest.MonkeyPatch):
    with pytest.raises(AssertionError):
        check("asm-gym demo --no-such-thing", monkeypatch)
    with pytest.raises(AssertionError):
        check("make no-such-thing", monkeypatch)
    with pytest.raises(AssertionError):
        check("python docs/checks/recalibrated.py no_such_robot", monkeypatch)


def test_a_block_that_needs_a_library_says_so(tmp_path: Path):
    page = tmp_path / "page.md"
    page.write_text("<!-- needs: ray.rllib -->\n```python\nx\n```\n\n```python\ny\n```\n")
    assert [block.needs for block in documents.blocks(page)] == [("ray.rllib",), ()]
    assert is_there("json.decoder")
    assert not is_there("no_such_library.at_all")


def test_a_comment_that_makes_a_block_small_must_match_it():
    assert documents.small("collect(episodes=60)", "<!-- small: 60 -> 6 -->\n") == "collect(episodes=6)"
    with pytest.raises(AssertionError, match="does not occur"):
        documents.small("collect(episodes=60)", "<!-- small: 50 -> 6 -->\n")


@pytest.mark.parametrize("page", RESULTS, ids=documents.name)
def test_the_check_of_a_page_of_results_can_be_given(page: Path, monkeypatch: pytest.MonkeyPatch):
    script = documents.tool("pages").Page.read(page).meta.get("check", "").replace("\\\n", " ")
    for command in re.findall(r"^(asm-gym [^|>\n]*)", script, re.M):
        check(command.replace("$CHECK", "runs/check"), monkeypatch)
