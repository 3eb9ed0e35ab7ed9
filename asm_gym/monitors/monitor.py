"""A monitor: a model, a detection on its errors, a threshold from nominal episodes, and a file to keep them in."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from asm_gym.checkpoint import Checkpoint, write_checkpoint
from asm_gym.contact_limits import healthy_forces
from asm_gym.detection import Detection, EvidenceDetection, ModelOutput, Nominal
from asm_gym.detection.conformal import HOUR
from asm_gym.detection.events import Excuses
from asm_gym.detection.tails import FEWEST_EPISODES
from asm_gym.episode import Episode
from asm_gym.familiar_speed import FamiliarSpeed
from asm_gym.monitors.base import Model, Progress, Specialises, State, Surprise, Told
from asm_gym.monitors.blindness import require_sight
from asm_gym.monitors.ceilings import worst_of
from asm_gym.monitors.doubt import LOG, doubt_crashes
from asm_gym.monitors.monitor_file import SavedMonitor, calibration_arrays
from asm_gym.monitors.overlap import Marks, check_fresh, marks, shares, sketch
from asm_gym.monitors.packing import packed, unpacked
from asm_gym.monitors.promise import Asked
from asm_gym.monitors.stream_model import ErrorPlaces, batch_of, model_outputs, parameter_names, side_by_side
from asm_gym.monitors.threshold import Calibrated
from asm_gym.monitors.training_data import check_nominal
from asm_gym.validation import check_choice, check_flag, check_number, shown, typed


class MonitorState(NamedTuple):
    """What is carried from step to step, one row a stream; a value, never changed in place."""

    model: State
    detection: State
    skill: State = ()  # of what listens for skills, where there is one
    knock: State = ()  # of what excuses surprise, where it does
    values: State = ()  # of what judges values beside changes, where there is one


class CalibratedMonitor(Calibrated):
    """Any model under any detection, with a threshold that is conformal on the maxima of nominal episodes.

    Args:
        model: what expects the stream.
        detections: what makes surprise of its errors. The first does; the others are fitted and saved beside it.
        seed: of whatever learning draws.

    Attributes:
        threshold_: what surprise must exceed for an alarm; None before ``calibrate``.
        healthy_: (N,) the most that an arm felt in the calibration episodes, in the order of ``felt_channels`` [N m],
            [N]; contact limits are no less. Empty before, and where the stream senses no such forces.
        familiar_: how fast the hand went at each place in them; None before, and where the stream tells of no hand.
        maxima_: (n,) largest surprise in each episode that ``calibrate`` was given; None before.
        blocks_: the same by the hour, as ``detection.hourly`` counts it; None before, and where it was not kept.
        promised_: ``"episode"`` or ``"hour"``, what the threshold's promise counts by.
        about: whatever else is worth knowing, such as its ``name``; JSON-serialisable, and saved with it.
    """

    model: Model
    _excuses: Excuses | None = None

    def __init__(self, model: Model, *detections: Detection, seed: int = 0) -> None:
        if not detections:
            raise ValueError("a monitor needs a detection, got none")
        self.seed = check_number("seed", seed, low=0, whole=True)
        self.spec, self.model, self.detection = model.spec, model, detections[0]
        self.detections = {d.name: d for d in detections}
        self._uncalibrate()
        self._learned_from: Marks | None = None
        self._ceilings_from: Marks | None = None
        self.about: dict[str, Any] = {}

    def __repr__(self) -> str:
        """Whose it is, and at which threshold it alarms."""
        name = f"{self.about['name']!r}, " if "name" in self.about else ""
        limit = "no threshold" if self.threshold_ is None else f"threshold {self.threshold_:.4g}"
        return f"<{type(self).__name__} {name}{self.spec.source or 'a stream'} at {1 / self.spec.dt:g} Hz, {limit}>"

    @property
    def learned_(self) -> dict[str, NDArray[Any]]:
        """All that ``fit`` has found, by name; empty before."""
        model: Any = self.model
        found = dict(model.state() if hasattr(model, "state") else model.learned_)
        for detection in self.detections.values():
            found |= detection.learned_
        return found

    @property
    def skills_(self) -> tuple[str, ...]:
        """Names of skills, where it was told any."""
        return self.model.skills_

    @typed
    def with_threshold(self, value: float) -> Self:
        """The same monitor with another threshold, ``inf`` for none that could be exceeded; this one keeps its own."""
        other = self._copy()
        other.threshold_ = check_number("threshold", value, infinite=True)
        return other

    @typed
    def with_detection(self, detection: str | Detection) -> Self:
        """The same model under another detection: a new one, which needs ``fit``, or the name of one fitted before.

        It has no threshold yet.
        """
        other = self._copy()
        if isinstance(detection, str):
            check_choice(f"detection of this {self._name}", detection, self.detections)
            detection = other.detections[detection]
        other.detection = detection
        other._uncalibrate()
        other.detections[detection.name] = detection
        return other

    def get_params(self) -> dict[str, Any]:
        """The hyperparameters by name, in one order whichever detection is in use."""
        parts = (self.model, *(self.detections[name] for name in sorted(self.detections)))
        found = {n: getattr(p, n) for p in parts for n in parameter_names(type(p)) if n != "seed"}
        return found | {"seed": self.seed}

    @typed
    def fit(self, episodes: Sequence[Episode], progress: Progress | None = None, *, warm_start: bool = False) -> Self:
        """Learns from whole nominal episodes of any number of skills; no labels.

        Args:
            episodes: of this spec.
            progress: called as ``progress(done, total)`` while learning.
            warm_start: go on from what it knows, for a model that can specialise: 10 to 50 episodes are enough then.
                How its errors become evidence stays as it is, for so few do not tell how bad the usual can be.

        Raises:
            ValueError: no episode, one that is too short or of another spec, or a number that is not finite.
            TypeError: the model cannot go on from what it knows.
            RuntimeError: it is to go on, and knows nothing yet.
        """
        if check_flag("warm_start", warm_start):
            if not isinstance(self.model, Specialises):
                raise TypeError(f"a {self._name} learns all anew: leave warm_start out")
            self._fitted()
        check_nominal(episodes, self.spec, self.model.shortest)
        new = self._copy()  # whatever interrupts leaves this one as it was
        new._learn(episodes, progress or (lambda done, total: None), warm_start)
        new.about = {**self.about, "specialised_on": len(episodes)} if warm_start else {}
        vars(self).update(vars(new))
        return self

    def _learn(self, episodes: Sequence[Episode], progress: Progress, warm_start: bool) -> None:
        rng, one_in = np.random.default_rng(self.seed), self.model.held_out
        order = rng.permutation(len(episodes)) if one_in else np.arange(len(episodes))
        kept = len(episodes) // one_in if one_in else 0
        held_out, learned = ([episodes[i] for i in part] for part in (order[:kept], order[kept:]))
        self._uncalibrate()
        if not warm_start:
            self._learned_from = self._ceilings_from = None
        self._remember(episodes)
        # One thread: products this small are slowed down by several, and ruined by several that share a core.
        with threadpool_limits(1):
            if warm_start and isinstance(self.model, Specialises):
                self.model.specialise(episodes)
                self._prepare()
                return
            self.model.fit(learned, rng, progress)
            self._prepare()
            nominal = Nominal(episodes, learned, held_out or learned, self._outputs)
            for detection in self.detections.values():
                taken = self.model.learned_.keys() & set(detection.arrays)
                if taken:
                    raise ValueError(f"{self.model.kind} and {detection.name} both learn {', '.join(sorted(taken))}")
                detection.fit(nominal, rng)

    @typed
    def learn_ceilings(self, episodes: Sequence[Episode]) -> Self:
        """Learns from healthy hours how far each sense goes at its worst, so that rare alarms are as rare in each.

        What it was fitted to, babbling say, tells less of hours than hours do. It has no threshold then: ``calibrate``
        it on other hours of the same policies and tasks.

        Args:
            episodes: healthy ones that ``fit`` has not seen, 100 at least, and one hit or so in each 50 at most.

        Raises:
            ValueError: too few, or bad ones; such as overlap, or as ``fit`` has learned from.
            TypeError: its detection is not that of evidence.
        """
        self._fitted()
        if not isinstance(self.detection, EvidenceDetection):
            raise TypeError(f"the detection {self.detection.name} has no ceilings: learn those of evidence")
        check_nominal(episodes, self.spec, self.model.shortest)
        if len(episodes) < FEWEST_EPISODES:
            raise ValueError(f"ceilings take {FEWEST_EPISODES} healthy episodes or more, got {len(episodes)}")
        check_fresh(episodes, self._learned_from)
        with threadpool_limits(1):
            maxima = worst_of(self.model, self.detection, self._excuses, episodes)
        new = self._copy()
        told = self.detection.with_ceilings(maxima, anew=self._ceilings_from is None)
        new.detection = new.detections[told.name] = told
        new._ceilings_from = sketch(episodes)
        new._uncalibrate()
        vars(self).update(vars(new))
        return self

    @typed
    def calibrate(
        self,
        episodes: Sequence[Episode],
        false_alarm_rate: float | None = None,
        *,
        false_alarms_per_hour: float | None = None,
        each: Sequence[str] = (),
    ) -> Self:
        """Sets the threshold from nominal episodes that ``fit`` has not seen, for one of two promises.

        What it finds is kept, so that ``threshold_at`` knows the threshold of every other rate too.

        Args:
            episodes: at least ``conformal_episodes(false_alarm_rate)`` of them: 99 for 0.01, 19 for 0.05; or together
                one hour for each false alarm in so many: 10 hours for 0.1 an hour.
            false_alarm_rate: P(any alarm in a nominal episode), at most; ``promise`` says how surely.
            false_alarms_per_hour: alarms in an hour of nominal episodes, at most, on average. One that persists, or
                comes back within a minute of the same episode, is one alarm.
            each: of each episode the task, or whose policy it is. Then the promise holds in each of them, by the
                greatest threshold that one needs; without it, over all of them together, and of one nothing is said.

        Raises:
            ValueError: too few episodes or hours for this rate (the message says which they can promise), or bad ones;
                by the hour also episodes that overlap, or that ``fit`` has learned from, which are only said where the
                rate is per episode. Or not one rate, but none or both.
        """
        self._fitted()
        asked = Asked.of(false_alarm_rate, false_alarms_per_hour)  # refuses a bad rate before the work begins
        check_nominal(episodes, self.spec, self.model.shortest)
        if each and len(each) != len(episodes):
            raise ValueError(f"each must name one group an episode, got {len(each)} for {len(episodes)} episodes")
        asked.check_hours(sum(map(len, episodes)) * self.spec.dt / 3600)
        try:
            check_fresh(episodes, self._learned_from, self._ceilings_from)
        except ValueError as error:
            if asked.per == HOUR:
                raise
            LOG.warning("%s; the promise by the episode does not hold for these", error)
        scores = self.score_episodes(episodes)
        self._set_threshold(scores, asked, each)
        doubt_crashes(episodes, [s.value for s in scores], self.threshold, asked, each)
        streams = [episode.stream for episode in episodes]
        self.healthy_ = healthy_forces(streams, self.spec)
        self.familiar_ = FamiliarSpeed.learned(streams, self.spec)
        return self

    @typed
    def knows(self, episode: Episode) -> bool:
        """Whether a stretch of it was learned from, by ``fit`` or ``learn_ceilings``: no promise is made of it."""
        return shares(marks(episode), self._learned_from, self._ceilings_from)

    def _check_threshold(self, threshold: float) -> None:
        """Raises ValueError where no fault of some channel could pass it."""
        require_sight(self.detection, self.model.error_columns, self.spec, threshold)

    @typed
    def initial_state(self, batch: int = 1, told: Sequence[Told] = ()) -> MonitorState:
        """The state before the first row of ``batch`` streams.

        Args:
            told: of each its skill and goal, as ``info`` of an episode says them, for a model that has to be told;
                others do not look.
        """
        check_number("batch", batch, low=1, whole=True)
        self._fitted()
        return MonitorState(self.model.start(batch, told), self.detection.start(batch, len(self.model.error_columns)))

    def observe(self, state: MonitorState, stream: NDArray[np.floating[Any]]) -> tuple[MonitorState, Surprise]:
        """The next row of each stream: the new state, and how surprising the row was.

        A number that is not finite makes the value and its own attribution infinite; it counts as unseen, so that
        later rows can be judged again.

        Args:
            state: as handed back last; it is not changed.
            stream: (B, D) one row a stream.
        """
        self._fitted()
        rows = self._rows(state, stream)
        model, output = self.model.predict(state.model, rows)
        detection, attribution = self.detection.attribute_step(state.detection, output, rows, self._places)
        finite = np.isfinite(rows)
        broken = ~finite.all(axis=1)
        if broken.any():
            attribution[broken] = np.where(finite[broken], 0.0, np.inf)
        return MonitorState(model, detection), Surprise(attribution.sum(axis=1), attribution)

    @typed
    def reset_evidence(self, state: MonitorState) -> MonitorState:
        """The state with the evidence so far forgotten, after an alarm that was acted on; the model goes on."""
        return state._replace(detection=self.detection.reset(state.detection))

    @typed
    def score(self, episode: Episode) -> Surprise:
        """The surprise of each step of an episode: value (T,), attribution (T, D); no names of skills."""
        return self.score_episodes([episode])[0]

    def score_episodes(self, episodes: Sequence[Episode]) -> list[Surprise]:
        """``score`` for many episodes, which are run side by side."""
        for episode in episodes:
            self.spec.require(episode.spec, "the episode")
        self._fitted()
        scores: list[Surprise] = [Surprise(np.zeros(0), np.zeros((0, self.spec.size)))] * len(episodes)
        with threadpool_limits(1):
            for group, steps in side_by_side(episodes, self.initial_state, self.observe):
                for n, i in enumerate(group):
                    mine = steps[: len(episodes[i])]
                    value, attribution = (np.array([s[k][n] for s in mine]) for k in range(2))
                    scores[i] = Surprise(value, attribution.reshape(-1, self.spec.size))
                    if mine and mine[0].raw is not None:
                        raw, excuse = np.array([(s.raw[n], s.excuse[n]) for s in mine]).T
                        scores[i] = scores[i]._replace(raw=raw, excuse=excuse.astype(np.int8))
                    if mine and mine[0].of_skill is not None:
                        body, skill = np.array([[part[n] for part in s.parts] for s in mine]).T
                        scores[i] = scores[i]._replace(of_body=body, of_skill=skill)
        return scores

    @typed
    def save(self, path: str | Path) -> None:
        """Writes everything learned to one file: arrays and JSON."""
        self._fitted()
        learned = {n: a if a.dtype.kind == "f" else np.asarray(a, np.float64) for n, a in self.learned_.items()}
        arrays = {**learned, **calibration_arrays(self.maxima_, self.blocks_, self._learned_from, self._ceilings_from)}
        header = {
            "spec": self.spec.to_json(),
            "hyperparameters": self.get_params(),
            "detection": self.detection.name,
            "threshold": self.threshold_,
            "promised": self.promised_,
            "skills": list(self.skills_),
            "about": self.about,
            "healthy": list(self.healthy_),
            "familiar": [] if self.familiar_ is None else self.familiar_.rows,
            "shapes": {name: list(array.shape) for name, array in arrays.items()},
        }
        write_checkpoint(path, self.model.kind, header, packed(arrays))

    def restore(self, saved: Checkpoint) -> Self:
        """Takes what ``save`` wrote of a monitor of the same spec, model and hyperparameters.

        A file may hold several detections; where it was calibrated for another one than this, it has no threshold here.

        Raises:
            ValueError: something is missing, or does not fit together.
        """
        found = SavedMonitor.of(saved._replace(arrays=unpacked(saved.arrays)))
        theirs = {n for d in self.detections.values() for n in d.arrays}
        missing = [n for n in self.detection.arrays if n not in found.arrays]
        if missing:
            raise ValueError(f"the checkpoint has no {', '.join(missing)}, so fit it anew")
        self.model.restore({n: a for n, a in found.arrays.items() if n not in theirs}, found.skills)
        self._prepare()
        for detection in self.detections.values():
            if found.arrays.keys() >= set(detection.arrays):
                detection.restore({n: found.arrays[n] for n in detection.arrays})
        self.about, self._learned_from, self._ceilings_from = found.about, found.learned_from, found.ceilings_from
        self.familiar_ = FamiliarSpeed.restored(saved.header.get("familiar", []))
        self.healthy_ = tuple(check_number("healthy", value, low=0.0) for value in saved.header.get("healthy", ()))
        if found.detection == self.detection.name:
            self.threshold_, self.promised_ = found.threshold_below(self.detection.reach), found.promised
            self.maxima_, self.blocks_ = found.maxima, found.blocks
        return self

    @property
    def _name(self) -> str:
        return f"{self.model.kind} monitor"

    def _copy(self) -> Self:
        """Another that nothing this one learns from now on can reach; learned arrays are never changed in place."""
        other = copy.copy(self)
        other.model = copy.copy(self.model)
        other.detections = {name: copy.copy(d) for name, d in self.detections.items()}
        other.detection = other.detections[self.detection.name]
        return other

    def _remember(self, episodes: Sequence[Episode]) -> None:
        """That these were learned from, so that no promise by the hour is made of them."""
        before = np.zeros(0) if self._learned_from is None else self._learned_from
        self._learned_from = np.union1d(before, sketch(episodes))

    def _fitted(self) -> None:
        if not self.model.learned_ or (self.detection.arrays and not self.detection.learned_):
            raise RuntimeError(f"this {self._name} has learned nothing yet: call fit(episodes) first")

    def _rows(self, state: MonitorState, stream: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
        """(B, D) the rows, of a layout that compiled code knows."""
        if not isinstance(state, MonitorState):
            raise TypeError(f"state must be what initial_state or observe gave, got {shown(state)}")
        try:
            rows = np.ascontiguousarray(stream, np.float64)
        except (TypeError, ValueError, OverflowError) as error:
            raise ValueError(f"stream must be rows of numbers, got {shown(stream)}") from error
        batch = batch_of(state)
        if rows.shape != (batch, self.spec.size):
            self.spec.check_row(rows)
            raise ValueError(f"stream must have the shape {(batch, self.spec.size)}, got {rows.shape}")
        return rows

    def _outputs(self, episodes: Sequence[Episode]) -> list[ModelOutput]:
        return model_outputs(self.model, episodes)

    def _prepare(self) -> None:
        """Where each error belongs in the stream, once the model knows."""
        self._places = ErrorPlaces(self.model.error_columns, self.spec)
