"""``asm-gym COMMAND``: every command; its module is imported only when the command is called."""

from __future__ import annotations

import sys
from dataclasses import make_dataclass
from importlib import import_module
from typing import Annotated, Any, NamedTuple, Union

from asm_gym import __version__
from asm_gym.extras import needed_for
from asm_gym.scripts.command import DONE, exit_code
from asm_gym.validation import check_choice


class Command(NamedTuple):
    """Module with ``main(argv) -> int``, and a line of help."""

    module: str
    summary: str


COMMANDS = {
    "demo": Command("demo", "watch a robot notice that something is wrong"),
    "collect": Command("collect", "record episodes of a policy, as a Minari dataset"),
    "inspect": Command("inspect_log", "show what a log holds"),
    "fit": Command("fit", "learn a memory from recorded episodes or logs"),
    "babble": Command("babble", "learn one memory of a body, for any policy"),
    "evaluate": Command("evaluate", "compare monitors on tasks and faults"),
    "watch": Command("watch", "watch a log or live rows with a memory"),
    "train": Command("train", "train an agent: cloned from an expert, then improved by SAC"),
    "push": Command("push", "upload a memory and its card to the Hugging Face hub"),
    "warmup": Command("warmup", "compile now what the first guarded step would wait for"),
    "doctor": Command("doctor", "say what this machine lacks, and what installs it"),
    "corpus": Command("corpus", "record the episodes that the tables of detection are judged on"),
    "reproduce": Command("reproduce", "run the studies behind the method's claims"),
    "benchmark": Command("benchmark", "measure speeds as ratios against named rivals"),
}
COMPLETION = "--tyro-print-completion"


def usage(prog: str, lines: dict[str, str], *notes: str) -> str:
    """Return the help of a command that has parts, a line for each part."""
    width = max(map(len, lines))
    parts = (f"  {name:<{width}}  {summary}" for name, summary in lines.items())
    return "\n".join([f"usage: {prog} [OPTIONS]", "", *parts, "", *notes])


def main(argv: list[str] | None = None) -> int:
    """Run one command and return its exit code, as ``asm_gym.scripts.command`` lists them."""
    name, *rest = (sys.argv[1:] if argv is None else argv) or ["--help"]
    if name in ("-h", "--help", "help", "--version"):
        summaries = {name: command.summary for name, command in COMMANDS.items()}
        notes = f"asm-gym {COMPLETION} bash (or zsh, tcsh) prints a completion script.", "asm-gym --version"
        print(f"asm-gym {__version__}" if name == "--version" else usage("asm-gym COMMAND", summaries, *notes))
        return DONE

    def work() -> int:
        if name == COMPLETION:
            print_completion([name, *rest])
        check_choice("command", name, COMMANDS)
        with needed_for("this command"):
            main_of = import_module(f"asm_gym.scripts.{COMMANDS[name].module}").main
        code: int = main_of(rest)
        return code

    return exit_code(name if name in COMMANDS else "", work)


def print_completion(argv: list[str]) -> None:
    """Print tyro's completion script of all commands, studies and benchmarks; raises SystemExit when done."""
    import tyro

    tyro.cli(_union(_all_options()), prog="asm-gym", args=argv, config=(tyro.conf.OmitSubcommandPrefixes,))


def _all_options() -> dict[str, Any]:
    """Return the options of each command; of reproduce, a dataclass with a union of those of its studies."""
    from asm_gym.scripts import reproduce
    from asm_gym.scripts.options import parser

    found = {}
    for name, command in COMMANDS.items():
        if name != "reproduce":
            found[name] = parser(import_module(f"asm_gym.scripts.{command.module}").Args)
    studies = {study: parser(reproduce.options_of(study)) for study in reproduce.STUDIES}
    found["reproduce"] = make_dataclass("reproduce", [("study", _union(studies))])
    return found


def _union(kinds: dict[str, Any]) -> Any:
    import tyro

    annotated: Any = Annotated
    return Union[tuple(annotated[kind, tyro.conf.subcommand(name=name)] for name, kind in kinds.items())]  # noqa: UP007


if __name__ == "__main__":
    sys.exit(main())
