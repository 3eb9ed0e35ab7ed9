"""Exceptions of asm-gym: each takes facts and builds its message from them.

AsmGymError                  a ValueError
├── SpecMismatch             a stream has other channels, or another rate
├── NotFitted                a monitor has not learned yet; a RuntimeError too
├── NotEnoughEpisodes        too few episodes to promise a rate of false alarms
├── UnsupportedEnvironment   an environment that cannot be guarded as asked
├── LimitsLacking            a format of limits needs what a memory does not keep
└── DamagedFile              a file that cannot be read
"""

from __future__ import annotations

from collections.abc import Sequence

__all__ = [
    "AsmGymError",
    "DamagedFile",
    "LimitsLacking",
    "NotEnoughEpisodes",
    "NotFitted",
    "SpecMismatch",
    "UnsupportedEnvironment",
]


class AsmGymError(ValueError):
    """Base class of the exceptions; ``args`` are its facts, so that it can be pickled."""


class SpecMismatch(AsmGymError):
    """A stream has other channels, or another rate, than it is to be read with.

    Args:
        whose: what was to read the stream, such as ``"the monitor"``.
        differences: one line for each.
        advice: what to do, where more is known.
    """

    def __init__(self, whose: str, differences: Sequence[str], advice: str = "") -> None:
        super().__init__(whose, differences, advice)
        self.whose = whose
        self.differences = differences
        self.advice = advice

    def __str__(self) -> str:
        message = "\n  ".join([f"{self.whose} does not fit this stream:", *self.differences])
        if self.advice:
            return f"{message}\n{self.advice}"
        return message


class NotFitted(AsmGymError, RuntimeError):
    """A monitor was asked for what it has not learned yet.

    Args:
        whose: the monitor.
        lacks: for example ``"has no threshold"``.
        call: the method that mends it.
    """

    def __init__(self, whose: str, lacks: str, call: str) -> None:
        super().__init__(whose, lacks, call)
        self.whose = whose
        self.lacks = lacks
        self.call = call

    def __str__(self) -> str:
        return f"{self.whose} {self.lacks} yet: call {self.call} first"


class NotEnoughEpisodes(AsmGymError):
    """A promise needs more episodes, or longer ones.

    Args:
        promise: what was asked for, as the subject of "needs" or "need".
        needed: the least number, with its unit.
        got: the number that there is.
        advice: what they can promise, or what to do.
    """

    def __init__(self, promise: str, needed: str, got: str, advice: str) -> None:
        super().__init__(promise, needed, got, advice)
        self.promise = promise
        self.needed = needed
        self.got = got
        self.advice = advice

    def __str__(self) -> str:
        return f"{self.promise} at least {self.needed}, got {self.got}: {self.advice}"


class UnsupportedEnvironment(AsmGymError):
    """An environment cannot be guarded as asked.

    Args:
        reason: what it lacks, or what is in the way.
        advice: what to do.
    """

    def __init__(self, reason: str, advice: str = "") -> None:
        super().__init__(reason, advice)
        self.reason = reason
        self.advice = advice

    def __str__(self) -> str:
        if self.advice:
            return f"{self.reason}: {self.advice}"
        return self.reason


class LimitsLacking(AsmGymError):
    """A format of limits needs a sense that a memory lacks, or of which it keeps no range.

    Args:
        form: the format.
        needed: what it needs.
        kinds: what the memory keeps limits of.
        channels: that it has.
    """

    def __init__(
        self, form: str, needed: str, kinds: Sequence[str], channels: Sequence[str]
    ) -> None:
        super().__init__(form, needed, kinds, channels)
        self.form = form
        self.needed = needed
        self.kinds = kinds
        self.channels = channels

    def __str__(self) -> str:
        return (
            f"{self.form} needs {self.needed}; this memory keeps limits of "
            f"{', '.join(self.kinds) or 'nothing'}, which the formats table, yaml and json print; "
            f"its channels are {', '.join(self.channels)}"
        )


class DamagedFile(AsmGymError):
    """A file, or a part of one, cannot be read.

    Args:
        what: the path, or the part of the file.
        reason: what is wrong in it.
        verdict: what it may be other than damaged.
    """

    def __init__(self, what: object, reason: object, verdict: str = "is damaged") -> None:
        super().__init__(str(what), str(reason), verdict)
        self.what = str(what)
        self.reason = str(reason)
        self.verdict = verdict

    def __str__(self) -> str:
        return f"{self.what} {self.verdict}: {self.reason}"
