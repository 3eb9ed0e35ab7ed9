"""Run ``python -m asm_gym``, as ``asm-gym``."""

from asm_gym.scripts.cli import main

if __name__ == "__main__":
    raise SystemExit(main())
