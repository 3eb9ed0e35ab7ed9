"""Everything that a guard can be told, in one place."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

from asm_gym.data.action_meaning import ActionMeans
from asm_gym.detection.adaptive import AdaptiveThreshold
from asm_gym.detection.contact_limits import ContactLimits
from asm_gym.guard.reflexes import GRADED, REFLEXES
from asm_gym.guard.responses import responses_from
from asm_gym.policies.policy import Policy
from asm_gym.validation import check_flag, check_number, short_repr

ON_ALARM = ("monitor", *REFLEXES, GRADED, "terminate")  # names that ``on_alarm`` takes
OnAlarmName = Literal["monitor", "hold", "retract", "comply", "recall", "graded", "terminate"]
"""The same for a type checker, which finds a name that is misspelt."""

OnAlarm = OnAlarmName | Policy | Callable[[Any], Policy]
"""What ``on_alarm`` takes: a name, a policy, or what makes a policy for an environment."""

# Under "graded":
TRY_AFTER_S = 0.5  # control is handed back on trial after so long [s]
GIVE_UP_AFTER_S = 3.0  # the episode ends after so long in an override [s]
GO_ON_S = 5.0  # for so long in an episode the policy may go on in alarm [s]
STRIKES = 3  # the episode ends where the policy passes a contact limit for this time
IMPULSE = 20.0  # or presses with more than this, beyond healthy motion [N s]


@dataclass(frozen=True)
class ReleaseRule:
    """When control is handed back, and when the episode ends.

    Counted in rows; infinite for never.
    """

    release_after: int = 10
    """Rows of low surprise after which control is handed back."""
    max_override: float = math.inf
    """Rows of a reflex, those before a hand-back after which the alarm was soon back too."""
    try_after: float = math.inf
    """Rows until a trial; after each trial that fails, twice as many."""
    free_after: int = 5
    """Rows without contact after which it is over; after each that was too early, twice as many."""
    strikes: float = math.inf
    """How often the policy may pass a contact limit before the episode ends."""
    impulse: float = math.inf
    """How much the arm may press in an episode, beyond healthy motion [N s]."""
    go_on: float = math.inf
    """Rows in alarm for which the policy may go on in an episode; at later alarms it is held."""


@dataclass(frozen=True)
class GuardOptions:
    """What the safety wrappers take beside environment and monitor, as ``NeuralASMSafety`` describes it.

    Raises:
        ValueError: a number out of its range, an unknown name, or responses that let a pressing arm go on.
    """

    on_alarm: OnAlarm | None = None
    release_after: int = 10
    max_override: int | None = None
    try_after: int | None = None
    truncate: bool = False
    responses: Mapping[str, str] | None = None
    contact_limits: ContactLimits | str | None = "memory"
    adaptive_threshold: AdaptiveThreshold | None = None
    action_means: ActionMeans | None = None

    def __post_init__(self) -> None:
        if isinstance(self.on_alarm, str) and self.on_alarm not in ON_ALARM:
            raise ValueError(
                f"unknown on_alarm {short_repr(self.on_alarm)}; known: {', '.join(ON_ALARM)}, "
                "or any policy"
            )
        check_number("release_after", self.release_after, low=1, whole=True)
        for name in ("max_override", "try_after"):
            if getattr(self, name) is not None:
                check_number(name, getattr(self, name), low=1, whole=True)
        check_flag("truncate", self.truncate)
        responses_from(self.responses)
        limits = self.contact_limits
        if not (limits is None or isinstance(limits, ContactLimits) or limits == "memory"):
            raise ValueError(
                f'contact_limits must be ContactLimits, "memory" or None, got {short_repr(limits)}'
            )
        adaptive = self.adaptive_threshold
        if adaptive is not None and not isinstance(adaptive, AdaptiveThreshold):
            raise TypeError(
                f"adaptive_threshold must be an AdaptiveThreshold, got {short_repr(adaptive)}"
            )

    def reaction(self, names_causes: bool) -> OnAlarm:
        """Return ``on_alarm``, or what None means for a monitor that names causes or does not.

        Raises:
            ValueError: there are responses, and nobody asks for them.
        """
        chosen = self.on_alarm
        if chosen is None:
            chosen = "hold"
            if names_causes:
                chosen = "graded"
        if self.responses is not None and not (isinstance(chosen, str) and chosen == GRADED):
            raise ValueError(f"responses need on_alarm='graded', got on_alarm={short_repr(chosen)}")
        return chosen

    def rule(self, graded: bool, dt: float, rows_per_step: int) -> ReleaseRule:
        """Return when control is handed back, for a control period of ``dt`` [s]; ``graded`` sets more limits."""

        def rows_of(steps: int | None, seconds: float) -> float:
            """Return how many rows steps have; without them, those in so many seconds, or infinite."""
            if steps is None and not graded:
                return math.inf
            if steps is None:
                steps = max(1, round(seconds / dt))
            return rows_per_step * steps

        rule = ReleaseRule(
            release_after=rows_per_step * self.release_after,
            max_override=rows_of(self.max_override, GIVE_UP_AFTER_S),
            try_after=rows_of(self.try_after, TRY_AFTER_S),
            free_after=rows_per_step * ReleaseRule.free_after,
            go_on=rows_of(None, GO_ON_S),
        )
        if graded:
            return replace(rule, strikes=STRIKES, impulse=IMPULSE)
        return rule
