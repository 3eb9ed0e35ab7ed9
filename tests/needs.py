"""A test of an optional library is skipped where that is not installed, with the line that installs it."""

from __future__ import annotations

from typing import Any

import pytest

from asm_gym.extras import BROUGHT_BY


def needs(module: str) -> Any:
    """The module, by its dotted name."""
    package = module.split(".")[0]
    brought = f"asm-gym[{BROUGHT_BY[package]}]" if package in BROUGHT_BY else package
    return pytest.importorskip(module, reason=f"pip install '{brought}'")
