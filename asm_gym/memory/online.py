"""Learning on the job: a body that wears changes what is normal, slowly, and association may follow it.

    ε_t = ψ((Δ_t - Δ̂_t)/σ_t) σ_t        ΔU = η ε_t f(h_t)ᵀ / n_t    ΔD = η ε_t a_tᵀ / n_t,   n_t = ‖f(h_t)‖² + ‖a_t‖²

Only what predicts is moved, by the rule that it was learned with; n_t makes η the share of an error that one step takes
away, so that no row, however loud, can make learning diverge.

Source: Nagumo and Noda 1967 (IEEE Trans. Automatic Control 12(3)) for the normalised delta rule.
"""

from __future__ import annotations

import numpy as np

from asm_gym.memory.association import Association, Change, complete, hidden_units
from asm_gym.memory.energy import Array
from asm_gym.memory.learning import coincidence
from asm_gym.memory.precision import log_variance


def followed(association: Association, exists: Change, a: Array, delta: Array, rate: float) -> Association:
    """The association after a batch of rows; the one given is left as it is.

    Args:
        association: the synapses.
        exists: 1 where there is one, as in ``association.synapses``.
        a: (B, I) inputs.
        delta: (B, X) changes, standardised.
        rate: η in (0, 1].
    """
    f = hidden_units(a, association.V)
    variance = log_variance(f, association.W_S, association.b_S, association.span_S)
    spread = association.remainder * np.exp(np.float32(0.5) * variance)
    error = np.clip(delta - complete(f, a, association.U, association.D), -spread, spread)
    error *= np.float32(rate) / (np.sum(f * f, axis=1) + np.sum(a * a, axis=1))[:, None]
    return association._replace(
        U=association.U + coincidence(error, f) * exists.U, D=association.D + coincidence(error, a) * exists.D
    )
