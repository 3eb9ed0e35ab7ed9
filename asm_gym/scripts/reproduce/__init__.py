"""``asm-gym reproduce <study>``: the claims of the method, each as one study with tables and every number."""

from __future__ import annotations

import sys
from importlib import import_module

from asm_gym.extras import needed_for
from asm_gym.scripts.cli import usage
from asm_gym.scripts.command import DONE, exit_code
from asm_gym.validation import check_choice

STUDIES = {
    "memorise_and_recall": "one network learns skills and recalls each from a cue",
    "repertoire": "capacity, forgetting and labels on letters, beside movement primitives",
    "panda": "one network learns six skills of the Panda without labels",
    "harm": "harm that the guard avoids, and success that it keeps",
    "learning": "agents that learn from scratch: harm and reward, alone and under guards",
    "chunks": "impacts predicted from chunks of actions, and false predictions",
    "day": "a simulated day of an arm: incidents against ten events",
    "alarm_causes": "the channel that an alarm points to, and its cause in words",
    "hours": "false alarms an hour of a shipped memory; needs a corpus",
    "wear": "how soon drifting encoders and growing friction are told as wear",
    "real_arms": "faults added to recordings of real arms (to download)",
}

MODULES = {"panda": "six_skills", "learning": "learning_safely", "wear": "wear_of_an_arm"}
"""Modules of studies that are not named after them."""


def main(argv: list[str] | None = None) -> int:
    """Run one study and return the exit code."""
    name, *rest = (sys.argv[1:] if argv is None else argv) or ["--help"]
    if name in ("-h", "--help"):
        print(usage("asm-gym reproduce STUDY", STUDIES))
        return DONE

    def chosen() -> int:
        from asm_gym.scripts.reproduce import kit

        check_choice("study", name, STUDIES)
        with needed_for(f"asm-gym reproduce {name}"):
            module = import_module(f"asm_gym.scripts.reproduce.{MODULES.get(name, name)}")
        return kit.main(name, module, rest)

    return exit_code("reproduce", chosen)
