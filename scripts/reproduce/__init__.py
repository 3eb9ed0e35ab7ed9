"""``asm-gym reproduce <study>``: the claims of the method, each as one study with a figure, tables and every number."""

from __future__ import annotations

import sys
from importlib import import_module

STUDIES = {
    "memorise_and_recall": "one network learns a repertoire, and expresses each skill from a cue",
    "contextual_inference": "the state says which skill is running, and nobody told it",
    "express_skills": "one memory closes the loop in robosuite: its own motor prediction drives the arm",
    "local_learning": "local updates against the gradient of backpropagation through time",
    "speed_accuracy": "more inference, or slower movements, for more accuracy",
    "fault_detection": "surprise across the repertoire against a library told the right or the wrong skill",
}


def usage() -> str:
    """The studies, a line each."""
    width = max(map(len, STUDIES))
    lines = [f"  {name:<{width}}  {summary}" for name, summary in STUDIES.items()]
    return "\n".join(
        ["usage: asm-gym reproduce STUDY|all [OPTIONS]", "", *lines, "", "all runs them one after another."]
    )


def main(argv: list[str] | None = None) -> int:
    """Runs one study, or all, and returns the exit code: 2 where there is no such study."""
    name, *rest = (sys.argv[1:] if argv is None else argv) or ["--help"]
    if name in ("-h", "--help"):
        print(usage())
        return 0
    if name != "all" and name not in STUDIES:
        print(f"asm-gym reproduce: unknown study {name!r}; the studies are all, {', '.join(STUDIES)}", file=sys.stderr)
        return 2
    code = 0
    for study in STUDIES if name == "all" else [name]:
        code = max(code, import_module(f"asm_gym.scripts.reproduce.{study}").main(rest))
    return code
