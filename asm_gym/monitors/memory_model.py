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
from asm_gym.memory.dynamics import DYNAMICS, RECURRENT, dynamics_of, train
from asm_gym.memory.learning import Schedule, Trajectory
from asm_gym.memory.linear_association import check_inputs, specialise
from asm_gym.memory.motor import Motor, situation
from asm_gym.memory.temporal import UNSURE, MemoryState, TemporalNetwork
from asm_gym.monitors.monitor_protocol import Progress
from asm_gym.monitors.pace_memory import PaceMemory
from asm_gym.monitors.row_kernel import RowWeights, expected_errors, row_weights, unwritten
from asm_gym.monitors.stream_model import ScaledModel, require_arrays
from asm_gym.scaling import StreamScaler, rows_apart
from asm_gym.spec import StreamSpec
from asm_gym.validation import check_shapes


class MemoryModel(ScaledModel):
    """The temporal network and association, and beside them a motor association and names of skills.

    Args:
        spec, hidden_size, association_size, dynamics: as of ``NeuralASM``.
        schedule: how to learn and to infer.

    Attributes:
        network_: the weights; None before ``fit``.
        motor_: the motor association; None before ``learn_to_act``.
        completion_: completes missing senses; None where they are too many, and once some were lost.
        pace_: how fast healthy motion passes its places; None without positions, and in older files.
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
        dynamics: str = RECURRENT,
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
        self.pace_: PaceMemory | None = None

    @property
    def network(self) -> TemporalNetwork:
        """The weights of a fitted model."""
        assert self.network_ is not None
        return self.network_

    def fit(
        self, episodes: Sequence[Episode], rng: np.random.Generator, progress: Progress
    ) -> Self:
        lag = self.lag
        trajectories = []
        readings = self.read_nominal(episodes)
        for reading in readings:
            inputs = reading.inputs[lag:]  # before these no change is known
            trajectories.append(Trajectory(reading.senses[::lag], reading.commands[::lag], inputs))
        senses = self.senses_
        check_inputs(senses.inputs)
        trained = train(
            trajectories,
            self._layout(senses),
            self.hidden_size,
            self.schedule,
            rng,
            progress,
            dynamics=self.dynamics,
        )
        self.crossfitted = {}
        ends = np.cumsum([len(trajectory.inputs) for trajectory in trajectories])[:-1]
        errors_of_episodes = np.split(trained.errors, ends)
        for episode, reading, errors in zip(episodes, readings, errors_of_episodes, strict=True):
            errors *= reading.precision[lag:]
            errors[:lag] *= UNSURE
            unknown = np.zeros((lag, errors.shape[1]), errors.dtype)
            self.crossfitted[id(episode)] = np.vstack([unknown, errors])

        network = trained.network
        learned = {**senses.arrays, "energy": trained.energy}
        learned |= network.weights._asdict()
        learned |= network.association.named()
        completion = Completion.fit(senses, [episode.stream for episode in episodes])
        if completion is not None:
            learned |= completion.named()
        pace = PaceMemory.fit(senses, [episode.stream for episode in episodes])
        if pace is not None:
            learned |= pace.named()
        return self.restore(learned)

    def specialise(self, episodes: Sequence[Episode]) -> Self:
        """Let the association learn more from these episodes; all other weights stay.

        Names of skills and the motor association belong to the association as it was, and are forgotten.
        """
        readings = [self.senses_.read_episode(episode.stream) for episode in episodes]
        inputs = np.concatenate([reading.inputs[self.lag :] for reading in readings])
        network = self.network
        association = specialise(network.association, inputs, self._layout(self.senses_))
        learned = {**self.senses_.arrays, "energy": self.learned_["energy"]}
        return self.restore({**learned, **network.weights._asdict(), **association.named()})

    def restore(self, learned: Arrays, skills: tuple[str, ...] = ()) -> Self:
        senses = StreamScaler.of(self.spec, learned, self.lag)
        units = len(learned["V"])
        kept_dynamics = dynamics_of(learned)
        if kept_dynamics != self.dynamics:
            raise ValueError(
                f"this is a memory of dynamics={kept_dynamics!r}, "
                f"which cannot be loaded as {self.dynamics!r}"
            )
        dynamics = DYNAMICS[self.dynamics]
        of_network = dynamics.shapes(self.hidden_size, senses.size, len(self.spec.commanded))
        shapes = of_network | association_shapes(senses.inputs, units, len(self.spec.sensory))
        if not len(learned.get("R", ())):  # leverage was not learned, from few rows
            shapes["R"] = (0, senses.inputs)
        if skills:
            shapes["W_K"] = (len(skills), units + self.hidden_size)
            shapes["b_K"] = (len(skills),)
        require_arrays(learned, shapes)
        check_shapes(learned, shapes)
        arrays = {name: np.ascontiguousarray(learned[name], np.float32) for name in shapes}
        network = dynamics.network(
            weights=dynamics.weights(**{name: arrays[name] for name in of_network}),
            association=Association.from_named(arrays),
            iterations=self.schedule.iterations,
            prior_precision=self.schedule.prior_precision,
            sensory_precision=self.schedule.sensory_precision,
        )
        super().restore(learned, skills)
        self.motor_ = Motor.found(learned, self.senses_)
        self.completion_ = Completion.found(learned, self.senses_)
        self.pace_ = PaceMemory.found(learned, self.senses_)
        self.network_ = network
        self.compiled_ = row_weights(network, self.senses_, learned)
        return self

    def start(self, batch: int) -> MemoryState:
        return MemoryState(
            carried=self.network.at_rest(batch),
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
        senses = self.senses_
        if self.motor_ is not None:
            last_rows = state.history.before[:, -1]
            return self.motor_.command(situation(senses, last_rows))
        expected = self.network.run_on(state.carried).expected
        motor = self.spec.motor
        is_action = np.isin(self.spec.commanded, motor)
        standard = expected[:, senses.size :][:, is_action]
        action = senses.mean[motor] + senses.spread[motor] * standard
        return action.astype(np.float32)

    def _layout(self, senses: StreamScaler) -> ChangeLayout:
        """Return the layout of the inputs, with the hidden units of association for each group."""
        groups = int(senses.groups.max()) + 1
        return ChangeLayout.of(senses, max(1, self.association_size // groups))
