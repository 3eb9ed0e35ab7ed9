"""What who writes to the senses can hide: slow drifts, a replayed recording, senses that say the mean.

The robot itself is healthy, and the guard only watches. From a step on, what reaches it is another's; after a knock,
which excuses surprise for a second, too.
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

from asm_gym.evaluation.tables import Column, Table, tabulate
from asm_gym.kinematics import Chain
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

POSITION, BOTH, ALL = "encoder alone", "encoder and speed", "encoder, speed and hand"


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
    after_knock: tuple[float, ...] = option((0.1, 1.0), quick=(1.0,), least=1, metavar="RAD/S")
    """How fast they do after a knock."""


class Attack(NamedTuple):
    """One attack: on a joint at a rate [rad/s], or on all senses; the wrist says of its first row that it was hit."""

    what: str
    joint: int = -1
    rate: float = 0.0
    knock: bool = False


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

BLOW = 60.0
"""Of a knock that is only said [N]."""


def forging(attack: Attack, spec: StreamSpec, recorded: NDArray[np.float32], chain: Chain) -> Forged:
    """What an attack makes of rows; ``recorded`` (T, D) is another healthy episode of the same task."""
    position, velocity = (spec.slices[name].start for name in ("joint_position", "joint_velocity"))
    senses = spec.sensory
    angles, hand = spec.slices["joint_position"], [spec.slices[n] for n in ("hand_position", "hand_orientation")]
    wrist = [spec.slices[name].start for name in ("wrist_force", "wrist_force_peak")]

    def drift(row: NDArray[np.float32], t: int) -> NDArray[np.float32]:
        before = chain.at(row[angles])
        row[position + attack.joint] += attack.rate * spec.dt * t
        row[velocity + attack.joint] += attack.rate * (attack.what != POSITION)
        if attack.what == ALL:
            place, turn = np.split(chain.at(row[angles]) - before, [3])
            row[hand[0]] += place
            row[hand[1]] += turn
        if attack.knock and t == 1:
            row[wrist] = BLOW
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
    recorded = np.zeros((1, memory.spec.size), np.float32)
    if attack.joint < 0:
        recorder = StreamRecorder(env)
        rollout(recorder, make_policy("scripted", env, seed=seed + 500), seed + 500)
        recorded = recorder.finish().stream
    arm: Any = env.unwrapped
    forged = forging(attack, memory.spec, recorded, arm.hand_chains[0])
    watched = NeuralASMSafety(Forging(env, forged, ONSET), memory, "monitor", on_overrun="ignore")
    infos: list[dict[str, Any]] = []
    rollout(watched, make_policy("scripted", env, seed=seed), seed, infos.append)
    said = [info["asm"] for info in infos[ONSET:]]
    by_memory = next((t for t, asm in enumerate(said) if asm["surprise"] > asm["threshold"]), None)
    by_guard = next((t for t, asm in enumerate(said) if asm["event"] == "fault"), None)
    rows = {"memory": by_memory, "guard": by_guard}
    took = {who: len(said) if t is None else t + 1 for who, t in rows.items()}
    named = by_guard is not None and said[by_guard]["cause"]["part"] == f"encoder[{attack.joint}]"
    return {
        **attack._asdict(),
        "seed": seed,
        "named": named,
        **{f"found_by_{who}": t is not None for who, t in rows.items()},
        **{f"seconds_{who}": took[who] * memory.spec.dt for who in rows},
        **{f"drift_{who}": attack.rate * took[who] * memory.spec.dt for who in rows},
    }


def run(config: Config) -> kit.Findings:
    """Every attack on its own episodes."""
    joints, hows = range(7), (POSITION, BOTH, ALL)
    attacks = [Attack(how, j, rate) for how in hows for rate in config.rates for j in joints]
    attacks += [Attack(how, j, rate, True) for how in hows[:2] for rate in config.after_knock for j in joints]
    attacks += [Attack("replay"), Attack("means")]
    jobs = [
        (a, 2000 + 100 * again + n) for again in config.repetitions for a in attacks for n in range(config.episodes)
    ]
    records = kit.each("episodes", partial(attacked, config=config), jobs, config)

    def of(**which: Any) -> list[kit.Record]:
        return [r for r in records if all(r[name] == value for name, value in which.items())]

    def cell(who: str, how: str, rate: float, knock: bool, joint: int) -> str:
        own = of(what=how, rate=rate, joint=joint, knock=knock)
        found = [r[f"drift_{who}"] for r in own if r[f"found_by_{who}"]]
        most = max(r[f"drift_{who}"] for r in own)
        return f"never ({most:.2f})" if not found else f"{np.median(found):.3f} ({len(found)} of {len(own)})"

    def drifts(caption: str, who: str, rates: tuple[float, ...], knock: bool = False) -> Table:
        columns: list[Column[int]] = [Column("joint", str)]
        columns += [
            Column(f"{how}, {rate:g} rad/s", partial(cell, who, how, rate, knock))
            for how, rate in product(hows[: 2 if knock else 3], rates)
        ]
        if who == "guard":
            columns.append(Column("encoder named, of the first two", partial(named, knock)))
        return tabulate(caption, columns, joints)

    def named(knock: bool, joint: int) -> str:
        own = [r for r in of(joint=joint, knock=knock, found_by_guard=True) if r["what"] != ALL]
        return f"{sum(r['named'] for r in own)} of {len(own)}"

    def whole(who: str, what: str) -> str:
        own = of(what=what)
        found = [r[f"seconds_{who}"] for r in own if r[f"found_by_{who}"]]
        return f"{len(found)} of {len(own)}" + (f", after {np.median(found):.2f} s" if found else "")

    replaced: list[Column[str]] = [Column("all senses replaced by", str)]
    replaced += [Column(f"found by the {who}", partial(whole, who)) for who in ("memory", "guard")]
    before = "Drift that is reached before the first fault [rad]; where there is none, by the end: "
    tables = [
        drifts(f"{before}the memory alone", "memory", config.rates),
        drifts(f"{before}the guard, which holds the hand against the joints", "guard", config.rates),
        drifts(f"{before}the memory alone, after a knock", "memory", config.after_knock, True),
        drifts(f"{before}the guard, after a knock", "guard", config.after_knock, True),
        tabulate("Whole senses", replaced, ("replay", "means")),
    ]
    return kit.Findings(records, tables)
