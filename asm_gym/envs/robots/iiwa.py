"""KUKA's LBR iiwa, with the Robotiq 140 gripper."""

from __future__ import annotations

from typing import Any

import mujoco

from asm_gym.envs.robots.robot_model import PERSON_AND_TABLE, RobotModel

_SEVERAL_CONTACTS = int(getattr(mujoco.mjtDisableBit, "mjDSBL_MULTICCD", 0))
"""Flag that turns them off; before MuJoCo 3.8 they are off, and 3.4 has no such flag."""


def touch_at_one_point(model: Any, prefix: str) -> None:
    """Let two meshes touch at one point, as before MuJoCo 3.8.

    Since then they touch at up to four, which MuJoCo 3.12 chooses otherwise than 3.11. The finger links of robosuite's
    Robotiq 140 overlap by 4 to 14 mm in every pose, so the forces in the gripper depended on the version. At one point
    the contacts are the same from 3.11 to 4.0.
    """
    model._model.opt.disableflags |= _SEVERAL_CONTACTS


IIWA = RobotModel(
    name="IIWA",
    contact_limits=PERSON_AND_TABLE,
    mend=touch_at_one_point,
)
