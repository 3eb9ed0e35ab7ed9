"""How the network of recurrent units learns: by local rules, which are the exact gradient through time.

    ΔW_C ∝ Π_z ε_z m_{t-1}ᵀ    ΔW_F ∝ Π_x ε_x f(z_t)ᵀ    ΔW_D ∝ Π_x ε_x [m_{t-1}, a_t, 1]ᵀ
    δ = W_Cᵀ Π_z ε_z + W_Dᵀ Π_x ε_x = -∂F/∂c_{t-1}   one complex number a unit
    E_t = λ E_{t-1} + γ r_tᵀ    e_t = λ e_{t-1} + c_{t-1}         eligibility: ∂c_t/∂B, ∂c_t/∂λ
    ΔB ∝ δ Ē_{t-1}    Δν ∝ Re(δ̄ e_{t-1} (-e^ν λ))    Δθ ∝ Re(δ̄ e_{t-1} iλ)

No unit reads another, so the eligibility of a synapse is a number that the synapse itself keeps, and it is exact: with
the weights held still, the sum of these changes over an episode is the gradient of F through all of its rows. Noise on
r while learning makes a network that acts stand its own deviations. Symbols are those of ``recurrent``.

Sources: Zucchet et al. 2023 (NeurIPS) for the exact eligibility of independent units; Millidge et al. 2024 (PLOS Comput
Biol) for learning; Jaeger 2001 (GMD Report 148) for the noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.memory.energy import Array, activate, infer, kernel, outward
from asm_gym.memory.learning import (
    Learner,
    Schedule,
    Tick,
    Trajectory,
    Turn,
    coincidence,
)
from asm_gym.memory.recurrent import (
    RecurrentNetwork,
    RecurrentWeights,
    advance,
    direct,
    multiplier,
    recurrent_shapes,
    sense,
)
from asm_gym.memory.temporal import Trained, learned_network

SHORTEST = 0.3  # |λ| of the most forgetful unit at first
LONGEST = 0.995  # of the least forgetful one
FASTEST = 0.3  # largest θ at first [rad a row]
SLOWER = 1 / 3  # learning rate of ν and θ, in that of the weights
LEARNING_PRIOR = (
    30.0  # Π_z while learning: the larger, the closer to the gradient of the prediction error
)
LEARNING_ITERATIONS = 5


class Eligibility(NamedTuple):
    """How the recurrent units of each of B streams follow from their own weights."""

    B_re: Array
    B_im: Array
    decay_re: Array  # (B, N) Re e
    decay_im: Array  # (B, N) Im e

    @classmethod
    def none(cls, streams: int, weights: RecurrentWeights) -> Eligibility:
        """Return that before an episode."""
        synapses = (streams, *weights.B_re.shape)
        units = synapses[:2]
        shapes = (synapses, synapses, units, units)
        return cls._make(np.zeros(shape, weights.B_re.dtype) for shape in shapes)


class RecurrentChange(NamedTuple):
    """The change of what each recurrent unit learns, averaged over a batch."""

    decay: Array
    turn: Array
    B_re: Array
    B_im: Array


@kernel
def recurrent_change(
    downhill: Array, eligible: Eligibility, weights: RecurrentWeights
) -> RecurrentChange:
    """Return the change along -∂F/∂m (B, I) of the rows that are eligible."""
    N, R = weights.B_re.shape
    batch = downhill.shape[0]
    change = RecurrentChange(
        np.zeros_like(weights.decay),
        np.zeros_like(weights.turn),
        np.zeros_like(weights.B_re),
        np.zeros_like(weights.B_im),
    )
    share = np.float32(1.0) / np.float32(batch)
    for i in range(N):
        re, im = multiplier(weights, i)
        rate = np.exp(weights.decay[i])
        for n in range(batch):
            d_re = share * downhill[n, i]
            d_im = share * downhill[n, N + i]
            # λ e, of which ∂c/∂ν is -e^ν times, and ∂c/∂θ is i times
            turned_re = re * eligible.decay_re[n, i] - im * eligible.decay_im[n, i]
            turned_im = re * eligible.decay_im[n, i] + im * eligible.decay_re[n, i]
            change.decay[i] -= rate * (d_re * turned_re + d_im * turned_im)
            change.turn[i] += d_im * turned_re - d_re * turned_im
            for j in range(R):
                e_re = eligible.B_re[n, i, j]
                e_im = eligible.B_im[n, i, j]
                change.B_re[i, j] += d_re * e_re + d_im * e_im
                change.B_im[i, j] += d_im * e_re - d_re * e_im
    return change


@kernel
def follow_eligibility(
    eligible: Eligibility, m: Array, rows: Array, weights: RecurrentWeights
) -> None:
    """Advance the eligibility in place by the rows r_t (B, R), from m_{t-1} (B, I)."""
    N, R = weights.B_re.shape
    read = rows * weights.reads
    for i in range(N):
        re, im = multiplier(weights, i)
        gain = weights.gain[i]
        for n in range(m.shape[0]):
            e_re = eligible.decay_re[n, i]
            e_im = eligible.decay_im[n, i]
            eligible.decay_re[n, i] = re * e_re - im * e_im + m[n, i]
            eligible.decay_im[n, i] = re * e_im + im * e_re + m[n, N + i]
            for j in range(R):
                E_re = eligible.B_re[n, i, j]
                E_im = eligible.B_im[n, i, j]
                eligible.B_re[n, i, j] = re * E_re - im * E_im + gain * read[n, j]
                eligible.B_im[n, i, j] = re * E_im + im * E_re


class Wiring(NamedTuple):
    """Which synapses exist: 1, else 0."""

    W_C: Array  # (I,) from what is carried on
    W_D: Array  # (S + A, I + A + 1)

    @classmethod
    def of(cls, weights: RecurrentWeights) -> Wiring:
        """Return the wiring of weights: none from a felt number but to the felt, none from an action to itself."""
        carried = weights.W_C.shape[1]
        motor = weights.W_D.shape[1] - carried - 1
        predicted = len(weights.W_F)
        units = 2 * len(weights.decay)
        from_carried = np.ones(carried, np.float32)
        from_carried[units:] = weights.reads
        to_prediction = np.ones(weights.W_D.shape, np.float32)
        is_felt = weights.reads[:predicted] == 0
        to_prediction[~is_felt, :carried] = from_carried
        to_prediction[predicted - motor :, carried:-1] = 0.0
        return cls(from_carried, to_prediction)


class Change(NamedTuple):
    """The change of each array that is learned, averaged over a batch."""

    decay: Array
    turn: Array
    B_re: Array
    B_im: Array
    W_C: Array
    W_F: Array
    W_D: Array


def initial_recurrent_weights(
    hidden: int, sensory: int, motor: int, rng: np.random.Generator
) -> RecurrentWeights:
    """Return random weights of about unit gain into the state and of gain 0.1 out of it, and no direct ones.

    Times of the units lie evenly on a logarithmic scale.
    """
    shapes = recurrent_shapes(hidden, sensory, motor)
    units = shapes["decay"][0]
    forgetting = np.geomspace(-np.log(SHORTEST), -np.log(LONGEST), units)
    weights = RecurrentWeights._make(np.zeros(shape, np.float32) for shape in shapes.values())
    weights.decay[:] = np.log(forgetting)
    weights.reads[:] = 1.0
    weights.turn[:] = rng.uniform(0.0, FASTEST, units)
    weights.gain[:] = np.sqrt(1 - np.exp(-2 * forgetting))
    for part in (weights.B_re, weights.B_im):
        part[:] = rng.standard_normal(part.shape) / np.sqrt(2 * part.shape[1])
    weights.W_C[:] = rng.standard_normal(weights.W_C.shape) / np.sqrt(weights.W_C.shape[1])
    weights.W_F[:] = 0.1 * rng.standard_normal(weights.W_F.shape) / np.sqrt(hidden)
    return weights


class Errors(NamedTuple):
    """Errors of a row at the inferred state."""

    state: Array  # (B, H) Π_z ε_z
    row: Array  # (B, S + A) Π_x ε_x


def local_change(
    m: Array,
    u: Array,
    z: Array,
    errors: Errors,
    eligible: Eligibility,
    weights: RecurrentWeights,
    wiring: Wiring,
) -> Change:
    """Apply the local learning rules to ``m`` (B, I), action and 1 ``u`` (B, A + 1) and the state ``z`` (B, H)."""
    carried = m.shape[1]
    downhill = errors.state @ weights.W_C + errors.row @ weights.W_D[:, :carried]  # (B, I)
    recurrent = recurrent_change(downhill, eligible, weights)
    return Change(
        **recurrent._asdict(),
        W_C=coincidence(errors.state, m) * wiring.W_C,
        W_F=coincidence(errors.row, activate(z)),
        W_D=coincidence(errors.row, np.hstack([m, u])) * wiring.W_D,
    )


class RecurrentLearner(Learner):
    """The network of recurrent units as it learns."""

    weights: RecurrentWeights
    learned = Change._fields
    early = False

    def __init__(
        self, weights: RecurrentWeights, schedule: Schedule, rng: np.random.Generator
    ) -> None:
        super().__init__(weights, schedule, rng)
        self.rng = rng
        self.wiring = Wiring.of(weights)
        self.eligible = Eligibility.none(schedule.batch_size, weights)

    def at_rest(self, size: int) -> Array:
        return np.zeros((size, self.weights.W_C.shape[1]), np.float32)

    def learn(self, change: Change, rate: float) -> None:
        for name, synapse in self.synapses.items():
            of_name = rate * SLOWER if name in ("decay", "turn") else rate
            synapse.learn(getattr(change, name), of_name)
        self._follow_norm()

    def practise(self, state: Array, turn: Turn, rate: float) -> tuple[Array, float]:
        w = self.weights
        inference = self.inference
        pi_z = inference.prior_precision
        pi_x = inference.sensory_precision
        sensory = turn.senses.shape[1]
        for array in self.eligible:
            array[turn.begins[:, 0]] = 0.0
        mu = outward(state, w.W_C)
        taken = turn.commands
        if turn.own.any():
            expected = direct(state, turn.commands, w.W_D) + sense(mu, w.W_F)
            taken = turn.commands_with(expected[:, sensory:])

        past = direct(state, taken, w.W_D)
        left = np.hstack([turn.senses, turn.commands[:, :-1]]) - past  # (B, S + A)
        z = infer(mu, left, w.W_F, np.full_like(left, pi_x), inference)
        error = left - sense(z, w.W_F)
        energy = 0.5 * float(pi_z * np.sum((z - mu) ** 2) + pi_x * np.sum(error**2))
        senses = turn.senses
        if turn.alone.any():
            expected = past + sense(mu, w.W_F)
            senses = np.where(turn.alone, expected[:, :sensory], turn.senses)
        errors = Errors(pi_z * (z - mu), pi_x * error)
        change = local_change(
            m=state,
            u=taken,
            z=z,
            errors=errors,
            eligible=self.eligible,
            weights=w,
            wiring=self.wiring,
        )
        self.learn(change, rate)

        rows = np.hstack([senses, taken])
        if self.schedule.noise > 0:
            noise = self.rng.standard_normal(rows[:, :-1].shape, np.float32)
            rows[:, :-1] += np.float32(self.schedule.noise) * noise
        self.mark_eligible(state, rows)
        return advance(state, rows, w), energy

    def mark_eligible(self, state: Array, rows: Array) -> None:
        """Advance the eligibility by the rows r_t (B, R), from m_{t-1} (B, I)."""
        follow_eligibility(self.eligible, state, rows, self.weights)


def near_gradient(schedule: Schedule) -> Schedule:
    """Return the schedule with the inference of learning in the place of that in use."""
    return schedule._replace(prior_precision=LEARNING_PRIOR, iterations=LEARNING_ITERATIONS)


def learn_recurrent(
    trajectories: Sequence[Trajectory],
    hidden: int,
    schedule: Schedule,
    rng: np.random.Generator,
    tick: Tick,
    felt: NDArray[np.bool_] | None = None,
) -> Trained:
    """Learn the synapses through time; see ``temporal.Learn``. ``felt`` (S,) says which senses are; by default none."""
    sensory = trajectories[0].senses.shape[1]
    motor = trajectories[0].commands.shape[1] - 1
    weights = initial_recurrent_weights(hidden, sensory, motor, rng)
    if felt is not None:
        weights.reads[:sensory] = ~felt
        weights.W_C[:] *= Wiring.of(weights).W_C
    learner = RecurrentLearner(weights, near_gradient(schedule), rng)
    trained = learned_network(RecurrentNetwork, learner, trajectories, rng, tick)
    in_use = RecurrentNetwork(
        weights,
        trained.network.association,
        schedule.iterations,
        schedule.prior_precision,
        schedule.sensory_precision,
    )
    return trained._replace(network=in_use)
