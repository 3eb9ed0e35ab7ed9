"""A small memory that several tests share: fitting one costs more than most of what is asked of it."""

from __future__ import annotations

from functools import cache

from asm_gym.monitors import NeuralASM
from tests.streams import sine_episodes, sine_spec

SMALL = {"hidden_size": 48, "association_size": 240, "epochs": 25, "seed": 1}


@cache
def sine_memory() -> NeuralASM:
    """Fitted to sines and calibrated at 5 %; a test must leave it as it is."""
    return (
        NeuralASM(sine_spec(), **SMALL)
        .fit(sine_episodes(50))
        .calibrate(sine_episodes(60, seed=1), 0.05)
    )


def learned_bytes(asm: NeuralASM) -> list[bytes]:
    senses = asm.senses_
    detector = [asm.learned_[name] for name in asm.detection.arrays]
    network = *asm.model.network_.weights, *asm.model.network_.association
    return [
        a.tobytes()
        for a in (
            *network,
            senses.mean,
            senses.spread,
            senses.change,
            *detector,
            asm.learned_["energy"],
        )
    ]
