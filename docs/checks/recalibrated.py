"""Sets the threshold of a shipped memory anew, on recordings of its body, and examines it; its weights stay.

    python docs/checks/recalibrated.py panda_100hz
    python docs/checks/recalibrated.py panda_100hz as-shipped   examined alone, at the thresholds that it has

What is missing in the run's folder is recorded. It leaves recalibrated.asm and card.md there.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from rich.console import Console

from asm_gym import NeuralASM
from asm_gym.evaluation.tables import markdown
from asm_gym.rollouts.pretraining.healthy import calibrate_body
from asm_gym.rollouts.pretraining.model_card import at_rates, card
from asm_gym.scripts.babble import RATES, Args, calibrated, examined, healthy_hours, healthy_lessons

AS_SHIPPED = "as-shipped"
YOUNG = tuple(f"runs/{task}_young/agent.npz" for task in ("lift", "stack", "door"))


def _body(robot: str = "Panda", hz: int | None = None, **settings: Any) -> Args:
    """The Panda's lessons are led by agents, those of others reach for places."""
    folder = "_".join(
        ["runs/babble", *([robot.lower()] if robot != "Panda" or hz else []), *([f"{hz}hz"] if hz else [])]
    )
    lessons: dict[str, Any] = {"guides": YOUNG} if robot == "Panda" else {"reaching": True}
    return Args(robot=robot, stream_freq=hz, workers="1", out=Path(folder), **lessons, **settings)


RUNS = {
    "panda": _body(healthy_episodes=520, corpus=Path("runs/corpus")),
    "sawyer": _body("Sawyer", healthy_episodes=1230, exam_episodes=480),
    "iiwa": _body("IIWA", healthy_episodes=1230, exam_episodes=480),
    "sawyer_100hz": _body("Sawyer", 100, healthy_episodes=1230, exam_episodes=480),
    "iiwa_100hz": _body("IIWA", 100, healthy_episodes=1230, exam_episodes=480),
    "panda_100hz": _body(
        hz=100,
        episodes=30,
        healthy_episodes=840,
        exam_episodes=330,
        exam_policies=("lift_sac", "stack_sac"),
        exam_tasks=("PickPlaceMilk",),
    ),
}


def recalibrated(args: Args, console: Console) -> NeuralASM:
    """The shipped memory, with a threshold and ceilings from the run's hours."""
    lessons = healthy_lessons(args, console)
    hours = [episode for episode in healthy_hours(args, console) if episode.success]
    memory = NeuralASM.pretrained(args.name)
    memory.about.pop("false_alarm_rate", None)  # of a promise by the episode, before there were others
    memory.about |= calibrated([*lessons.whole, *hours], args.false_alarms_per_hour)
    memory.about["false_alarms_per_hour"] = args.false_alarms_per_hour
    calibrate_body(memory, lessons, hours, args.false_alarms_per_hour).save(args.out / "recalibrated.asm")
    return memory


def main(name: str, how: str = "") -> None:
    if how not in ("", AS_SHIPPED):
        sys.exit(f"either {AS_SHIPPED} or nothing stands behind {name}, got {how!r}")
    args, console = RUNS[name], Console()
    args.out.mkdir(parents=True, exist_ok=True)
    memory = NeuralASM.pretrained(name) if how else recalibrated(args, console)
    marks = examined(args, memory, console)
    text = f"{markdown(card(marks, memory, args.window))}\n\n{at_rates(marks, memory, RATES)}\n"
    (args.out / "card.md").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main(*sys.argv[1:])
