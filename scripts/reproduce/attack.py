"""What who writes to the senses can hide from the memory: slow drifts, a replayed recording, senses that say the mean.

The robot itself is healthy, and the guard only watches. From a step on, what reaches the memory is another's.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import gymnasium as gym
import mujoco
import numpy as np
from numpy.typing import NDArray

from asm_gym.evaluation.tables import Column, tabulate
from asm_gym.monitors import NeuralASM
from asm_gym.policies import make_policy, rollout
from asm_gym.rollouts.staging import environment
from asm_gym.scripts.options import option
from asm_gym.scripts.reproduce import kit
from asm_gym.spec import StreamSpec
from asm_gym.tasks import env_id
from asm_gym.wrappers import NeuralASMSafety, StreamRecorder

Forged = Callable[[NDArray[np.float32], int], NDArray[np.float32]]
"""What a row (D,) becomes, so many steps after the attack began."""

POSITION, BOTH = "encoder alone", "encoder and speed"


@dataclass(frozen=True)
class Config(kit.Config):
    """Attacks on the senses of a robot whose expert is watched by a shipped memory."""

    seeds: int = option(1, least=1)
    """How often it is done anew."""
    memory: str = option("panda", metavar="NAME|FILE")
    """A shipped memory, or the file of one."""
    task: str = option("Stack", metavar="TASK")
    """What the expert does."""
    episodes: int = option(5, quick=1, least=1)
    """Episodes of each attack."""
    rates: tuple[float, ...] = option((0.005, 0.02, 0.1), quick=(0.1,), least=1, metavar="RAD/S")
    """How fast encoders drift."""


class Attack(NamedTuple):
    """One attack: on a joint at a rate [rad/s], or on all senses."""

    what: str
    joint: int = -1
    rate: float = 0.0


class Forging(gym.Wrapper[Any, Any, Any, Any]):
    """Hands on another stream than the robot's, from ``onset`` on."""

    def __init__(self, env: gym.Env[Any, Any], forged: Forged, onset: int) -> None:
        super().__init__(env)
        self._forged, self._onset, self._t = forged, onset, 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        self._t = 0
        return super().reset(seed=seed, options=options)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = super().step(action)
        self._t += 1
        if self._t > self._onset:
            info = {**info, "stream": self._forged(info["stream"].copy(), self._t - self._onset)}
        return observation, reward, terminated, truncated, info


ONSET = 20
"""Row from which on somebody else speaks."""

DIFFERS = 2.0
"""Hand and joints contradict each other where they are so many times as far apart as they ever were before."""


def forging(attack: Attack, spec: StreamSpec, recorded: NDArray[np.float32]) -> Forged:
    """What an attack makes of rows; ``recorded`` (T, D) is another healthy episode of the same task."""
    position, velocity = (spec.slices[name].start for name in ("joint_position", "joint_velocity"))
    senses = spec.sensory

    def drift(row: NDArray[np.float32], t: int) -> NDArray[np.float32]:
        row[position + attack.joint] += attack.rate * spec.dt * t
        row[velocity + attack.joint] += attack.rate * (attack.what == BOTH)
        return row

    def replay(row: NDArray[np.float32], t: int) -> NDArray[np.float32]:
        row[senses] = recorded[min(ONSET + t, len(recorded) - 1), senses]
        return row

    def mean(row: NDArray[np.float32], t: int) -> NDArray[np.float32]:
        row[senses] = recorded[:, senses].mean(axis=0)
        return row

    return {"replay": replay, "means": mean}.get(attack.what, drift)


def attacked(job: tuple[Attack, int], config: Config) -> kit.Record:
    """One episode under one attack."""
    attack, seed = job
    memory = NeuralASM.load(config.memory) if config.memory.endswith(".asm") else NeuralASM.pretrained(config.memory)
    env = environment(env_id(config.task))
    recorder = StreamRecorder(env)
    rollout(recorder, make_policy("scripted", env, seed=seed + 500), seed + 500)
    forged = forging(attack, memory.spec, recorder.finish().stream)
    watched = NeuralASMSafety(Forging(env, forged, ONSET), memory, "monitor", on_overrun="ignore")
    infos: list[dict[str, Any]] = []
    rollout(watched, make_policy("scripted", env, seed=seed), seed, infos.append)
    apart = hand_off(env.unwrapped, memory.spec, np.stack([info["stream"] for info in infos]))
    differs = np.flatnonzero(apart[ONSET:] > DIFFERS * apart[:ONSET].max())
    alarm = next((t for t, i in enumerate(infos) if t >= ONSET and i["asm"]["reason"] == "surprise"), None)
    took = (len(infos) if alarm is None else alarm + 1) - ONSET
    return {
        **attack._asdict(),
        "seed": seed,
        "found": alarm is not None,
        "seconds": took * memory.spec.dt,
        "drift": attack.rate * took * memory.spec.dt,
        "differs": attack.rate * (differs[0] + 1) * memory.spec.dt if differs.size else np.nan,
    }


def hand_off(arm: Any, spec: StreamSpec, rows: NDArray[np.float32]) -> NDArray[np.float64]:
    """(T,) how far the hand's place in ``rows`` (T, D) is from where the joints' angles in them put it [m]."""
    robot, model = arm.robosuite_env.robots[0], arm.simulation.model
    data, found = mujoco.MjData(model), np.zeros(len(rows))
    data.qpos[:] = arm.simulation.data.qpos
    for t, row in enumerate(rows):
        data.qpos[robot._ref_joint_pos_indexes] = row[spec.slices["joint_position"]]
        mujoco.mj_kinematics(model, data)
        place = data.site_xpos[robot.eef_site_id["right"]]
        found[t] = np.linalg.norm(row[spec.slices["hand_position"]] - place)
    return found


def run(config: Config) -> kit.Findings:
    """Every attack on its own episodes."""
    joints = range(7)
    attacks = [Attack(how, j, rate) for how in (POSITION, BOTH) for rate in config.rates for j in joints]
    attacks += [Attack("replay"), Attack("means")]
    jobs = [
        (a, 2000 + 100 * again + n) for again in config.repetitions for a in attacks for n in range(config.episodes)
    ]
    records = kit.each("episodes", partial(attacked, config=config), jobs, config)

    def cell(how: str, rate: float, joint: int) -> str:
        own = [r for r in records if (r["what"], r["rate"], r["joint"]) == (how, rate, joint)]
        found = [r["drift"] for r in own if r["found"]]
        most = max(r["drift"] for r in own)
        return f"never ({most:.2f})" if not found else f"{np.median(found):.3f} ({len(found)} of {len(own)})"

    columns: list[Column[int]] = [Column("joint", str)]
    columns += [
        Column(f"{how}, {rate:g} rad/s", partial(cell, how, rate)) for how in (POSITION, BOTH) for rate in config.rates
    ]
    drifts = tabulate(
        "Drift that is reached before the first alarm [rad]; where there is none, by the end", columns, joints
    )

    def against(rate: float, joint: int) -> str:
        own = [r["differs"] for r in records if (r["what"], r["rate"], r["joint"]) == (POSITION, rate, joint)]
        return "never" if np.isnan(own).any() else f"{np.median(own):.3f}"

    columns = [Column("joint", str), *(Column(f"{rate:g} rad/s", partial(against, rate)) for rate in config.rates)]
    kinematic = tabulate(
        "Drift at which the hand's place, if it is not computed from the encoders, contradicts them [rad]",
        columns,
        joints,
    )

    def whole(what: str) -> str:
        own = [r for r in records if r["what"] == what]
        found = [r["seconds"] for r in own if r["found"]]
        return f"{len(found)} of {len(own)}" + (f", after {np.median(found):.2f} s" if found else "")

    others: list[Column[str]] = [Column("all senses replaced by", str), Column("found", whole)]
    names = tabulate("Whole senses", others, ("replay", "means"))
    return kit.Findings(records, [drifts, kinematic, names])
