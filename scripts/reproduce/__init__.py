"""``asm-gym reproduce <study>``: the claims of the method, each as one study with a figure, tables and every number."""

from __future__ import annotations

import sys
from importlib import import_module

from asm_gym.scripts.cli import usage
from asm_gym.scripts.command import DONE, exit_code
from asm_gym.validation import check_choice

STUDIES = {
    "memorise_and_recall": "one network learns skills, recalls each from a cue",
    "panda": "one network, six skills of the Panda, no label",
    "local_learning": "local updates against backpropagation through time",
    "harm": "harm avoided against success kept, under any policy",
    "chunks": "blows foretold from chunks of actions, and false verdicts",
    "hours": "alarms an hour of a shipped memory, as promised? needs a corpus",
    "real_arms": "faults in recordings of real arms, once downloaded",
}


def main(argv: list[str] | None = None) -> int:
    """Run one study and return the exit code."""
    name, *rest = (sys.argv[1:] if argv is None else argv) or ["--help"]
    if name in ("-h", "--help"):
        print(usage("asm-gym reproduce STUDY", STUDIES))
        return DONE

    def chosen() -> int:
        from asm_gym.scripts.reproduce import kit

        check_choice("study", name, STUDIES)
        return kit.main(import_module(f"asm_gym.scripts.reproduce.{name}"), rest)

    return exit_code("reproduce", chosen)
