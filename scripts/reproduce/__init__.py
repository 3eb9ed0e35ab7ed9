"""``asm-gym reproduce <study>``: the claims of the method, each as one study with a figure, tables and every number."""

from __future__ import annotations

import sys
from importlib import import_module
from typing import Any

from asm_gym.scripts import command
from asm_gym.scripts.cli import usage
from asm_gym.scripts.command import DONE, REFUSED, exit_code
from asm_gym.validation import check_choice

INDEPENDENT = {
    "memorise_and_recall": "one network learns skills, recalls each from a cue",
    "panda": "one network, six skills of the Panda, no label",
    "local_learning": "local updates against backpropagation through time",
    "harm": "harm avoided against success kept, under any policy",
    "chunks": "blows foretold from chunks of actions, and false verdicts",
}
STUDIES = {
    **INDEPENDENT,
    "hours": "alarms an hour of a shipped memory, as promised?",
    "real_arms": "faults in recordings of real arms, once downloaded",
}
"""Every study; all but the independent ones need recordings."""


def main(argv: list[str] | None = None) -> int:
    """Run one study, or all that need no recordings, and return the exit code."""
    name, *rest = (sys.argv[1:] if argv is None else argv) or ["--help"]
    if name in ("-h", "--help"):
        notes = f"all runs {', '.join(INDEPENDENT)}.", "The others need recordings: of asm-gym evaluate, or of a file."
        print(usage("asm-gym reproduce STUDY", STUDIES, *notes))
        return DONE

    def chosen() -> int:
        check_choice("study", name, ("all", *STUDIES))
        return everything(rest) if name == "all" else _run(name, rest)

    return exit_code("reproduce", chosen)


def everything(argv: list[str]) -> int:
    """Run the independent studies; the options are checked against each of them before the first begins."""
    from asm_gym.scripts.reproduce.kit import Config

    command.parse("reproduce all", Config, argv)
    for name in INDEPENDENT:
        command.parse(f"reproduce {name}", _module(name).Config, argv)
    code = DONE
    for name in INDEPENDENT:
        code = max(code, _run(name, argv))
        if code > REFUSED:  # interrupted
            break
    return code


def _run(study: str, argv: list[str]) -> int:
    from asm_gym.scripts.reproduce import kit

    return kit.main(_module(study), argv)


def _module(study: str) -> Any:
    return import_module(f"asm_gym.scripts.reproduce.{study}")
