"""A column of a log: its role, and what its numbers are.

sense     read, and predicted from the others       constant  never moves
command   read; what the robot was told to do       copy      equals another column
label     marks faulty rows                         counter   counts rows, or goes on as the clock does
clock     says when a row was sensed                ignored   by the user, or it holds no numbers
                                                    unclear   the user decides
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from fnmatch import fnmatchcase

from asm_gym.validation import check_choice, check_number

SENSE = "sense"
COMMAND = "command"
LABEL = "label"
CLOCK = "clock"
CONSTANT = "constant"
COPY = "copy"
COUNTER = "counter"
IGNORED = "ignored"
UNCLEAR = "unclear"
COLUMN_ROLES = (SENSE, COMMAND, LABEL, CLOCK, CONSTANT, COPY, COUNTER, IGNORED, UNCLEAR)


@dataclass(frozen=True, kw_only=True)
class LogColumn:
    """What a column of a log is.

    Args:
        name: in the log, without the unit behind it.
        role: one of ``COLUMN_ROLES``; senses and commands are read.
        unit: of its numbers after ``scale``; empty if the log does not say.
        channel: to which its numbers belong; by default its name.
        element: which of several numbers of the channel it is.
        wrap: turn of an angle that turns over [unit]; 0 of other numbers.
        missing: the number that stands for missing data; None without one.
        scale: its numbers are multiplied by this.
        noise: standard deviation of its white noise [unit].
        varies: logs may differ in its range.
        reason: why it has this role.
    """

    name: str
    role: str = SENSE
    unit: str = ""
    channel: str = ""
    element: str = ""
    wrap: float = 0.0
    missing: float | None = None
    scale: float = 1.0
    noise: float = 0.0
    varies: bool = False
    reason: str = field(default="", compare=False)

    def __post_init__(self) -> None:
        check_choice(f"role of {self.name!r}", self.role, COLUMN_ROLES)
        for what in ("unit", "channel", "element"):
            text = getattr(self, what)
            if not isinstance(text, str):
                raise ValueError(f"{what} of {self.name!r} must be text, got {text!r}")
        for what, low in (("scale", None), ("wrap", 0.0), ("noise", 0.0)):
            check_number(f"{what} of {self.name!r}", getattr(self, what), low=low)

    @property
    def is_read(self) -> bool:
        """Whether it is part of the stream."""
        return self.role in (SENSE, COMMAND)

    @property
    def stream_channel(self) -> str:
        """The channel of the stream: an angle that turns over has one of its own."""
        if self.wrap or not self.channel:
            return self.name
        return self.channel

    @property
    def label(self) -> str:
        """What the stream calls its number."""
        if self.element:
            return f"{self.channel}[{self.element}]"
        return self.channel or self.name

    def matches(self, patterns: Iterable[str]) -> bool:
        """Return whether it or its channel is called as one of the patterns says."""
        for pattern in patterns:
            for name in (self.name, self.channel):
                if name == pattern or fnmatchcase(name, pattern):
                    return True
        return False
