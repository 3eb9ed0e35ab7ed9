"""A monitor: a model, a detection on its errors, a threshold from nominal episodes, and its file."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from asm_gym.checkpoint import Checkpoint
from asm_gym.data.action_meaning import ACTIONS, ActionMeaning
from asm_gym.data.episode import Episode
from asm_gym.data.log_comparison import refuse_other_scales
from asm_gym.detection import Blocks, Detection, EvidenceDetection, ModelOutput, Nominal
from asm_gym.detection.base import Arrays
from asm_gym.detection.commands import healthy_commands, learned_motion
from asm_gym.detection.conformal import EPISODE, HOUR, Promise, hourly_promise
from asm_gym.detection.contact_limits import healthy_forces
from asm_gym.detection.hand_speed_map import HandSpeedMap
from asm_gym.detection.healthy_ranges import healthy_ranges
from asm_gym.exceptions import NotFitted
from asm_gym.monitors.calibration import (
    AlarmRate,
    blocks_of_incidents,
    ceiling_episodes,
    require_sight,
    with_ceilings,
)
from asm_gym.monitors.monitor_files import read_monitor, threshold_below, write_monitor
from asm_gym.monitors.monitor_protocol import Progress, State, Surprise
from asm_gym.monitors.monitor_state import MonitorState, checked_rows, surprise_of_stream
from asm_gym.monitors.robot_limits import MARGIN, RobotLimits, limits_of
from asm_gym.monitors.stream_model import (
    StreamModel,
    error_shares,
    model_outputs,
    parameter_names,
    require_arrays,
    side_by_side,
)
from asm_gym.monitors.training_data import (
    Hashes,
    about_episodes,
    check_fresh,
    check_nominal,
    hashes_of,
    with_held_out,
)
from asm_gym.validation import check_flag, check_number, typed


class CalibratedMonitor:
    """Combine a model with a detection, and set a conformal threshold from the maxima of nominal episodes.

    Args:
        model: predicts the stream.
        detection: computes surprise from its errors.
        seed: of all random draws while learning.

    Attributes:
        about: JSON values to save with it, such as its ``name``.
        learned_from_: hashes of the episodes of ``fit``; None before.
        ceilings_from_: hashes of the episodes of ``calibrate`` that set ceilings; None before, or without such.
        threshold_: surprise above which a row is an alarm; None before ``calibrate``, as are the next two.
        maxima_: (n,) largest surprise in each calibration episode.
        blocks_: surprise in blocks of time, for promises by the hour (``detection.conformal``).
        promised_: ``"episode"`` or ``"hour"``, the unit of the promise.
        healthy_: (N,) largest force of each of ``felt_channels`` in these episodes [N m], [N], a lower bound of contact
            limits; empty if the stream has no such channels.
        pace_: by task, (N, 16) speed of the hands in these episodes by place and direction; see ``HandSpeedMap``.
        motion_: how hands move by commands (``detection.commands``); None without hands.
        commands_: (3, A) least, most and greatest step of the commands of these episodes; None without.
        ranges_: (8, D) how far each number went in these episodes (``detection.healthy_ranges``); None in files of
            earlier versions.
        wear_: (4, M) how much senses drift between these episodes (``detection.drift``); None without.
    """

    model: StreamModel
    threshold_: float | None
    maxima_: NDArray[np.float64] | None
    blocks_: Blocks | None
    healthy_: tuple[float, ...]
    pace_: dict[str, NDArray[np.float32]]
    motion_: NDArray[np.floating[Any]] | None
    commands_: NDArray[np.floating[Any]] | None
    ranges_: NDArray[np.floating[Any]] | None
    wear_: NDArray[np.floating[Any]] | None

    def __init__(self, model: StreamModel, detection: Detection, seed: int = 0) -> None:
        self.seed = check_number("seed", seed, low=0, whole=True)
        self.spec = model.spec
        self.model = model
        self.detection = detection
        self._uncalibrate()
        self.learned_from_: Hashes | None = None
        self.ceilings_from_: Hashes | None = None
        self.about: dict[str, Any] = {}

    def __repr__(self) -> str:
        """Return name, body and threshold in one line."""
        parts = [f"{self.spec.source or 'a stream'} at {1 / self.spec.dt:g} Hz"]
        if "name" in self.about:
            parts.insert(0, repr(self.about["name"]))
        if self.threshold_ is None:
            parts.append("no threshold")
        else:
            parts.append(f"threshold {self.threshold_:.4g}")
        return f"<{type(self).__name__} {', '.join(parts)}>"

    @property
    def learned_(self) -> dict[str, NDArray[Any]]:
        """All arrays that ``fit`` has learned, by name; empty before."""
        return {**self.model.learned_, **self.detection.learned_}

    @property
    def skills_(self) -> tuple[str, ...]:
        """Names of the skills it knows."""
        return self.model.skills_

    def get_params(self) -> dict[str, Any]:
        """Return the hyperparameters by name."""
        params: dict[str, Any] = {}
        for part in (self.model, self.detection):
            names = parameter_names(type(part))
            params |= {name: getattr(part, name) for name in names if name != "seed"}
        return params | {"seed": self.seed}

    @typed
    def with_threshold(self, value: float) -> Self:
        """Return a copy with another threshold, ``inf`` for no alarm."""
        other = self._copy()
        other.threshold_ = check_number("threshold", value, infinite=True)
        return other

    @typed
    def fit(
        self,
        episodes: Sequence[Episode],
        progress: Progress | None = None,
        *,
        warm_start: bool = False,
    ) -> Self:
        """Learn from nominal episodes of any number of skills, without labels, and return the monitor.

        Args:
            episodes: nominal episodes with this spec.
            progress: called as ``progress(done, total)`` while learning.
            warm_start: continue from the fitted model, for a model that can: 10 to 50 episodes are then enough. The
                detection does not change.

        Raises:
            ValueError: no episode, one that is too short or has another spec, or a number that is not finite.
            TypeError, RuntimeError: with ``warm_start``, the model has no warm start, or is not fitted yet.
        """
        if check_flag("warm_start", warm_start):
            if not hasattr(self.model, "specialise"):
                raise TypeError(f"{self._name} has no warm start: leave warm_start out")
            self._require_fitted()
        check_nominal(episodes, self.spec, self.model.shortest)
        refuse_other_scales(episodes)
        new = self._copy()  # an interrupt leaves this one as it was
        new._learn(episodes, progress or (lambda done, total: None), warm_start)
        about = about_episodes(episodes, with_actions=not warm_start)
        if warm_start:
            about = {**self.about, "specialised_on": len(episodes), **about}
        new.about = about
        self._become(new)
        return self

    def _learn(self, episodes: Sequence[Episode], progress: Progress, warm_start: bool) -> None:
        """Learn from episodes, in place: anew, or on from what is learned with ``warm_start``."""
        self._uncalibrate()
        hashes = hashes_of(episodes)
        if warm_start and self.learned_from_ is not None:
            hashes = np.union1d(self.learned_from_, hashes)
        self.learned_from_ = hashes

        with threadpool_limits(1):  # products this small are slower on several threads
            if warm_start:
                model: Any = self.model
                model.specialise(episodes)
                self._place_errors()
                return
            self.ceilings_from_ = None
            self._learn_anew(episodes, progress)

    def _learn_anew(self, episodes: Sequence[Episode], progress: Progress) -> None:
        """Fit the model, and then the detection on the model's errors."""
        rng = np.random.default_rng(self.seed)
        learned, held_out = with_held_out(episodes, self.model.held_out, rng)
        self.model.fit(learned, rng, progress)
        self._place_errors()
        nominal = Nominal(episodes, learned, held_out, self._nominal_outputs)
        shared_names = self.model.learned_.keys() & set(self.detection.arrays)
        if shared_names:
            names = ", ".join(sorted(shared_names))
            raise ValueError(f"{self.model.kind} and {self.detection.name} both learn {names}")
        self.detection.fit(nominal, rng)
        self.model.crossfitted = {}

    def _nominal_outputs(self, episodes: Sequence[Episode]) -> list[ModelOutput]:
        """Return the model's outputs, with the cross-fitted errors of the episodes that it has learned."""
        outputs = []
        for episode, output in zip(episodes, model_outputs(self.model, episodes), strict=True):
            errors = self.model.crossfitted.get(id(episode), output.errors)
            outputs.append(output._replace(errors=errors))
        return outputs

    @typed
    def calibrate(
        self,
        episodes: Sequence[Episode],
        false_alarm_rate: float | None = None,
        *,
        false_alarms_per_hour: float | None = None,
        each: Sequence[str] = (),
    ) -> Self:
        """Set the threshold from nominal episodes that ``fit`` has not seen, and return the monitor.

        Give one rate; ``threshold_at`` returns the threshold of any other rate. If fewer than five of
        the episodes' maxima may exceed the threshold, their tail is modelled, and
        ``promise.modelled`` is true.

        With evidence detection and 300 episodes or more, a third of them (a tenth, if the rate needs
        more of the others) sets ceilings: how far each sense goes at its worst. The others set the
        threshold. Without ceilings fewer faults are found.

        Args:
            episodes: at least 99 for a rate of 0.01 and 19 for 0.05; or 10 hours for 0.1 alarms an
                hour.
            false_alarm_rate: largest probability of an alarm in a nominal episode, in (0, 1).
            false_alarms_per_hour: largest mean number of incidents in an hour of nominal episodes
                (``detection.incidents``).
            each: task or policy of each episode, to keep the promise in each of them.

        Raises:
            ValueError: too few episodes or hours for this rate (the message names the rate that they can
                promise), bad episodes, not exactly one rate, an episode that was given to ``fit``,
                or one that is given twice.
        """
        self._require_fitted()
        rate = AlarmRate.of(false_alarm_rate, false_alarms_per_hour)
        check_nominal(episodes, self.spec, self.model.shortest)
        if each and len(each) != len(episodes):
            raise ValueError(
                "each must name a group for each episode, "
                f"got {len(each)} for {len(episodes)} episodes"
            )
        rate.check_hours(sum(map(len, episodes)) * self.spec.dt / 3600)
        new = self._copy()  # an error leaves this one as it was
        for_ceilings: set[int] = set()  # indices of episodes
        if isinstance(self.detection, EvidenceDetection):
            for_ceilings = ceiling_episodes(episodes, rate, each)
        if for_ceilings:
            check_fresh(episodes, self.learned_from_)
            new._set_ceilings([episodes[n] for n in sorted(for_ceilings)])
        else:  # earlier ceilings stay
            check_fresh(episodes, self.learned_from_, self.ceilings_from_)

        for_threshold = [e for n, e in enumerate(episodes) if n not in for_ceilings]
        groups = [group for n, group in enumerate(each) if n not in for_ceilings]
        new = new._balanced(for_threshold, rate)
        new._set_threshold(for_threshold, rate, groups)
        new._keep_healthy_ranges(episodes)
        self._become(new)
        return self

    def _become(self, new: Self) -> None:
        """Take over everything from a copy that has learned or was calibrated."""
        vars(self).update(vars(new))

    def _set_ceilings(self, episodes: Sequence[Episode]) -> None:
        """Set the ceilings of the detection by healthy episodes."""
        self.detection = with_ceilings(self, episodes)
        self.ceilings_from_ = hashes_of(episodes)

    def _set_threshold(
        self, episodes: Sequence[Episode], rate: AlarmRate, groups: Sequence[str]
    ) -> None:
        """Set the threshold for a rate of alarms in these episodes, and in each of their groups."""
        surprises = self._calibration_scores(episodes)
        values = [surprise.value for surprise in surprises]
        blocks = Blocks.of(values, self.spec.dt, groups)
        blocks = blocks_of_incidents(blocks, surprises, self, groups)
        self.threshold_ = rate.threshold_of(values, blocks, groups)
        require_sight(self.detection, self.model.error_columns, self.spec, self.threshold_)
        self.promised_ = rate.per
        self.maxima_ = np.array([value.max() for value in values])
        self.blocks_ = blocks

    def _keep_healthy_ranges(self, episodes: Sequence[Episode]) -> None:
        """Keep the forces, speeds, motion and commands of healthy episodes."""
        streams = [episode.stream for episode in episodes]
        self.healthy_ = healthy_forces(streams, self.spec)
        self.pace_ = HandSpeedMap.by_task(episodes, self.spec)
        self.motion_ = learned_motion(streams, self.spec)
        self.commands_ = healthy_commands(streams, self.spec)
        self.wear_ = self._healthy_wear(streams)
        meaning: ActionMeaning | None = None
        if ACTIONS in self.about:
            meaning = ActionMeaning.from_json(self.about[ACTIONS])
        self.ranges_ = healthy_ranges(streams, self.spec, meaning)

    @typed
    def limits(self, margin: float = MARGIN) -> RobotLimits:
        """Return what healthy motion needs, as limits for the robot; raises as ``robot_limits.limits_of`` does."""
        return limits_of(self, margin)

    def _healthy_wear(self, streams: Sequence[NDArray[Any]]) -> NDArray[np.float64] | None:
        """Return how much senses drift between healthy episodes (T, D); None where nothing tells."""
        return None

    @property
    def threshold(self) -> float:
        """Surprise above which a row is an alarm. Raises NotFitted before ``calibrate``."""
        if self.threshold_ is None:
            raise self._lacking("threshold")
        return self.threshold_

    @typed
    def threshold_at(
        self, false_alarm_rate: float | None = None, *, false_alarms_per_hour: float | None = None
    ) -> float:
        """Return the threshold for another rate, from the episodes of ``calibrate``; raises as that does."""
        rate = AlarmRate.of(false_alarm_rate, false_alarms_per_hour)
        if self.maxima_ is None or self.blocks_ is None:
            raise self._lacking("calibration")
        return rate.threshold(self.maxima_, self.blocks_)

    @property
    def promise(self) -> Promise:
        """The promised rate of alarms in nominal operation. Raises NotFitted before ``calibrate``."""
        if self.maxima_ is None or self.blocks_ is None:
            raise self._lacking("calibration")
        if self.promised_ == HOUR:
            return hourly_promise(self.blocks_, self.threshold, len(self.maxima_))
        return Promise.of(self.maxima_, self.threshold)

    def _balanced(self, episodes: Sequence[Episode], rate: AlarmRate) -> Self:
        """Return a copy in which several judgements share the rate in nominal episodes; itself with just one."""
        return self

    def _calibration_scores(self, episodes: Sequence[Episode]) -> list[Surprise]:
        """Return the surprise of the nominal episodes that set the threshold."""
        return self.score_episodes(episodes)

    @typed
    def initial_state(self, batch: int = 1) -> MonitorState:
        """Return the state before the first row of ``batch`` streams."""
        check_number("batch", batch, low=1, whole=True)
        self._require_fitted()
        return MonitorState(
            self.model.start(batch), self.detection.start(batch, len(self.model.error_columns))
        )

    def observe(
        self, state: MonitorState, stream: NDArray[np.floating[Any]]
    ) -> tuple[MonitorState, Surprise]:
        """Return the new state after the next row (B, D) of each stream, and the surprise of the rows.

        A number that is not finite makes the surprise and its own attribution infinite, and counts as missing
        afterwards. The old state does not change.
        """
        self._require_fitted()
        rows = checked_rows(state, stream, self.spec)
        model, output = self.model.predict(state.model, rows)
        detection, surprise = self.judge(state.detection, output, rows)
        return MonitorState(model, detection), surprise

    def judge(
        self, state: State, output: ModelOutput, rows: NDArray[Any]
    ) -> tuple[State, Surprise]:
        """Return the new state of the detection, and the surprise of rows (B, D) by the model's output for them."""
        state, attribution = self.detection.attribute_step(
            state, output, rows, lambda shares: shares @ self._error_shares
        )
        is_finite = np.isfinite(rows)
        incomplete = ~is_finite.all(axis=1)
        attribution[incomplete] = np.where(is_finite[incomplete], 0.0, np.inf)
        return state, Surprise(attribution.sum(axis=1), attribution)

    @typed
    def reset_evidence(self, state: MonitorState) -> MonitorState:
        """Return the state without its evidence, after the response to an alarm; the state of the model stays."""
        return state._replace(detection=self.detection.reset(state.detection))

    @typed
    def score(self, episode: Episode) -> Surprise:
        """Return the surprise of each step of an episode: values (T,), attributions (T, D)."""
        return self.score_episodes([episode])[0]

    def score_episodes(self, episodes: Sequence[Episode]) -> list[Surprise]:
        """Return the ``score`` of each episode; they run in one batch."""
        for episode in episodes:
            self.spec.require(episode.spec, "the episode")
        self._require_fitted()
        scores = [Surprise(np.zeros(0), np.zeros((0, self.spec.size)))] * len(episodes)
        with threadpool_limits(1):
            for group, steps in side_by_side(episodes, self.initial_state, self.observe):
                for stream, index in enumerate(group):
                    own_steps = steps[: len(episodes[index])]
                    if own_steps:
                        scores[index] = surprise_of_stream(own_steps, stream)
        return scores

    @typed
    def save(self, path: str | Path) -> None:
        """Write all that was learned to one file of arrays and JSON, which ``load`` reads."""
        self._require_fitted()
        write_monitor(path, self)

    def restore(self, saved: Checkpoint) -> Self:
        """Take over what ``save`` wrote of a monitor of the same spec, model and hyperparameters.

        Raises:
            ValueError: something is missing, or does not fit together.
        """
        header = saved.header
        kept = read_monitor(saved)
        self.restore_learned(kept.learned, tuple(header["skills"]))
        vars(self).update(kept.attributes)
        self.threshold_ = threshold_below(header["threshold"], self.detection.reach)
        return self

    def restore_learned(self, arrays: Arrays, skills: tuple[str, ...] = ()) -> Self:
        """Take over the arrays that ``learned_`` returned, in place and without a threshold; return the monitor."""
        require_arrays(arrays, self.detection.arrays)
        self._uncalibrate()
        arrays_of_model = dict(arrays)
        own_arrays = {name: arrays_of_model.pop(name) for name in self.detection.arrays}
        self.detection.restore(own_arrays)
        self.model.restore(arrays_of_model, skills)
        self._place_errors()
        return self

    def _uncalibrate(self) -> None:
        """Forget all that ``calibrate`` has set, but for ceilings."""
        self.threshold_ = None
        self.maxima_ = None
        self.blocks_ = None
        self.promised_ = EPISODE
        self.healthy_ = ()
        self.pace_ = {}
        self.motion_ = None
        self.commands_ = None
        self.ranges_ = None
        self.wear_ = None

    @property
    def _name(self) -> str:
        return f"{self.model.kind} monitor"

    def _lacking(self, what: str) -> NotFitted:
        """Return the error of a monitor that is not calibrated. Raises that of one that is not even fitted."""
        self._require_fitted()
        return NotFitted(f"this {self._name}", f"has no {what}", "calibrate(nominal_episodes)")

    def _copy(self) -> Self:
        """Return a copy that shares nothing that learning changes; learned arrays are never changed in place."""
        other = copy.copy(self)
        other.about = copy.deepcopy(self.about)
        other.model = copy.copy(self.model)
        other.detection = copy.copy(self.detection)
        return other

    def _require_fitted(self) -> None:
        """Raise NotFitted before ``fit``."""
        if not self.model.learned_ or (self.detection.arrays and not self.detection.learned_):
            raise NotFitted(f"this {self._name}", "has learned nothing", "fit(episodes)")

    def _place_errors(self) -> None:
        """Compute how each error is shared out to columns, once the model knows which it predicts."""
        self._error_shares = error_shares(self.model.error_columns, self.spec)
