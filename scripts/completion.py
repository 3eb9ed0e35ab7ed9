"""Prints what makes bash and zsh complete commands, studies and options: add its output to ~/.bashrc or ~/.zshrc.

asm-gym completion >> ~/.bashrc
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import import_module
from typing import Any

from rich.console import Console

from asm_gym.scripts.command import run
from asm_gym.scripts.options import rows

SCRIPT = """\
[ -n "${{ZSH_VERSION:-}}" ] && autoload -U +X bashcompinit && bashcompinit
_asm_gym() {{
    local words
    case "${{COMP_WORDS[1]:-}} ${{COMP_WORDS[2]:-}}" in
{cases}
        *) words="" ;;
    esac
    [ "$COMP_CWORD" = 1 ] && words="{commands}"
    COMPREPLY=($(compgen -W "$words" -- "${{COMP_WORDS[COMP_CWORD]}}"))
}}
complete -o default -F _asm_gym asm-gym
"""
"""Where no word fits, files do."""


@dataclass(frozen=True)
class Args:
    """There are no options."""


def words() -> Iterator[tuple[str, str]]:
    """What may follow, by what was typed: a command, or a command and what it is of."""
    from asm_gym.scripts import benchmark, cli, reproduce

    for study in reproduce.STUDIES:
        yield f"reproduce {study}", _options(reproduce.options_of(study))
    for name, kind in benchmark.BENCHMARKS.items():
        yield f"benchmark {name}", _options(kind)
    yield "reproduce", " ".join(("all", *reproduce.STUDIES))
    yield "benchmark", " ".join(benchmark.BENCHMARKS)
    for name, command in cli.COMMANDS.items():
        if name not in ("reproduce", "benchmark"):
            yield name, _options(import_module(command.module).Args)


def _options(kind: Any) -> str:
    return " ".join(row.name.split()[0] for row in rows(kind) if not row.positional)


def show(args: Args, console: Console) -> None:
    """Prints the script."""
    from asm_gym.scripts import cli

    cases = "\n".join(f'        "{typed}"*) words="{said}" ;;' for typed, said in words())
    print(SCRIPT.format(cases=cases, commands=" ".join(cli.COMMANDS)), end="")


def main(argv: list[str] | None = None) -> int:
    """Prints the script, and returns the exit code."""
    return run("completion", Args, show, argv, __doc__)


if __name__ == "__main__":
    sys.exit(main())
