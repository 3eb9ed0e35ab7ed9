"""The template that stops a ros2_control arm at an alarm, with stand-ins for ROS's packages."""

from __future__ import annotations

import io
import runpy
import sys
from unittest.mock import MagicMock

import pytest

from asm_gym.guard.live_events import LiveEvent
from tests.wheel import ROOT

NOTE = LiveEvent("note", 0.5, "knock: no alarm").to_json()
ALARM = LiveEvent(
    "alarm", 1.0, "q[0]  inf thresholds", "missing data", "q[0]", float("inf"), 0.1
).to_json()


@pytest.mark.parametrize(
    ("lines", "left"), [([NOTE, ALARM, NOTE], [NOTE]), (["no json", NOTE], [NOTE]), ([NOTE], [])]
)
def test_an_alarm_or_the_end_of_the_watch_deactivates_the_controllers(lines, left, monkeypatch):
    ros, services = MagicMock(), MagicMock()
    for name, module in {
        "rclpy": ros,
        "controller_manager_msgs": MagicMock(),
        "controller_manager_msgs.srv": services,
    }.items():
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setattr(sys, "argv", ["ros2_stop.py", "arm_controller"])
    monkeypatch.setattr(sys, "stdin", io.StringIO("\n".join(lines)))
    runpy.run_path(str(ROOT / "docs" / "examples" / "ros2_stop.py"), run_name="__main__")
    assert [*map(str.strip, sys.stdin)] == left
    ((request,), _) = ros.create_node().create_client().call_async.call_args
    assert request.deactivate_controllers == ["arm_controller"]
