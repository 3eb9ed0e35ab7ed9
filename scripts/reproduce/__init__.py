"""``asm-gym reproduce <study>``: the claims of the method, each as one study with a figure, tables and every number."""

from __future__ import annotations

import sys
from importlib import import_module
from typing import Any, NamedTuple

from asm_gym.scripts import command
from asm_gym.scripts.cli import usage
from asm_gym.scripts.command import DONE, REFUSED, exit_code
from asm_gym.validation import check_choice


class Study(NamedTuple):
    """What a study asks, and whether it judges the recordings of another run, which must be there."""

    summary: str
    needs_a_run: bool = False


STUDIES = {
    "memorise_and_recall": Study("one network learns skills, recalls each from a cue"),
    "abstract": Study("one network, six skills, no label: the abstract"),
    "local_learning": Study("local updates against backpropagation through time"),
    "speed_accuracy": Study("more inference, or slower movements, for more accuracy"),
    "failure": Study("does surprise tell that a policy will fail"),
    "harm": Study("harm avoided against success kept, under any policy"),
    "hours": Study("alarms an hour of a shipped memory, as promised?", needs_a_run=True),
    "one_energy": Study("surprise, completion, reaction by one energy", needs_a_run=True),
    "real_arms": Study("faults in recordings of real arms, once downloaded", needs_a_run=True),
}
INDEPENDENT = tuple(name for name, study in STUDIES.items() if not study.needs_a_run)


def main(argv: list[str] | None = None) -> int:
    """Runs one study, or all that need no other run's folder, and returns the exit code."""
    name, *rest = (sys.argv[1:] if argv is None else argv) or ["--help"]
    if name in ("-h", "--help"):
        notes = f"all runs {', '.join(INDEPENDENT)}.", "The others need recordings: of asm-gym evaluate, or of a file."
        print(usage("asm-gym reproduce STUDY", {name: study.summary for name, study in STUDIES.items()}, *notes))
        return DONE

    def chosen() -> int:
        check_choice("study", name, ("all", *STUDIES))
        return everything(rest) if name == "all" else _run(name, rest)

    return exit_code("reproduce", chosen)


def everything(argv: list[str]) -> int:
    """Runs the independent studies; the options are checked against each of them before the first begins."""
    from asm_gym.scripts.reproduce.kit import Config

    command.parse("reproduce all", Config, argv, f"Run {', '.join(INDEPENDENT)}.")
    for name in INDEPENDENT:
        command.parse(f"reproduce {name}", options_of(name), argv)
    code = DONE
    for name in INDEPENDENT:
        code = max(code, _run(name, argv))
        if code > REFUSED:  # interrupted
            break
    return code


def _run(name: str, argv: list[str]) -> int:
    from asm_gym.scripts.reproduce import kit

    return kit.main(_module(name), argv)


def options_of(study: str) -> Any:
    """The dataclass of a study's options."""
    return _module(study).Config


def _module(study: str) -> Any:
    return import_module(f"asm_gym.scripts.reproduce.{study}")
