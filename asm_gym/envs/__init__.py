"""Robosuite's tasks with Gymnasium's contract."""

from asm_gym.extras import require

# Looked for here, so that whoever asks for an environment, or for a fault in one, is told what to install.
require("mujoco", what="a robosuite environment or a fault in one")
