"""Robosuite's tasks with Gymnasium's contract."""

from asm_gym.extras import check_mujoco, require

# Checked here, so that the error of a missing or unfit package says what to install.
check_mujoco()
require("mujoco", what="a robosuite environment or a fault in one")
