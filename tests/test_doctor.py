"""The doctor, on machines that lack one thing at a time."""

from __future__ import annotations

import ctypes
import os
import platform
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from importlib import metadata
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from llvmlite.binding import get_host_cpu_features

from asm_gym import extras, graphics
from asm_gym.scripts import cli, doctor

PACKAGE_OF = {"libGL.so.1": "libgl1", "libglib-2.0.so.0": "libglib2.0-0", "libgthread-2.0.so.0": "libglib2.0-0"}


@pytest.fixture(autouse=True)
def no_remembered_backend() -> Iterator[None]:
    graphics.rendering_backend.cache_clear()
    yield
    graphics.rendering_backend.cache_clear()


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Makes this machine look like one that lacks some libraries and backends, and has some versions."""
    version = metadata.version

    def make(lacks: tuple[str, ...] = (), draws: tuple[str, ...] = ("egl",), **versions: str | None) -> None:
        def load(name: str) -> None:
            if name in lacks:
                raise OSError(f"{name}: cannot open shared object file: No such file or directory")

        def installed(name: str) -> str:
            found = versions.get(name, version(name))
            if found is None:
                raise metadata.PackageNotFoundError(name)
            return found

        monkeypatch.setattr(ctypes, "CDLL", load)
        monkeypatch.setattr(metadata, "version", installed)
        monkeypatch.setattr(graphics, "draws_a_frame", lambda backend: backend in draws)
        monkeypatch.setattr(sys, "platform", "linux")
        monkeypatch.setattr(doctor, "compiled_code", lambda: doctor.Check("compiled code", True, False, "in a folder"))
        monkeypatch.setattr(doctor, "matrix_products", lambda: doctor.Check("matrix products", True, False, "known"))

    return make


def failed() -> dict[str, doctor.Check]:
    return {check.name: check for check in doctor.run_checks() if not check.ok}


def test_a_complete_machine_passes_every_check(machine: Any, capsys: pytest.CaptureFixture[str]) -> None:
    machine()
    assert failed() == {}
    assert doctor.main([]) == 0
    assert "Everything is here" in capsys.readouterr().out


@pytest.mark.parametrize("name", PACKAGE_OF)
def test_a_missing_library_of_opencv_is_named_with_its_debian_package_and_can_be_done_without(
    machine: Any, name: str
) -> None:
    machine(lacks=(name,))
    check = failed().pop(name)
    assert not check.needed
    assert check.remedy == f"apt-get install {PACKAGE_OF[name]}"
    assert doctor.main([]) == 0


def test_without_a_rendering_backend_only_video_is_missing(machine: Any, capsys: pytest.CaptureFixture[str]) -> None:
    machine(lacks=("libEGL.so.1", "libOSMesa.so.8"), draws=())
    check = failed().pop("rendering")
    assert not check.needed
    assert check.detail == "no video: libEGL.so.1 missing, libOSMesa.so.8 missing"
    assert "apt-get install libegl1 libgl1 libgl1-mesa-dri" in check.remedy
    assert doctor.main([]) == 0
    assert "without rendering" in capsys.readouterr().out


def test_a_library_that_is_there_but_draws_nothing_is_told_from_a_missing_one(machine: Any) -> None:
    machine(lacks=("libOSMesa.so.8",), draws=())
    assert failed()["rendering"].detail == "no video: libEGL.so.1 draws nothing, libOSMesa.so.8 missing"


@pytest.mark.parametrize(
    ("draws", "backend"), [(("egl", "osmesa"), "egl"), (("egl",), "egl"), (("osmesa",), "osmesa"), ((), None)]
)
def test_the_first_backend_that_draws_is_taken(machine: Any, draws: tuple[str, ...], backend: str | None) -> None:
    machine(draws=draws)
    assert graphics.rendering_backend() == backend


def test_the_backend_is_looked_for_once(monkeypatch: pytest.MonkeyPatch) -> None:
    tried: list[str] = []

    def draws_nothing(backend: str) -> bool:
        tried.append(backend)
        return False

    monkeypatch.setattr(graphics, "draws_a_frame", draws_nothing)
    assert graphics.rendering_backend() is graphics.rendering_backend() is None
    assert tried == ["egl", "osmesa"]


def test_looking_for_a_backend_leaves_this_process_as_it_was() -> None:
    before = dict(os.environ)
    graphics.rendering_backend()
    assert dict(os.environ) == before


def test_a_driver_that_hangs_draws_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    def hang(*args: Any, **kwargs: Any) -> None:
        raise subprocess.TimeoutExpired("python", kwargs["timeout"])

    monkeypatch.setattr(subprocess, "run", hang)
    assert not graphics.draws_a_frame("egl")


FAKE_MUJOCO = """
import os
import numpy as np

class MjModel:
    from_xml_string = staticmethod(lambda xml: None)

def MjData(model): ...
def mj_forward(model, data): ...

class Renderer:
    def __init__(self, model, height, width):
        if os.environ["MUJOCO_GL"] == "glfw":
            raise RuntimeError("no display")
        self.frame = np.zeros((height, width, 3), np.uint8)
        self.frame[:16] = {"egl": 200, "osmesa": 0}[os.environ["MUJOCO_GL"]]
    def __enter__(self): return self
    def __exit__(self, *error): ...
    def update_scene(self, data): ...
    def render(self): return self.frame
"""


@pytest.mark.parametrize(("backend", "draws"), [("egl", True), ("osmesa", False), ("glfw", False)])
def test_only_a_frame_with_something_in_it_counts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, backend: str, draws: bool
) -> None:
    (tmp_path / "mujoco.py").write_text(FAKE_MUJOCO)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    assert graphics.draws_a_frame(backend) is draws


def test_a_backend_that_mujoco_does_not_know_draws_nothing() -> None:
    assert not graphics.draws_a_frame("no_such_backend")


@pytest.mark.parametrize(("name", "version"), [("mujoco", "3.10.0"), ("mujoco", "3.2.9"), ("robosuite", "1.4.1")])
def test_a_version_out_of_range_is_needed_and_says_the_range(machine: Any, name: str, version: str) -> None:
    machine(**{name: version})
    check = failed().pop(name)
    assert check.needed
    assert check.detail.startswith(f"{version}, but needs ")
    wanted = check.detail.removeprefix(f"{version}, but needs ")
    assert check.remedy == f"python -m pip install '{name}{wanted}'"


@pytest.mark.parametrize(("version", "ok"), [("3.9.0", True), ("3.10.0", False), ("4.0.0", False)])
def test_a_mujoco_that_another_package_brought_is_named_before_it_is_imported(
    monkeypatch: pytest.MonkeyPatch, version: str, ok: bool
) -> None:
    monkeypatch.setattr(extras, "version", lambda name: version)
    with nullcontext() if ok else pytest.raises(ImportError, match=f"got {version}: pip install 'mujoco<3.10'"):
        extras.check_mujoco()
    bounds = [r for r in metadata.requires("asm-gym") or [] if r.startswith("mujoco")]
    assert bounds
    assert all(f"<{extras.MUJOCO_BELOW}" in bound for bound in bounds)


def test_a_torch_that_is_too_old_is_needed(machine: Any) -> None:
    machine(torch="1.0")
    assert failed()["torch"].needed


def test_a_local_build_of_the_right_version_passes(machine: Any) -> None:
    machine(torch="2.13.0+cpu", mujoco="3.9.0")
    assert failed() == {}


def test_a_missing_robosuite_names_the_compiler_that_evdev_needs(machine: Any) -> None:
    machine(robosuite=None)
    check = failed().pop("robosuite")
    assert (check.needed, check.detail) == (False, "not installed")
    assert check.remedy.startswith("apt-get install gcc libc6-dev linux-libc-dev python3-dev, then ")
    assert "pip install 'asm-gym[robosuite]'" in check.remedy


def test_what_every_install_has_is_needed_and_what_an_extra_brings_is_not(machine: Any) -> None:
    machine(numba=None, torch=None)
    found = failed()
    assert (found["numba"].needed, found["numba"].remedy) == (True, doctor.REINSTALL)
    assert (found["torch"].needed, found["torch"].remedy) == (False, "python -m pip install 'asm-gym[agents]'")


@pytest.mark.parametrize(
    ("version", "ok"), [("3.10.14", False), ("3.11.0", True), ("3.12.9", True), ("3.13.0", True), ("3.14.0", False)]
)
def test_python_is_held_against_requires_python(monkeypatch: pytest.MonkeyPatch, version: str, ok: bool) -> None:
    monkeypatch.setattr(platform, "python_version", lambda: version)
    assert doctor.python().ok is ok
    assert ("PYTHON=" in doctor.python().remedy) is not ok


@pytest.mark.parametrize(("encoders", "ok"), [(b" V....D libx264  H.264", True), (b" V....D mpeg4  MPEG-4", False)])
def test_an_ffmpeg_without_h264_is_reported(monkeypatch: pytest.MonkeyPatch, encoders: bytes, ok: bool) -> None:
    monkeypatch.setattr(subprocess, "run", lambda *args, **kwargs: SimpleNamespace(stdout=encoders))
    check = doctor.encoder()
    assert (check.ok, check.needed) == (ok, False)


def test_no_ffmpeg_is_no_video(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", os.path.join(os.path.dirname(__file__), "no_such_ffmpeg"))
    check = doctor.encoder()
    assert (check.ok, check.needed) == (False, False)
    assert "apt-get install ffmpeg" in check.remedy


def test_the_table_shows_commands_with_square_brackets_as_they_are(capsys: pytest.CaptureFixture[str]) -> None:
    from rich.console import Console

    checks = [doctor.Check("x", False, True, "found [red]", "pip install '.[dev]'")]
    Console(width=200).print(doctor.table(checks))
    shown = capsys.readouterr().out
    assert "found [red]" in shown
    assert "pip install '.[dev]'" in shown


def test_code_that_is_still_to_be_compiled_is_said_with_what_compiles_it(monkeypatch: Any, tmp_path: Path) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    check = doctor.compiled_code()
    assert (check.ok, check.needed, check.remedy) == (False, False, "asm-gym warmup")
    assert check.detail.startswith(f"not yet in {tmp_path}")


def test_kernels_of_a_processor_without_avx_are_named_on_one_with_it(monkeypatch: Any) -> None:
    monkeypatch.setenv("OPENBLAS_CORETYPE", "Haswell")
    assert doctor.matrix_products().ok
    if not get_host_cpu_features().get("avx2"):
        pytest.skip("this processor has none")
    monkeypatch.setenv("OPENBLAS_CORETYPE", "Nehalem")
    check = doctor.matrix_products()
    assert (check.ok, check.needed) == (False, False)
    assert "takes this processor for a Nehalem" in check.detail
    assert re.fullmatch("export OPENBLAS_CORETYPE=(SkylakeX|Haswell)", check.remedy)


def test_python_3_13_is_told_why_it_has_no_robosuite(machine: Any, monkeypatch: Any) -> None:
    machine(robosuite=None)
    monkeypatch.setattr(sys, "version_info", (3, 13, 0, "final", 0))
    check = failed()["robosuite"]
    assert "NumPy below 2" in check.detail
    assert "3.12" in check.remedy


def test_the_doctor_imports_nothing_that_it_checks() -> None:
    code = (
        "import sys, asm_gym.scripts.doctor;"
        "sys.exit(' '.join({'robosuite', 'cv2', 'mujoco', 'torch', 'imageio_ffmpeg'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stderr.strip() == ""


def test_an_unknown_option_is_refused() -> None:
    assert doctor.main(["--no-such-option"]) == 2


@pytest.mark.parametrize("argv", [[], ["--help"], ["-h"]])
def test_help_lists_every_command(argv: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(argv) == 0
    shown = capsys.readouterr().out
    for name, command in cli.COMMANDS.items():
        assert f"  {name}" in shown
        assert command.summary in shown


def test_an_unknown_command_lists_the_known_ones(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["docter"]) == 2
    shown = capsys.readouterr().err
    assert "'docter'" in shown
    assert all(name in shown for name in cli.COMMANDS)


def test_a_command_gets_the_rest_of_the_arguments_and_its_exit_code_is_returned(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    got: list[list[str]] = []

    def script(argv: list[str]) -> int:
        got.append(argv)
        return 7

    monkeypatch.setitem(sys.modules, "a_script", SimpleNamespace(main=script))
    monkeypatch.setitem(cli.COMMANDS, "try", cli.Subcommand("a_script", "tries"))
    assert cli.main(["try", "--seed", "3"]) == 7
    assert got == [["--seed", "3"]]


def test_the_version_is_the_installed_one(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out.strip() == f"asm-gym {metadata.version('asm-gym')}"
