"""Print what lets a shell complete commands and their options: ``source <(asm-gym completion bash)``, or ``zsh``."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import partial
from importlib import import_module
from typing import Any, Literal

from rich.console import Console

from asm_gym.scripts.cli import COMMANDS, MODULES
from asm_gym.scripts.command import option, run
from asm_gym.scripts.reproduce import STUDIES

_SCRIPT = """\
_asm_gym() {{
    local words
    case "$COMP_CWORD:${{COMP_WORDS[1]}}" in
        1:*) words="{commands}" ;;
{cases}
    esac
    COMPREPLY=($(compgen -W "$words" -- "${{COMP_WORDS[COMP_CWORD]}}"))
}}
complete -o default -F _asm_gym asm-gym
"""
_FOR_ZSH = "autoload -U +X bashcompinit && bashcompinit\n"


@dataclass(frozen=True)
class Args:
    """What is typed."""

    shell: Literal["bash", "zsh"] = option("bash", positional=True)
    """Shell."""


def print_script(args: Args, console: Console) -> None:
    """Print the script that the shell reads."""
    cases = []
    for name in COMMANDS:
        words = " ".join(_words_after(name))
        cases.append(f'        *:{name}) words="{words}" ;;')
    script = _SCRIPT.format(commands=" ".join(COMMANDS), cases="\n".join(cases))
    if args.shell == "zsh":
        script = _FOR_ZSH + script
    print(script, end="")


def _words_after(name: str) -> list[str]:
    """Return the options of a command, or the studies of ``reproduce``."""
    if name == "reproduce":
        return list(STUDIES)
    try:
        module: Any = import_module(f"asm_gym.scripts.{MODULES.get(name, name)}")
    except ImportError:  # its extra is not installed
        return ["--help"]
    names = [each.name for each in fields(module.Args) if not each.metadata.get("positional")]
    return ["--help", *(f"--{each.replace('_', '-')}" for each in names)]


main = partial(run, "completion", Args, print_script)
