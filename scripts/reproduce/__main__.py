"""Run ``python -m asm_gym.scripts.reproduce``."""

from asm_gym.scripts.reproduce import main

raise SystemExit(main())
