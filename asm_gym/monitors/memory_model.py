"""The memory as a model: it predicts each row of a stream, and returns the errors.

row → standardise → memory: expect, infer, associate → ε_t/σ_t, and the context f(μ_t)
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.episode import Episode
from asm_gym.detection import ModelOutput
from asm_gym.detection.base import Arrays
from asm_gym.memory.association import Association, ChangeLayout, association_shapes
from asm_gym.memory.completion import Completion
from asm_gym.memory.dynamics import DYNAMICS, TRACES, dynamics_of, train
from asm_gym.memory.learning import Schedule, Trajectory
from asm_gym.memory.linear_association import check_inputs, specialise
from asm_gym.memory.motor import Motor, situation
from asm_gym.memory.temporal import UNSURE, MemoryState, TemporalNetwork
from asm_gym.monitors.row_kernel import RowWeights, expected_errors, row_weights, unwritten
from asm_gym.monitors.stream_model import ScaledModel, require_arrays
from asm_gym.monitors.surprise import Progress
from asm_gym.scaling import StreamScaler, rows_apart
from asm_gym.spec import StreamSpec
from asm_gym.validation import check_shapes


class MemoryModel(ScaledModel):
    """The temporal network, association, and what is learned on top of them: motor association and names of skills.

    Args:
        spec, hidden_size, association_size, dynamics: as of ``NeuralASM``.
        schedule: how to learn and to infer.

    Attributes:
        network_: the weights; None before ``fit``.
        motor_: the motor association; None before ``learn_to_act``.
        completion_: completes missing senses; None where they are too many, and once some were lost.
        compiled_: what the row kernel computes with; None before ``fit``.
    """

    kind = "neural_asm"
    held_out = 0  # what it learns of errors is cross-fitted

    def __init__(
        self,
        spec: StreamSpec,
        hidden_size: int,
        association_size: int,
        schedule: Schedule,
        dynamics: str = TRACES,
    ) -> None:
        super().__init__(spec, rows_apart(spec.dt))
        self.dynamics = dynamics
        self.hidden_size = hidden_size
        self.association_size = association_size
        self.schedule = schedule
        self.network_: TemporalNetwork | None = None
        self.compiled_: RowWeights | None = None
        self.motor_: Motor | None = None
        self.completion_: Completion | None = None

    @property
    def network(self) -> TemporalNetwork:
        """The weights of a fitted model."""
        assert self.network_ is not None
        return self.network_

    def _take(self, network: TemporalNetwork) -> None:
        names: Arrays = {"W_K": np.zeros((0, 0)), "b_K": np.zeros(0)}
        if self.skills_:
            names = self.learned_
        self.network_ = network
        self.compiled_ = row_weights(network, self.senses_, names)

    def fit(
        self, episodes: Sequence[Episode], rng: np.random.Generator, progress: Progress
    ) -> Self:
        streams = [episode.stream for episode in episodes]
        lag = self.lag
        senses = StreamScaler.fit(self.spec, streams, lag)
        check_inputs(senses.inputs)
        # Nothing came before the first ``lag`` rows, so that no change in them is known.
        trajectories = []
        for stream in streams:
            read = senses.read_episode(stream)
            trajectories.append(
                Trajectory(read.senses[::lag], read.commands[::lag], read.inputs[lag:])
            )
        trained = train(
            trajectories,
            self._layout(senses),
            self.hidden_size,
            self.schedule,
            rng,
            progress,
            dynamics=self.dynamics,
        )
        learned = {**senses.arrays, "energy": trained.energy}
        self.crossfitted = {}
        ends = np.cumsum([len(t.inputs) for t in trajectories])[:-1]
        for episode, errors in zip(episodes, np.split(trained.errors, ends), strict=True):
            errors[:lag] *= UNSURE
            unknown = np.zeros((lag, errors.shape[1]), errors.dtype)
            self.crossfitted[id(episode)] = np.vstack([unknown, errors])
        network = trained.network
        completion = Completion.fit(senses, streams)
        if completion is not None:
            learned |= completion.named()
        return self.restore({**learned, **network.weights._asdict(), **network.association.named()})

    def specialise(self, episodes: Sequence[Episode]) -> Self:
        """Go on from what it knows: association learns what these episodes have of their own, all else stays.

        Names of skills and the motor association belong to the association as it was, and are forgotten.
        """
        senses, lag = self.senses_, self.lag
        inputs = np.concatenate([senses.read_episode(e.stream).inputs[lag:] for e in episodes])
        now = specialise(self.network.association, inputs, self._layout(senses))
        kept = {"mean", "spread", "change", "energy", *self.network.weights._fields}
        return self.restore(
            {**{n: a for n, a in self.learned_.items() if n in kept}, **now.named()}
        )

    def restore(self, learned: Arrays, skills: tuple[str, ...] = ()) -> Self:
        senses = StreamScaler.of(self.spec, learned, self.lag)
        X, A = len(self.spec.sensory), len(self.spec.motor)
        units = len(learned["V"])
        kept = dynamics_of(learned)
        if kept != self.dynamics:
            raise ValueError(
                f"this is a memory of dynamics={kept!r}, "
                f"which cannot be loaded as {self.dynamics!r}"
            )
        dynamics = DYNAMICS[self.dynamics]
        temporal = dynamics.shapes(self.hidden_size, senses.size, A)
        shapes = temporal | association_shapes(senses.inputs, units, X)
        if not len(learned.get("R", ())):  # leverage was not learned, from few rows
            shapes["R"] = (0, senses.inputs)
        if skills:
            shapes |= {"W_K": (len(skills), units + self.hidden_size), "b_K": (len(skills),)}
        require_arrays(learned, shapes)
        check_shapes(learned, shapes)
        arrays = {name: np.ascontiguousarray(learned[name], np.float32) for name in shapes}
        association = Association.from_named(arrays)
        how = (
            self.schedule.iterations,
            self.schedule.prior_precision,
            self.schedule.sensory_precision,
        )
        super().restore(learned, skills)
        self.motor_ = Motor.found(learned, self.senses_)
        self.completion_ = Completion.found(learned, self.senses_)
        self._take(
            dynamics.network(
                dynamics.weights(**{n: arrays[n] for n in temporal}), association, *how
            )
        )
        return self

    def start(self, batch: int) -> MemoryState:
        return MemoryState(
            traces=self.network.at_rest(batch),
            expected=np.zeros((batch, self.network.hidden_size), np.float32),
            history=super().start(batch),
            skill=np.zeros((batch, len(self.skills_)), np.float32),
        )

    def predict(
        self, state: MemoryState, rows: NDArray[np.float64]
    ) -> tuple[MemoryState, ModelOutput]:
        assert self.compiled_ is not None
        new: MemoryState = unwritten(state)
        errors = expected_errors(self.compiled_, state, new, np.ascontiguousarray(rows, np.float64))
        return new, ModelOutput(errors, new.expected)

    def expected_action(self, state: MemoryState) -> NDArray[np.float32]:
        """Return the likely next command (B, A), by the motor association or else by the temporal network."""
        if self.motor_ is not None:
            return self.motor_.command(situation(self.senses_, state.history.before[:, -1]))
        motor = self.spec.motor
        senses = self.senses_
        action = self.network.run_on(state.traces).expected[:, senses.size :]
        return (senses.mean[motor] + senses.spread[motor] * action).astype(np.float32)

    def _layout(self, senses: StreamScaler) -> ChangeLayout:
        """Return the layout of the inputs, with the hidden units of association for each group."""
        groups = int(senses.groups.max()) + 1
        return ChangeLayout.of(senses, max(1, self.association_size // groups))
