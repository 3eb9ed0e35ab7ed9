"""What an attacker who writes to the senses can hide: slow drifts of an encoder, or a replayed recording.

The robot is healthy and the guard only watches. From a step on, the guard receives a forged stream.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from asm_gym.evaluation.tables import Table
from asm_gym.monitors import NeuralASM
from asm_gym.policies import make_policy, rollout
from asm_gym.rollouts.staging import environment
from asm_gym.scripts.options import option
from asm_gym.scripts.reproduce import kit
from asm_gym.scripts.reproduce.kit import Record, where
from asm_gym.spec import StreamSpec
from asm_gym.tasks import env_id
from asm_gym.wrappers import NeuralASMSafety, StreamRecorder

Forge = Callable[[NDArray[np.float32], int], NDArray[np.float32]]
"""Function of a row (D,) and the number of steps since the attack began; returns the forged row."""

POSITION, BOTH, ALL = "encoder alone", "encoder and speed", "encoder, speed and hand"
REPLAY = "replay"
JOINTS = range(7)
ONSET = 20
"""First forged row."""


@dataclass(frozen=True)
class Config(kit.Config):
    """Attacks on the senses of a robot that a shipped memory watches."""

    seeds: int = option(1, least=1)
    """Number of repetitions, with other episodes."""
    memory: str = option("panda", metavar="NAME")
    """A shipped memory, or the path of an .asm file."""
    task: str = option("Stack", metavar="TASK")
    """Task of the expert."""
    episodes: int = option(5, quick=1, least=1)
    """Episodes of each attack."""
    rates: tuple[float, ...] = option((0.005, 0.02, 0.1), quick=(0.1,), least=1, metavar="RAD/S")
    """Drifts of an encoder."""


class Attack(NamedTuple):
    """A drift of one joint's senses [rad/s], or a replay of all senses."""

    what: str
    joint: int = -1
    rate: float = 0.0


class Forging(gym.Wrapper[Any, Any, Any, Any]):
    """Replace the stream by a forged one from ``ONSET`` on."""

    def __init__(self, env: gym.Env[Any, Any], forge: Forge) -> None:
        super().__init__(env)
        self._forge, self._steps = forge, 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        self._steps = 0
        return super().reset(seed=seed, options=options)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        *rest, info = super().step(action)
        self._steps += 1
        if self._steps > ONSET:
            info = {**info, "stream": self._forge(info["stream"].copy(), self._steps - ONSET)}
        return *rest, info


def forging(attack: Attack, spec: StreamSpec, recorded: NDArray[np.float32], chain: Any) -> Forge:
    """Return the forgery of an attack.

    Args:
        attack: what is forged.
        spec: of the stream.
        recorded: another healthy episode of the task (T, D), to replay.
        chain: kinematics of the arm, to move the hand with the joints.
    """
    position, velocity = (spec.slices[name].start for name in ("joint_position", "joint_velocity"))
    angles, place, turn = (spec.slices[name] for name in ("joint_position", "hand_position", "hand_orientation"))

    def drift(row: NDArray[np.float32], t: int) -> NDArray[np.float32]:
        before = chain.at(row[angles])
        row[position + attack.joint] += attack.rate * spec.dt * t
        row[velocity + attack.joint] += attack.rate * (attack.what != POSITION)
        if attack.what == ALL:
            moved = chain.at(row[angles]) - before
            row[place] += moved[:3]
            row[turn] += moved[3:]
        return row

    def replay(row: NDArray[np.float32], t: int) -> NDArray[np.float32]:
        row[spec.sensory] = recorded[min(ONSET + t, len(recorded) - 1), spec.sensory]
        return row

    return replay if attack.what == REPLAY else drift


def attacked(job: tuple[Attack, int], config: Config) -> Record:
    """Run one episode under one attack."""
    attack, seed = job
    memory = NeuralASM.load(config.memory) if config.memory.endswith(".asm") else NeuralASM.pretrained(config.memory)
    env = environment(env_id(config.task))
    recorded = np.zeros((1, memory.spec.size), np.float32)
    if attack.what == REPLAY:
        recorder = StreamRecorder(env)
        rollout(recorder, make_policy("scripted", env, seed=seed + 500), seed + 500)
        recorded = recorder.finish().stream
    arm: Any = env.unwrapped
    forge = forging(attack, memory.spec, recorded, arm.hand_chains[0])
    watched = NeuralASMSafety(Forging(env, forge), memory, "monitor", on_overrun="ignore")
    infos: list[dict[str, Any]] = []
    rollout(watched, make_policy("scripted", env, seed=seed), seed, infos.append)
    events = [info["asm"]["event"] == "fault" for info in infos[ONSET:]]
    seconds = (events.index(True) + 1 if any(events) else len(events)) * memory.spec.dt
    return {**attack._asdict(), "seed": seed, "found": any(events), "seconds": seconds}


def run(config: Config) -> kit.Findings:
    """Run every attack on its own episodes."""
    hows = list(product((POSITION, BOTH, ALL), config.rates))
    attacks = [Attack(how, joint, rate) for how, rate in hows for joint in JOINTS] + [Attack(REPLAY)]
    first = [2000 + 100 * again for again in config.repetitions]
    jobs = [(attack, seed + n) for seed in first for attack in attacks for n in range(config.episodes)]
    records = kit.each("episodes", partial(attacked, config=config), jobs, config)

    def cell(own: list[Record], scale: float) -> str:
        found = [scale * r["seconds"] for r in where(own, found=True)]
        most = max(scale * r["seconds"] for r in own)
        return f"{np.median(found):.3f} ({len(found)} of {len(own)})" if found else f"never ({most:.2f})"

    rows = [
        (str(joint), *(cell(where(records, what=how, rate=rate, joint=joint), rate) for how, rate in hows))
        for joint in JOINTS
    ]
    drifts = Table(
        "Drift before the guard's first alarm [rad]; never: the drift reached by the end.",
        ("joint", *(f"{how}, {rate:g} rad/s" for how, rate in hows)),
        rows,
    )
    replayed = Table(
        "All senses replayed.", ("", "found after [s]"), [(REPLAY, cell(where(records, what=REPLAY), 1.0))]
    )
    return kit.Findings(records, [drifts, replayed])
