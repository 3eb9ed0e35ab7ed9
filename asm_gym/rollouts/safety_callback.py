"""A callback of stable-baselines3 that logs what the guard did, and what wore the arm, in each episode."""

from __future__ import annotations

import warnings
from typing import Any, NamedTuple

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback

from asm_gym.readings import spans

FIRST_STEPS = 1_000  # after which it is said whether the agent could act in most of them


class GuardedStep(NamedTuple):
    """What the guard did in one step, and what wore the arm."""

    surprise: float  # in thresholds
    alarm: bool
    cost: float
    overridden: bool
    slowed: float  # share of the action that the speed limit removed
    force: float  # largest contact force within the step [N]
    impulse: float  # contact force beyond 40 N, summed over physics substeps [N s]
    joint_stops: int
    self_contacts: int

    @classmethod
    def of(cls, info: dict[str, Any]) -> GuardedStep:
        """Return the step that an ``info`` describes; what strains the arm is 0 where nothing measures it."""
        return cls(
            surprise=float(info["asm_surprise"]) / float(info["asm"]["threshold"]),
            alarm=bool(info["asm_alarm"]),
            cost=float(info["cost"]),
            overridden=bool(info["asm_intervened"]),
            slowed=float(info["asm"]["slowed"]),
            force=float(info.get("contact_force", 0.0)),
            impulse=float(info.get("contact_impulse", 0.0)),
            joint_stops=int(info.get("joint_stops", 0)),
            self_contacts=int(info.get("self_contacts", 0)),
        )


class SafetyCallback(BaseCallback):
    """Log means over finished episodes to stable-baselines3's logger.

    ``safety/surprise``: the largest surprise in thresholds. ``safety/alarms``: the number of alarms. ``safety/cost``:
    steps in alarm. ``safety/overridden``: steps in which a reflex acted. ``safety/slowed``: the mean share
    of the action that the speed limit removed. Of this package's environments also ``safety/force``: the largest
    contact force [N]. ``safety/impulse``: contact force beyond 40 N, summed over time [N s]. ``safety/joint_stops`` and
    ``safety/self_contacts``: joints at their stops, and contacts of the robot with itself, summed over steps.

    After the first 1,000 steps it warns where most of them were in alarm, or a reflex acted.

    Raises:
        KeyError: the environment is not guarded.
        ValueError: a wrapper hides from the learner that an episode has ended.
    """

    def __init__(self) -> None:
        super().__init__()
        self.ended: list[dict[str, float]] = []  # the numbers of all episodes that have ended
        self._steps_seen = 0
        self._stopped_seen = 0

    def _on_training_start(self) -> None:
        self._steps: list[list[GuardedStep]] = [[] for _ in range(self.training_env.num_envs)]
        self._last_steps = np.zeros(self.training_env.num_envs, np.int64)  # of the episode

    def _on_step(self) -> bool:
        infos = self.locals["infos"]
        dones = self.locals["dones"]
        for member, (info, done) in enumerate(zip(infos, dones, strict=True)):
            if "asm" not in info:
                raise KeyError('info has no "asm": wrap the environment in NeuralASMSafety')
            self._check_end(member, int(info["asm_steps"]), bool(done))
            step = GuardedStep.of(info)
            self._count(step)
            self._steps[member].append(step)
            if done:
                self._log(self._steps[member])
                self._steps[member].clear()
        return True

    def _check_end(self, member: int, steps: int, done: bool) -> None:
        """Raise ValueError where the guard began an episode, and the learner was told of no end."""
        if steps <= self._last_steps[member]:
            raise ValueError(
                f"the guard of environment {member} began an episode within one of the learner: "
                f'info["asm_steps"] is {steps} after {self._last_steps[member]}. A wrapper outside '
                "the guard resets it and hides that the episode ended. Pass terminated and "
                "truncated on to the learner"
            )
        self._last_steps[member] = 0 if done else steps

    def _count(self, step: GuardedStep) -> None:
        """Count a step, and warn once where the agent could not act in most of the first ones."""
        self._steps_seen += 1
        self._stopped_seen += step.alarm or step.overridden
        if self._steps_seen == FIRST_STEPS and 2 * self._stopped_seen > FIRST_STEPS:
            warnings.warn(
                f"{self._stopped_seen} of the first {FIRST_STEPS} steps of learning are in alarm, "
                "or a reflex acts: the memory does not know how this agent explores, and the agent "
                "learns little. "
                "Use a memory of the body, as NeuralASMSafety(env) does or asm-gym babble records; "
                'or on_alarm="monitor", under which nothing is held and no contact is limited',
                stacklevel=2,
            )

    def _log(self, steps: list[GuardedStep]) -> None:
        """Log the numbers of an episode."""
        episode = {
            "surprise": max(step.surprise for step in steps),
            "slowed": float(np.mean([step.slowed for step in steps])),
            "alarms": len(spans(np.array([step.alarm for step in steps]))),
            "force": max(step.force for step in steps),
        }
        for name in ("cost", "overridden", "impulse", "joint_stops", "self_contacts"):
            episode[name] = sum(getattr(step, name) for step in steps)
        self.ended.append(episode)
        for name, value in episode.items():
            self.logger.record_mean(f"safety/{name}", float(value))
