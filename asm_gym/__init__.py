"""Neural associative skill memories that watch robots: importing this registers the environments with Gymnasium."""

import gymnasium

from asm_gym.moved import install
from asm_gym.tasks import TASKS

__version__ = "0.1.0"

for _task in TASKS.values():
    gymnasium.register(
        id=_task.id,
        entry_point=f"asm_gym.envs.registration:{_task.name}",
        # The environment truncates itself, so that `horizon` is an argument like any other.
        max_episode_steps=None,
    )

gymnasium.register(id="asm_gym/SyntheticArm-v0", entry_point="asm_gym.synthetic_arm:SyntheticArm")

install()
