"""The memory as a model: what it expects of a stream, and what else can be asked of it.

row → standardise → memory: expect, infer, associate → ε_t/σ_t, and the context f(μ_t)
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.detection import ModelOutput
from asm_gym.detection.base import Arrays
from asm_gym.episode import Episode
from asm_gym.memory.adaptation import followed, specialise
from asm_gym.memory.association import Association, association_shapes, existing, hidden_units
from asm_gym.memory.association_learning import FEEDBACK, LEARNED
from asm_gym.memory.completion import Completion
from asm_gym.memory.dynamics import DYNAMICS, TRACES, dynamics_of, train
from asm_gym.memory.free_energy import FreeEnergy
from asm_gym.memory.learning import Schedule, Trajectory
from asm_gym.memory.linear import check_inputs
from asm_gym.memory.marginalise import MOST_INPUTS, Kept, fewer_changes, fewer_settled, fewer_traces, moments
from asm_gym.memory.motor import Motor, learn_motor, lessons, situation
from asm_gym.memory.network import Network
from asm_gym.memory.readout import add_up, learn_readout
from asm_gym.memory.recall import continued
from asm_gym.memory.state import MemoryState, at_start, carry_on, newest, past, sure
from asm_gym.memory.temporal import TemporalNetwork
from asm_gym.monitors.base import Progress, Told
from asm_gym.monitors.stream_model import StreamModel, model_outputs, running
from asm_gym.scaling import StreamScaler, rows_apart
from asm_gym.spec import StreamSpec


class MemoryModel(StreamModel):
    """The temporal network, association, and what is learned on top of them: motor association and readout.

    Args:
        spec: the stream it is to expect.
        hidden_size: H, hidden units of the temporal network.
        association_size: hidden units of association, shared out among the groups of senses.
        schedule: how to learn and to infer.
        feedback: how errors come back to the hidden units of association, a name of ``association_learning.FEEDBACK``.
        dynamics: how what was is carried on, one of ``memory.dynamics.DYNAMICS``.

    Attributes:
        senses_: how it reads a row.
        network_: the weights; None before ``fit``.
        motor_: the motor association; None before ``learn_to_act``.
        completion_: what completes missing senses; None where they are too many, and once some were lost.
    """

    kind = "neural_asm"

    def __init__(
        self,
        spec: StreamSpec,
        hidden_size: int,
        association_size: int,
        schedule: Schedule,
        feedback: str = LEARNED,
        dynamics: str = TRACES,
    ) -> None:
        super().__init__(spec)
        self.feedback, self.dynamics = feedback, dynamics
        self.hidden_size, self.association_size, self.schedule = hidden_size, association_size, schedule
        self.lag = rows_apart(spec.dt)
        self.shortest = 1 + self.lag
        self.network_: TemporalNetwork | None = None
        self.motor_: Motor | None = None
        self.completion_: Completion | None = None

    def fit(self, episodes: Sequence[Episode], rng: np.random.Generator, progress: Progress) -> Self:
        streams, lag = [e.stream for e in episodes], self.lag
        senses = StreamScaler.fit(self.spec, streams, lag)
        check_inputs(senses.inputs)
        readings = [senses.read_episode(s) for s in streams]
        # Nothing came before the first ``lag`` rows, so that no change in them is known.
        trajectories = [Trajectory(r.senses[::lag], r.commands[::lag], r.inputs[lag:]) for r in readings]
        layout = senses.groups, senses.changes, self.hidden_size, self._units_each(senses)
        how = FEEDBACK[self.feedback](), self.dynamics
        trained = train(trajectories, *layout, self.schedule, rng, progress, *how)
        standard: dict[str, NDArray[Any]] = {"mean": senses.mean, "spread": senses.spread, "change": senses.change}
        standard["energy"] = trained.energy
        if senses.inputs <= MOST_INPUTS:
            standard["moments"] = moments(np.concatenate([t.inputs for t in trajectories]))
        network, completion = trained.network, Completion.fit(senses, streams)
        filled = completion.named() if completion is not None else {}
        return self.restore({**standard, **network.weights._asdict(), **network.association._asdict(), **filled})

    def fewer(self, spec: StreamSpec) -> tuple[MemoryModel, Kept]:
        """The model of a stream that lacks senses of this one, and what became of its errors.

        Raises:
            ValueError: the stream has senses that this memory never met, or the memory does not know what its own have
                in common.
        """
        columns = spec.columns_in(self.spec)
        if "moments" not in self.learned_:
            raise ValueError(
                "this memory does not keep what its senses have in common (it has lost "
                f"senses before, or has more than {MOST_INPUTS} inputs), so that none of them can be left out"
            )
        C, old, known = self.learned_["moments"], self.senses_, columns >= 0
        standard = {
            name: np.where(known, getattr(old, name)[columns], nothing)
            for name, nothing in (("mean", 0.0), ("spread", 1.0), ("change", 1.0))
        }
        new = StreamScaler(spec, **standard, lag=self.lag)
        network, left = self.network, (old, new, columns)
        kept = fewer_changes(network.association, C, *left)
        traces = isinstance(network, Network)
        weights = fewer_traces(network.weights, C, *left) if traces else fewer_settled(network.weights, *left)
        skills = {name: self.learned_[name] for name in ("W_K", "b_K") if self.skills_}
        learned = {**standard, **skills, "energy": self.learned_["energy"]}
        model = MemoryModel(spec, self.hidden_size, self.association_size, self.schedule, self.feedback, self.dynamics)
        return model.restore({**learned, **weights._asdict(), **kept.association._asdict()}, self.skills_), kept

    def specialise(self, episodes: Sequence[Episode]) -> Self:
        """Goes on from what it knows: association learns what these episodes have of their own, all else stays.

        Names of skills, and what was learned to act by, are of the association as it was, and are forgotten.
        """
        senses, lag = self.senses_, self.lag
        inputs = np.concatenate([senses.read_episode(e.stream).inputs[lag:] for e in episodes])
        changes = np.ascontiguousarray(inputs[:, senses.changes])
        layout = senses.groups, senses.changes, self._units_each(senses)
        now = specialise(self.network.association, inputs, changes, *layout)
        kept = {"mean", "spread", "change", "energy", "moments", *self.network.weights._fields}
        return self.restore({**{n: a for n, a in self.learned_.items() if n in kept}, **now._asdict()})

    def restore(self, learned: Arrays, skills: tuple[str, ...] = ()) -> Self:
        senses = StreamScaler(self.spec, learned["mean"], learned["spread"], learned["change"], self.lag)
        X, A = len(self.spec.sensory), len(self.spec.motor)
        units = len(learned["V"])
        if (found := dynamics_of(learned)) != self.dynamics:
            raise ValueError(f"this is a memory of dynamics={found!r}, which cannot be loaded as {self.dynamics!r}")
        dynamics = DYNAMICS[self.dynamics]
        temporal = dynamics.shapes(self.hidden_size, senses.size, A)
        shapes = temporal | association_shapes(senses.inputs, units, X)
        if skills:
            shapes |= {"W_K": (len(skills), units + self.hidden_size), "b_K": (len(skills),)}
        if missing := [name for name in shapes if name not in learned]:
            older = f"a memory of an older version, which had no {', '.join(missing)}"
            raise ValueError(f"this is {older}: make it anew, by asm-gym fit or asm-gym babble")
        for name, shape in shapes.items():
            if learned[name].shape != shape:
                raise ValueError(f"{name} should be of shape {shape}, found {learned[name].shape}")
        arrays = {name: np.ascontiguousarray(learned[name], np.float32) for name in shapes}
        association = Association(**{n: arrays[n] for n in Association._fields})
        how = self.schedule.iterations, self.schedule.prior_precision, self.schedule.sensory_precision
        self.network_ = dynamics.network(dynamics.weights(**{n: arrays[n] for n in temporal}), association, *how)
        self.senses_, self.motor_ = senses, Motor.found(learned, senses)
        self.completion_ = Completion.found(learned, senses)
        return super().restore(learned, skills)

    def start(self, batch: int, told: Sequence[Told] = ()) -> MemoryState:
        return at_start(batch, self.network, self.lag, self.spec.size, len(self.skills_))

    def predict(self, state: MemoryState, rows: NDArray[np.float64]) -> tuple[MemoryState, ModelOutput]:
        before, earlier = past(state, rows)
        reading = self.senses_.read(rows, before, earlier)
        traces, expected = carry_on(self.network, state, reading)
        error, units = self.network.associate(reading)
        if state.steps.min() < 2 * self.lag:
            error = error * sure(state.steps, self.lag)
        skill = state.skill
        if self.skills_:
            skill = add_up(skill, units, expected, self.learned_["W_K"], self.learned_["b_K"])
        seen = newest(state.before, rows), newest(state.earlier, before), state.steps + 1
        return MemoryState(traces, expected, *seen, skill), ModelOutput(error, expected)

    @property
    def network(self) -> TemporalNetwork:
        """The weights, which are there once it is fitted."""
        assert self.network_ is not None
        return self.network_

    def name_skills(self, episodes: Sequence[Episode], rng: np.random.Generator) -> Self:
        """Learns to tell which skill is running. Raises ValueError where an episode says none, or all say the same."""
        told = []
        for n, episode in enumerate(episodes):
            try:
                told.append(running(episode))
            except ValueError as error:
                raise ValueError(f"episode {n} {error}") from error
        known, skills = np.unique(np.concatenate(told), return_inverse=True)
        if len(known) < 2:
            raise ValueError(f"two skills at least are needed to tell them apart, got {', '.join(known)}")
        inputs = np.concatenate([self.senses_.read_episode(e.stream).inputs for e in episodes])
        states, V = np.concatenate([o.contexts for o in model_outputs(self, episodes)]), self.network.association.V
        W_K, b_K = learn_readout(lambda i: np.hstack([hidden_units(inputs[i], V), states[i]]), skills, len(known), rng)
        return self.restore({**self.learned_, "W_K": W_K, "b_K": b_K}, tuple(map(str, known)))

    def skills(self, stream: NDArray[np.floating[Any]]) -> NDArray[np.str_]:
        """(T,) the skill that seems to run in each step of a stream (T, D), once some have a name."""
        state, named = self.start(1), []
        for row in np.asarray(stream, np.float64):
            state, _ = self.predict(state, row[None])
            named.append(self.skills_[int(state.skill.argmax())])
        return np.array(named)

    def adapt(
        self, before: MemoryState, rows: NDArray[np.float64], quiet: NDArray[np.bool_], rate: float
    ) -> NDArray[np.bool_]:
        """Moves association towards those of the rows (B, D) that are ``quiet`` (B,) and whole; which those were."""
        reading = self.senses_.read(rows, before.before[:, 0], before.earlier[:, 0])
        learned: NDArray[np.bool_] = quiet & (before.steps >= 2 * self.lag) & (reading.whole[:, 0] > 0)
        if learned.any():
            association = self.network.association
            now = followed(association, existing(association), reading.inputs[learned], reading.changes[learned], rate)
            self.network_ = self.network.with_association(now)
            self.learned_ = {**self.learned_, "U": now.U, "D": now.D}
        return learned

    def learn_to_act(self, episodes: Sequence[Episode], units: int, rng: np.random.Generator) -> Self:
        """Learns what to command in which situation, for ``expected_action``."""
        motor = learn_motor(*lessons(self.senses_, episodes), units, rng)
        return self.restore({**self.learned_, **motor.named(self.senses_)}, self.skills_)

    def expected_action(self, state: MemoryState) -> NDArray[np.float32]:
        """(B, A) what is likely to be commanded next, in the units of the action."""
        if self.motor_ is not None:
            return self.motor_.command(situation(self.senses_, state.before[:, -1]))
        motor, senses = self.spec.motor, self.senses_
        action = self.network.run_on(state.traces).expected[:, senses.size :]
        return (senses.mean[motor] + senses.spread[motor] * action).astype(np.float32)

    def free_energy(self, healthy: Sequence[Episode]) -> FreeEnergy:
        """F of all that it expects, in the spreads that ``healthy`` episodes leave, from which it has not learned."""
        return FreeEnergy.of(self.network, self.senses_, self.motor_, [e.stream for e in healthy])

    def recall(self, cue: NDArray[np.floating[Any]], steps: int) -> NDArray[np.float64]:
        """(steps, D) rows that come after a cue (T, D), in the units of the stream."""
        return continued(self.network, self.senses_, cue, steps)

    def _units_each(self, senses: StreamScaler) -> int:
        """Hidden units of association for each group."""
        return max(1, self.association_size // (int(senses.groups.max()) + 1))
