"""``python -m asm_gym.scripts.benchmark``."""

import sys

from asm_gym.scripts.benchmark import main

if __name__ == "__main__":
    sys.exit(main())
