"""``asm-gym COMMAND``: every command; its module is imported only when the command is called."""

from __future__ import annotations

import sys
from importlib import import_module
from typing import Any

from asm_gym.extras import needed_for
from asm_gym.scripts.command import DONE, exit_code
from asm_gym.scripts.shortage import check_address_space
from asm_gym.validation import check_choice
from asm_gym.version import __version__

COMMANDS = {
    "demo": "show the safety wrapper on one task, with injected faults",
    "collect": "record episodes of a policy, as a Minari dataset",
    "inspect": "show how a log is read: clock, columns, roles",
    "fit": "learn a memory from recorded episodes or logs",
    "babble": "learn a memory of a body, for any policy",
    "evaluate": "compare monitors on tasks and faults",
    "watch": "watch a log or live rows with a memory",
    "limits": "print what healthy motion needs, as the robot's own settings",
    "train": "train an agent: cloned from an expert, then improved by SAC",
    "warmup": "compile once, so that the first guarded step does not wait",
    "doctor": "check this machine, and print what to install",
    "corpus": "record the episodes behind the detection tables",
    "reproduce": "run the studies behind the method's claims",
    "benchmark": "measure speeds as ratios against named rivals",
}

MODULES = {"inspect": "inspect_log"}  # modules with another name than their command


def usage(prog: str, lines: dict[str, str], *notes: str) -> str:
    """Return the help of a command that has parts, a line for each part."""
    width = max(map(len, lines))
    parts = (f"  {name:<{width}}  {summary}" for name, summary in lines.items())
    return "\n".join([f"usage: {prog} [OPTIONS]", "", *parts, "", *notes])


def main(argv: list[str] | None = None) -> int:
    """Run one command and return its exit code, as ``asm_gym.scripts.command`` lists them."""
    if argv is None:
        argv = sys.argv[1:]
    name, *rest = argv or ["--help"]
    if name == "--version":
        print(f"asm-gym {__version__}")
        return DONE
    if name in ("-h", "--help", "help"):
        print(usage("asm-gym COMMAND", COMMANDS, "asm-gym --version"))
        return DONE

    def work() -> int:
        check_choice("command", name, COMMANDS)
        if name != "doctor":
            check_address_space()
        with needed_for("this command"):
            module: Any = import_module(f"asm_gym.scripts.{MODULES.get(name, name)}")
        return module.main(rest)

    known = name if name in COMMANDS else ""
    return exit_code(known, work)
