"""LeRobot's robot type ``guarded``: found by LeRobot's own discovery where that is installed, else beside a fake."""

from __future__ import annotations

import sys
import tomllib
from dataclasses import dataclass, make_dataclass
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar

import numpy as np
import pytest

from asm_gym.monitors import make_monitor
from tests.test_lerobot import MOTORS, Arm, recorded
from tests.wheel import ROOT

PLUGIN = ROOT / "plugins" / "lerobot_robot_asm_gym"
FAKE_ARM = """
from dataclasses import dataclass

from lerobot.robots import Robot, RobotConfig
from tests.test_lerobot import MOTORS, Arm

@RobotConfig.register_subclass("fake_arm")
@dataclass(kw_only=True)
class FakeArmConfig(RobotConfig):
    seed: int = 0

class FakeArm(Robot):
    config_class = FakeArmConfig
    name = "fake_arm"
    is_connected = False
    is_calibrated = True
    observation_features = action_features = dict.fromkeys(MOTORS, float)

    def __init__(self, config):
        self.servos = Arm(config.seed)
        self.cameras = {}

    def connect(self, calibrate=True):
        self.is_connected = True

    def disconnect(self):
        self.is_connected = False

    def calibrate(self): ...
    def configure(self): ...

    def get_observation(self):
        return self.servos.get_observation() | {"front": [[0]]}

    def send_action(self, action):
        return self.servos.send_action(action)
"""


def fake_lerobot() -> ModuleType:
    """The part of ``lerobot.robots`` that a robot type needs."""

    class Robot: ...

    @dataclass(kw_only=True)
    class RobotConfig:
        id: str | None = None
        known: ClassVar[dict[str, type]] = {}

        @classmethod
        def register_subclass(cls, name: str) -> Any:
            return lambda config_class: cls.known.setdefault(name, config_class)

    def make_robot_from_config(config: Any) -> Any:
        module = import_module(type(config).__module__)
        return getattr(module, type(config).__name__.removesuffix("Config"))(config)

    module = ModuleType("lerobot.robots")
    vars(module).update(
        Robot=Robot, RobotConfig=RobotConfig, make_robot_from_config=make_robot_from_config
    )
    return module


@pytest.fixture
def robots(tmp_path, monkeypatch) -> Any:
    """``lerobot.robots`` after LeRobot has looked for robots of others."""
    (tmp_path / "fake_arm.py").write_text(FAKE_ARM)
    info = tmp_path / "lerobot_robot_asm_gym-0.1.0.dist-info"
    info.mkdir()
    name = tomllib.loads((PLUGIN / "pyproject.toml").read_text())["project"]["name"]
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 0.1.0\n")
    monkeypatch.syspath_prepend(str(PLUGIN))
    monkeypatch.syspath_prepend(str(tmp_path))
    is_real = find_spec("lerobot") is not None
    if is_real:
        import_module("lerobot.utils.import_utils").register_third_party_plugins()
    else:
        for missing in ("draccus", "lerobot"):
            monkeypatch.setitem(sys.modules, missing, ModuleType(missing))
        monkeypatch.setitem(sys.modules, "lerobot.robots", fake_lerobot())
        import_module(name)
    yield import_module("lerobot.robots")
    if not is_real:
        del sys.modules[name]
        sys.modules.pop("fake_arm", None)


@pytest.fixture(scope="module")
def memory(tmp_path_factory) -> Path:
    made = make_monitor("kalman+evidence", recorded(0).spec).fit([recorded(n) for n in range(20)])
    made.calibrate([recorded(100 + n) for n in range(39)], 0.025)
    path = tmp_path_factory.mktemp("memory") / "arm.asm"
    made.save(path)
    return path


def guarded(robots: Any, memory: Path, seed: int) -> Any:
    """A guarded fake arm, made from configs as LeRobot's commands make it."""
    arm = import_module("fake_arm").FakeArmConfig(seed=seed)
    config_class = sys.modules["lerobot_robot_asm_gym"].GuardedRobotConfig
    robot = robots.make_robot_from_config(config_class(arm=arm, memory=str(memory)))
    robot.connect()
    return robot


def test_a_guarded_robot_is_the_robot_within_until_an_alarm(robots, memory):
    robot = guarded(robots, memory, 201)
    assert robot.is_connected
    assert (robot.robot_type, robot.cameras) == ("fake_arm", {})
    assert robot.action_features == dict.fromkeys(MOTORS, float)
    servos = robot.arm.servos
    for k in range(120):
        servos.jammed[2] = k >= 100
        assert "front" in robot.get_observation()
        action = servos.policy(k)
        sent = robot.send_action(action)
        if robot.guard.intervened:
            break
        assert sent == action
    assert 100 < k <= 115
    assert sent["elbow_flex.pos"] == pytest.approx(servos.q[2], abs=1.0)
    assert robot.guard.last_alarm["servo"] == "elbow_flex"
    robot.disconnect()
    assert not robot.is_connected


def test_a_command_without_a_reading_is_judged_beside_a_new_one(robots, memory):
    robot = guarded(robots, memory, 200)
    servos = robot.arm.servos
    readings = []
    read = robot.arm.get_observation
    robot.arm.get_observation = lambda: readings.append(1) or read()
    for k in range(40):
        robot.send_action(servos.policy(k))
    assert len(readings) == 40
    assert not robot.guard.intervened
    np.testing.assert_array_equal(servos.sent[-1], list(servos.policy(39).values()))


def test_lerobots_own_command_line_takes_it(robots, memory):
    pytest.importorskip("lerobot.utils", reason="pip install lerobot")
    draccus = import_module("draccus")
    import_module("fake_arm")
    command = make_dataclass("Command", [("robot", robots.RobotConfig)])
    arm = "{type: fake_arm, seed: 7}"
    options = {"type": "guarded", "memory": memory, "on_alarm": "stop", "arm": arm}
    words = [f"--robot.{name}={value}" for name, value in options.items()]
    config = draccus.parse(command, args=words).robot
    assert config.type == "guarded"
    robot = robots.make_robot_from_config(config)
    assert (robot.guard.on_alarm, robot.name) == ("stop", "fake_arm")
    np.testing.assert_array_equal(robot.arm.servos.phase, Arm(7).phase)
