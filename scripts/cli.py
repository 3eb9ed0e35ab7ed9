"""``asm-gym <command>``: one entry for every script; each is imported only when it is asked for."""

from __future__ import annotations

import sys
from importlib import import_module
from typing import NamedTuple

from asm_gym import __version__


class Command(NamedTuple):
    """A script: the module whose ``main(argv) -> int`` it is, and one line of what it does."""

    module: str
    summary: str


COMMANDS: dict[str, Command] = {
    "demo": Command("asm_gym.scripts.demo", "a robot that notices when something is wrong, in a few minutes"),
    "collect": Command("asm_gym.scripts.collect", "episodes of a policy, as a Minari dataset"),
    "import": Command(
        "asm_gym.scripts.import_demonstrations", "robosuite's or robomimic's HDF5 demonstrations, likewise"
    ),
    "train": Command("asm_gym.scripts.train", "an agent: cloned from an expert, improved by SAC, TD3 or PPO"),
    "train-safely": Command(
        "asm_gym.scripts.reproduce.safe_training", "the same agent trained alone and under the safety wrapper"
    ),
    "lagrangian": Command(
        "asm_gym.scripts.examples.lagrangian", "an example: PPO with a Lagrange multiplier on alarms"
    ),
    "evaluate": Command("asm_gym.scripts.evaluate", "tasks x monitors x faults: who notices what, with a report"),
    "adopt": Command(
        "asm_gym.scripts.reproduce.transfer", "one policy's memory on another: as it is, re-calibrated, fitted anew"
    ),
    "repertoire": Command(
        "asm_gym.scripts.reproduce.repertoire", "one memory of all skills against one for each, over seeds"
    ),
    "react": Command(
        "asm_gym.scripts.reproduce.reflexes", "reflexes x faults: what acting on alarms is worth, paired by seed"
    ),
    "reproduce": Command("asm_gym.scripts.reproduce", "the method's claims: figures, tables, and where they fail"),
    "benchmark": Command("asm_gym.scripts.benchmark", "speeds, as ratios against rivals in the same run, and experts"),
    "doctor": Command("asm_gym.scripts.doctor", "what this machine lacks, and the command that installs it"),
}


def usage() -> str:
    """The commands, a line each."""
    width = max(map(len, COMMANDS))
    lines = [f"  {name:<{width}}  {command.summary}" for name, command in COMMANDS.items()]
    return "\n".join(
        ["usage: asm-gym COMMAND [OPTIONS]", "", *lines, "", "`asm-gym COMMAND --help` lists the options of one."]
    )


def main(argv: list[str] | None = None) -> int:
    """Runs one command, and returns its exit code: 2 where there is no such command."""
    name, *rest = (sys.argv[1:] if argv is None else argv) or ["--help"]
    if name in ("-h", "--help", "help"):
        print(usage())
        return 0
    if name == "--version":
        print(f"asm-gym {__version__}")
        return 0
    if name not in COMMANDS:
        print(f"asm-gym: unknown command {name!r}; the commands are {', '.join(COMMANDS)}", file=sys.stderr)
        return 2
    code: int = import_module(COMMANDS[name].module).main(rest)
    return code


if __name__ == "__main__":
    sys.exit(main())
