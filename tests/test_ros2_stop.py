"""The template that stops a ros2_control arm at an alarm, with stand-ins for ROS's packages."""

from __future__ import annotations

import importlib.util
import json
import sys
from types import ModuleType, SimpleNamespace
from unittest.mock import MagicMock

import pytest

from asm_gym.guard.alarm_outputs import as_json
from asm_gym.guard.live import LiveEvent
from tests.wheel import ROOT

ALARM = LiveEvent("alarm", 1.0, "q[0]  inf thresholds", "missing data", "q[0]", float("inf"), 0.1)


class Node:
    def __init__(self, name: str) -> None:
        self.client, self.heard = MagicMock(), {}

    def declare_parameter(self, name, default):
        return SimpleNamespace(value=default)

    def create_client(self, kind, name):
        return self.client

    def create_subscription(self, kind, topic, callback, quality):
        self.heard[topic] = callback

    def get_logger(self):
        return MagicMock()


class SwitchController:
    class Request:
        BEST_EFFORT = 1


@pytest.mark.parametrize("text", [as_json(ALARM), "no json"])
def test_an_alarm_deactivates_the_controllers(text, monkeypatch):
    given = {
        "rclpy": {},
        "rclpy.node": {"Node": Node},
        "rclpy.qos": {name: MagicMock() for name in ("DurabilityPolicy", "QoSProfile", "ReliabilityPolicy")},
        "controller_manager_msgs": {},
        "controller_manager_msgs.srv": {"SwitchController": SwitchController},
        "std_msgs": {},
        "std_msgs.msg": {"String": object},
    }
    for name, content in given.items():
        module = ModuleType(name)
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, name, module)
    spec = importlib.util.spec_from_file_location("ros2_stop", ROOT / "docs" / "guides" / "ros2_stop.py")
    assert spec is not None
    assert spec.loader is not None
    template = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(template)
    node = template.StopOnAlarm()
    node.heard["/asm_gym/alarm"](SimpleNamespace(data=text))
    ((request,), _) = node.client.call_async.call_args
    assert request.deactivate_controllers == ["joint_trajectory_controller"]
    assert json.loads(as_json(ALARM))["thresholds"] == "inf"
