"""A model with a detection on its errors: it learns from nominal episodes, and scores rows."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from asm_gym.data.episode import Episode
from asm_gym.data.log_comparison import refuse_other_scales
from asm_gym.detection import Detection, ModelOutput, Nominal
from asm_gym.detection.base import Arrays
from asm_gym.exceptions import NotFitted
from asm_gym.monitors.monitor_protocol import Progress, State, Surprise
from asm_gym.monitors.monitor_state import MonitorState, checked_rows, surprise_of_stream
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
    check_nominal,
    hashes_of,
    with_held_out,
)
from asm_gym.validation import check_flag, check_number, typed


class LearnedMonitor:
    """Combine a model with a detection.

    Args:
        model: predicts the stream.
        detection: computes surprise from its errors.
        seed: of all random draws while learning.

    Attributes:
        about: JSON values to save with it, such as its ``name``.
        learned_from_: hashes of the episodes of ``fit``; None before.
        ceilings_from_: hashes of the episodes of ``calibrate`` that set ceilings; None before, or without such.
        readings_: (3, X) least, most and greatest step of each sense in the episodes of ``fit`` and ``calibrate``; None
            where no reading is judged by it (``detection.misreadings``).
    """

    model: StreamModel
    readings_: NDArray[np.floating[Any]] | None

    def __init__(self, model: StreamModel, detection: Detection, seed: int = 0) -> None:
        self.seed = check_number("seed", seed, low=0, whole=True)
        self.spec = model.spec
        self.model = model
        self.detection = detection
        self._uncalibrate()
        self.readings_ = None
        self.learned_from_: Hashes | None = None
        self.ceilings_from_: Hashes | None = None
        self.about: dict[str, Any] = {}

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
        """Forget what was set by what was learned before."""

    @property
    def _name(self) -> str:
        return f"{self.model.kind} monitor"

    def _become(self, new: Self) -> None:
        """Take over everything from a copy that has learned or was calibrated."""
        vars(self).update(vars(new))

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
