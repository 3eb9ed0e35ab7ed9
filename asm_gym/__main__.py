"""Run ``python -m asm_gym``, as ``asm-gym``."""

from asm_gym.scripts.cli import main

raise SystemExit(main())
