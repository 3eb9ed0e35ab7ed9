"""``asm-gym <command>``: one entry for every command; each is imported only when it is asked for."""

from __future__ import annotations

import sys
from importlib import import_module
from typing import NamedTuple

from asm_gym import __version__
from asm_gym.extras import needed_for
from asm_gym.scripts.command import DONE, exit_code
from asm_gym.validation import check_choice


class Subcommand(NamedTuple):
    """The module whose ``main(argv) -> int`` it is, and one line of what it does."""

    module: str
    summary: str


GROUPS: dict[str, dict[str, Subcommand]] = {
    "Use it": {
        "demo": Subcommand("asm_gym.scripts.demo", "a robot that notices when something is wrong"),
        "collect": Subcommand("asm_gym.scripts.collect", "record episodes of a policy, as a Minari dataset"),
        "inspect": Subcommand("asm_gym.scripts.inspect_log", "what a log holds, and what would be done about it"),
        "fit": Subcommand("asm_gym.scripts.fit", "a memory from recorded episodes or logs"),
        "babble": Subcommand("asm_gym.scripts.babble", "one memory of a body, for any policy"),
        "evaluate": Subcommand("asm_gym.scripts.evaluate", "tasks x monitors x faults: who notices what"),
        "watch": Subcommand("asm_gym.scripts.watch", "a log, or rows as they come: when, where, how surprising"),
        "train": Subcommand("asm_gym.scripts.train", "an agent: cloned, then improved by SAC, TD3 or PPO"),
        "push": Subcommand("asm_gym.scripts.push", "a memory and its card, to the Hugging Face hub"),
        "completion": Subcommand("asm_gym.scripts.completion", "what makes your shell complete all of this"),
        "warmup": Subcommand("asm_gym.scripts.warmup", "compile ahead what the first guarded step waits for"),
        "doctor": Subcommand("asm_gym.scripts.doctor", "what this machine lacks, and what installs it"),
    },
    "Study it": {
        "corpus": Subcommand("asm_gym.scripts.corpus", "the recordings that tables of detection are judged on"),
        "reproduce": Subcommand("asm_gym.scripts.reproduce", "the method's claims, one study each; all runs many"),
        "benchmark": Subcommand("asm_gym.scripts.benchmark", "speeds as ratios against rivals"),
    },
}
COMMANDS = {name: command for group in GROUPS.values() for name, command in group.items()}


def usage() -> str:
    """The commands, a line each."""
    width = max(map(len, COMMANDS))
    lines = ["usage: asm-gym COMMAND [OPTIONS]", "       asm-gym --version"]
    for title, group in GROUPS.items():
        lines += ["", f"{title}:", *(f"  {name:<{width}}  {command.summary}" for name, command in group.items())]
    return "\n".join([*lines, "", "asm-gym COMMAND --help lists the options of one."])


def main(argv: list[str] | None = None) -> int:
    """Runs one command, and returns its exit code, as ``asm_gym.scripts.command`` says."""
    name, *rest = (sys.argv[1:] if argv is None else argv) or ["--help"]
    if name in ("-h", "--help", "help", "--version"):
        print(f"asm-gym {__version__}" if name == "--version" else usage())
        return DONE

    def chosen() -> int:
        check_choice("command", name, COMMANDS)
        with needed_for("this command"):
            main_of = import_module(COMMANDS[name].module).main
        code: int = main_of(rest)
        return code

    return exit_code(name if name in COMMANDS else "", chosen)


if __name__ == "__main__":
    sys.exit(main())
