"""The doctor, on machines that lack one thing at a time."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest

from asm_gym import compilation, extras, graphics
from asm_gym.scripts import cli, doctor
from tests.wheel import ROOT


@pytest.fixture(autouse=True)
def no_remembered_backend() -> Iterator[None]:
    graphics.rendering_backend.cache_clear()
    yield
    graphics.rendering_backend.cache_clear()


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Make this machine look like one that draws with some backends, and has some versions."""
    version = metadata.version

    def make(draws: tuple[str, ...] = ("egl",), **versions: str | None) -> None:
        def installed(name: str) -> str:
            found = versions.get(name, version(name))
            if found is None:
                raise metadata.PackageNotFoundError(name)
            return found

        monkeypatch.setattr(metadata, "version", installed)
        monkeypatch.setattr(graphics, "draws_a_frame", lambda backend: backend in draws)
        monkeypatch.setattr(sys, "platform", "linux")

    return make


def failed() -> dict[str, doctor.Check]:
    return {check.name: check for check in doctor.run_checks() if check.remedy}


def test_a_complete_machine_passes_every_check(machine: Any, capsys: Any) -> None:
    machine(torch="2.13.0+cpu", mujoco="3.9.0")
    assert failed() == {}
    assert doctor.main([]) == 0
    assert "Everything is here" in capsys.readouterr().out


def test_what_only_video_needs_is_optional(machine: Any, capsys: Any) -> None:
    machine(draws=())
    found = failed()
    assert (found["rendering"].needed, found["rendering"].remedy) == (False, graphics.GET_RENDERING)
    assert doctor.main([]) == 0
    assert "without rendering" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("draws", "backend"),
    [(("egl", "osmesa"), "egl"), (("egl",), "egl"), (("osmesa",), "osmesa"), ((), None)],
)
def test_the_first_backend_that_draws_is_taken_and_looked_for_once(
    machine: Any, draws: tuple[str, ...], backend: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    machine(draws=draws)
    before = dict(os.environ)
    assert graphics.rendering_backend() == backend
    monkeypatch.setattr(graphics, "draws_a_frame", None)
    assert graphics.rendering_backend() == backend
    assert dict(os.environ) == before


@pytest.mark.parametrize(
    ("name", "version"), [("mujoco", "4.1.0"), ("mujoco", "3.3.7"), ("robosuite", "1.4.1")]
)
def test_a_version_out_of_range_is_needed_and_names_the_range(
    machine: Any, name: str, version: str
) -> None:
    machine(**{name: version})
    check = failed().pop(name)
    assert (check.found, check.needed) == (f"{version}, but needs {extras.TESTED[name]}", True)
    assert check.remedy.endswith(f"'{name}{extras.TESTED[name]}'")
    assert ("--no-deps" in check.remedy) == (name == "robosuite")  # which brings NumPy below 2


@pytest.mark.parametrize("numpy", ["1.26.4", "2.4.6"])
def test_a_pyarrow_that_needs_numpy_2_is_named(machine: Any, numpy: str) -> None:
    machine(numpy=numpy, pyarrow="26.0.1")
    assert [c.remedy for c in failed().values() if "pyarrow" in c.name] == [
        "pip install 'pyarrow<26'"
    ] * (numpy < "2")


def test_an_old_gymnasium_is_named_with_what_replaces_it(machine: Any) -> None:
    machine(gymnasium="0.29.1")
    check = failed()["gymnasium"]
    assert check.needed
    assert check.remedy.startswith("pip install 'gymnasium>=")


@pytest.mark.parametrize(
    ("name", "fits", "fails"), [("mujoco", "4.0.0", "4.1.0"), ("robosuite", "1.5.2", "1.5.1")]
)
def test_a_simulator_out_of_range_is_refused_before_it_is_imported(
    name: str, fits: str, fails: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = {"mujoco": "3.9.0", "robosuite": "1.5.2", name: fits}
    monkeypatch.setattr(extras, "version", found.get)
    extras.check_simulator()
    found[name] = fails
    with pytest.raises(ImportError, match=f"got {fails}: pip install .*{name}"):
        extras.check_simulator()


def test_packages_of_every_install_are_needed_and_those_of_an_extra_are_not(
    machine: Any, capsys: Any
) -> None:
    machine(numba=None, torch=None, robosuite=None)
    found = failed()
    assert (found["numba"].needed, found["numba"].remedy) == (True, doctor.REINSTALL)
    assert (found["torch"].needed, found["torch"].remedy) == (
        False,
        "pip install 'asm-gym[agents]'",
    )
    assert found["robosuite"].remedy == extras.INSTALL_ROBOSUITE
    assert doctor.main([]) == 1
    # in one line, however narrow the terminal is
    assert extras.INSTALL_ROBOSUITE in capsys.readouterr().out


def test_a_machine_that_keeps_no_compiled_code_is_told_which_variable_names_a_folder(
    machine: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    machine()
    monkeypatch.setattr(
        compilation, "kept_in", lambda function: tmp_path / f"{compilation.KEEP_NOWHERE}x"
    )
    assert "NUMBA_CACHE_DIR" in failed()["cache"].remedy


def test_robosuite_is_pinned_alike_for_users_and_for_the_clone() -> None:
    assert extras.ROBOSUITE in (ROOT / "constraints.txt").read_text().splitlines()


def test_the_doctor_imports_nothing_that_it_checks() -> None:
    code = (
        "import sys, asm_gym.scripts.doctor;"
        "sys.exit(' '.join({'robosuite', 'cv2', 'mujoco', 'torch'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stderr.strip() == ""


def test_the_version_is_the_installed_one(capsys: Any) -> None:
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out.strip() == f"asm-gym {metadata.version('asm-gym')}"
