"""Networks that act in closed loop in the tasks of ``workspace``.

A network that learned by local rules is surprised where the energy of a group of senses passes its ceiling:

    ε_t = [x_t, a_t] - [x̂_t, â_t](μ_t),   log σ² = max(W f(μ_t) + b, least)
    F_g = (Σ_i (v_i/q_i)^(κ_i p))^(1/p)   v_i: evidence in the errors ε/σ of group g, see ``detection.evidence``

It leaves out a group that alone is over its ceiling, and yields where several are.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.linear_model import Ridge

from asm_gym.data.episode import Episode
from asm_gym.detection.detector import BOUND
from asm_gym.detection.evidence import Evidence, bounded, pool, strength, whitening, worst_case
from asm_gym.memory.motor import learn_motor, situation
from asm_gym.memory.temporal import TemporalNetwork
from asm_gym.monitors.memory_policy import CommandReadout
from asm_gym.scaling import StreamScaler
from asm_gym.scripts.reproduce.expression import Backpropagated
from asm_gym.scripts.reproduce.workspace import EVENT, GROUP_OF, GROUPS, JOINTS, Floats, Workspace

LONGEST = 250  # rows of a rollout
YIELD = 12  # rows for which a pushed arm yields
ATTENTIVE = EVENT // 2  # row after which the network reacts to its energy
GAINS = np.array([0.8, 0.2, 0.05])  # a, weights of the newest row in the evidence
SHARPEST = 0.01  # smallest variance of an error, in its mean
PRIOR = 150.0  # ridge of the regression of variances on the state
MOTOR_UNITS = 256  # hidden units of the motor association


class Reading(NamedTuple):
    """The network's state, error and energy at a row; of T rows, each with a first axis T."""

    state: Floats  # (H,) f(μ)
    error: Floats  # (N,) of senses, changes and commands [σ]
    energy: Floats  # (G,) of ``GROUPS`` [ceiling]


class GroupEnergy:
    """The energy of each group of senses: the evidence in its errors, as a share of the worst of healthy episodes.

    Args:
        episodes: errors (T, N) of healthy episodes [σ].
        members: (G, N) which errors belong to which group.
    """

    def __init__(self, episodes: Sequence[Floats], members: NDArray[np.bool_]) -> None:
        self.members = members
        self.whitening = whitening(np.concatenate(episodes))
        self.worst = np.ones((len(GAINS), members.shape[1]))
        self.tail = np.ones_like(self.worst)
        strongest = [self.strengths(errors).max(axis=0) for errors in episodes]
        self.worst, self.tail = worst_case(np.array(strongest))

    def strengths(self, errors: Floats) -> Floats:
        """Return the evidence in each error (T, gains, N) at each row of an episode (T, N)."""
        self.begin()
        all_seen = np.ones(errors.shape[1], np.bool_)
        return np.array([self._strength(error, all_seen) for error in errors])

    def begin(self) -> None:
        """Forget the past."""
        self.evidence = Evidence.start(1, len(GAINS), self.members.shape[1])

    def _strength(self, error: Floats, seen: NDArray[np.bool_]) -> Floats:
        before = self.evidence
        white = bounded(error[None] @ self.whitening, BOUND)
        vector = before.vector + GAINS[:, None] * (white[:, None] - before.vector)
        vector = np.where(seen, vector, 0.0)
        self.evidence = before._replace(vector=vector, steps=before.steps + 1)
        return strength(self.evidence, GAINS)[0]

    def add(self, error: Floats, seen: NDArray[np.bool_]) -> Floats:
        """Return the energy of each group (G,) after a row's errors (N,); what is not seen has none."""
        ratios = (self._strength(error, seen) / self.worst) ** self.tail
        energies = [pool(ratios[:, own].reshape(1, -1))[0][0] for own in self.members]
        return np.array(energies)


class Prediction(NamedTuple):
    """What a network made of a row."""

    state: Floats  # (H,) f(μ)
    error: Floats  # (N,) [σ]; 0 in the first row, and where nothing is seen
    seen: NDArray[np.bool_]  # (N,)


class LocalNetwork:
    """A network that learned by local rules.

    Args:
        reader: how it reads a row.
        network: its weights.
        episodes: healthy ones, of which it learns how far its errors spread in each state, log σ² = W f(μ), and how
            much evidence there is in them.

    Attributes:
        ceiling: energy from which a group counts; 1 until the caller sets it.
    """

    def __init__(
        self, reader: StreamScaler, network: TemporalNetwork, episodes: Sequence[Episode]
    ) -> None:
        self.reader = reader
        self.network = network
        spec = reader.spec
        columns = np.concatenate([spec.sensory, reader.slow, spec.motor])  # (N,) of each error
        self.ceiling = 1.0

        # With weights of 0, errors are read as they are.
        self.W = np.zeros((len(columns), network.hidden_size))
        self.bias = np.zeros(len(columns))
        self.least = np.zeros(len(columns))
        steps = [self._steps(e.stream) for e in episodes]
        states = np.array([step.state for episode in steps for step in episode])
        squares = np.array([step.error for episode in steps for step in episode]) ** 2
        self.least = np.log(SHARPEST * squares.mean(axis=0) + 1e-12)
        log_variance = np.log(squares + np.exp(self.least))
        ridge = Ridge(PRIOR).fit(states, log_variance)
        variance = np.exp(ridge.predict(states))
        ratios = squares / variance
        self.W = ridge.coef_
        self.bias = ridge.intercept_ + np.log(np.mean(ratios, axis=0))

        errors = [np.array([step.error for step in self._steps(e.stream)]) for e in episodes]
        members = GROUP_OF[columns] == np.array(GROUPS)[:, None]  # (G, N)
        self.energy = GroupEnergy(errors, members)

    def _steps(self, stream: NDArray[Any]) -> list[Prediction]:
        """Return the predictions of all rows of a stream (T, D)."""
        self._forget()
        return [self._step(row) for row in np.asarray(stream, np.float64)]

    def _forget(self) -> None:
        self.c = self.network.at_rest(1)
        self.rows: list[Floats] = []

    def _step(self, row: Floats) -> Prediction:
        """Read a row (D,), NaN where left out."""
        now = row[None]
        is_first = not self.rows
        if is_first:
            self.rows = [now, now]
        earlier, before = self.rows
        self.rows = [before, now]
        scaled = self.reader.read(now, before, earlier)
        step = self.network.follow(self.c, scaled.commands, scaled.senses, scaled.seen)
        self.c = step.traces
        state = np.tanh(step.mu[0])

        difference = np.hstack([scaled.senses, scaled.commands[:, :-1]]) - step.expected
        commanded = np.ones((1, difference.shape[1] - self.reader.size))
        seen = np.hstack([scaled.seen, commanded])[0] > 0
        log_variance = np.maximum(self.W @ state + self.bias, self.least)
        sigma = np.exp(0.5 * log_variance)
        if is_first:
            seen[:] = False
        error = np.where(seen, difference[0] / sigma, 0.0)
        return Prediction(state, error, seen)

    def begin(self) -> None:
        """Forget the past."""
        self._forget()
        self.energy.begin()

    def read(self, row: Floats) -> Reading:
        """Read a row (D,), NaN where left out; nothing surprises in the first."""
        step = self._step(row)
        energy = self.energy.add(step.error, step.seen)
        return Reading(step.state, step.error, energy / self.ceiling)

    def read_stream(self, stream: NDArray[Any]) -> Reading:
        """Return the reading of all rows of a stream (T, D)."""
        self.begin()
        readings = [self.read(row) for row in np.asarray(stream, np.float64)]
        return Reading._make(map(np.array, zip(*readings, strict=True)))

    def command(self) -> Floats:
        """Return the action (A,) that it expects to be given next."""
        expected = self.network.run_on(self.c).expected
        return rescaled(self.reader, expected[0, self.reader.size :])


class Cell:
    """A GRU or an LSTM."""

    def __init__(self, model: Backpropagated) -> None:
        self.reader = model.reader
        self.network = model.network

    def begin(self) -> None:
        """Forget the past."""
        self.state: Any = None
        self.before: Floats | None = None

    def read(self, row: Floats) -> None:
        """Read a row (D,)."""
        now = row[None]
        before = self.before
        if before is None:
            before = now
        self.before = now
        scaled = self.reader.read(now, before, before)
        values = torch.from_numpy(np.hstack([scaled.senses, scaled.commands[:, :-1]]))
        with torch.no_grad():
            self.hidden, self.state = self.network.cell(values[None], self.state)

    def command(self) -> Floats:
        """Return the next action (A,)."""
        return rescaled(self.reader, self.network.act(self.hidden[0, 0]).numpy())


class Associated:
    """The motor association of ``learn_to_act``."""

    def __init__(
        self, reader: StreamScaler, episodes: Sequence[Episode], rng: np.random.Generator
    ) -> None:
        self.reader = reader
        situations = np.concatenate([situation(reader, e.stream[:-1]) for e in episodes])
        commands = np.concatenate([e.stream[1:, reader.spec.motor] for e in episodes])
        self.motor = learn_motor(situations, commands, MOTOR_UNITS, rng)

    def begin(self) -> None:
        """It has no past."""

    def read(self, row: Floats) -> None:
        """Read a row (D,)."""
        self.row = row

    def command(self) -> Floats:
        """Return the next action (A,)."""
        expected = self.motor.command(situation(self.reader, self.row[None]))
        return np.asarray(expected[0], np.float64)


def rescaled(reader: StreamScaler, action: NDArray[Any]) -> Floats:
    """Return an action (A,) in its own units."""
    motor = reader.spec.motor
    return np.asarray(reader.mean[motor] + reader.spread[motor] * action, np.float64)


Actor = LocalNetwork | Cell | Associated


# ------------------------------------------------------------------ closed loop


class Reaction:
    """Reaction to energies over their ceilings.

    A group that alone is over its ceiling is left out. Where several are, the arm yields for a while, but only once:
    then it hands back, and goes on.
    """

    def __init__(self) -> None:
        self.left_out = ""
        self.rows_to_yield = 0
        self.has_yielded = False

    def update(self, energy: Floats) -> None:
        """Take in the energies of a row (G,)."""
        over = np.flatnonzero(energy[:-1] > 1.0)  # the last is of the action
        if self.rows_to_yield:
            return
        if len(over) == 1 and not self.left_out:
            self.left_out = GROUPS[over[0]]
        if len(over) > 1 and not self.has_yielded:
            self.rows_to_yield = YIELD
            self.has_yielded = True

    def apply(self, action: NDArray[Any]) -> None:
        """Hold the arm still while it yields."""
        if self.rows_to_yield:
            action[:6] = 0.0
            self.rows_to_yield -= 1

    def __str__(self) -> str:
        if self.rows_to_yield:
            return "yields"
        if self.left_out:
            return f"without the {self.left_out} sense"
        return "goes on" if self.has_yielded else ""


@dataclass(frozen=True)
class Conditions:
    """Conditions of a rollout."""

    # seed of the scene
    seed: int
    # whether all encoders of the joints stick from row ``EVENT`` on
    encoders_stick: bool = False
    # whether the network reacts to its energy
    reacts: bool = False
    # whether the state is carried on from the rollout before, without notice
    keeps_state: bool = False
    # rows after which the rollout ends, if the task has not ended before
    steps: int = LONGEST


class Rollout(NamedTuple):
    """Outcome of a run in closed loop."""

    solved: bool
    energies: Floats  # (T, G) [ceiling]; empty for rivals
    left_out: str  # the group that was left out
    yielded: bool


def run_policy(
    actor: Actor,
    env: gym.Env[Any, Any],
    conditions: Conditions,
    watch: Callable[[Reaction], None] = lambda reaction: None,
) -> Rollout:
    """Let a network act until the task is solved.

    Args:
        actor: acts.
        env: of the skill, with what happens to the body.
        conditions: of the rollout.
        watch: is called before every step.
    """
    work = Workspace(env)
    readout = CommandReadout(env)
    reaction = Reaction()
    energies = []
    grip = None
    solved = False
    if not conditions.keeps_state:
        actor.begin()
    _, row = work.reset(conditions.seed)
    for t in range(min(conditions.steps, work.inner.horizon)):
        if t < EVENT or not conditions.encoders_stick:
            encoders = row[JOINTS].copy()
        row[JOINTS] = encoders
        row[reaction.left_out == GROUP_OF] = np.nan
        reading = actor.read(row)
        if reading is not None:
            energies.append(reading.energy)
            if conditions.reacts and t > ATTENTIVE:
                reaction.update(reading.energy)
        action, grip = readout(actor.command().astype(np.float32), grip)
        watch(reaction)
        reaction.apply(action)
        _, row, solved = work.step(action)
        if solved or work.terminated:
            break
    return Rollout(solved, np.array(energies), reaction.left_out, reaction.has_yielded)
