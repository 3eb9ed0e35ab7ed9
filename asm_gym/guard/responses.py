"""What is done about which cause: one table, and the responses that it names."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from asm_gym.monitors.diagnosis import FAMILIES, as_info
from asm_gym.validation import check_choice, short_repr

LASTING = {"contact": 1.0, "actuator": 2.5}
"""From when on a cause is a lasting one [s]: a contact that is there for so long; an actuator's fault where its joint
has been pressed for most of that time and has not turned. Where the policy goes on in spite of another cause, and the
arm is pressed so and does not move, it is a lasting contact."""

PRESSING = "pressing"
"""The arm presses harder than healthy motion does, whatever the cause is taken for."""

CAUSES = (*FAMILIES, *(f"lasting {family}" for family in LASTING), PRESSING, f"lasting {PRESSING}")
"""What a table of responses says something about."""

SLOW = "slow"
GOING_ON = ("go on", "complete", SLOW)  # responses to an alarm under which the policy acts

STAYING = ("hold", "comply", "retract", "stop")  # responses under which it does not

RESPONSES = (*GOING_ON, *STAYING)
"""Let the policy go on; complete the sensors at fault and go on; let the policy go on for a second at a quarter of the
speed, with half of the limits on force, however sure the cause is; stay and keep the grip, yielding to more than a
hold's force; give way to what presses; go back along the path; stay, and end the episode."""

DEFAULT: dict[str, str] = {
    "sensor": "complete",
    "contact": "hold",
    "lasting contact": "comply",
    "actuator": "go on",
    "lasting actuator": "stop",
    "action": "hold",
    "object": "go on",
    "unknown": "hold",
    PRESSING: "retract",
    f"lasting {PRESSING}": "comply",
}
"""What ``on_alarm="graded"`` does. What presses comes first: then only its two rows count, and neither may let the
policy go on; the arm goes back the way it came, which ends the force at once. Below that, the policy may go on where
the cause is sure, the hand is not faster than any healthy one, for a bounded time, and where a sense of force says that
it presses with no more than 40 N; else the robot holds."""


class Response(NamedTuple):
    """What is to be done about a row of one robot."""

    name: str
    """One of ``RESPONSES``; empty where there is nothing to respond to, or no table is followed."""
    cause: dict[str, Any]
    """As ``info["asm"]["cause"]`` says it."""
    touched: bool | None = None
    """The contact is still there; None: not known, or so long that it may never end."""
    case: str = ""
    """The row of the table that was followed, one of ``CAUSES``; empty where none was."""

    @property
    def why(self) -> str:
        """The cause in words, in brackets; empty where there is none."""
        family = self.cause["family"]
        if not family:
            return ""
        words = " ".join(filter(None, (self.case or family, self.cause["part"])))
        return f" ({words}, {self.cause['probability']:.2f})"


NO_RESPONSE = Response("", as_info(None))  # where nothing is to be done


def unexplained(name: str, part: str) -> Response:
    """Return a response that an alarm term asks for by itself, whatever the cause."""
    return Response(name, as_info(None) | {"family": "unknown", "part": part}, case="unknown")


def responses_from(table: Mapping[str, str] | None, can_slow: bool = True) -> dict[str, str]:
    """Return the default table with the entries of ``table`` in place of its own.

    Args:
        table: responses by cause.
        can_slow: the speed of the robots can be limited.

    Raises:
        ValueError: an unknown cause or response (the message lists those that exist), one that lets the policy go on
            while the arm presses, or one that slows down robots whose speed cannot be limited.
    """
    if table is None:
        table = {}
    if not isinstance(table, Mapping):
        raise ValueError(f"responses must map causes to responses, got {short_repr(table)}")
    for cause, response in table.items():
        check_choice("cause", cause, CAUSES)
        check_choice("response", response, RESPONSES)
        if response == SLOW and not can_slow:
            raise ValueError(
                f"the response {short_repr(SLOW)} needs an environment of this package, "
                "whose speed can be limited"
            )
        if cause.endswith(PRESSING) and response in GOING_ON:
            possible = ", ".join(STAYING)
            raise ValueError(
                f"{short_repr(response)} would let a pressing arm go on: {cause} takes {possible}"
            )
    return {**DEFAULT, **table}
