"""The guard's reflexes: they stay, undo the last actions, or give way to what presses."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from asm_gym.guard.reflexes import COMPLIANCE, Reflexes
from asm_gym.spec import MOTOR, Channel, StreamSpec

SPEC = StreamSpec((Channel("external_torque", 2), Channel("action", 2, group=MOTOR)), 0.05)


def reflexes(on_alarm: str, spec: StreamSpec = SPEC, refused: dict[str, str] | None = None) -> Reflexes:
    robots: Any = SimpleNamespace(
        count=1, rest=np.zeros(2, np.float32), refused=refused or {}, brakes=False, dt=0.05, turn=lambda _, turns: turns
    )
    made = Reflexes(robots, spec, on_alarm)
    made.begin(np.ones(1, bool))
    return made


def test_retract_undoes_the_last_actions_newest_first_and_then_stays():
    felt = reflexes("retract")
    felt.path[0, -2:, 0], felt.steps[0] = (0.2, 0.3), 2
    moves = [felt.move(0, "retract").action[0] for _ in range(3)]
    np.testing.assert_allclose(moves, [-0.3, -0.2, 0.0], rtol=1e-6)


def test_comply_gives_way_beyond_what_is_usual_and_tolerated():
    felt = reflexes("comply")
    felt.torque[0], felt.usual[0] = [5.0, -9.0], [0.0, -5.0]
    beyond = np.array([3.0, -2.0])
    np.testing.assert_allclose(felt.move(0, "comply").action, COMPLIANCE * 0.05 * beyond, rtol=1e-6)
    felt.torque[0] = felt.usual[0]
    assert not felt.move(0, "comply").action.any()


def test_a_reflex_that_the_robots_cannot_do_is_refused_and_graded_stays_instead():
    blind = StreamSpec((Channel("position", 2), Channel("action", 2, group=MOTOR)), 0.05)
    with pytest.raises(ValueError, match="external_torque"):
        reflexes("comply", blind)
    with pytest.raises(ValueError, match="OSC_POSE"):
        reflexes("retract", refused={"retract": "retract needs OSC_POSE"})
    graded = reflexes("graded", blind)
    graded.expected[0] = 0.7
    assert not graded.move(0, "comply").action.any()
