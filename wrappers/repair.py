"""Hands the policy what a faulty sense should say: completed from all others, the command and the past."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, SupportsFloat

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import NDArray

from asm_gym.memory.completion import Completion, Filling
from asm_gym.monitors import ExplainsItself, Monitor
from asm_gym.protocols import LaysOutObservations
from asm_gym.spec import StreamSpec
from asm_gym.stream_source import StreamSource
from asm_gym.validation import check_number, shown, typed
from asm_gym.wrappers.factory import check_monitor
from asm_gym.wrappers.hand import HandAgainstJoints
from asm_gym.wrappers.observer import Observer

WELL_AFTER_S = 1.0
"""A sense is well again once it has said what was expected for so long [s]."""

WELL_WITHIN = 4.0
"""Standard deviations of the completion's own error that this may be off."""

UNTOLD = 0.5
"""Nothing else tells of a sense where its completion leaves more than this share of its spread."""

TRUST_S = 1.0
"""Such a sense is completed by its last good value, and for so long at most [s]."""

LONGEST_S = 20.0
"""No sense is completed for longer than this [s]."""

MOST_MISSING = 0.5
"""Where more than this share of the senses is missing, what is left tells too little of them."""

FARTHEST = 6.0
"""No completed number goes further than so many of its spreads from its mean."""


class Repair:
    """Keeps the rows of one stream well: senses that are not believed have precision 0, and are completed.

    Args:
        completion: of the memory that watches the stream.
        trust_s: how long a sense that nothing else tells of is completed [s].
        read: (D,) which columns the policy reads, of whose completion something depends; all where that is not known.
        hands: tell of missing angles better than the memory, and which senses are not to be believed again yet.
    """

    def __init__(
        self,
        completion: Completion,
        trust_s: float = TRUST_S,
        read: NDArray[np.bool_] | None = None,
        hands: Sequence[HandAgainstJoints] = (),
    ) -> None:
        self._completion, spec, self._hands = completion, completion.spec, hands
        self._read = np.ones(spec.size, bool) if read is None else read
        self._spec, self._patience = spec, round(check_number("trust_s", trust_s, low=0) / spec.dt)
        self._well_after, self._longest = max(1, round(WELL_AFTER_S / spec.dt)), round(LONGEST_S / spec.dt)
        self._settle = 2 * completion.senses.lag + 1  # rows in which changes are taken from what was not yet repaired
        self.reset()

    def reset(self) -> None:
        """A new episode begins."""
        self.missing = np.zeros(self._spec.size, bool)
        """(D,) which columns are completed."""
        self.settling = 0
        """Rows until the monitor has seen nothing but repaired rows of a sense that was found at fault."""
        self._returned = np.zeros(self._spec.size, np.int64)  # (D,) rows until its changes are those of the sense again
        self._returning = 0  # the most of them
        self._gone: set[str] = set()  # of those that are missing, which said nothing, and are believed when they do
        self._since: dict[str, int] = {}  # rows for which each has been missing
        self._good: NDArray[np.float64] | None = None  # (D,) the last row before something was missing
        self._before: NDArray[np.float64] | None = None  # (D,) repaired
        self._raw = self._earlier = np.zeros(self._spec.size)
        self._unchecked = 0
        self._calm: dict[str, int] = {}  # rows in which each missing sensor has said what was expected

    @property
    def names(self) -> tuple[str, ...]:
        """The sensors that are completed."""
        return tuple(self._calm)

    @property
    def unread(self) -> tuple[str, ...]:
        """Those of them that the policy does not read: it goes on without them, however long nothing tells of them."""
        if not self._calm:
            return ()
        return tuple(name for name, own in self._completion.sensors if name in self._calm and not self.reads(own))

    def reads(self, columns: NDArray[np.intp]) -> bool:
        """Whether the policy reads one of ``columns``."""
        return bool(self._read[columns].any())

    @property
    def trusted(self) -> bool:
        """Whether the policy can rely on it.

        False once a sense that nothing else tells of is missing for long, any for very long, or too many at a time.
        """
        if not self._calm:  # as nearly always
            return self._unchecked <= self._patience
        sensory = self._spec.sensory
        few = self.missing[sensory].mean() <= MOST_MISSING if len(sensory) else True
        return bool(few and self._unchecked <= self._patience and max(self._since.values(), default=0) <= self._longest)

    @property
    def judged(self) -> bool:
        """Whether every number is."""
        return not (self._calm or self._returning)

    @property
    def calm(self) -> bool:
        """Whether there is nothing to do about a row that is whole."""
        return self.judged and not self.settling and self.trusted

    def passed(self, rows: Sequence[NDArray[np.floating[Any]]]) -> None:
        """These rows (D,) were whole, while it was calm."""
        before, now = (np.array(row, np.float64) for row in ([self._raw, *rows])[-2:])
        self._earlier, self._raw, self._good, self._before = before, now, now, now

    @property
    def unjudged(self) -> NDArray[np.bool_]:
        """(D,) at which numbers nobody is surprised: those that are missing, or were so recently that their changes are
        taken from what was completed."""
        return self.missing | (self._returned > 0)

    def read(self, row: NDArray[np.floating[Any]], whole: bool = False) -> NDArray[np.float32]:
        """(D,) the next row, as it should be.

        Args:
            whole: all of its numbers are known to be finite.
        """
        self._earlier, self._raw = self._raw, np.array(row, np.float64)
        self.settling = max(0, self.settling - 1)
        if self._returning:
            self._returned, self._returning = np.maximum(self._returned - 1, 0), self._returning - 1
        if not self._calm and (whole or np.isfinite(self._raw).all()):  # as nearly always
            self._good = self._before = self._raw
            return row.astype(np.float32)
        finite = np.isfinite(self._raw)
        self._since = {name: self._since.get(name, 0) + 1 for name in self._calm}
        lost = ~finite & ~self.missing
        lost[self._spec.motor] = False
        if lost.any() and not lost[self._spec.sensory].all():
            self._gone |= self._doubt(lost)
        repaired = self._repaired()
        if self._calm:
            self._judge(repaired)
        if not self.missing.any():
            self._good = self._raw
        self._before = repaired
        return repaired.astype(np.float32)

    def suspect(self, columns: NDArray[np.intp]) -> NDArray[np.float32] | None:
        """(D,) the last row with the sensors of ``columns`` completed too; None where that leaves nothing to go by."""
        wanted = self.missing.copy()
        wanted[columns] = True
        if wanted[self._spec.sensory].all() or not (wanted & ~self.missing).any():
            return None
        self._gone -= self._doubt(wanted)
        self.settling = self._settle
        self._before = repaired = self._repaired()
        return repaired.astype(np.float32)

    def _doubt(self, columns: NDArray[np.bool_]) -> set[str]:
        """Believes the sensors of ``columns`` (D,) no more; which those are."""
        names = [name for name, own in self._completion.sensors if columns[own].any()]
        self._calm |= dict.fromkeys(names, 0)  # in an order that no hash decides, for reports are to the last bit
        self._choose()
        return set(names)

    def _choose(self) -> None:
        """Takes up which sensors are missing."""
        self.missing[:] = False
        for name, own in self._completion.sensors:
            if name in self._calm:
                self.missing[own] = True
        self._filling: Filling = self._completion.filling(self.missing)
        spread = self._completion.senses.spread[self._filling.columns]
        self._untold = self._filling.error > UNTOLD * spread  # (M,)
        self._guessed = self._untold & self._read[self._filling.columns]  # (M,)

    def _repaired(self) -> NDArray[np.float64]:
        if not self._calm:
            return self._raw
        repaired, columns = self._raw.copy(), self._filling.columns
        before = self._raw if self._before is None else self._before
        value = self._completion.complete(self._filling, self._completion.lift(np.stack([before, self._raw])))[-1]
        if self._guessed.any():
            last = self._completion.senses.mean if self._good is None else self._good
            value = np.where(self._guessed, last[columns], value)
        mean, spread = self._completion.senses.mean[columns], self._completion.senses.spread[columns]
        repaired[columns] = np.clip(value, mean - FARTHEST * spread, mean + FARTHEST * spread)
        for hand in self._hands:
            repaired = hand.refined(repaired, self.missing, self._completion.error * self._completion.senses.spread)
        return repaired

    def _judge(self, repaired: NDArray[np.float64]) -> None:
        """Counts for how long each missing sensor has been well, and believes those that have been for long enough."""
        columns, limit = self._filling.columns, WELL_WITHIN * self._filling.error
        self._unchecked = self._unchecked + 1 if self._guessed.any() else 0
        close = np.abs(self._raw[columns] - repaired[columns]) <= limit  # False for what is not finite
        repeats = (self._raw[columns] == self._earlier[columns]) & (self._spec.noise[columns] > 0)
        for hand in self._hands:
            close &= ~hand.accused[columns]
        back = np.isfinite(self._raw[columns]) & (close | self._untold)
        fine = dict(zip(columns.tolist(), (close & ~repeats & ~self._untold).tolist(), strict=True))
        there = dict(zip(columns.tolist(), back.tolist(), strict=True))
        well = []
        for name, own in self._completion.sensors:
            if name in self._calm:
                self._calm[name] = self._calm[name] + 1 if all(fine[int(c)] for c in own) else 0
                # What said nothing, and says what is expected again, is believed at once; what was wrong is not.
                if self._calm[name] >= self._well_after or (name in self._gone and all(there[int(c)] for c in own)):
                    well.append(name)
                    self._returned[own] = self._returning = self._settle
                    repaired[own] = self._raw[own]
        if well:
            self._gone -= set(well)
            self._calm = {name: rows for name, rows in self._calm.items() if name not in well}
            self._since = {name: rows for name, rows in self._since.items() if name in self._calm}
            self._choose()


class Place(NamedTuple):
    """Where columns of a stream stand in a part of an observation."""

    part: str  # of a dict; empty for an array
    columns: NDArray[np.intp]
    entries: NDArray[np.intp]


class ObservationMap:
    """Where the numbers of a stream stand in the observation.

    Args:
        env: one of this package's, or any whose stream is its observation and the action.

    Raises:
        ValueError: it is not known where they stand: the environment does not say, or a wrapper inside has changed the
            observation.
    """

    def __init__(self, env: gym.Env[Any, Any], spec: StreamSpec) -> None:
        self._space, inner = env.observation_space, env.unwrapped
        if isinstance(inner, LaysOutObservations) and env.has_wrapper_attr("stream_spec"):
            # One of many environments has the space of all, wrapped, and says what its own was.
            own = getattr(inner, "laid_out_space", env.unwrapped.observation_space)
            if self._space != own:
                raise ValueError(f"a wrapper inside has changed the observation, which was {own}")
            self._places = _laid_out(inner.observation_layout, spec, self._space)
        elif not env.has_wrapper_attr("stream_spec") and isinstance(self._space, spaces.Box):
            self._places = [Place("", spec.sensory, np.arange(len(spec.sensory)))]
        else:
            raise ValueError(f"{inner} does not say where its stream stands in its observation")
        self.shown = np.zeros(spec.size, bool)
        """(D,) which columns stand in the observation; a policy that sees nothing else cannot read the others."""
        for place in self._places:
            self.shown[place.columns] = True

    def repaired(self, observation: Any, row: NDArray[np.float32], missing: NDArray[np.bool_]) -> Any:
        """The observation with the numbers of ``row`` (D,) where they are ``missing`` (D,); the rest is not touched."""
        for part, columns, entries in self._places:
            wrong = missing[columns]
            if not wrong.any():
                continue
            array = np.array(observation[part] if part else observation)
            array.reshape(-1)[entries[wrong]] = row[columns[wrong]]
            box = self._space[part] if isinstance(self._space, spaces.Dict) else self._space
            if isinstance(box, spaces.Box):
                array = np.clip(array, box.low, box.high).astype(box.dtype)
            observation = {**observation, part: array} if part else array
        return observation


def _laid_out(layout: dict[str, int], spec: StreamSpec, space: spaces.Space[Any]) -> list[Place]:
    """The places of channels in a flat observation, in its ``state``, or in a dict of named arrays."""
    named = isinstance(space, spaces.Dict) and "state" not in space.spaces
    flat = "state" if isinstance(space, spaces.Dict) else ""
    found, start = [], 0
    for name, size in layout.items():
        if name in spec.slices:
            columns = np.arange(spec.size)[spec.slices[name]]
            entries = np.arange(size) + (0 if named else start)
            found.append(Place(name if named else flat, columns, entries))
        start += size
    return found


class CompletedObservation(gym.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Hands on the observation and the stream with the numbers that a sense at fault should say.

    Where the monitor alarms and names a sensor as the cause, that sensor is not believed until it has said what was
    expected for a second; numbers that are not finite are never believed. ``info["completed"]`` names the sensors that
    are completed, and ``info["completion_trusted"]`` is False from the moment on that a sense which nothing else tells
    of has been missing for longer than ``trust_s``. It completes, and does nothing else: ``NeuralASMSafety`` with
    ``on_alarm="graded"`` does the same, and acts on all other causes.

    Args:
        env: one of this package's, or any whose observation and action are Boxes.
        monitor: a fitted and calibrated memory.
        sensors: names of sensors that are not believed from the first row on, such as ``encoder[3]``.
        trust_s: how long a sense that nothing else tells of is completed, by its last good value [s].

    Raises:
        ValueError: the monitor knows no completion, watches another stream, or it is not known where the stream stands
            in the observation; an unknown sensor (the message lists those that exist).
    """

    @typed
    def __init__(
        self, env: gym.Env[Any, Any], monitor: Monitor, sensors: Sequence[str] = (), trust_s: float = TRUST_S
    ) -> None:
        RecordConstructorArgs.__init__(self, _disable_deepcopy=True, monitor=monitor, sensors=sensors, trust_s=trust_s)
        gym.Wrapper.__init__(self, env)
        self._source = StreamSource(env)
        if self._source.rows_per_step > 1:
            raise ValueError("a stream is completed at its control rate: make the environment without stream_freq")
        self._threshold = check_monitor(monitor, self._source.spec)
        diagnosis = monitor.diagnosis_ if isinstance(monitor, ExplainsItself) else None
        if diagnosis is None:
            raise ValueError(f"{shown(monitor)} knows no completion: fit it anew")
        self._explained, self._repair = diagnosis, Repair(diagnosis.completion, trust_s)
        known = dict(diagnosis.completion.sensors)
        for name in sensors:
            if name not in known:
                raise ValueError(f"unknown sensor {shown(name)}; known: {', '.join(known)}")
        self._always = np.concatenate([known[name] for name in sensors]) if len(sensors) else np.zeros(0, np.intp)
        self._map = ObservationMap(env, monitor.spec)
        self._observer = Observer(monitor)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        observation, info = self.env.reset(seed=seed, options=options)
        self._repair.reset()
        self._observer.begin()
        self._rows: list[NDArray[np.float32]] = []
        row = self._source.row(observation, np.zeros(self.action_space.shape or (0,), np.float32), info)
        return self._handed_on(observation, self._believed(row), info)

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        row = self._believed(self._source.row(observation, action, info))
        self._rows = [*self._rows[-3:], row]
        missing = self._repair.missing
        surprise = self._observer.observe(row[None], ("",)).surprise.without(missing)
        if float(surprise.value[0]) > self._threshold and not self._repair.settling:
            cause = self._explained(np.stack(self._rows), surprise.attribution[0], missing)
            again = self._repair.suspect(cause.columns) if cause.family == "sensor" else None
            row = row if again is None else again
            self._rows[-1] = row
        if self._repair.settling:
            self._observer.forget(np.ones(1, bool))
        observation, info = self._handed_on(observation, row, info)
        return observation, reward, terminated, truncated, info

    def _believed(self, row: NDArray[np.float32]) -> NDArray[np.float32]:
        row = self._repair.read(row)
        again = self._repair.suspect(self._always) if self._always.size else None
        return row if again is None else again

    def _handed_on(
        self, observation: Any, row: NDArray[np.float32], info: dict[str, Any]
    ) -> tuple[Any, dict[str, Any]]:
        if "stream" in info:
            info["stream"] = row
        info["completed"], info["completion_trusted"] = self._repair.names, self._repair.trusted
        return self._map.repaired(observation, row, self._repair.missing), info
