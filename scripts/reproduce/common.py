"""Studies whose work is handed where to print and how long it took; the kit's have neither."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from rich.console import Console

from asm_gym.scripts import command
from asm_gym.scripts.reproduce import kit
from asm_gym.scripts.reproduce.kit import Config as Common
from asm_gym.scripts.reproduce.kit import Findings, Record, over_seeds, shown
from asm_gym.scripts.reproduce.recordings import wide_enough

__all__ = ["Common", "Findings", "Record", "over_seeds", "reproduce", "shown", "wide_enough"]

Args = TypeVar("Args", bound=Common)


def reproduce(
    name: str,
    study: Callable[[Args, Console, dict[str, float]], Findings],
    kind: type[Args],
    description: str | None,
    argv: list[str] | None,
) -> int:
    """Runs a study, publishes what it found, and returns the exit code."""

    def work(args: Args, console: Console) -> None:
        kit.conduct(name, lambda own: study(own, kit.now().console, kit.now().seconds), args, console)

    return command.run(f"reproduce {name}", kind, work, argv, description)
