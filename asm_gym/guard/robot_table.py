"""The guard's state of n robots: one structured array, a record a robot.

The part that owns a field is named above it, and nothing else writes the field. Compiled code takes the array and reads
``robot.pressed_impulse += excess * dt``; ``print(table)`` shows it, and a copy of it is what a report keeps of a row.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.spec import StreamSpec
from asm_gym.validation import check_choice

FINITE = "threshold", "pressed_impulse", "leaning_time"  # fields that are always finite numbers

Mask = NDArray[np.bool_]
Floats32 = NDArray[np.float32]

MOST_WRISTS = 8  # wrists of a robot whose hands are weighed

STATES = "policy", "trial", "reflex", "ended"
"""Who acts: the policy; the policy on trial, so recently that an alarm which comes back had not gone; the reflex;
nobody, for the episode is to end."""

POLICY, TRIAL, REFLEX, ENDED = range(len(STATES))

WEIGHED_WRIST = np.dtype([("steps", np.float64), ("force", np.float64, 3)], align=True)
"""The mean force [N] of a wrist without a contact, over so many steps: the weight of its hand."""

ROBOT = np.dtype(
    [
        # The guard, before a row is judged
        ("active", np.bool_),  # the row counts
        ("ends_step", np.bool_),  # the row ends a control step
        ("refused", np.bool_),  # the policy's action could not be executed
        ("out_of_range", np.bool_),  # it was far out of the range of healthy commands
        ("failed", np.bool_),  # monitor, stream, policy or reflex failed
        ("overridden", np.bool_),  # something else than the policy's action was executed
        ("held", np.bool_),  # a reflex acted
        # there is something to decide, whatever surprise and contact are
        ("must_decide", np.bool_),
        # Row validation (``recent_rows``, ``hand_comparison``)
        ("episode_rows", np.int64),  # rows in this episode
        ("lost", np.bool_),  # a number is not finite
        ("contradicts", np.bool_),  # a hand is not where its joints say
        # The monitor
        ("surprise", np.float64),  # as it counts
        ("raw_surprise", np.float64),  # before a benign event excuses part of it
        ("excuse", np.int8),  # that event, an index in ``EVENTS``
        # Contact state (``contact_state``)
        # largest share of a contact limit in the physics substeps of this step
        ("load", np.float64),
        # when in the step a limit was passed [s]; infinite for never
        ("limit_passed_s", np.float64),
        ("contact_force", np.float64),  # on the arm, estimated from wrist and joints [N]
        # of that force beyond ``FREE_FORCE``, in this episode [N s]
        ("pressed_impulse", np.float64),
        ("leaning_time", np.float64),  # for which the arm has leant on something [s]
        ("hand_speed", np.float64),  # of the fastest hand [m/s]
        ("presses", np.bool_),  # a limit was passed, or the arm leans on something
        ("felt_wrists", WEIGHED_WRIST, MOST_WRISTS),  # by what the arm feels in physics substeps
        ("sensed_wrists", WEIGHED_WRIST, MOST_WRISTS),  # by its rows
        # The alarm rule (``judged_rows``, and ``Guard`` where there is something to decide)
        ("threshold", np.float64),  # surprise beyond it is an alarm in this episode
        ("over", np.bool_),  # surprise is beyond it
        ("knocked", np.bool_),  # it is but for a knock, which excuses it
        ("event", np.int8),  # of the row, an index in ``EVENTS``
        ("alarm", np.bool_),  # the row is an alarm, for whatever reason
        # Counters (``judged_rows`` where there is nothing to decide, else ``Arbiter``)
        ("state", np.int8),  # who acts next, an index in ``STATES``
        ("low_surprise_rows", np.int64),  # one after the other
        ("contact_free_rows", np.int64),  # of a reflex without a contact, one after the other
        ("held_rows", np.int64),  # of a reflex since it took over
        # the same, those before a hand-back that came too early included
        ("override_rows", np.int64),
        ("early_returns", np.int64),  # hand-backs that came too early, one after the other
        ("rows_since_return", np.int64),  # of the policy since control was handed back
        ("rows_going_on", np.int64),  # of the policy in alarm, in this episode
        ("strikes", np.int64),  # how often the policy has pressed too hard in this episode
        # that a reflex acts before a trial; infinite for no trial
        ("rows_until_trial", np.float64),
        ("on_trial", np.bool_),  # the last hand-back was a trial
        ("confirmed", np.bool_),  # an alarm in this episode was no false one
        ("largest_surprise", np.float64),  # in this episode while the policy acted
        ("policy_rows", np.int64),  # of the policy, in all episodes
        ("policy_alarms", np.int64),  # and how many of them alarmed
    ],
    align=True,
)

KEPT = "threshold", "policy_rows", "policy_alarms"  # fields that an episode hands on to the next


class RobotTable:
    """The records of n robots, and what alarm terms may ask beside them.

    Args:
        count: n.
        spec: of the robots' streams.
        threshold: that surprise must exceed for an alarm.

    Attributes:
        records: (n,) of dtype ``ROBOT``; the same array for as long as the table lives.
        rows: (n, D) as they were sensed last.
        infos: what the environments said in the last step; of a vector, its arrays.
    """

    def __init__(self, count: int, spec: StreamSpec, threshold: float) -> None:
        self.spec = spec
        self.records: NDArray[Any] = np.zeros(count, ROBOT)
        self.records["threshold"] = threshold
        self.rows = np.full((count, spec.size), np.nan, np.float32)
        self.infos: Mapping[str, Any] = {}
        self.begin(np.ones(count, bool))

    def begin(self, which: Mask) -> None:
        """Clear the records of the robots of ``which`` (n,), whose episodes begin."""
        self.records[which] = cleared(self.records[which])

    def robot(self, index: int) -> Any:
        """Return the record of a robot; writing to its attributes changes the table."""
        return self.records.view(np.recarray)[index]

    def channel(self, name: str) -> NDArray[np.float32]:
        """Return the numbers (n, k) of a channel of the rows. Raises ValueError for an unknown name."""
        check_choice("channel", name, self.spec.slices)
        return self.rows[:, self.spec.slices[name]]

    def info(self, name: str, otherwise: float = np.nan) -> NDArray[np.float64]:
        """Return the number (n,) that the environments say under ``name`` in ``info``; ``otherwise`` without one."""
        values = np.broadcast_to(
            np.asarray(self.infos.get(name, otherwise), np.float64), len(self.records)
        )
        there = self.infos.get(f"_{name}", True)
        return np.where(there, values, otherwise)

    def __str__(self) -> str:
        """Return a line for each robot: state, surprise, threshold, contact."""
        lines = ["robot  state   surprise  threshold  force [N]  impulse [N s]  alarm"]
        for i, robot in enumerate(self.records):
            surprise = f"{robot['surprise']:8.3g}  {robot['threshold']:9.3g}"
            contact = f"{robot['contact_force']:9.3g}  {robot['pressed_impulse']:13.3g}"
            lines.append(
                f"{i:5}  {STATES[robot['state']]:6}  {surprise}  {contact}  {bool(robot['alarm'])}"
            )
        return "\n".join(lines)


def damaged(records: NDArray[Any]) -> dict[int, str]:
    """Return which field of a record is no finite number though it must be, by robot."""
    failures: dict[int, str] = {}
    for name in FINITE:
        for robot in np.flatnonzero(~np.isfinite(records[name])).tolist():
            failures[robot] = f"guard: {name} is {records[name][robot]}"
    return failures


def copied(records: NDArray[Any]) -> NDArray[Any]:
    """Return a copy of records that cannot be written to; NumPy's own copies field by field, 40 times as slowly."""
    return np.frombuffer(records.tobytes(), ROBOT)


def cleared(records: NDArray[Any]) -> NDArray[Any]:
    """Return records as they are before the first row of an episode, with what an episode hands on to the next."""
    fresh = np.zeros(records.shape, ROBOT)
    for name in KEPT:
        fresh[name] = records[name]
    fresh["active"] = True
    fresh["largest_surprise"] = -np.inf
    for name in ("load", "limit_passed_s", "contact_force", "hand_speed"):
        fresh[name] = np.nan
    return fresh
