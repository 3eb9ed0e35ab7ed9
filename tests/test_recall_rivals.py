"""The rivals of recall are what their names say."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from asm_gym.scripts.reproduce.expression import Backpropagated  # noqa: E402
from asm_gym.scripts.reproduce.recall_rivals import Practice, learned  # noqa: E402


@pytest.mark.parametrize(
    ("name", "cell", "truncated"),
    [("gru", "gru", False), ("gru_one_step", "gru", True), ("lstm", "lstm", False), ("rnn", "rnn", False)],
)
def test_only_the_network_of_one_step_is_truncated(monkeypatch, name, cell, truncated):
    asked: dict[str, Any] = {}

    def remember(
        train: Any, cell: str, units: int, rng: Any, updates: int, truncated: bool = False, **how: Any
    ) -> None:
        asked.update(cell=cell, truncated=truncated)

    monkeypatch.setattr(Backpropagated, "learned", remember)
    learned(name, {}, [], [], 8, Practice(1, 10, 10), np.random.default_rng(0))
    assert asked == {"cell": cell, "truncated": truncated}
