"""Random problems for the memory's mathematics."""

from __future__ import annotations

import numpy as np

from asm_gym.memory.association import Association, association_shapes
from asm_gym.memory.precision import unbounded

CHANGES = slice(5, 10)
"""Where the changes of five senses stand among the inputs."""


def problem(seed: int, batch: int = 3, hidden: int = 8, sensory: int = 5, scale: float = 1.0, dtype=np.float32):
    """Random (z, mu, x, W_F, pi_z, pi_x) of an energy."""
    rng = np.random.default_rng(seed)
    arrays = [
        rng.normal(size=s) * scale for s in ((batch, hidden), (batch, hidden), (batch, sensory), (sensory, hidden))
    ]
    pi_x = rng.uniform(0.0, 3.0, size=(batch, sensory))
    return *(a.astype(dtype) for a in arrays), 1.5, pi_x.astype(dtype)


def some_association(rng: np.random.Generator, inputs: int, units: int, changes: int) -> Association:
    shapes = association_shapes(inputs, units, changes).values()
    drawn = Association(*(rng.normal(scale=0.3, size=s).astype(np.float32) for s in shapes))
    return drawn._replace(remainder=np.exp(drawn.remainder), span_S=unbounded(changes))
