"""Motor association: predict the next command from the present situation.

    m_t = [κ ⊙ v_t, 1]                             standardised values of everything that is no rate; κ: resolution
    â_{t+1} = U f(V m_t) + D m_t
    ΔU ∝ ε f(h)ᵀ    ΔD ∝ ε mᵀ    ΔV ∝ ε_h mᵀ       ε = a_{t+1} - â_{t+1},  ε_h = f'(h) ⊙ Uᵀ ε
    W ← (1 - ηλ) W                                 weight decay

The rules are those of association with three differences. Errors are not bounded: where a gripper closes, most rows
around it say open. Rates and the last command are not inputs: a policy that copies them never moves again once it
stands still. Weights decay, or each episode would be learned by heart.

Sources: as ``association``; de Haan et al. 2019 (NeurIPS) for copied commands; Krogh and Hertz 1991 (NeurIPS) for
weight decay.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.memory.association import complete, hidden_units
from asm_gym.memory.association_learning import association_change
from asm_gym.memory.energy import Array
from asm_gym.memory.learning import Synapse, cosine_decay, shuffled
from asm_gym.scaling import StreamScaler
from asm_gym.spec import MOTOR, StreamSpec
from asm_gym.validation import check_shapes

# largest number of batches, and of passes over the rows; rows of a batch
UPDATES, PASSES, BATCH = (
    12_000,
    100,
    256,
)
RATE, FORGETTING = 3e-3, 0.3  # step size, and λ
FINE = 8.0  # κ of relative positions of objects, where a centimetre decides
PLACED = (
    4.0  # κ of the position of the hand: objects are put down at places that nothing else marks
)
FARTHEST = 100.0  # inputs are clipped to this


@lru_cache(maxsize=8)
def fineness(spec: StreamSpec) -> NDArray[np.float64]:
    """Return κ (D,); 0 for commands and for what is measured per second."""

    def of(name: str, unit: str, group: str) -> float:
        if group == MOTOR or unit.endswith("/s"):
            return 0.0
        if group == "hand" and unit == "m":
            return PLACED
        return FINE if group == "object" and "_to_" in name and "quat" not in name else 1.0

    return np.array([of(c.name, c.unit, c.group) for c in spec.channels for _ in range(c.size)])


def situation(senses: StreamScaler, rows: NDArray[np.floating[Any]]) -> NDArray[np.float32]:
    """Return m (B, I) of rows (B, D); 0 where a number is not finite."""
    kappa = fineness(senses.spec)
    read = np.flatnonzero(kappa)
    values = (kappa * (np.asarray(rows, np.float64) - senses.mean) / senses.spread)[:, read]
    values = np.clip(np.nan_to_num(values, nan=0.0, posinf=0.0, neginf=0.0), -FARTHEST, FARTHEST)
    return np.hstack([values, np.ones((len(values), 1))]).astype(np.float32)


class Motor(NamedTuple):
    """The synapses of I inputs, M hidden units and A motor, and the scale of commands."""

    V: Array  # (M, I)
    U: Array  # (A, M)
    D: Array  # (A, I)
    mean: NDArray[np.float64]  # (A,)
    spread: NDArray[np.float64]  # (A,)

    def command(self, m: Array) -> NDArray[np.float32]:
        """Return â (B, A), in the units of the action, in situations (B, I)."""
        expected = complete(hidden_units(m, self.V), m, self.U, self.D)
        return (self.mean + self.spread * expected).astype(np.float32)

    def named(self) -> dict[str, NDArray[Any]]:
        """Return the arrays of a checkpoint."""
        return {f"motor_{name}": array for name, array in self._asdict().items()}

    @classmethod
    def found(cls, learned: Mapping[str, NDArray[Any]], senses: StreamScaler) -> Self | None:
        """Restore what ``named`` returned; None where it is absent. Raises ValueError where it does not fit."""
        if "motor_U" not in learned:
            return None
        units, motor = learned["motor_U"].shape[-1], len(senses.spec.motor)
        inputs = int(np.count_nonzero(fineness(senses.spec))) + 1
        shapes: dict[str, tuple[int, ...]] = {
            "V": (units, inputs),
            "U": (motor, units),
            "D": (motor, inputs),
        }
        shapes |= {"mean": (motor,), "spread": (motor,)}
        check_shapes(learned, {f"motor_{name}": shape for name, shape in shapes.items()})
        return cls(**{name: learned[f"motor_{name}"] for name in shapes})


def learn_motor(m: Array, commands: Array, units: int, rng: np.random.Generator) -> Motor:
    """Learn M ``units`` from situations (N, I) and the next command in each (N, A), in random order."""
    if units < 1:
        raise ValueError(f"units must be at least 1, got {units}")
    mean, spread = commands.mean(axis=0, dtype=np.float64), commands.std(axis=0, dtype=np.float64)
    spread = np.where(spread > 0, spread, 1.0)
    wanted = ((commands - mean) / spread).astype(np.float32)
    (_, inputs), A = m.shape, commands.shape[1]
    V = (rng.standard_normal((units, inputs)) / np.sqrt(inputs)).astype(np.float32)
    weights = V, np.zeros((A, units), np.float32), np.zeros((A, inputs), np.float32)
    synapses, plain = [Synapse(W) for W in weights], np.ones(A, np.float32)
    updates = max(1, min(UPDATES, PASSES * len(m) // BATCH))
    for n, rows in zip(range(updates), shuffled(len(m), BATCH, rng), strict=False):
        change, _ = association_change(m[rows], wanted[rows], plain, *weights, bound=np.inf)
        rate = cosine_decay(RATE, n / updates)
        for synapse, product in zip(synapses, change, strict=True):
            synapse.W *= np.float32(1.0 - FORGETTING * rate)
            synapse.learn(product, rate)
    return Motor(*weights, mean, spread)
