"""A monitor: a model, a detection on its errors, a threshold from nominal episodes, and its file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.checkpoint import Checkpoint
from asm_gym.data.action_meaning import ACTIONS, ActionMeaning
from asm_gym.data.episode import Episode
from asm_gym.detection import Blocks, EvidenceDetection
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
from asm_gym.monitors.learned_monitor import LearnedMonitor
from asm_gym.monitors.monitor_files import read_monitor, threshold_below, write_monitor
from asm_gym.monitors.monitor_protocol import Surprise
from asm_gym.monitors.robot_limits import MARGIN, RobotLimits, limits_of
from asm_gym.monitors.training_data import check_fresh, check_nominal, hashes_of
from asm_gym.validation import check_number, typed


class CalibratedMonitor(LearnedMonitor):
    """Combine a model with a detection, and set a conformal threshold from the maxima of nominal episodes.

    Attributes:
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

    threshold_: float | None
    maxima_: NDArray[np.float64] | None
    blocks_: Blocks | None
    healthy_: tuple[float, ...]
    pace_: dict[str, NDArray[np.float32]]
    motion_: NDArray[np.floating[Any]] | None
    commands_: NDArray[np.floating[Any]] | None
    ranges_: NDArray[np.floating[Any]] | None
    wear_: NDArray[np.floating[Any]] | None

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

    @typed
    def with_threshold(self, value: float) -> Self:
        """Return a copy with another threshold, ``inf`` for no alarm."""
        other = self._copy()
        other.threshold_ = check_number("threshold", value, infinite=True)
        return other

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
        self.commands_ = healthy_commands(streams, self.spec.motor)
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

    def _lacking(self, what: str) -> NotFitted:
        """Return the error of a monitor that is not calibrated. Raises that of one that is not even fitted."""
        self._require_fitted()
        return NotFitted(f"this {self._name}", f"has no {what}", "calibrate(nominal_episodes)")
