"""The Neural Associative Skill Memory as a monitor: it learns to predict the sensor readings of skills.

row → memory: errors, context → whiten → accumulate → value, attribution

Further functions take a memory as an argument: ``memory_skills``, ``shipped``.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.checkpoint import read_checkpoint
from asm_gym.data.episode import Episode
from asm_gym.detection import EvidenceDetection
from asm_gym.detection.base import Arrays
from asm_gym.detection.benign_events import BenignEvents, EventState
from asm_gym.detection.commands import healthy_commands
from asm_gym.detection.drift import DriftSenses, WearCounter, WearScale, wear_scale
from asm_gym.detection.misreadings import misread, widened, without_misreadings
from asm_gym.memory.dynamics import DYNAMICS, RECURRENT
from asm_gym.memory.learning import Schedule
from asm_gym.monitors.blame import Blame
from asm_gym.monitors.calibrated_monitor import CalibratedMonitor
from asm_gym.monitors.calibration import AlarmRate
from asm_gym.monitors.diagnosis import Diagnosis, Readout
from asm_gym.monitors.kernel_streams import observe_streams
from asm_gym.monitors.memory_config import (
    ASSOCIATION_UNITS,
    EPOCHS,
    HIDDEN_UNITS,
    OF_EVIDENCE,
    MemoryConfig,
)
from asm_gym.monitors.memory_model import MemoryModel
from asm_gym.monitors.monitor_files import restored
from asm_gym.monitors.monitor_protocol import Progress, Surprise
from asm_gym.monitors.monitor_state import MonitorState, checked_rows
from asm_gym.monitors.named_causes import CauseNamer
from asm_gym.monitors.row_kernel import RowKernel
from asm_gym.monitors.shipped import pretrained_file
from asm_gym.monitors.stream_model import groups_side_by_side, made, parameter_names
from asm_gym.monitors.torque.arm_features import (
    ArmFeatures,
    judged_by_values,
    torque_names,
    torques_with_speeds,
)
from asm_gym.monitors.torque.value_judge import ValueJudge, without_values
from asm_gym.monitors.weight_packing import rounded
from asm_gym.scaling import StreamScaler
from asm_gym.spec import LOG, StreamSpec
from asm_gym.validation import check_choice, check_flag, check_number, typed


class NeuralASM(CalibratedMonitor):
    """Learn to predict a stream from healthy episodes, and return the surprise of each row.

    Args:
        spec: the stream to watch.
        hidden_size: H, hidden units of the temporal network.
        association_size: hidden units of association, shared out among the groups of senses.
        epochs: passes of the temporal network over the training episodes; fewer if there are very many episodes.
        free_running_probability: probability that a training step continues from the prediction and the memory's own
            action; reached halfway through training. Above 0 the memory learns recall (``memory_skills.recall``, best
            at 0.6).
        habituates: divide surprise by its usual size in a context. The context depends on the policy, so use False for
            a memory that watches any policy.
        dynamics: how the temporal network represents the past: ``"recurrent"``, by units that learn how long they
            remember, or ``"settling"``, the temporal predictive coding network of the papers, whose state is inferred
            on every row.
        excuses: do not count knocks, joints at their stops and moving fingers as faults
            (``detection.benign_events``): for a memory that watches any policy, including policies that hit things.
        values: judge values, such as torques, beside changes (``monitors.torque``), if other senses predict them: for
            lasting pushes. None judges them where torques, currents or efforts are among the senses
            (``torque.arm_features.judged_by_values``).
        urdf: text of the arm's body model, from ``torque.urdf.read_urdf``, to predict torques from the weight and the
            inertia of its links, where values are judged.
        seed: of the initial weights and of the order of the episodes.
        config: all other hyperparameters.

    Attributes:
        values_: judges values; None before ``fit``, where values are not judged, and if nothing predicts one.
        excuses_: distinguishes knocks and stops from faults; None with ``excuses=False``.

    Example:
        >>> import numpy as np
        >>> from asm_gym import Channel, Episode, NeuralASM, StreamSpec
        >>> spec, rng = StreamSpec((Channel("position", 2, "m"),), dt=0.05), np.random.default_rng(0)
        >>> healthy = [Episode.from_stream(rng.normal(size=(60, 2)).cumsum(0), spec) for _ in range(40)]
        >>> memory = NeuralASM(spec, hidden_size=16, association_size=16, epochs=2).fit(healthy[:20])
        >>> memory = memory.calibrate(healthy[20:], false_alarm_rate=0.05)
        >>> knocked = Episode.from_stream(healthy[0].stream + 50.0 * (np.arange(60)[:, None] > 30), spec)
        >>> bool((memory.score(knocked).value > memory.threshold).any())
        True
    """

    kind = MemoryModel.kind
    config_class = MemoryConfig
    model: MemoryModel

    @typed
    def __init__(
        self,
        spec: StreamSpec,
        hidden_size: int = HIDDEN_UNITS,
        association_size: int = ASSOCIATION_UNITS,
        epochs: int = EPOCHS,
        free_running_probability: float = 0.0,
        habituates: bool = True,
        dynamics: str = RECURRENT,
        excuses: bool = False,
        values: bool | None = None,
        urdf: str = "",
        seed: int = 0,
        config: MemoryConfig | None = None,
    ) -> None:
        check_choice("dynamics", dynamics, DYNAMICS)
        self.config = config or MemoryConfig()
        self.dynamics = dynamics
        self.urdf = urdf
        self.hidden_size = check_number("hidden_size", hidden_size, low=1, whole=True)
        self.association_size = check_number(
            "association_size", association_size, low=1, whole=True
        )
        self.epochs = check_number("epochs", epochs, low=1, whole=True)
        self.free_running_probability = check_number(
            "free_running_probability", free_running_probability, low=0.0, high=1.0
        )
        if values is None:
            values = judged_by_values(spec)
        self.values = check_flag("values", values)
        self.excuses = check_flag("excuses", excuses)
        if urdf and not self.values:
            raise ValueError(
                "a body model predicts torques, and values are not judged: "
                "the stream has none, or values=False was given; leave urdf out"
            )
        ArmFeatures.of(spec, urdf)  # refuses a body model of another arm
        schedule = Schedule(**{name: self._param(name) for name in Schedule._fields})
        model = MemoryModel(spec, self.hidden_size, self.association_size, schedule, dynamics)
        evidence_params = {name: getattr(self.config, name) for name in OF_EVIDENCE}
        evidence = EvidenceDetection(spec, habituates=habituates, **evidence_params)
        self.config = self.config.as_checked_by(evidence)
        self.habituates = evidence.habituates
        super().__init__(model, evidence, seed=seed)
        self.excuses_ = BenignEvents(spec) if excuses else None
        self.values_: ValueJudge | None = None
        self._diagnosis: Diagnosis | None = None
        self._blame: Blame | None = None
        self._kernel: RowKernel | None = None

    def _param(self, name: str) -> Any:
        """Return a hyperparameter, of the memory or of its config."""
        if hasattr(self, name):
            return getattr(self, name)
        return getattr(self.config, name)

    def get_params(self) -> dict[str, Any]:
        return {name: self._param(name) for name in parameter_names(type(self))}

    @classmethod
    @typed
    def load(cls, path: str | Path) -> Self:
        """Read what ``save`` wrote. Raises FileNotFoundError, or ValueError for a file that is damaged or foreign."""
        saved = read_checkpoint(path, cls.kind)
        return restored(path, saved, lambda spec, **parameters: made(cls, spec, parameters))

    @classmethod
    @typed
    def pretrained(cls, name: str) -> Self:
        """Return a calibrated memory that is shipped with the package, learned from an arm's motor babbling.

        Raises:
            ValueError: an unknown name; the message lists the known ones.
        """
        return cls.load(pretrained_file(name))

    @property
    def senses_(self) -> StreamScaler:
        """The reader of rows."""
        return self.model.senses_

    @property
    def diagnosis_(self) -> Diagnosis | None:
        """Names the cause of a surprise and estimates senses; None if no sense can be estimated."""
        completion = self.model.completion_
        if completion is None:
            return None
        if self._diagnosis is None or self._diagnosis.completion is not completion:
            self._diagnosis = Diagnosis(completion, Readout.shipped())
        return self._diagnosis

    def wear_counter(self) -> WearCounter | None:
        """Return what adds up the drift of a robot; None where the memory was calibrated on too few episodes."""
        senses = self._drift_senses()
        if senses is None or self.wear_ is None:
            return None
        scale = WearScale.restored(np.asarray(self.wear_, np.float64), len(senses.labels))
        return WearCounter(senses, scale)

    def _drift_senses(self) -> DriftSenses | None:
        """Return what reads drift, by the completion; None without one."""
        completion = self.model.completion_
        if completion is None:
            return None
        withheld = np.zeros(self.spec.size, bool)
        withheld[torque_names(self.spec)] = True
        return DriftSenses.of(completion, torques_with_speeds(self.spec), withheld)

    def _healthy_wear(self, streams: Sequence[NDArray[Any]]) -> NDArray[np.float64] | None:
        senses = self._drift_senses()
        if senses is None:
            return None
        scale = wear_scale(senses, streams, self.spec.dt)
        return None if scale is None else scale.array

    @property
    def blame_(self) -> Blame | None:
        """Finds the channels that an alarm points to; None if no sense can be estimated."""
        completion = self.model.completion_
        if completion is None:
            return None
        if self._blame is None or self._blame.completion is not completion:
            self._blame = Blame(completion)
        return self._blame

    @property
    def cause_namer_(self) -> CauseNamer | None:
        """Names causes of alarms in words; None if no sense can be estimated."""
        blame = self.blame_
        if blame is None:
            return None
        return CauseNamer(blame, self.model.pace_)

    @property
    def learned_(self) -> dict[str, NDArray[Any]]:
        learned = super().learned_
        if self.values_ is not None:
            learned |= self.values_.arrays
        return learned

    def initial_state(self, batch: int = 1) -> MonitorState:
        state = super().initial_state(batch)._replace(excuses=EventState.start(batch, 0))
        if self.excuses_ is not None:
            state = state._replace(excuses=self.excuses_.start(batch))
        if self.values_ is not None:
            state = state._replace(values=self.values_.start(batch))
        return state

    def observe(
        self,
        state: MonitorState,
        stream: NDArray[np.floating[Any]],
        out: MonitorState | None = None,
    ) -> tuple[MonitorState, Surprise]:
        """Observe as in ``CalibratedMonitor``; write the new state to ``out``, a state that is no longer needed."""
        self._require_fitted()
        rows = self._without_misreadings(state, checked_rows(state, stream, self.spec))
        # divisor (B,): by it knocks and stops have divided the surprise
        new, surprise, divisor = self._row_kernel()(state, rows, out)
        if self.values_ is not None:
            values, surprise = self.values_.join(state.values, rows, surprise, divisor)
            new = new._replace(values=values)
        if self.skills_:
            likeliest = new.model.skill.argmax(axis=1)
            surprise = surprise._replace(skill=np.array(self.skills_)[likeliest])
        return new, surprise

    def score_episodes(self, episodes: Sequence[Episode]) -> list[Surprise]:
        kernel = self._row_kernel()
        if kernel is None or self.skills_:
            return super().score_episodes(episodes)
        self._require_fitted()
        for episode in episodes:
            self.spec.require(episode.spec, "the episode")
        scores: dict[int, Surprise] = {}
        for group in groups_side_by_side(episodes):
            streams = [self._read_stream(episodes[index].stream) for index in group]
            found = observe_streams(kernel, self.initial_state(len(group)), streams)
            for index, stream, (surprise, divisor) in zip(group, streams, found, strict=True):
                scores[index] = surprise
                if self.values_ is not None:
                    joined = self.values_.join_episode(stream, surprise, divisor)
                    scores[index] = joined
        return [scores[index] for index in range(len(episodes))]

    def _without_misreadings(
        self, state: MonitorState, rows: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the next rows (B, D) with NaN for each number that is misread."""
        if self.readings_ is None:
            return rows
        history = state.model.history
        senses = self.spec.sensory
        before = history.before[:, -1, senses]
        wrong = misread(self.readings_, before, rows[:, senses]) & (history.steps > 0)[:, None]
        if not wrong.any():
            return rows
        rows = rows.copy()
        rows[:, senses] = np.where(wrong, np.nan, rows[:, senses])
        return rows

    def _read_stream(self, stream: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return a stream (T, D) with NaN for each number that is misread."""
        if self.readings_ is None:
            return stream
        senses = self.spec.sensory
        read = stream.copy()
        read[:, senses] = without_misreadings(self.readings_, stream[:, senses])
        return read

    def compiled_row(self) -> RowKernel | None:
        """Return the kernel that does all that ``observe`` does; None where Python takes part in a row."""
        if self.values_ is not None or self.readings_ is not None or self.skills_:
            return None
        return self._row_kernel()

    def expected_action(self, state: MonitorState) -> NDArray[np.float32]:
        """Return the likely next command (B, A), in the units of the action, after this state."""
        return self.model.expected_action(state.model)

    def rounded(self) -> Self:
        """Return a copy with weights of 8 bits, whose file is a quarter as large; ``calibrate`` it anew."""
        self._require_fitted()
        other = self._copy()
        other.model.restore(rounded(self.model.learned_), self.skills_)
        other._uncalibrate()
        return other

    def restore_learned(self, arrays: Arrays, skills: tuple[str, ...] = ()) -> Self:
        super().restore_learned(without_values(arrays), skills)
        self.values_ = ValueJudge.restored(self.spec, arrays, self.seed, self.urdf)
        return self

    def _row_kernel(self) -> RowKernel:
        """Return the kernel of the weights as they are."""
        memory = self.model.compiled_
        assert memory is not None
        assert isinstance(self.detection, EvidenceDetection)
        if self._kernel is None or not self._kernel.is_of(memory, self.detection):
            self._kernel = RowKernel(memory, self.detection, self.excuses_)
        return self._kernel

    def _balanced(self, episodes: Sequence[Episode], rate: AlarmRate) -> Self:
        """Return a copy in which values and changes take half of the rate each, in nominal episodes.

        What was read in these is possible.
        """
        other = self._copy()
        if other.readings_ is not None:
            other._widen_readings(episodes)
        if self.values_ is None:
            return other
        other.values_ = self.values_.of_changes_alone()
        by_changes = other.score_episodes(episodes)
        expected = rate.expected(episodes)
        other.values_ = self.values_.balanced(by_changes, episodes, expected)
        return other

    def _calibration_scores(self, episodes: Sequence[Episode]) -> list[Surprise]:
        scores = self.score_episodes(episodes)
        if self.values_ is None:
            return scores
        return self.values_.raised(scores)

    def _keep_healthy_ranges(self, episodes: Sequence[Episode]) -> None:
        super()._keep_healthy_ranges(episodes)
        if self.readings_ is not None:
            self._widen_readings(episodes)

    def _widen_readings(self, episodes: Sequence[Episode]) -> None:
        """Count the readings of healthy episodes as possible."""
        streams = [episode.stream for episode in episodes]
        self.readings_ = widened(self.readings_, healthy_commands(streams, self.spec.sensory))

    def _learn(self, episodes: Sequence[Episode], progress: Progress, warm_start: bool) -> None:
        super()._learn(episodes, progress, warm_start)
        if not warm_start:
            self.readings_ = None
        if self.spec.source == LOG:
            self._widen_readings(episodes)
        self.values_ = None
        if self.values:
            self.values_ = ValueJudge.learned(episodes, self.seed, self.urdf)
