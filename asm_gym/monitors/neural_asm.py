"""The Neural Associative Skill Memory as a monitor: it learns what skills feel like, and says when one feels wrong.

row → standardise → memory: expect, infer, associate → ε_t/σ_t → whiten → accumulate → value, attribution
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from asm_gym.episodes import Episode
from asm_gym.memory.adaptation import followed
from asm_gym.memory.association import Association, association_shapes, hidden_units, synapses
from asm_gym.memory.inference import Weights, motor_prediction, weight_shapes
from asm_gym.memory.learning import Schedule, Trajectory
from asm_gym.memory.motor import Motor, learn_motor, lessons, situation
from asm_gym.memory.network import Network, train
from asm_gym.memory.readout import add_up, learn_readout, running
from asm_gym.memory.recall import continued
from asm_gym.memory.state import MemoryState, at_start, carry_on, newest, past
from asm_gym.monitors.base import Surprise
from asm_gym.monitors.monitor import Progress, require
from asm_gym.monitors.predictive import BOUND, GAINS, PredictiveMonitor, PredictiveState
from asm_gym.scaling import StreamScaler, rows_apart
from asm_gym.stream import StreamSpec


class NeuralASM(PredictiveMonitor):
    """Predictive coding through time and across the senses, learned by local rules, with a calibrated threshold.

    Args:
        spec: the stream it watches.
        hidden_size: H, hidden units of the temporal network.
        association_size: hidden units of association, shared out among the groups of senses.
        iterations: inference steps per control step.
        learning_rate: largest change of a synapse in one step, decaying to 0 along a cosine; scaled by 256 / H where H
            is larger, so that a unit's input does not change more for having more synapses.
        epochs: passes of the temporal network over the training episodes; fewer where they are very many.
        batch_size: episodes it learns from side by side.
        prior_precision: Π_z, trust in what was expected.
        sensory_precision: Π_x, trust in what is sensed.
        carry_prior: probability, reached linearly by the end of training, that after a random cue the state carried on
            while learning is the expected one rather than the inferred one, and the action that comes with it. Above 0
            the memory learns to run on without senses (``recall``, best at 0.95 with a learning rate of 1e-3).
        gains: a in (0, 1], weights of the newest step in the accumulated evidence; several, for faults that come as
            a knock and faults that creep.
        bound: ν > 0, how many standard deviations an error counts at most, so that a knock that is soon over counts
            less than what stays.
        shrinkage: λ in [0, 1] of the whitening, towards no correlation between errors.
        seed: of the initial weights and of the order of the episodes.

    Attributes:
        network_: the memory with its weights; None before ``fit``.
        motor_: its motor association; None before ``learn_to_act``.
        senses_: how it reads a row.
        detector_: what turns errors into surprise; None before ``fit``.
        energy_: mean energy of a step in each pass.
        threshold_: what surprise must exceed for an alarm; None before ``calibrate``.
    """

    kind = "neural_asm"
    hyperparameters = (*Schedule._fields, "hidden_size", "association_size", "gains", "bound", "shrinkage", "seed")

    def __init__(
        self,
        spec: StreamSpec,
        hidden_size: int = 256,
        association_size: int = 960,
        iterations: int = 20,
        learning_rate: float = 3e-3,
        epochs: int = 40,
        batch_size: int = 32,
        prior_precision: float = 1.0,
        sensory_precision: float = 1.0,
        carry_prior: float = 0.0,
        gains: Sequence[float] = GAINS,
        bound: float = BOUND,
        shrinkage: float = 1e-3,
        seed: int = 0,
    ) -> None:
        super().__init__(spec, gains, bound, shrinkage, seed)
        sizes = {"hidden_size": hidden_size, "association_size": association_size}
        counts = {**sizes, "iterations": iterations, "epochs": epochs, "batch_size": batch_size}
        for name, count in counts.items():
            require(name, count, isinstance(count, (int, np.integer)) and count >= 1, "a whole number of at least 1")
        precisions = {"prior_precision": prior_precision, "sensory_precision": sensory_precision}
        for name, number in {"learning_rate": learning_rate, **precisions}.items():
            require(name, number, 0.0 < number < math.inf, "positive and finite")
        require("carry_prior", carry_prior, 0.0 <= carry_prior <= 1.0, "in [0, 1]")
        self.shortest = 1 + self._lag
        # Plain Python numbers, for a checkpoint holds them as JSON.
        self.hidden_size, self.association_size = int(hidden_size), int(association_size)
        self.epochs, self.batch_size, self.iterations = int(epochs), int(batch_size), int(iterations)
        self.prior_precision, self.sensory_precision = float(prior_precision), float(sensory_precision)
        self.carry_prior, self.learning_rate = float(carry_prior), float(learning_rate)
        self.network_: Network | None = None
        self.motor_: Motor | None = None

    def learn_model(
        self, streams: Sequence[NDArray[np.float32]], rng: np.random.Generator, progress: Progress
    ) -> dict[str, NDArray[Any]]:
        senses = StreamScaler.fit(self.spec, streams, self._lag)
        readings = [senses.read_episode(s) for s in streams]
        lag = self._lag
        trajectories = [Trajectory(r.senses[::lag], r.commands[::lag], r.inputs) for r in readings]
        schedule = Schedule(*(getattr(self, name) for name in Schedule._fields))
        sizes = self.hidden_size, self._units_each(senses)
        self.skills_ = ()
        trained = train(trajectories, senses.groups, senses.changes, *sizes, schedule, rng, progress)
        standard = {"mean": senses.mean, "spread": senses.spread, "change": senses.change, "energy": trained.energy}
        return {**standard, **trained.network.weights._asdict(), **trained.network.association._asdict()}

    def build_model(self) -> None:
        found = self.learned_
        self.energy_ = found["energy"]
        self.senses_ = senses = StreamScaler(self.spec, found["mean"], found["spread"], found["change"], self._lag)
        X, A = len(self.spec.sensory), len(self.spec.motor)
        units = self._units_each(senses) * (int(senses.groups.max()) + 1)
        shapes = weight_shapes(self.hidden_size, senses.size, A) | association_shapes(senses.inputs, units, X)
        if self.skills_:
            shapes |= {"W_K": (len(self.skills_), units), "b_K": (len(self.skills_),)}
        for name, shape in shapes.items():
            if found[name].shape != shape:
                raise ValueError(f"{name} should be of shape {shape}, found {found[name].shape}")
        arrays = {name: np.ascontiguousarray(found[name], np.float32) for name in shapes}
        weights = Weights(**{n: arrays[n] for n in Weights._fields})
        association = Association(**{n: arrays[n] for n in Association._fields})
        how = self.iterations, self.prior_precision, self.sensory_precision
        self.network_ = Network(weights, association, *how)
        self.motor_ = Motor.found(found, senses)

    def start_model(self, batch: int) -> MemoryState:
        return at_start(batch, self.hidden_size, self._lag, self.spec.size, len(self.skills_))

    def predict(
        self, state: MemoryState, rows: NDArray[np.float64]
    ) -> tuple[MemoryState, NDArray[np.float32], NDArray[np.float32]]:
        assert self.network_ is not None
        before, earlier = past(state, rows)
        reading = self.senses_.read(rows, before, earlier)
        hidden, expected = carry_on(self.network_, state, reading)
        error, units = self.network_.associate(reading)
        if state.steps.min() < self._lag:
            error[state.steps < self._lag] = 0.0  # nothing came before, so that no change is known
        skill = state.skill
        if self.skills_:
            skill = add_up(skill, units, self.learned_["W_K"], self.learned_["b_K"])
        seen = newest(state.before, rows), newest(state.earlier, before), state.steps + 1
        return MemoryState(hidden, expected, *seen, skill), error, expected

    def name_skills(self, episodes: Sequence[Episode]) -> Self:
        """Learns to tell which skill is running, from episodes whose ``info["skill"]`` says it.

        Only ``surprise.skill`` depends on it: neither the weights nor the surprise do.

        Raises:
            ValueError: an episode says none, or all say the same.
        """
        self._fitted()
        self._check(episodes)
        names = [str(e.info.get("skill", "")) for e in episodes]
        if "" in names:
            raise ValueError(f"episode {names.index('')} does not say its skill: set info['skill']")
        known = sorted(set(names))
        if len(known) < 2:
            raise ValueError(f"two skills at least are needed to tell them apart, got {', '.join(known)}")
        assert self.network_ is not None
        inputs = np.concatenate([self.senses_.read_episode(e.stream).inputs for e in episodes])
        skills = np.repeat([known.index(name) for name in names], [len(e) for e in episodes])
        V = self.network_.association.V
        with threadpool_limits(1):
            rng = np.random.default_rng(self.seed)
            W_K, b_K = learn_readout(lambda i: hidden_units(inputs[i], V), skills, len(known), rng)
        self.learned_ = self.learned_ | {"W_K": W_K, "b_K": b_K}
        self.skills_ = tuple(known)
        return self

    def skills(self, stream: NDArray[np.floating[Any]]) -> NDArray[np.str_]:
        """(T,) the skill that seems to run in each step of a stream (T, D), by what came before.

        Raises:
            RuntimeError: no skill has a name: ``name_skills`` comes first.
        """
        if not self.skills_:
            raise RuntimeError("no skill has a name yet: call name_skills(episodes) first")
        assert self.network_ is not None
        units = hidden_units(self.senses_.read_episode(np.asarray(stream)).inputs, self.network_.association.V)
        return np.array(self.skills_)[running(units, self.learned_["W_K"], self.learned_["b_K"])]

    def adapt(
        self,
        before: PredictiveState,
        stream: NDArray[np.floating[Any]],
        surprise: Surprise,
        rate: float = 5e-3,
        below: float = 0.5,
    ) -> NDArray[np.bool_]:
        """Learns from rows that were just observed, where they were not surprising: for a body that slowly wears.

        Nothing calls this unless asked to. It changes this memory for whoever watches with it; the promise of
        ``calibrate`` holds for the weights it was made with, so calibrate anew now and then.

        Args:
            before: the state that ``observe`` was given.
            stream: (B, D) the rows that ``observe`` was given.
            surprise: what it made of them.
            rate: share of an error that one step takes away, in (0, 1].
            below: only rows whose surprise is under this share of the threshold are learned from.

        Returns:
            (B,) which rows were learned from.

        Raises:
            RuntimeError: there is no threshold yet.
        """
        require("rate", rate, 0.0 < rate <= 1.0, "in (0, 1]")
        require("below", below, 0.0 < below <= 1.0, "in (0, 1]")
        assert self.network_ is not None
        model, rows = before.model, np.asarray(stream, np.float64)
        quiet = (surprise.value < below * self.threshold) & (model.steps >= 2 * self._lag)
        reading = self.senses_.read(rows, model.before[:, 0], model.earlier[:, 0])
        learned: NDArray[np.bool_] = quiet & (reading.whole[:, 0] > 0)
        if learned.any():
            senses, size = self.senses_, self._units_each(self.senses_)
            exists = synapses(senses.groups, senses.changes, senses.inputs, size)
            now = followed(self.network_.association, exists, reading.inputs[learned], reading.changes[learned], rate)
            self.network_.association = now
            self.learned_ = self.learned_ | {"U": now.U, "D": now.D}
        return learned

    def learn_to_act(self, episodes: Sequence[Episode], units: int = 512) -> Self:
        """Learns what to command in which situation, so that ``NeuralASMPolicy`` can act by it.

        Only ``expected_action`` depends on it: neither the other weights nor the surprise do.

        Args:
            episodes: whose ``actions`` say what was intended; where they are empty, the stream says what was commanded.
            units: hidden units of the motor association.
        """
        self._fitted()
        self._check(episodes)
        with threadpool_limits(1):
            self.motor_ = learn_motor(*lessons(self.senses_, episodes), units, np.random.default_rng(self.seed))
        self.learned_ = self.learned_ | self.motor_.named(self.senses_)
        return self

    def expected_action(self, state: PredictiveState) -> NDArray[np.float32]:
        """(B, A) the motor prediction: what is likely to be commanded next, in the units of the action.

        That of the motor association, where ``learn_to_act`` made one; else that of the state.

        Args:
            state: as ``observe`` handed it back.
        """
        assert self.network_ is not None
        if self.motor_ is not None:
            return self.motor_.command(situation(self.senses_, state.model.before[:, -1]))
        motor, senses = self.spec.motor, self.senses_
        _, action = motor_prediction(state.model.hidden, self.network_.weights)
        return (senses.mean[motor] + senses.spread[motor] * action).astype(np.float32)

    def recall(self, cue: NDArray[np.floating[Any]], steps: int) -> NDArray[np.float64]:
        """What comes after a cue, from memory alone: (steps, D) rows in the units of the stream.

        Actions are the memory's own motor predictions. Fit with ``carry_prior`` above 0 to make it learn to run on.

        Args:
            cue: (T, D) the first rows of an episode, at least a tenth of a second and 2 rows.
            steps: how many rows to recall.

        Raises:
            ValueError: the cue is too short, not finite, or of another width; fewer than one step.
        """
        self._fitted()
        assert self.network_ is not None
        return continued(self.network_, self.senses_, cue, steps)

    def observe(self, state: PredictiveState, stream: NDArray[np.floating[Any]]) -> tuple[PredictiveState, Surprise]:
        state, surprise = super().observe(state, stream)
        if self.skills_:
            surprise = surprise._replace(skill=np.array(self.skills_)[state.model.skill.argmax(axis=1)])
        return state, surprise

    @property
    def _lag(self) -> int:
        """l."""
        return rows_apart(self.spec.dt)

    def _units_each(self, senses: StreamScaler) -> int:
        """Hidden units of association for each group."""
        return max(1, self.association_size // (int(senses.groups.max()) + 1))
