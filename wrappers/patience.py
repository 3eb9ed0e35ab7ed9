"""When control is handed back to the policy."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

from asm_gym.validation import check_number


@dataclass(frozen=True)
class Patience:
    """When control is handed back.

    Args:
        release_after: control steps of quiet after which it is.
        release_below: share of the threshold, in (0, 1], that surprise must be under to count as quiet.
        max_override: control steps for which a reflex may act. Those before a hand-back after which the alarm is back
            within ``release_after`` steps count too: what comes back at once has not gone. None for as many as it
            takes.
        try_after: control steps after which control is handed back on trial though surprise is not quiet, for a robot
            that holds still where it never did may surprise itself; after each trial that fails, twice as many. None
            for no trials.
        free_after: control steps in which nothing presses any more, after which a contact is over though surprise is
            not quiet; after each hand-back that was too early, twice as many.
    """

    release_after: int = 10
    release_below: float = 0.8
    max_override: int | None = None
    try_after: int | None = None
    free_after: int = 5

    def __post_init__(self) -> None:
        check_number("release_after", self.release_after, low=1, whole=True)
        check_number("release_below", self.release_below, above=0, high=1)
        for name in ("max_override", "try_after"):
            number = getattr(self, name)
            if number is not None:
                check_number(name, number, low=1, whole=True)

    def in_rows(self, each: int) -> Self:
        """The same, counted in rows of a stream that has ``each`` of them in a control step."""
        longest = None if self.max_override is None else each * self.max_override
        wait = None if self.try_after is None else each * self.try_after
        rows = {"release_after": each * self.release_after, "free_after": each * self.free_after}
        return replace(self, max_override=longest, try_after=wait, **rows)
