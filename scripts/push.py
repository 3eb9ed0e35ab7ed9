"""Uploads a memory and its card to the Hugging Face hub, or to the server that HF_ENDPOINT names.

asm_gym.monitors.hub.from_hub("OWNER/NAME") reads it there.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from asm_gym.monitors.hub import push
from asm_gym.scripts.command import run
from asm_gym.scripts.options import check_options, option


@dataclass(frozen=True)
class Args:
    """A memory for others."""

    memory: Path = option(positional=True, metavar="FILE.asm")
    """A calibrated monitor, such as asm-gym fit writes."""
    repo: str = option(positional=True, metavar="OWNER/NAME")
    """Repository on the hub; it is made where there is none."""
    card: Path | None = option(None)
    """What it was learned from, and how well it judges; by default what the file says of itself."""
    private: bool = option(False)
    """Only you see a repository that is made."""

    def __post_init__(self) -> None:
        check_options(self)


def upload(args: Args, console: Console) -> None:
    """Uploads, and says where to."""
    where = push(args.memory, args.repo, args.card, args.private)
    console.print(f"Uploaded to {where}", soft_wrap=True, highlight=False, markup=False)


def main(argv: list[str] | None = None) -> int:
    """Uploads, and returns the exit code."""
    return run("push", Args, upload, argv)


if __name__ == "__main__":
    sys.exit(main())
