"""What the documentation shows works: its Python runs, its commands parse, and its links and files exist."""

from __future__ import annotations

import contextlib
import doctest
import inspect
import io
import json
import re
import runpy
import shlex
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
import pytest

import asm_gym
from asm_gym.faults.suite import KINDS
from asm_gym.guard.robot_table import RobotTable
from asm_gym.guard.step_info import RowReport, asm_info
from asm_gym.monitors import MONITORS
from asm_gym.policies.registry import POLICIES
from asm_gym.scripts import command as command_of
from asm_gym.scripts.cli import COMMANDS, main
from asm_gym.scripts.reproduce import STUDIES
from asm_gym.spec import Channel, StreamSpec
from asm_gym.tasks import OWN

ROOT = Path(__file__).resolve().parent.parent
DOCS = ROOT / "docs"
# by a build of the site
MADE = (
    DOCS / "_build",
    DOCS / "reference" / "api",
    DOCS / "reference" / "commands.md",
)
PAGES = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "SECURITY.md")),
    *(p for p in sorted(DOCS.rglob("*.md")) if not any(p.is_relative_to(made) for made in MADE)),
]
NOTEBOOKS = sorted((DOCS / "notebooks").glob("*.ipynb"))
# which tests/test_ros2_stop.py runs
EXAMPLES = sorted(p for p in (DOCS / "examples").glob("*.py") if p.stem != "ros2_stop")

FENCE = re.compile(r"^```([\w{}-]*)\n(.*?)^```\s*$", re.M | re.S)
CODE = re.compile(r"`[^`\n]*`")
LINK = re.compile(r"\]\(([^)\s]+)\)")
FILE = re.compile(
    r"`((?:asm_gym|policies|wrappers|scripts|tests|docs)/[\w./-]+\.\w+)(?:::(\w+))?[^`]*`"
)
NEEDS = re.compile(r"<!-- needs: ([\w. ]+) -->\n\Z")
SMALL = re.compile(r"<!-- small: ([^\n]*) -->\n\Z")


class Block(NamedTuple):
    """A fenced block: its language, its text with small numbers, the line it begins in, and the modules it needs."""

    language: str
    text: str
    line: int
    needs: list[str]


def name(path: Path) -> str:
    return str(path.relative_to(ROOT))


def blocks(path: Path) -> list[Block]:
    """Return the fenced blocks of a page.

    A comment above a block changes what is tested: ``<!-- needs: ray -->`` skips it where the module is not installed,
    ``<!-- small: 60 -> 6; [:40] -> [:4] -->`` replaces each number once.
    """
    text = path.read_text(encoding="utf-8")
    found = []
    for match in FENCE.finditer(text):
        above, code = text[: match.start()], match[2]
        small, needs = SMALL.search(above), NEEDS.search(above)
        for pair in small[1].split("; ") if small else []:
            long, short = pair.split(" -> ")
            assert long in code, f"{name(path)}: {long!r} of the comment is not in the block"
            code = code.replace(long, short, 1)
        found.append(
            Block(match[1], code, above.count("\n") + 2, needs[1].split() if needs else [])
        )
    return found


def installed(module: str) -> bool:
    package, _, rest = module.partition(".")
    return find_spec(package) is not None and (not rest or find_spec(module) is not None)


def python_page(page: Path) -> Any:
    """Pages that record robots and fit memories are slow; README does so too, and is what people try first."""
    slow = page.name != "README.md" and any(
        "collect(" in b.text for b in blocks(page) if b.language == "python"
    )
    return pytest.param(page, marks=pytest.mark.slow if slow else (), id=name(page))


@pytest.fixture(autouse=True)
def registries():
    """Undo what an example registers."""
    kept = [(registry, dict(registry)) for registry in (KINDS, MONITORS, OWN, POLICIES)]
    yield
    for registry, before in kept:
        registry.clear()
        registry.update(before)


@pytest.mark.parametrize(
    "page", [python_page(p) for p in PAGES if any(b.language == "python" for b in blocks(p))]
)
def test_python_of_a_page_runs_from_top_to_bottom(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    module = ModuleType("page")
    monkeypatch.setitem(sys.modules, "page", module)
    for block in blocks(page):
        if block.language == "python" and all(map(installed, block.needs)):
            placed = "\n" * (block.line - 1) + block.text  # tracebacks name the lines of the page
            exec(compile(placed, str(page), "exec", dont_inherit=True), vars(module))


class Parsed(Exception):  # noqa: N818
    """The arguments are valid; the command need not run."""


def check_command(line: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Fail unless the command exists and accepts these arguments."""
    program, *argv = shlex.split(line)
    if program == "make":
        targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.M)
        assert argv[0] in targets, line
        return
    if not all(map(installed, re.findall(r" (\w+):[\w/-]+", line))):
        return  # an environment of an extra that is not installed, such as gymnasium_robotics:FetchReach-v4
    parse = command_of.parse

    def parse_only(*args: Any, **kwargs: Any) -> Any:
        parse(*args, **kwargs)
        raise Parsed

    with monkeypatch.context() as patch:
        patch.setattr(command_of, "parse", parse_only)
        try:
            code = main(argv)
        except Parsed:
            return
        except SystemExit as stopped:
            code = stopped.code
    assert code == 0, line


@pytest.mark.parametrize(
    "page", [p for p in PAGES if any(b.language == "sh" for b in blocks(p))], ids=name
)
def test_commands_of_a_page_parse(page: Path, monkeypatch: pytest.MonkeyPatch):
    recorder = "".join(f'{p}() {{ printf "%q " {p} "$@"; echo; }}; ' for p in ("asm-gym", "make"))
    recorder += "".join(
        f"{p}() {{ :; }}; "
        for p in ("apt-get", "pip", "git", "cd", "docker", "uv", "python", "sudo")
    )
    for block in blocks(page):
        if block.language == "sh":
            script = ["/bin/bash", "-euc", f"{recorder}\n{block.text}"]
            done = subprocess.run(script, env={"PATH": ""}, capture_output=True, text=True)
            assert done.returncode == 0, f"{name(page)}, line {block.line}: {done.stderr}"
            for line in done.stdout.splitlines():
                check_command(line, monkeypatch)


@pytest.fixture(scope="module")
def options() -> set[str]:
    """Every option of every command and study, from its help."""
    help_of = [[name] for name in COMMANDS] + [["reproduce", study] for study in STUDIES]
    found: set[str] = {"--help", "--version"}
    for argv in help_of:
        with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.suppress(SystemExit):
            main([*argv, "--help"])
        found |= set(re.findall(r"--[a-z][\w-]*", out.getvalue()))
    return found


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_commands_and_options_named_in_a_text_exist(page: Path, options: set[str]):
    for code in CODE.findall(FENCE.sub("", page.read_text(encoding="utf-8"))):
        command = re.match(r"`asm-gym ([a-z]+)", code)
        assert not command or command[1] in COMMANDS, code
        if code.startswith(("`asm-gym", "`--")):
            assert set(re.findall(r"--[a-z][\w-]*", code)) <= options, f"{name(page)}: {code}"


def anchors(path: Path) -> set[str]:
    """Return the anchors of a page's headings, as GitHub and MyST make them."""
    headings = re.findall(r"^#+ (.*)$", FENCE.sub("", path.read_text(encoding="utf-8")), re.M)
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_links_anchors_pictures_and_files_exist(page: Path):
    text = page.read_text(encoding="utf-8")
    for target in LINK.findall(CODE.sub("", FENCE.sub("", text))):
        file, _, anchor = target.partition("#")
        place = (page.parent / file).resolve() if file else page
        if not re.match(r"https?:|mailto:", target) and not any(
            place.is_relative_to(made) for made in MADE
        ):
            assert place.exists(), target
            assert not anchor or anchor in anchors(place), target
    for file, test in FILE.findall(text):
        assert (ROOT / file).exists(), file
        assert not test or re.search(
            rf"^(?:    )?(?:def|class) {test}\b|^{test} = ", (ROOT / file).read_text(), re.M
        ), test


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_code_of_a_notebook_runs_and_no_output_is_kept(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    if path.stem == "guard_an_agent":
        pytest.importorskip("IPython", reason="pip install 'asm-gym[notebooks]'")
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {"__name__": "__main__"}
    for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
        if cell["cell_type"] == "code":
            assert not cell["outputs"]
            exec(compile("".join(cell["source"]), str(path), "exec", dont_inherit=True), names)


def test_the_page_on_info_names_every_field():
    spec = StreamSpec((Channel("q", 1),), dt=0.1)
    said = asm_info([RowReport(RobotTable(1, spec, 1.0).records, np.zeros((1, 1)))], 0, spec)
    page = (DOCS / "reference" / "info.md").read_text(encoding="utf-8")
    assert [
        name for name in (*said, *said["severity"], "alarms", "slowed") if f"`{name}`" not in page
    ] == []


SLOW = ("film_an_alarm", "live_udp", "learn_safely")
FEWER = {"learn_safely": ["1024"]}  # arguments that make an example short


@pytest.mark.parametrize(
    "path",
    [
        pytest.param(p, marks=pytest.mark.slow if p.stem in SLOW else (), id=p.stem)
        for p in EXAMPLES
    ],
)
def test_an_example_runs(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [str(path), *FEWER.get(path.stem, [])])
    runpy.run_path(str(path), run_name="__main__")


WITH_EXAMPLE = sorted(set(asm_gym.__all__) - set(asm_gym.exceptions.__all__))


@pytest.mark.parametrize("public", WITH_EXAMPLE)
def test_the_docstring_example_of_a_public_name_runs(public: str):
    thing = inspect.unwrap(getattr(asm_gym, public))
    examples = doctest.DocTestParser().get_doctest(inspect.getdoc(thing) or "", {}, public, None, 0)
    assert examples.examples, f"{public} has no example"
    report: list[str] = []
    doctest.DocTestRunner().run(examples, out=report.append)
    assert not report, "".join(report)


@pytest.mark.slow
def test_the_site_builds_without_a_warning(tmp_path: Path):
    command = [
        sys.executable,
        "-m",
        "sphinx",
        "-b",
        "html",
        "-W",
        "--keep-going",
        "-q",
        "-d",
        str(tmp_path / "trees"),
    ]
    done = subprocess.run(
        [*command, str(DOCS), str(tmp_path / "html")], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
