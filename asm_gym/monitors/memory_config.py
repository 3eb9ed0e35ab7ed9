"""Hyperparameters of a memory: the defaults of those that ``NeuralASM`` takes, and those that seldom need a change."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

from asm_gym.detection.detector import BOUND, GAINS
from asm_gym.detection.evidence import TAIL_INDEX
from asm_gym.detection.evidence_detection import EvidenceDetection
from asm_gym.memory.dynamics import ITERATIONS, PRIOR_PRECISION
from asm_gym.validation import check_number

HIDDEN_UNITS = 256  # of the temporal network
ASSOCIATION_UNITS = 480
EPOCHS = 40

MOST_ITERATIONS = 1000
"""Of inference in a row: twenty are enough, and a damaged file must not ask for a thousand million."""

OF_EVIDENCE = ("gains", "bound", "shrinkage", "tail_index")  # that the detection takes and checks


@dataclass(frozen=True)
class MemoryConfig:
    """Set how a memory learns, infers and accumulates evidence, beside the arguments of ``NeuralASM``.

    Args:
        iterations: largest number of inference steps; inference ends earlier when the state stops changing. Settling
            infers on every row, recurrent units with a missing sense, and in learning in at most 5 steps.
        learning_rate: largest change of a synapse in one step, decaying to 0 along a cosine; scaled by 256 / H for
            larger H, so that the input of a unit does not change faster with more synapses.
        batch_size: episodes in a batch of learning.
        prior_precision: Π_z, trust in the prediction. By default 1, so that the senses move the state. Recurrent units
            always learn with 30, which brings local learning closer to the gradient.
        sensory_precision: Π_x, trust in the senses.
        noise: standard deviation of the noise on what recurrent units carry on while they learn, in standardised rows;
            0.3 for a memory that acts or runs on alone. The other networks learn without.
        gains: a in (0, 1], weights of the newest step in the evidence; several, for sudden and for slow faults.
        bound: ν > 0, largest number of standard deviations that an error counts, to limit the effect of short knocks.
        shrinkage: λ in [0, 1] of the whitening, towards no correlation between errors.
        tail_index: ξ_0 in (0, 1]: surprise falls off as probability to this power; the smaller, the more senses add up.
    """

    iterations: int = ITERATIONS
    learning_rate: float = 3e-3
    batch_size: int = 64
    prior_precision: float = PRIOR_PRECISION
    sensory_precision: float = 1.0
    noise: float = 0.0
    gains: Sequence[float] = GAINS
    bound: float = BOUND
    shrinkage: float = 1e-3
    tail_index: float = TAIL_INDEX

    def as_checked_by(self, evidence: EvidenceDetection) -> Self:
        """Return the config with the numbers that the detection has made of it."""
        return replace(self, **{name: getattr(evidence, name) for name in OF_EVIDENCE})

    def __post_init__(self) -> None:
        checked: dict[str, Any] = {
            "iterations": check_number(
                "iterations", self.iterations, low=1, high=MOST_ITERATIONS, whole=True
            ),
            "learning_rate": check_number("learning_rate", self.learning_rate, above=0.0),
            "batch_size": check_number("batch_size", self.batch_size, low=1, whole=True),
            "prior_precision": check_number("prior_precision", self.prior_precision, above=0.0),
            "sensory_precision": check_number(
                "sensory_precision", self.sensory_precision, above=0.0
            ),
            "noise": check_number("noise", self.noise, low=0.0),
            "gains": tuple(self.gains),  # EvidenceDetection checks all of ``OF_EVIDENCE``
        }
        for name, value in checked.items():
            object.__setattr__(self, name, value)
