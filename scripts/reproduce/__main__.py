"""``python -m asm_gym.scripts.reproduce``."""

import sys

from asm_gym.scripts.reproduce import main

if __name__ == "__main__":
    sys.exit(main())
