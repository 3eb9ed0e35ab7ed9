"""Upload a memory and its card to the Hugging Face hub, or to the server that HF_ENDPOINT names.

asm_gym.monitors.shipped.from_hub("OWNER/NAME") reads it there.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path

from rich.console import Console

from asm_gym.monitors.shipped import push
from asm_gym.scripts.command import option, run


@dataclass(frozen=True)
class Args:
    """A memory for others."""

    memory: Path = option(positional=True, metavar="FILE.asm")
    """A calibrated monitor, such as asm-gym fit writes."""
    repo: str = option(positional=True, metavar="OWNER/NAME")
    """Repository on the hub; it is made where there is none."""
    private: bool = False
    """Only you see a repository that is made."""


def upload(args: Args, console: Console) -> None:
    """Upload, and print the address."""
    where = push(args.memory, args.repo, args.private)
    console.print(f"Uploaded to {where}", soft_wrap=True, highlight=False, markup=False)


main = partial(run, "push", Args, upload)
