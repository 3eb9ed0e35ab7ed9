"""The Neural Associative Skill Memory as a monitor: it learns what skills feel like, and says when one feels wrong.

row → memory: errors, context → whiten → accumulate → value, attribution
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from asm_gym.checkpoint import Checkpoint, read_checkpoint
from asm_gym.detection import Detector, EvidenceDetection
from asm_gym.detection.detector import BOUND, GAINS
from asm_gym.detection.events import Excuses
from asm_gym.detection.tails import TAIL_INDEX
from asm_gym.episode import Episode
from asm_gym.memory.association_learning import FEEDBACK, LEARNED
from asm_gym.memory.dynamics import DYNAMICS, TRACES
from asm_gym.memory.inference import iterations_within
from asm_gym.memory.learning import Schedule
from asm_gym.memory.motor import Motor
from asm_gym.memory.temporal import TemporalNetwork
from asm_gym.monitors.base import Progress, Surprise, Told
from asm_gym.monitors.baselines.arm_inputs import Derived
from asm_gym.monitors.diagnosis import Diagnosis, Readout
from asm_gym.monitors.fused import CompiledRow
from asm_gym.monitors.hub import fetched
from asm_gym.monitors.memory_model import MemoryModel
from asm_gym.monitors.monitor import CalibratedMonitor, MonitorState
from asm_gym.monitors.monitor_file import restored
from asm_gym.monitors.packing import rounded, unpacked
from asm_gym.monitors.promise import Asked
from asm_gym.monitors.shipped import pretrained_file
from asm_gym.monitors.skill import ALARMS_ON, SkillSurprise, apart
from asm_gym.monitors.stream_model import parameter_names
from asm_gym.monitors.training_data import check_nominal
from asm_gym.monitors.values import PREFIX as VALUES
from asm_gym.monitors.values import Values
from asm_gym.scaling import StreamScaler
from asm_gym.spec import StreamSpec
from asm_gym.validation import check_choice, check_flag, check_number, shown, typed

MOST_ITERATIONS = 1000
"""Of inference in a row: twenty are enough, and a file that asks for a thousand million would never answer."""


class NeuralASM(CalibratedMonitor):
    """A predictive coding network through time, association across the senses, and a calibrated threshold.

    Args:
        spec: the stream it watches.
        hidden_size: H, hidden units of the temporal network.
        association_size: hidden units of association, shared out among the groups of senses.
        iterations: inference steps at most, which end sooner where nothing moves any more; 5 by traces, while learning
            and where a sense is missing, for a row that is seen needs none; 20 by settling, on every row.
        learning_rate: largest change of a synapse in one step, decaying to 0 along a cosine; scaled by 256 / H where H
            is larger, so that a unit's input does not change more for having more synapses.
        epochs: passes of the temporal network over the training episodes; fewer where they are very many.
        batch_size: episodes it learns from side by side.
        prior_precision: Π_z, trust in what was expected; 30 by traces, for the firmer, the closer local learning is to
            the gradient; 1 by settling, where the senses are to move the state.
        sensory_precision: Π_x, trust in what is sensed.
        free_running_probability: reached half-way through training; with it, after a random cue, a stream runs on
            alone for a step: the action is the memory's own, and it goes on from what it expected. Above 0 the memory
            learns to run on without senses (``recall``, best at 0.6).
        gains: a in (0, 1], weights of the newest step in the accumulated evidence; several, for faults that come as
            a knock and faults that creep.
        bound: ν > 0, how many standard deviations an error counts at most, so that a knock that is soon over counts
            less than what stays.
        shrinkage: λ in [0, 1] of the whitening, towards no correlation between errors.
        habituates: surprise is measured against what is usual in a context. A context knows the policy, so a memory
            that is to watch any policy leaves it out.
        tail_index: ξ_0 in (0, 1]: surprise falls off as probability to this power. The smaller, the more senses add up.
        excuses: knocks, joints at their stops and fingers that move are told apart from faults (``detection.events``):
            for a memory that is to watch any policy, of which some strike things.
        values: torques, and other values that the rest of a row tells, are judged beside changes (``monitors.values``):
            for a push that is held, in logs of real arms.
        urdf: text of the arm's body model, as ``body_model.read_urdf`` reads it: torques are then expected from what
            its links weigh, and from their inertia.
        seed: of the initial weights and of the order of the episodes.
        feedback: how errors come back to the hidden units of association, a name of ``association_learning.FEEDBACK``.
        dynamics: how the temporal network carries on what was: ``"traces"`` of what was sensed and done, or
            ``"settling"``, the temporal predictive coding network of the papers, whose state is inferred on every row.

    Attributes:
        threshold_: what surprise must exceed for an alarm; None before ``calibrate``.
        maxima_: largest surprise in each episode that ``calibrate`` was given; None before.
        blocks_: the same by the hour; None before, and in memories that were saved before it was kept.
        skill_: what listens for skills; None before ``learn_skills``.
        values_: what judges values; empty before ``fit``, where nobody asked for it, and where nothing tells any.

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
    model: MemoryModel

    @typed
    def __init__(
        self,
        spec: StreamSpec,
        hidden_size: int = 256,
        association_size: int = 240,
        iterations: int | None = None,
        learning_rate: float = 3e-3,
        epochs: int = 40,
        batch_size: int = 64,
        prior_precision: float | None = None,
        sensory_precision: float = 1.0,
        free_running_probability: float = 0.0,
        gains: Sequence[float] = GAINS,
        bound: float = BOUND,
        shrinkage: float = 1e-3,
        habituates: bool = True,
        seed: int = 0,
        feedback: str = LEARNED,
        dynamics: str = TRACES,
        excuses: bool = False,
        values: bool = False,
        urdf: str = "",
        tail_index: float = TAIL_INDEX,
    ) -> None:
        self.values = check_flag("values", values)
        self.urdf = urdf
        if urdf and not values:
            raise ValueError("a body model tells torques, which only values=True judges")
        Derived.of(spec, friction=True, body=False, urdf=urdf)  # refuses one that does not fit
        self._excuses = Excuses(spec) if check_flag("excuses", excuses) else None
        self.excuses = excuses
        check_choice("dynamics", dynamics, DYNAMICS)
        self.dynamics, usual = dynamics, DYNAMICS[dynamics]
        iterations = usual.iterations if iterations is None else iterations
        prior_precision = usual.prior_precision if prior_precision is None else prior_precision
        self.hidden_size = check_number("hidden_size", hidden_size, low=1, whole=True)
        self.association_size = check_number("association_size", association_size, low=1, whole=True)
        self.epochs = check_number("epochs", epochs, low=1, whole=True)
        self.batch_size = check_number("batch_size", batch_size, low=1, whole=True)
        self.iterations = check_number("iterations", iterations, low=1, high=MOST_ITERATIONS, whole=True)
        self.learning_rate = check_number("learning_rate", learning_rate, above=0.0)
        self.prior_precision = check_number("prior_precision", prior_precision, above=0.0)
        self.sensory_precision = check_number("sensory_precision", sensory_precision, above=0.0)
        self.free_running_probability = check_number(
            "free_running_probability", free_running_probability, low=0.0, high=1.0
        )
        check_choice("feedback", feedback, FEEDBACK)
        self.feedback = feedback
        schedule = Schedule(**{name: getattr(self, name) for name in Schedule._fields})
        model = MemoryModel(spec, self.hidden_size, self.association_size, schedule, feedback, dynamics)
        evidence = EvidenceDetection(spec, gains, bound, shrinkage, habituates, tail_index)
        super().__init__(model, evidence, seed=seed)
        self._diagnosis: Diagnosis | None = None
        self._row: CompiledRow | None = None
        self._row_of: tuple[Any, ...] | None = None
        self.skill_: SkillSurprise | None = None
        self.values_ = Values()

    def rounded(self) -> Self:
        """The same memory in fewer bits, weights in 8, which takes a quarter of the space when it is saved.

        It has no threshold: ``calibrate`` sets that of the rounded weights.
        """
        self._fitted()
        other = self._copy()
        other.model.restore(rounded(self.model.learned_), self.skills_)
        for detection in other.detections.values():
            if detection.learned_:
                detection.restore(rounded(detection.learned_))
        other._uncalibrate()
        return other

    @property
    def network_(self) -> TemporalNetwork | None:
        """The memory with its weights; None before ``fit``."""
        return self.model.network_

    @property
    def motor_(self) -> Motor | None:
        """The motor association; None before ``learn_to_act``."""
        return self.model.motor_

    @property
    def diagnosis_(self) -> Diagnosis | None:
        """What names the cause of a surprise, and completes senses; None where nothing completes senses."""
        completion = self.model.completion_
        if completion is None:
            return None
        if self._diagnosis is None or self._diagnosis.completion is not completion:
            self._diagnosis = Diagnosis(completion, Readout.shipped())
        return self._diagnosis

    @property
    def senses_(self) -> StreamScaler:
        """How it reads a row."""
        return self.model.senses_

    @property
    def detector_(self) -> Detector | None:
        """What turns errors into surprise; None before ``fit``."""
        evidence = self.detections["evidence"]
        return evidence.detector_ if isinstance(evidence, EvidenceDetection) else None

    @property
    def energy_(self) -> NDArray[np.float64]:
        """Mean energy of a step in each pass."""
        return self.model.learned_["energy"]

    def get_params(self) -> dict[str, Any]:
        """The hyperparameters by name."""
        schedule = {name: getattr(self, name) for name in Schedule._fields}
        sizes = {"hidden_size": self.hidden_size, "association_size": self.association_size}
        detections = {n: getattr(d, n) for d in self.detections.values() for n in parameter_names(type(d))}
        how = {n: getattr(self, n) for n in ("seed", "feedback", "dynamics", "excuses", "values", "urdf")}
        return schedule | sizes | detections | how

    @classmethod
    @typed
    def load(cls, path: str | Path) -> Self:
        """Reads what ``save`` wrote.

        Raises:
            FileNotFoundError: there is no such file.
            ValueError: the file is damaged, from a newer version, or something else.
        """
        return restored(path, read_checkpoint(path, cls.kind), cls)

    @classmethod
    @typed
    def pretrained(cls, name: str) -> Self:
        """A memory of a body that comes with the package, calibrated: ``NeuralASM.pretrained("panda")``.

        It has learned what an arm does under any policy, from motor babbling; ``about`` says from which.

        Raises:
            ValueError: there is none of that name; the message lists those that there are.
        """
        return cls.load(pretrained_file(name))

    @classmethod
    def from_hub(cls, repo: str, revision: str | None = None) -> Self:
        """A memory that ``asm-gym push`` has put on the Hugging Face hub; see ``asm_gym.monitors.hub.fetched``."""
        return cls.load(fetched(repo, revision))

    def observe(self, state: MonitorState, stream: NDArray[np.floating[Any]]) -> tuple[MonitorState, Surprise]:
        self._fitted()
        rows, row = self._rows(state, stream), self.compiled_row
        before, knock, held = state.skill, state.knock, state.values
        state, surprise = super().observe(state, rows) if row is None else row(state, rows)
        state, surprise = self.values_.step(held, rows, state, surprise)
        if self._excuses is not None:
            knock, excused = self._excuses.step(knock, rows)
            state, surprise = state._replace(knock=knock), surprise.excused(excused)
        if self.skills_:
            surprise = surprise._replace(skill=np.array(self.skills_)[state.model.skill.argmax(axis=1)])
        if self.skill_ is not None:
            after, skill = self.skill_.monitor.observe(before, rows)
            state, surprise = state._replace(skill=after), self.skill_.joined(surprise, skill, self.alarm_on)
        return state, surprise

    @property
    def events(self) -> Excuses | None:
        """What tells knocks and stops from faults; None where nobody does."""
        return self._excuses

    @property
    def compiled_row(self) -> CompiledRow | None:
        """``observe`` in one call, of the weights as they are now; None where the parts have no such call."""
        evidence, of = self.detection, self._row_of
        now = self.model.network_, evidence.detector_ if isinstance(evidence, EvidenceDetection) else None, self.skills_
        if of is None or of[0] is not now[0] or of[1] is not now[1] or of[2] is not now[2]:
            self._row, self._row_of = CompiledRow.of(self.model, self.detection), now
        return self._row

    def initial_state(self, batch: int = 1, told: Sequence[Told] = ()) -> MonitorState:
        state = super().initial_state(batch, told)
        state = state._replace(values=self.values_.start(batch))
        if self._excuses is not None:
            state = state._replace(knock=self._excuses.start(batch))
        return state if self.skill_ is None else state._replace(skill=self.skill_.monitor.initial_state(batch))

    def reset_evidence(self, state: MonitorState) -> MonitorState:
        state = super().reset_evidence(state)._replace(values=self.values_.reset(state.values))
        return state if self.skill_ is None else state._replace(skill=self.skill_.monitor.reset_evidence(state.skill))

    @property
    def learned_(self) -> dict[str, NDArray[Any]]:
        found = super().learned_ | self.values_.arrays
        return found if self.skill_ is None else found | self.skill_.arrays

    def restore(self, saved: Checkpoint) -> Self:
        own, skill = apart(saved._replace(arrays=unpacked(saved.arrays)))
        own, values = apart(own, VALUES)
        super().restore(own)
        self.skill_ = SkillSurprise.found(self.spec, skill, self.seed) if skill else None
        self.values_ = Values.found(self.spec, values, self.seed, self.urdf)
        if self.alarm_on != "body" and self.skill_ is None:
            raise ValueError(f"the checkpoint alarms on {shown(self.alarm_on)} surprise, and holds no skills")
        check_choice("alarm_on", self.alarm_on, ALARMS_ON)
        return self

    def _learn(self, episodes: Sequence[Episode], progress: Progress, warm_start: bool) -> None:
        self.skill_ = None  # it was weighed against the memory as it was
        super()._learn(episodes, progress, warm_start)
        self.values_ = Values.learned(episodes, self.seed, self.urdf) if self.values else Values()

    def learn_ceilings(self, episodes: Sequence[Episode]) -> Self:
        """As every monitor of evidence does; skills are then to be learned anew."""
        super().learn_ceilings(episodes)
        self.skill_ = None  # it was weighed against the memory as it was
        self.about = {name: value for name, value in self.about.items() if name != "alarm_on"}
        return self

    def _set_threshold(self, scores: Sequence[Surprise], asked: Asked, each: Sequence[str]) -> None:
        super()._set_threshold(scores, asked, each)
        if self.skill_ is not None:
            self.skill_ = self.skill_.heard(scores, self.spec.dt)

    @property
    def alarm_on(self) -> str:
        """Which surprise ``value`` and an alarm go by; one of ``ALARMS_ON``."""
        return str(self.about.get("alarm_on", "body"))

    def learn_skills(self, episodes: Sequence[Episode]) -> Self:
        """Learns how the skills of the policy that is guarded go on, so that each row has a skill surprise too.

        The surprise of the body, its threshold and its alarms stay as they are: ``with_alarm_on`` chooses others.

        Args:
            episodes: nominal ones, of one skill or many; those of ``fit`` will do.

        Raises:
            RuntimeError: the memory has not learned anything yet.
            ValueError: as ``fit``; or there are more channels than can be weighed against all traces.
        """
        self._check(episodes)
        body = self.with_alarm_on("body")
        body.skill_ = None
        self.skill_ = SkillSurprise.learned(episodes, body.score_episodes(episodes), self.seed)
        self.threshold_, self.maxima_, self.about = body.threshold_, body.maxima_, body.about
        self.blocks_, self.promised_ = body.blocks_, body.promised_
        self._remember(episodes)
        return self

    def with_alarm_on(self, which: str) -> Self:
        """The same memory with alarms on another surprise; this one keeps its own.

        ``"body"`` is what no body does, ``"skill"`` what no skill that was shown does; ``"either"`` goes by the larger
        of the two, and ``"both"`` by the smaller. Each has the threshold of the rate that ``calibrate`` was given, and
        none where the skills were learned after it.

        Raises:
            ValueError: an unknown name; the message lists what exists.
            RuntimeError: the skills have not been learned yet: ``learn_skills`` comes first.
        """
        check_choice("alarm_on", which, ALARMS_ON)
        other = self._copy()
        if which == self.alarm_on:
            return other
        if self.skill_ is None:
            raise RuntimeError(f"alarm_on={which!r} takes a skill surprise: call learn_skills(episodes) first")
        other.about = {**self.about, "alarm_on": which}
        known = self.threshold_, self.maxima_, self.blocks_, self.promised_
        other.threshold_, other.maxima_, other.blocks_ = self.skill_.calibrated(which, *known)
        return other

    def with_budget(self, budget: float) -> Self:
        """The same memory with as many steps of inference a row as ``budget`` steps a second allow.

        It has no threshold: ``calibrate`` sets that of what it expects now. By traces a row that is seen takes no step.

        Raises:
            ValueError: a row would have none.
            RuntimeError: the memory has not learned anything yet.
        """
        self._fitted()
        other = self._copy()
        most = iterations_within(budget, self.spec.dt * self.model.lag)  # one row in l is inferred
        other.iterations = min(most, MOST_ITERATIONS)
        other.model.schedule = self.model.schedule._replace(iterations=other.iterations)
        other.model.network_ = self.model.network.with_iterations(other.iterations)
        other._uncalibrate()
        return other

    def for_stream(self, spec: StreamSpec) -> Self:
        """A smaller memory, for a stream that lacks channels of this one; those that are left stand in for them.

        Commands that it does not know, as those of another controller, are not looked at. The threshold is this one's,
        whose promise was not made for fewer senses: ``calibrate`` makes it anew.

        Args:
            spec: of that stream; its channels may stand in another order.

        Raises:
            ValueError: it has senses that this memory never met (the message names them), or another rate; the memory
                has lost channels before.
            RuntimeError: the memory has not learned anything yet, or alarms on skills, which takes all senses.
        """
        self._fitted()
        if self.alarm_on != "body":
            raise RuntimeError('skill surprise takes all senses: with_alarm_on("body") does with fewer')
        evidence = self.detections["evidence"]
        assert isinstance(evidence, EvidenceDetection)
        other = type(self)(spec, **self.get_params())
        other.model, kept = self.model.fewer(spec)
        other.detection = evidence.fewer(spec, kept.left, kept.widened, kept.narrower)
        other.detections = {other.detection.name: other.detection}
        other.threshold_, other.about = self.threshold_, self.about
        other._prepare()
        return other

    def name_skills(self, episodes: Sequence[Episode]) -> Self:
        """Learns to tell which skill is running, from episodes that say it.

        ``info["skill"]`` is the skill of a whole episode. Of one in which skills follow each other, ``info["skills"]``
        names them in order, and ``info["changed"]`` says in which row each next one begins (a number, or a list of
        them). A change is followed sooner by who was shown some.

        Only ``surprise.skill`` depends on it: neither the weights nor the surprise do.

        Raises:
            ValueError: an episode says none, or rows in which nothing can change; or all say the same.
        """
        self._check(episodes)
        with threadpool_limits(1):
            self.model.name_skills(episodes, np.random.default_rng(self.seed))
        return self

    def skills(self, stream: NDArray[np.floating[Any]]) -> NDArray[np.str_]:
        """(T,) the skill that seems to run in each step of a stream (T, D), by what came before.

        Raises:
            RuntimeError: no skill has a name: ``name_skills`` comes first.
        """
        if not self.skills_:
            raise RuntimeError("no skill has a name yet: call name_skills(episodes) first")
        return self.model.skills(stream)

    @typed
    def adapt(
        self,
        before: MonitorState,
        stream: NDArray[np.floating[Any]],
        surprise: Surprise,
        rate: float = 0.1,
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
        rate = check_number("rate", rate, above=0.0, high=1.0)
        below = check_number("below", below, above=0.0, high=1.0)
        quiet = surprise.value < below * self.threshold
        return self.model.adapt(before.model, self._rows(before, stream), quiet, rate)

    def learn_to_act(self, episodes: Sequence[Episode], units: int = 512) -> Self:
        """Learns what to command in which situation, so that ``NeuralASMPolicy`` can act by it.

        Only ``expected_action`` depends on it: neither the other weights nor the surprise do.

        Args:
            episodes: whose ``actions`` say what was intended; where they are empty, the stream says what was commanded.
            units: hidden units of the motor association.
        """
        self._check(episodes)
        with threadpool_limits(1):
            self.model.learn_to_act(episodes, units, np.random.default_rng(self.seed))
        return self

    def expected_action(self, state: MonitorState) -> NDArray[np.float32]:
        """(B, A) the motor prediction: what is likely to be commanded next, in the units of the action.

        That of the motor association, where ``learn_to_act`` made one; else that of the state.

        Args:
            state: as ``observe`` handed it back.
        """
        return self.model.expected_action(state.model)

    def recall(self, cue: NDArray[np.floating[Any]], steps: int) -> NDArray[np.float64]:
        """What comes after a cue, from memory alone: (steps, D) rows in the units of the stream.

        Actions are the memory's own motor predictions. Fit with ``free_running_probability`` above 0 to make it
        learn to run on.

        Args:
            cue: (T, D) the first rows of an episode, at least a tenth of a second and 2 rows.
            steps: how many rows to recall.

        Raises:
            ValueError: the cue is too short, not finite, or of another width; fewer than one step, or more than a
                million.
        """
        self._fitted()
        return self.model.recall(cue, steps)

    def _check(self, episodes: Sequence[Episode]) -> None:
        """Refuses to go on without a model, or with episodes that cannot be learned from."""
        self._fitted()
        check_nominal(episodes, self.spec, self.model.shortest)
