"""Imports point one way, heavy libraries stay where they belong, and an install puts one name in site-packages."""

from __future__ import annotations

import ast
import importlib
import subprocess
import sys
from collections.abc import Iterator

import pytest

import asm_gym
from tests.wheel import ROOT

LAYERS = (
    *(
        "core",
        "data",
        "memory",
        "policies",
        "detection",
        "envs",
        "monitors",
        "faults",
        "evaluation",
    ),
    *("guard", "wrappers", "rollouts", "scripts"),
)
"""Rooms in their order: each may import itself and what stands before it, so that nothing enters a room twice."""
FACADE = "asm_gym.__init__"
"""Hands out names of every layer, each when it is asked for: see ``test_importing_the_package_is_cheap``."""
AUTOGRAD = ("torch", "jax", "autograd", "tensorflow", "theano")


def layer(module: str) -> str:
    """The layer of a dotted name inside asm_gym."""
    part = module.split(".")[1] if "." in module else ""
    return part if part in LAYERS else "core"


def modules() -> dict[str, ast.Module]:
    """Every module of the package by its long name, parsed."""
    files = (ROOT / "asm_gym").rglob("*.py")
    named = {".".join(f.relative_to(ROOT).with_suffix("").parts): f for f in files}
    return {
        name: ast.parse(f.read_text(encoding="utf-8"), str(f)) for name, f in sorted(named.items())
    }


def imports(name: str, tree: ast.Module) -> Iterator[str]:
    """Full dotted names that a module imports, wherever the statement stands; ``from a import b`` gives ``a.b``."""
    # ``asm_gym.envs.__init__`` lies in ``asm_gym.envs`` as ``asm_gym.envs.x`` does
    package = name.split(".")[:-1]
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            source = ".".join([*base, *(node.module or "").split(".")]).strip(".")
            yield from (f"{source}.{alias.name}" for alias in node.names)


MODULES = modules()
IMPORTS = {name: list(imports(name, tree)) for name, tree in MODULES.items()}


def offences(within: str, *roots: str) -> list[str]:
    """``module imports what`` for each module whose name starts with ``within`` that imports one of the roots."""
    return [
        f"{name} imports {what}"
        for name, whats in IMPORTS.items()
        for what in whats
        if name.startswith(within) and what.split(".")[0] in roots
    ]


@pytest.mark.parametrize("name", sorted(MODULES.keys() - {FACADE, "asm_gym.__main__"}))
def test_imports_point_one_way(name: str) -> None:
    allowed = LAYERS[: LAYERS.index(layer(name)) + 1]
    ours = [what for what in IMPORTS[name] if what.split(".")[0] == "asm_gym"]
    upstream = [w for w in ours if layer(w) not in allowed]
    assert not upstream, f"{name}, of layer {layer(name)}, may import {', '.join(allowed)}"


def test_nothing_is_imported_by_its_short_name() -> None:
    tests = {
        f"tests.{f.stem}": ast.parse(f.read_text(encoding="utf-8"))
        for f in (ROOT / "tests").glob("*.py")
    }
    everywhere = IMPORTS | {name: list(imports(name, tree)) for name, tree in tests.items()}
    short = [
        f"{name} imports {w}"
        for name, whats in everywhere.items()
        for w in whats
        if w.split(".")[0] in ("policies", "wrappers", "scripts")
    ]
    assert not short, "write asm_gym.wrappers, asm_gym.policies, asm_gym.scripts"


def test_the_memory_learns_without_automatic_differentiation() -> None:
    assert not offences("asm_gym.memory", *AUTOGRAD)


def test_only_envs_imports_robosuite() -> None:
    # The benchmark times robosuite as a rival.
    allowed = ("asm_gym.envs.", "asm_gym.scripts.benchmark")
    assert not [line for line in offences("asm_gym", "robosuite") if not line.startswith(allowed)]


def test_no_module_speaks_to_a_network() -> None:
    # Live rows are heard on the loopback alone.
    names = "socket", "ssl", "urllib", "http", "ftplib", "smtplib", "requests", "httpx", "aiohttp"
    allowed = ("asm_gym.data.",)
    assert not [line for line in offences("asm_gym", *names) if not line.startswith(allowed)]


def test_importing_the_package_is_cheap() -> None:
    code = (
        "import sys, asm_gym;"
        "print(*sorted({m.partition('.')[0] for m in sys.modules}), *(m for m in sys.modules if 'asm_gym.' in m))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = set(done.stdout.split())
    assert not loaded & {"robosuite", "mujoco", "torch", "stable_baselines3", "numba", "scipy"}
    assert {name for name in loaded if "." in name} <= {
        f"asm_gym.{m}"
        for m in ("exceptions", "extras", "tasks", "files", "registries", "validation", "version")
    }


def test_every_name_of_the_package_is_what_its_room_calls_so():
    for name in asm_gym.__all__:
        room = importlib.import_module(f"asm_gym.{asm_gym._HOME[name]}")
        assert getattr(asm_gym, name) is getattr(room, name)
    assert set(asm_gym.__all__) == set(asm_gym._HOME) <= set(dir(asm_gym))
    with pytest.raises(AttributeError, match=r"module 'asm_gym' has no attribute 'Tracer'"):
        asm_gym.Tracer  # noqa: B018 (looked up)
