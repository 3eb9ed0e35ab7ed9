"""A light install: the core watches a stream with nothing else installed, and what is missing is named."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tomllib
import zipfile

import numpy as np

from asm_gym import exceptions
from asm_gym.extras import BROUGHT_BY
from tests.wheel import ROOT, build_wheel

CORE = (
    "filelock",
    "gymnasium",
    "numpy",
    "numba",
    "packaging",
    "pandas",
    "rich",
    "scipy",
    "threadpoolctl",
    "tyro",
)
WATCH = """
import gymnasium, numpy as np
import asm_gym, asm_gym.monitors, asm_gym.wrappers
from asm_gym.data.episode import Episode, load_episode, save_episode
from asm_gym.monitors import NeuralASM
from asm_gym.spec import Channel, StreamSpec

spec = StreamSpec((Channel("x", 3, group="joint"), Channel("u", 1, group="action")), dt=0.05)
rng = np.random.default_rng(0)
t = np.arange(60)[:, None]
waves = lambda: np.hstack([np.sin(t * (0.1, 0.2, 0.3)), np.ones((60, 1))]) + 0.01 * rng.normal(size=(60, 4))
episodes = [Episode.from_stream(waves(), spec) for _ in range(24)]
asm = NeuralASM(spec, hidden_size=8, association_size=8, epochs=1).fit(episodes[:5])
asm.calibrate(episodes[5:], false_alarm_rate=0.05)
asm.save("small.asm")
asm = NeuralASM.load("small.asm")
broken = waves()
broken[30:, 1] = 3.0
state, alarms = asm.initial_state(), []
for row in load_episode(save_episode("one.npz", Episode.from_stream(broken, spec))).stream:
    state, surprise = asm.observe(state, row[None])
    alarms.append(bool(surprise.value[0] > asm.threshold))
assert not any(alarms[:30]) and any(alarms[30:33]), alarms

class Still(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(-9, 9, (3,), np.float32)
    action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)
    def reset(self, *, seed=None, options=None): return np.zeros(3, np.float32), {}
    def step(self, action): return np.zeros(3, np.float32), 0.0, False, False, {}

recorder = asm_gym.wrappers.StreamRecorder(Still())
recorder.reset()
recorder.step(np.zeros(1, np.float32))
assert recorder.finish().stream.shape == (1, 4)

def said(task):
    try:
        task()
    except ImportError as error:
        return str(error)

import json
print(json.dumps([
    said(lambda: gymnasium.make("asm_gym/Lift-v0")),
    said(lambda: asm_gym.wrappers.FaultInjection),
    said(lambda: asm_gym.monitors.make_monitor("gru", spec)),
    said(lambda: __import__("asm_gym.data.minari_datasets").data.minari_datasets.require_minari()),
    said(lambda: __import__("asm_gym.tasks").tasks.env_id("gymnasium_robotics:FetchReach-v4")),
    {name: said(lambda: getattr(asm_gym, name)) for name in asm_gym.__all__},
]))
"""

SAID = [
    "a robosuite environment or a fault in one needs mujoco: pip install 'asm-gym[robosuite]'",
    "a robosuite environment or a fault in one needs mujoco: pip install 'asm-gym[robosuite]'",
    "GRU needs torch: pip install 'asm-gym[agents]'",
    "a dataset needs h5py: pip install 'asm-gym[data]'",
    "gymnasium_robotics:FetchReach-v4 needs gymnasium_robotics: pip install 'asm-gym[environments]'",
]

ONE_IMPORT = {
    **dict.fromkeys(
        ("NeuralASM", "NeuralASMSafety", "VectorNeuralASMSafety", "StreamRecorder"), None
    ),
    **dict.fromkeys(
        (
            "Channel",
            "Episode",
            "LogSchema",
            "StreamSpec",
            "make_monitor",
            "make_policy",
            "harmless",
        ),
        None,
    ),
    **dict.fromkeys(("register_monitor", "register_policy", "register_task"), None),
    **dict.fromkeys(exceptions.__all__, None),
    "register_fault": "register_fault needs mujoco: pip install 'asm-gym[robosuite]'",
    **dict.fromkeys(("FaultInjection", "collect"), SAID[0]),
}
"""What a core install answers for each name of the package."""

NOTHING_ELSE = """
import sys

class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ABSENT:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Absent())
"""


def test_the_core_watches_a_stream_and_names_what_the_rest_needs(tmp_path):
    code = NOTHING_ELSE.replace("ABSENT", repr(set(BROUGHT_BY))) + WATCH
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == [*SAID, ONE_IMPORT]


def test_a_command_says_which_extra_it_lacks(tmp_path):
    code = (
        NOTHING_ELSE.replace("ABSENT", "{'matplotlib'}")
        + "from asm_gym.scripts.cli import main; sys.exit(main())"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, "evaluate"], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout) == (2, "")
    assert (
        done.stderr
        == "asm-gym evaluate: this command needs matplotlib: pip install 'asm-gym[report]'\n"
    )


def test_logs_are_watched_without_a_simulator(tmp_path):
    log = tmp_path / "logs"
    log.mkdir()
    for k in range(40):
        rows = np.sin(0.2 * np.arange(60)[:, None] + np.array((k, 2 * k, 3.0)))
        rows[30:, 0] += 9.0 * (k == 39)
        np.savetxt(
            log / f"{k:02}.csv", rows, delimiter=",", header="a,b,c", comments="", fmt="%.6f"
        )
    (log / "39.csv").rename(tmp_path / "torn.csv")
    code = NOTHING_ELSE.replace("ABSENT", repr(set(BROUGHT_BY))) + (
        "from asm_gym.scripts.cli import main\n"
        "fit = 'fit logs --rate 20 --monitor kalman --false-alarm-rate 0.1 --out m.asm'.split()\n"
        "watch = 'watch torn.csv --rate 20 --monitor m.asm --out seen'.split()\n"
        "print(main(['doctor']), main(fit), main(watch))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.stdout.endswith("0 0 1\n"), done.stdout + done.stderr
    assert "alarms.csv; the report needs matplotlib: pip install 'asm-gym[report]'" in done.stdout
    assert {p.name for p in (tmp_path / "seen").iterdir()} <= {"alarms.csv", "incidents"}


def test_every_requirement_of_an_extra_is_known_by_the_name_it_is_imported_under():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    imported_as = {"pillow": "PIL", "scikit-learn": "sklearn", "rerun-sdk": "rerun"}

    def names(requirements):
        found = [re.match(r"[\w.-]+", line).group() for line in requirements]
        # gymnasium brings the one, and the other brings what another extra names
        ours = (
            "cloudpickle",
            "asm-gym",
        )
        return {imported_as.get(n, n.replace("-", "_")) for n in found if n not in ours}

    assert names(project["dependencies"]) == set(CORE)
    extras = {
        e: names(r)
        for e, r in project["optional-dependencies"].items()
        if e not in ("all", "dev", "docs")
    }
    bounded = (
        ("environments", "mujoco"),
        ("robosuite", "PIL"),
        ("robosuite", "opencv_python_headless"),
    )
    for extra, package in bounded:  # others bring it
        extras[extra].remove(package)
    extras["robosuite"].add("robosuite")  # by a line of its own
    assert extras == {e: {n for n in BROUGHT_BY if BROUGHT_BY[n] == e} for e in BROUGHT_BY.values()}


def test_a_wheel_holds_every_file_of_the_package(tmp_path):
    """An editable install finds them all, whatever pyproject.toml says."""
    there = {str(f.relative_to(ROOT)) for f in (ROOT / "asm_gym").rglob("*") if f.is_file()}
    with zipfile.ZipFile(build_wheel(tmp_path)) as wheel:
        assert {name for name in there if "__pycache__" not in name} <= set(wheel.namelist())
