"""Networks that act in closed loop in the tasks of ``workspace``.

A network that learned by local rules is surprised where the energy of a group of senses passes its ceiling, see
``group_energy``:

    ε_t = [x_t, a_t] - [x̂_t, â_t](μ_t),   log σ² = max(W f(μ_t) + b, least)

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
from asm_gym.memory.motor import learn_motor, situation
from asm_gym.memory.temporal import TemporalNetwork
from asm_gym.monitors.memory_policy import CommandReadout
from asm_gym.scaling import StreamScaler
from asm_gym.scripts.reproduce.expression import Backpropagated
from asm_gym.scripts.reproduce.group_energy import (
    WHOLE,
    EnergyParts,
    Prediction,
    SurprisedModel,
    rescaled,
    values_of,
)
from asm_gym.scripts.reproduce.skill_envelope import SkillEnvelope
from asm_gym.scripts.reproduce.workspace import EVENT, GROUP_OF, GROUPS, JOINTS, Floats, Workspace

LONGEST = 250  # rows of a rollout
YIELD = 12  # rows for which a pushed arm yields
ATTENTIVE = EVENT // 2  # row after which the network reacts to its energy
SHARPEST = 0.01  # smallest variance of an error, in its mean
PRIOR = 150.0  # ridge of the regression of variances on the state
MOTOR_UNITS = 256  # hidden units of the motor association


class LocalNetwork(SurprisedModel):
    """A network that learned by local rules.

    Args:
        reader: how it reads a row.
        network: its weights.
        episodes: healthy ones, of which it learns how far its errors spread in each state, log σ² = W f(μ), and how
            much evidence there is in them.
        parts: of its energy.
    """

    def __init__(
        self,
        reader: StreamScaler,
        network: TemporalNetwork,
        episodes: Sequence[Episode],
        parts: EnergyParts = WHOLE,
    ) -> None:
        super().__init__(reader)
        self.network = network

        # With weights of 0, errors are read as they are.
        self.W = np.zeros((len(self.columns), network.hidden_size))
        self.bias = np.zeros(len(self.columns))
        self.least = np.zeros(len(self.columns))
        if parts.by_state:
            self._learn_variance(episodes)
        self.calibrate([self.errors(e.stream) for e in episodes], parts)

    def _learn_variance(self, episodes: Sequence[Episode]) -> None:
        steps = [step for e in episodes for step in self.steps(e.stream)]
        states = np.array([step.state for step in steps])
        squares = np.array([step.error for step in steps]) ** 2
        self.least = np.log(SHARPEST * squares.mean(axis=0) + 1e-12)
        log_variance = np.log(squares + np.exp(self.least))
        ridge = Ridge(PRIOR).fit(states, log_variance)
        variance = np.exp(ridge.predict(states))
        ratios = squares / variance
        self.W = ridge.coef_
        self.bias = ridge.intercept_ + np.log(np.mean(ratios, axis=0))

    def _forget(self) -> None:
        super()._forget()
        self.c = self.network.at_rest(1)

    def _step(self, row: Floats) -> Prediction:
        is_first = not self.rows
        scaled = self._read(row)
        step = self.network.follow(self.c, scaled.commands, scaled.senses, scaled.seen)
        self.c = step.carried
        state = np.tanh(step.mu[0])

        difference = values_of(scaled) - step.expected[0]
        commanded = np.ones(len(difference) - self.reader.size)
        seen = np.concatenate([scaled.seen[0], commanded]) > 0
        log_variance = np.maximum(self.W @ state + self.bias, self.least)
        sigma = np.exp(0.5 * log_variance)
        if is_first:
            seen[:] = False
        error = np.where(seen, difference / sigma, 0.0)
        return Prediction(state, error, seen)

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


Actor = LocalNetwork | Cell | Associated | SkillEnvelope


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
