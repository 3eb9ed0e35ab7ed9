"""Learning of association: the linear part in closed form, the hidden units from its errors, the precision last.

    r_t = (Δ_t - D a_t) / s                        what the linear part leaves
    ε_t = ψ((r_t - U f(h_t)) / σ),  ψ(ε) = min(max(ε, -1), 1)
    ΔU ∝ ε_t f(h_t)ᵀ     ΔV ∝ ε_h a_tᵀ,   ε_h = f'(h_t) ⊙ Bᵀ ε_t
    c = Σ_n ψ(r_n) Δ̂_n / Σ_n Δ̂_n², in [0, 1]       share of the hidden units' predictions Δ̂ to believe
    ΔW_S ∝ (ε²/σ² - 1) f(h_t)ᵀ                     gradient of the Gaussian log likelihood
    τ = argmax Σ_n log t_4(ε_n/(σ_n g_n)) - log g_n   how much a prediction is doubted by its leverage

Errors come back by weights B of their own, which approach U. c, the precision and τ are learned on cross-fitted errors:
each row is predicted by what was learned from the two thirds of the episodes that it is not in. From very few rows
D reads the past and the command only, and U, W_S and τ are 0.

Sources: Huber 1964 for ψ; Kolen and Pollack 1994 and Akrout et al. 2019 (NeurIPS) for learned feedback; Stone 1974 and
Chernozhukov et al. 2018 (Econometrics Journal) for cross-fitting; Friston 2005 (Phil. Trans. R. Soc. B) for learned
precision; Lange et al. 1989 for t_4.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from asm_gym.memory.association import (
    Association,
    Change,
    complete,
    hidden_units,
    leverage,
    log_variance,
    no_doubt,
    synapses,
    unbounded,
)
from asm_gym.memory.energy import Array, kernel, outward
from asm_gym.memory.learning import Synapse, Tick, coincidence, cosine_decay, shuffled
from asm_gym.memory.linear import inverse_of, learn_from_past, learn_linear

FEEDBACK_GAIN = 1e-3  # initial gain of B
DECAY = 0.3  # share of its step size by which a synapse of U or B decays
# largest number of batches, and of passes over the rows; rows of a batch
UPDATES, PASSES, BATCH = (
    20_000,
    40,
    256,
)
# step size, and share of the updates in which it rises; after that it falls along a cosine
RATE, WARM_UP = (
    5e-3,
    0.1,
)
TICKS = 20  # progress reports of one learning of the hidden units
ROWS_PER_INPUT = 12  # with fewer rows for each input, the senses are not predicted from each other
TRACKING = np.float32(0.01)  # weight of the newest batch in the running spread σ of each error

THIRDS = 3
LARGEST_ERROR = 3.0  # standard deviations to which errors are clipped in ``trust``
SMALLEST_SPREAD = np.float32(1e-4)  # below this single precision is noise
EXTREME = 0.0005  # share of nominal rows below the limits of log σ², and above
LARGEST_RATIO = 30.0  # clips ε²/σ² (5.5 σ), so that one contact does not undo a thousand steps
PRECISION_EPOCHS, PRECISION_RATE = 20, 1e-3
# rows of a batch, and most batches in an epoch; then they are larger
PRECISION_BATCH, PRECISION_BATCHES = (
    64,
    250,
)
DOUBTS = 0.0, *(10.0 ** np.arange(-2.0, 0.6, 0.25))  # τ to choose from
# of the t distribution, steps to its spread, and rows to choose τ by
FREEDOM, SCALINGS, MOST_DOUBTED = (
    4,
    10,
    30_000,
)
ALL_TICKS = (THIRDS + 1) * TICKS + PRECISION_EPOCHS  # progress reports of ``learn_association``


@kernel
def inward(pulled: Array, f: Array, back: Array) -> Array:
    """Return f'(h) ⊙ Bᵀ ε (B, M) for errors (B, X), hidden units ``f`` (B, M) and feedback ``back`` (X, M)."""
    out = np.empty((len(pulled), back.shape[1]), pulled.dtype)
    np.dot(pulled, back, out)
    for n in range(out.shape[0]):
        for j in range(out.shape[1]):
            out[n, j] *= np.float32(1) - f[n, j] * f[n, j]
    return out


def association_change(
    a: Array,
    delta: Array,
    spread: Array,
    V: Array,
    U: Array,
    D: Array,
    bound: float = 1.0,
    back: Array | None = None,
) -> tuple[Change, Array]:
    """Return the change of each synapse, as if all existed, and the errors (B, X).

    Inputs ``a`` are (B, I), changes (B, X), σ (X,) and ``D`` (X, I), or (X, 0) without a linear part; ``bound`` is that
    of ψ; the feedback weights ``back`` (X, M) are ``U`` where None.
    """
    f = hidden_units(a, V)
    error = delta - (complete(f, a, U, D) if D.size else outward(f, U))
    pulled = np.clip(error / spread, np.float32(-bound), np.float32(bound))
    upstream = inward(pulled, f, U if back is None else back)  # (B, M) ε_h
    return Change(
        coincidence(upstream, a), coincidence(pulled, f), coincidence(pulled, a) if D.size else D
    ), error


def learn_association(
    a: Array,
    delta: Array,
    groups: NDArray[np.intp],
    changes: slice,
    size: int,
    rng: np.random.Generator,
    tick: Tick = lambda: None,
    lengths: Sequence[int] = (),
    independent: int | None = None,
) -> tuple[Association, Array]:
    """Learn the linear part, then the hidden units, then the precision.

    Args:
        a: (N, I) inputs of whole episodes, concatenated; the last input is a constant 1.
        delta: (N, X) changes, standardised.
        groups, changes, size: as in ``synapses``.
        rng, tick: draws initial weights and the order of the rows; is called ``ALL_TICKS`` times.
        lengths: rows of each episode; without them cross-fitting cuts the rows into three consecutive parts.
        independent: number of rows if overlapping changes are counted once; N where None.

    Returns:
        What was learned, and the normalised errors (N, X) of rows by what was learned without them.
    """
    few = (independent or len(a)) < ROWS_PER_INPUT * a.shape[1]
    exists = synapses(groups, changes, a.shape[1], size)
    D = learn_from_past(a, changes) if few else learn_linear(a, groups, changes)
    left = delta - outward(a, D)
    remainder = np.maximum(np.sqrt(np.mean(left**2, axis=0)), SMALLEST_SPREAD)  # (X,)
    left /= remainder
    if few:
        for _ in range(ALL_TICKS):
            tick()
        none, flat = np.zeros_like(exists.U), np.zeros_like(remainder)
        precision = none.copy(), flat, unbounded(len(D)), remainder
        return Association(
            _random(exists.V, rng), none, D, *precision, **no_doubt(*D.shape[::-1])
        ), left

    def expect(learned_from: NDArray[np.bool_], asked: NDArray[np.bool_]) -> Array:
        own_D = learn_linear(a[learned_from], groups, changes)
        own_left = (delta - outward(a, own_D)) / remainder
        V, U = _learn_hidden(a[learned_from], own_left[learned_from], exists, rng, tick)
        known = *inverse_of(a[learned_from], groups, changes), groups, changes.start
        return np.hstack(
            [own_left[asked], outward(hidden_units(a[asked], V), U), leverage(a[asked], *known)]
        )

    # Errors on rows that were learned are smaller than those to come.
    fresh = crossfit(expect, thirds(len(a), lengths, rng), 3 * len(D))
    fresh_left, expected, far = np.split(fresh, 3, axis=1)
    V, U = _learn_hidden(a, left, exists, rng, tick)
    share = trust(fresh_left, expected)
    U *= share[:, None]
    f, error = hidden_units(a, V), fresh_left - share * expected
    W_S, b_S = learn_precision(f, error, rng, tick)
    span_S = usual_span(f, W_S, b_S)
    error *= np.exp(np.float32(-0.5) * log_variance(f, W_S, b_S, span_S))
    doubt = learn_doubt(error, far)
    error /= np.sqrt(doubt[0] + doubt[1] * far)
    inverse = inverse_of(a, groups, changes)
    return Association(
        V, U * remainder[:, None], D, W_S, b_S, span_S, remainder, *inverse, doubt
    ), error


def learn_doubt(error: Array, far: Array) -> Array:
    """Return ``Association.doubt`` (3, X) from cross-fitted errors and leverages (N, X)."""
    usual = np.maximum(np.median(far, axis=0), SMALLEST_SPREAD)  # (X,)
    shown = slice(None, None, -(-len(far) // MOST_DOUBTED))
    squares, ratio = error[shown].astype(np.float64) ** 2, far[shown] / usual
    costs = []
    for tau in DOUBTS:
        g = (1.0 + tau * ratio) / (1.0 + tau)
        q = squares / g
        spread = np.maximum(np.median(q, axis=0), SMALLEST_SPREAD**2)
        for _ in range(SCALINGS):
            spread = np.maximum(
                np.mean(q * (FREEDOM + 1) / (FREEDOM + q / spread), axis=0), SMALLEST_SPREAD**2
            )
        costs.append(
            np.mean(np.log(g * spread) + (FREEDOM + 1) * np.log1p(q / spread / FREEDOM), axis=0)
        )
    tau = np.array(DOUBTS)[np.argmin(costs, axis=0)]
    return np.stack([1.0 / (1.0 + tau), tau / (1.0 + tau) / usual, far.max(axis=0)]).astype(
        np.float32
    )


def _random(exists: Array, rng: np.random.Generator) -> Array:
    """Return initial V (M, I)."""
    return (
        rng.standard_normal(exists.shape).astype(np.float32)
        / np.float32(np.sqrt(exists.shape[1]))
        * exists
    )


def _learn_hidden(
    a: Array, left: Array, exists: Change, rng: np.random.Generator, tick: Tick
) -> tuple[Array, Array]:
    """Return V and U learned from inputs (N, I) and what the linear part leaves (N, X), standardised."""
    updates = max(TICKS, min(UPDATES, PASSES * len(a) // BATCH))
    V = _random(exists.V, rng)
    U, no_linear = np.zeros_like(exists.U), exists.D[:, :0]
    into, out_of = Synapse(V), Synapse(U)
    spread = np.ones(left.shape[1], np.float32)
    each = np.maximum(exists.U.sum(axis=1, keepdims=True), 1.0)
    B = (FEEDBACK_GAIN * rng.standard_normal(exists.U.shape) / np.sqrt(each)).astype(
        np.float32
    ) * exists.U
    back = Synapse(B)
    for n, rows in zip(range(updates), shuffled(len(a), BATCH, rng), strict=False):
        change, error = association_change(a[rows], left[rows], spread, V, U, no_linear, back=B)
        rate, outward_change = _rate(n / updates), change.U * exists.U
        into.learn(change.V * exists.V, rate)
        out_of.learn(outward_change, rate)
        back.learn(outward_change, rate)
        for W in (U, B):
            W *= np.float32(1.0 - DECAY * rate)
        now = np.sqrt(np.mean(np.minimum(error**2, 9 * spread**2), axis=0))
        spread += TRACKING * (np.maximum(now, SMALLEST_SPREAD) - spread)
        if (n + 1) * TICKS // updates > n * TICKS // updates:
            tick()
    return V, U


def _rate(progress: float) -> float:
    if progress < WARM_UP:
        return RATE * progress / WARM_UP
    return cosine_decay(RATE, (progress - WARM_UP) / (1.0 - WARM_UP))


def thirds(rows: int, lengths: Sequence[int], rng: np.random.Generator) -> NDArray[np.intp]:
    """Return the third (N,) of each row: of whole episodes by their ``lengths``; of rows if there are fewer than 3."""
    if len(lengths) >= THIRDS:
        return np.repeat(rng.permutation(len(lengths)) % THIRDS, lengths)
    return np.arange(rows) * THIRDS // max(rows, 1)


def crossfit(
    expect: Callable[[NDArray[np.bool_], NDArray[np.bool_]], Array],
    third: NDArray[np.intp],
    size: int,
) -> Array:
    """Return the prediction (N, X) of each row; ``expect`` learns from one mask (N,), and predicts another (M, X)."""
    found = np.zeros((len(third), size), np.float32)
    for k in range(THIRDS):
        asked = third == k
        found[asked] = expect(~asked, asked)
    return found


def trust(left: Array, expected: Array) -> Array:
    """Return c (X,) in [0, 1]: the share of the predictions (N, X) that leaves the least of the targets (N, X)."""
    known = np.sum(expected**2, axis=0)
    clipped = np.clip(left, -LARGEST_ERROR, LARGEST_ERROR)
    share: Array = np.sum(clipped * expected, axis=0) / np.maximum(known, SMALLEST_SPREAD)
    return np.clip(share, 0.0, 1.0).astype(np.float32)


def usual_span(f: Array, W_S: Array, b_S: Array) -> Array:
    """Return the limits (2, X) of log σ² in nominal contexts (N, M)."""
    found: Array = np.quantile(
        log_variance(f, W_S, b_S, unbounded(len(b_S))), (EXTREME, 1.0 - EXTREME), axis=0
    )
    return found.astype(np.float32)


def precision_change(f: Array, error: Array, W_S: Array, b_S: Array) -> tuple[Array, Array]:
    """Return the change of ``W_S`` (X, M) and ``b_S`` (X,) for contexts ``f`` (B, M) and errors (B, X)."""
    excess = np.minimum(
        error**2 * np.exp(-log_variance(f, W_S, b_S, unbounded(len(b_S)))),
        np.float32(LARGEST_RATIO),
    )
    excess -= np.float32(1.0)
    return coincidence(excess, f), excess.mean(axis=0)


def learn_precision(
    f: Array, error: Array, rng: np.random.Generator, tick: Tick = lambda: None
) -> tuple[Array, Array]:
    """Return ``W_S`` (X, M) and ``b_S`` (X,) learned from contexts ``f`` (N, M) and the errors (N, X) in them."""
    W_S = np.zeros((error.shape[1], f.shape[1]), np.float32)
    b_S: Array = np.clip(np.log(np.mean(error**2, axis=0) + 1e-12), *unbounded(len(W_S))).astype(
        np.float32
    )
    context, bias = Synapse(W_S), Synapse(b_S)
    for epoch in range(PRECISION_EPOCHS):
        order: NDArray[np.intp] = rng.permutation(len(f))
        rate = cosine_decay(PRECISION_RATE, epoch / PRECISION_EPOCHS)
        for rows in np.array_split(
            order, max(1, min(PRECISION_BATCHES, len(order) // PRECISION_BATCH))
        ):
            change, bias_change = precision_change(f[rows], error[rows], W_S, b_S)
            context.learn(change, rate)
            bias.learn(bias_change, rate)
        tick()
    return W_S, b_S
