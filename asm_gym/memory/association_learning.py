"""Learning of association: the linear part in closed form, the hidden units from its errors, the precision last.

    r_t = (Δ_t - D a_t) / s                        what the linear part leaves
    ε_t = ψ((r_t - U f(h_t)) / σ),  ψ(ε) = min(max(ε, -1), 1)
    ΔU ∝ ε_t f(h_t)ᵀ     ΔV ∝ ε_h a_tᵀ,   ε_h = f'(h_t) ⊙ Bᵀ ε_t
    c = Σ_n min(max(r_n, -3), 3) Δ̂_n / Σ_n Δ̂_n², in [0, 1]       share of the hidden units' predictions Δ̂ to believe
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
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.memory.association import (
    LARGEST,
    SMALLEST,
    Association,
    Change,
    ChangeLayout,
    complete,
    hidden_units,
    leverage,
    log_variance,
    synapses,
    unbounded,
    without_leverage,
)
from asm_gym.memory.energy import Array, kernel, outward
from asm_gym.memory.learning import Synapse, Tick, coincidence, cosine_decay, shuffled
from asm_gym.memory.linear_association import inverse_of, learn_from_past, learn_linear

Mask = NDArray[np.bool_]

ROWS_PER_INPUT = 12  # with fewer rows for each input, the senses are not predicted from each other
SMALLEST_SPREAD = np.float32(1e-4)  # below this single precision is noise

# The hidden units
FEEDBACK_GAIN = 1e-3  # initial gain of B
DECAY = 0.3  # share of its step size by which a synapse of U or B decays
UPDATES = 20_000  # most batches
PASSES = 40  # most passes over the rows
BATCH = 256  # rows of a batch
RATE = 5e-3  # largest step size; it falls along a cosine
WARM_UP = 0.1  # share of the updates in which the step size rises
TICKS = 20  # progress reports of one learning of the hidden units
TRACKING = np.float32(0.01)  # weight of the newest batch in the running spread σ of each error

# Cross-fitting, and the share of the predictions to believe
THIRDS = 3
LARGEST_ERROR = 3.0  # standard deviations to which errors are clipped in ``trust``

# The precision
EXTREME = 0.0005  # share of nominal rows below the limits of log σ², and above
LARGEST_RATIO = 30.0  # clips ε²/σ² (5.5 σ), so that one contact does not undo a thousand steps
PRECISION_EPOCHS = 20
PRECISION_RATE = 1e-3
PRECISION_BATCH = 64  # rows of a batch
PRECISION_BATCHES = 250  # most batches in an epoch; beyond, batches are larger

# The leverage scale
TAUS = np.concatenate([[0.0], 10.0 ** np.arange(-2.0, 0.6, 0.25)])  # τ to choose from
FREEDOM = 4  # degrees of freedom of the t distribution
SCALINGS = 10  # steps to its spread
MOST_COMPARED = 30_000  # rows by which τ is chosen

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
    if back is None:
        back = U
    upstream = inward(pulled, f, back)  # (B, M) ε_h
    change = Change(V=coincidence(upstream, a), U=coincidence(pulled, f), D=D)
    if D.size:
        change = change._replace(D=coincidence(pulled, a))
    return change, error


def learn_association(
    inputs: Array,
    layout: ChangeLayout,
    rng: np.random.Generator,
    tick: Tick = lambda: None,
    lengths: Sequence[int] = (),
    independent: int | None = None,
) -> tuple[Association, Array]:
    """Learn the linear part, then the hidden units, then the precision.

    Args:
        inputs: (N, I) of whole episodes, concatenated, standardised; the last input is a constant 1.
        layout: of the inputs.
        rng: draws initial weights and the order of the rows.
        tick: is called ``ALL_TICKS`` times.
        lengths: rows of each episode; without them cross-fitting cuts the rows into three consecutive parts.
        independent: number of rows if overlapping changes are counted once; N where None.

    Returns:
        What was learned, and the normalised errors (N, X) of rows by what was learned without them.
    """
    if (independent or len(inputs)) < ROWS_PER_INPUT * layout.inputs:
        for _ in range(ALL_TICKS):
            tick()
        return _learn_from_few(inputs, layout, rng)

    delta = np.ascontiguousarray(inputs[:, layout.changes])
    D = learn_linear(inputs, layout)
    left, remainder = _unexplained(inputs, delta, D)
    third = thirds(len(inputs), lengths, rng)
    fresh = _crossfitted(inputs, delta, layout, remainder, third=third, rng=rng, tick=tick)
    V, U = _learn_hidden(inputs, left, synapses(layout), rng, tick)
    share = trust(fresh.left, fresh.predicted)
    U *= share[:, None]
    f = hidden_units(inputs, V)
    unexplained = fresh.left - share * fresh.predicted
    expected_size, normalised = learn_expected_size(unexplained, f, fresh.far, rng, tick)
    R, Q = inverse_of(inputs, layout)
    association = Association(
        V=V,
        U=U * remainder[:, None],
        D=D,
        remainder=remainder,
        R=R,
        Q=Q,
        **expected_size,
    )
    return association, normalised


class _FreshRows(NamedTuple):
    """Rows by what was learned without them: errors on rows that were learned are smaller than those to come."""

    left: Array  # (N, X) what the linear part leaves, in spreads of it
    predicted: Array  # (N, X) what the hidden units predict of it
    far: Array  # (N, X) leverage


def _crossfitted(
    inputs: Array,
    delta: Array,
    layout: ChangeLayout,
    remainder: Array,
    *,
    third: NDArray[np.intp],
    rng: np.random.Generator,
    tick: Tick,
) -> _FreshRows:
    """Return each row (N, I), and its changes (N, X), by what was learned without its third (N,)."""
    exists = synapses(layout)

    def expect(learned_from: Mask, asked: Mask) -> Array:
        """Return what another linear part leaves, the prediction of that, and leverage (M, 3 X)."""
        rows = inputs[learned_from]
        own_D = learn_linear(rows, layout)
        own_left = (delta - outward(inputs, own_D)) / remainder
        V, U = _learn_hidden(rows, own_left[learned_from], exists, rng, tick)
        fresh = inputs[asked]
        predicted = outward(hidden_units(fresh, V), U)
        R, Q = inverse_of(rows, layout)
        far = leverage(fresh, R, Q, layout.groups, layout.changes_last)
        return np.hstack([own_left[asked], predicted, far])

    fresh = crossfit(expect, third, 3 * delta.shape[1])
    left, predicted, far = np.split(fresh, 3, axis=1)
    return _FreshRows(left=left, predicted=predicted, far=far)


def _learn_from_few(
    inputs: Array, layout: ChangeLayout, rng: np.random.Generator
) -> tuple[Association, Array]:
    """Learn a linear part that reads the past and the command, and nothing else."""
    exists = synapses(layout)
    D = learn_from_past(inputs, layout)
    left, remainder = _unexplained(inputs, inputs[:, layout.changes], D)
    association = Association(
        V=_random(exists.V, rng),
        U=np.zeros_like(exists.U),
        D=D,
        W_S=np.zeros_like(exists.U),
        b_S=np.zeros_like(remainder),
        span_S=unbounded(len(D)),
        remainder=remainder,
        **without_leverage(layout.inputs, len(D)),
    )
    return association, left


def _unexplained(inputs: Array, delta: Array, D: Array) -> tuple[Array, Array]:
    """Return what the linear part leaves, in spreads of it (N, X), and these spreads (X,)."""
    left = delta - outward(inputs, D)
    remainder = np.maximum(np.sqrt(np.mean(left**2, axis=0)), SMALLEST_SPREAD)
    return left / remainder, remainder


def learn_expected_size(
    error: Array, f: Array, far: Array, rng: np.random.Generator, tick: Tick
) -> tuple[dict[str, Array], Array]:
    """Learn how large errors (N, X) are, by hidden units (N, M) and leverage (N, X).

    Returns:
        W_S, b_S, span_S and leverage_scale of ``Association``, and the normalised errors (N, X).
    """
    W_S, b_S = learn_precision(f, error, rng, tick)
    span_S = usual_span(f, W_S, b_S)
    precision = np.exp(np.float32(-0.5) * log_variance(f, W_S, b_S, span_S))
    scale = learn_leverage_scale(error * precision, far)
    normalised = error * precision / np.sqrt(scale[0] + scale[1] * far)
    return {"W_S": W_S, "b_S": b_S, "span_S": span_S, "leverage_scale": scale}, normalised


def learn_leverage_scale(error: Array, far: Array) -> Array:
    """Return ``Association.leverage_scale`` (3, X) from cross-fitted errors and leverages (N, X)."""
    usual = np.maximum(np.median(far, axis=0), SMALLEST_SPREAD)  # (X,)
    stride = -(-len(far) // MOST_COMPARED)
    squares = error[::stride].astype(np.float64) ** 2
    ratio = far[::stride] / usual
    costs = [_cost_of_tau(tau, squares, ratio) for tau in TAUS]
    tau = TAUS[np.argmin(costs, axis=0)]
    steady = 1.0 / (1.0 + tau)
    return np.stack([steady, tau / (1.0 + tau) / usual, far.max(axis=0)]).astype(np.float32)


def _cost_of_tau(tau: float, squares: Array, ratio: Array) -> Array:
    """Return the mean of -2 log t_4 (X,) of squared errors (N, X), for leverages in units of the usual one (N, X)."""
    g = (1.0 + tau * ratio) / (1.0 + tau)
    q = squares / g
    spread = np.maximum(np.median(q, axis=0), SMALLEST_SPREAD**2)
    for _ in range(SCALINGS):
        weighted = q * (FREEDOM + 1) / (FREEDOM + q / spread)
        spread = np.maximum(np.mean(weighted, axis=0), SMALLEST_SPREAD**2)
    cost = np.log(g * spread) + (FREEDOM + 1) * np.log1p(q / spread / FREEDOM)
    return np.asarray(cost.mean(axis=0))


def _random(exists: Array, rng: np.random.Generator) -> Array:
    """Return initial V (M, I)."""
    drawn = rng.standard_normal(exists.shape).astype(np.float32)
    return drawn / np.float32(np.sqrt(exists.shape[1])) * exists


def _random_feedback(exists: Array, rng: np.random.Generator) -> Array:
    """Return initial B (X, M)."""
    fan_in = np.maximum(exists.sum(axis=1, keepdims=True), 1.0)
    drawn = FEEDBACK_GAIN * rng.standard_normal(exists.shape) / np.sqrt(fan_in)
    return drawn.astype(np.float32) * exists


def _learn_hidden(
    a: Array, left: Array, exists: Change, rng: np.random.Generator, tick: Tick
) -> tuple[Array, Array]:
    """Return V and U learned from inputs (N, I) and what the linear part leaves (N, X), standardised."""
    updates = max(TICKS, min(UPDATES, PASSES * len(a) // BATCH))
    V = _random(exists.V, rng)
    U = np.zeros_like(exists.U)
    B = _random_feedback(exists.U, rng)
    into = Synapse(V)
    out_of = Synapse(U)
    back = Synapse(B)
    no_linear = exists.D[:, :0]
    spread = np.ones(left.shape[1], np.float32)
    for n, rows in zip(range(updates), shuffled(len(a), BATCH, rng), strict=False):
        change, error = association_change(a[rows], left[rows], spread, V, U, no_linear, back=B)
        rate = _rate(n / updates)
        outward_change = change.U * exists.U
        into.learn(change.V * exists.V, rate)
        for synapse in (out_of, back):
            synapse.learn(outward_change, rate)
            synapse.W *= np.float32(1.0 - DECAY * rate)

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


def crossfit(expect: Callable[[Mask, Mask], Array], third: NDArray[np.intp], size: int) -> Array:
    """Return the prediction (N, X) of each row; ``expect`` learns from one mask (N,), and predicts another (M, X)."""
    predicted = np.zeros((len(third), size), np.float32)
    for k in range(THIRDS):
        asked = third == k
        predicted[asked] = expect(~asked, asked)
    return predicted


def trust(left: Array, expected: Array) -> Array:
    """Return c (X,) in [0, 1]: the share of the predictions (N, X) that leaves the least of the targets (N, X)."""
    clipped = np.clip(left, -LARGEST_ERROR, LARGEST_ERROR)
    squares = np.maximum(np.sum(expected**2, axis=0), SMALLEST_SPREAD)
    share: Array = np.sum(clipped * expected, axis=0) / squares
    return np.clip(share, 0.0, 1.0).astype(np.float32)


def usual_span(f: Array, W_S: Array, b_S: Array) -> Array:
    """Return the limits (2, X) of log σ² in nominal contexts (N, M)."""
    nominal = log_variance(f, W_S, b_S, unbounded(len(b_S)))
    span: Array = np.quantile(nominal, (EXTREME, 1.0 - EXTREME), axis=0)
    return span.astype(np.float32)


def precision_change(f: Array, error: Array, W_S: Array, b_S: Array) -> tuple[Array, Array]:
    """Return the change of ``W_S`` (X, M) and ``b_S`` (X,) for contexts ``f`` (B, M) and errors (B, X)."""
    ratio = error**2 * np.exp(-log_variance(f, W_S, b_S, unbounded(len(b_S))))
    excess = np.minimum(ratio, np.float32(LARGEST_RATIO)) - np.float32(1.0)
    return coincidence(excess, f), excess.mean(axis=0)


def learn_precision(
    f: Array, error: Array, rng: np.random.Generator, tick: Tick = lambda: None
) -> tuple[Array, Array]:
    """Return ``W_S`` (X, M) and ``b_S`` (X,) learned from contexts ``f`` (N, M) and the errors (N, X) in them."""
    W_S = np.zeros((error.shape[1], f.shape[1]), np.float32)
    constant = np.log(np.mean(error**2, axis=0) + 1e-12)
    b_S: Array = np.clip(constant, SMALLEST, LARGEST).astype(np.float32)
    context = Synapse(W_S)
    bias = Synapse(b_S)
    batches = max(1, min(PRECISION_BATCHES, len(f) // PRECISION_BATCH))
    for epoch in range(PRECISION_EPOCHS):
        order: NDArray[np.intp] = rng.permutation(len(f))
        rate = cosine_decay(PRECISION_RATE, epoch / PRECISION_EPOCHS)
        for rows in np.array_split(order, batches):
            change, bias_change = precision_change(f[rows], error[rows], W_S, b_S)
            context.learn(change, rate)
            bias.learn(bias_change, rate)
        tick()
    return W_S, b_S
