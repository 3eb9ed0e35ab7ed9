"""Commands: each reads its arguments, calls the rooms below, and prints what came out."""

from asm_gym.moved import MOVED

MOVED.update(
    {
        "asm_gym.scripts.adopt": "asm_gym.scripts.reproduce.adoption",
        "asm_gym.scripts.demonstrations": "asm_gym.scripts.import_demonstrations",
        "asm_gym.scripts.dispatch": "asm_gym.rollouts.parallel",
        "asm_gym.scripts.lagrangian": "asm_gym.scripts.examples.lagrangian",
        "asm_gym.scripts.public": "asm_gym.scripts.reproduce.public",
        "asm_gym.scripts.react": "asm_gym.scripts.reproduce.reflexes",
        "asm_gym.scripts.repertoire": "asm_gym.scripts.reproduce.repertoire",
        "asm_gym.scripts.train_safely": "asm_gym.scripts.reproduce.safe_training",
    }
)
