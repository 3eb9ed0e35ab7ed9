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
from asm_gym.spec import MOTOR, Channel, StreamSpec
from asm_gym.validation import check_shapes

UPDATES = 12_000  # most batches
PASSES = 100  # most passes over the rows
BATCH = 256  # rows of a batch
RATE = 3e-3  # largest step size
FORGETTING = 0.3  # λ
FINE = 8.0  # κ of relative positions of objects, where a centimetre decides
# κ of the position of the hand: objects are put down at places that nothing else marks
PLACED = 4.0
FARTHEST = 100.0  # inputs are clipped to this


@lru_cache(maxsize=8)
def fineness(spec: StreamSpec) -> NDArray[np.float64]:
    """Return κ (D,); 0 for commands and for what is measured per second."""
    return np.repeat([_fineness_of(c) for c in spec.channels], [c.size for c in spec.channels])


def _fineness_of(channel: Channel) -> float:
    if channel.group == MOTOR or channel.unit.endswith("/s"):
        return 0.0
    if channel.group == "hand" and channel.unit == "m":
        return PLACED
    if channel.group == "object" and "_to_" in channel.name and "quat" not in channel.name:
        return FINE
    return 1.0


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
        units = learned["motor_U"].shape[-1]
        motor = len(senses.spec.motor)
        inputs = int(np.count_nonzero(fineness(senses.spec))) + 1
        shapes = {
            "motor_V": (units, inputs),
            "motor_U": (motor, units),
            "motor_D": (motor, inputs),
            "motor_mean": (motor,),
            "motor_spread": (motor,),
        }
        check_shapes(learned, shapes)
        return cls._make(learned[name] for name in shapes)


def learn_motor(m: Array, commands: Array, units: int, rng: np.random.Generator) -> Motor:
    """Learn M ``units`` from situations (N, I) and the next command in each (N, A), in random order."""
    if units < 1:
        raise ValueError(f"units must be at least 1, got {units}")
    mean = commands.mean(axis=0, dtype=np.float64)
    spread = commands.std(axis=0, dtype=np.float64)
    spread = np.where(spread > 0, spread, 1.0)
    wanted = ((commands - mean) / spread).astype(np.float32)
    motor = commands.shape[1]
    inputs = m.shape[1]
    V = (rng.standard_normal((units, inputs)) / np.sqrt(inputs)).astype(np.float32)
    U = np.zeros((motor, units), np.float32)
    D = np.zeros((motor, inputs), np.float32)
    synapses = [Synapse(W) for W in (V, U, D)]
    no_scale = np.ones(motor, np.float32)
    updates = max(1, min(UPDATES, PASSES * len(m) // BATCH))
    for n, rows in zip(range(updates), shuffled(len(m), BATCH, rng), strict=False):
        change, _ = association_change(m[rows], wanted[rows], no_scale, V, U, D, bound=np.inf)
        rate = cosine_decay(RATE, n / updates)
        for synapse, product in zip(synapses, change, strict=True):
            synapse.W *= np.float32(1.0 - FORGETTING * rate)
            synapse.learn(product, rate)
    return Motor(V, U, D, mean, spread)
