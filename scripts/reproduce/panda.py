"""The network of the papers on the Panda: six skills in one network that settles, learned from unlabelled episodes.

Every task is seen by the same senses: the body, where the thing is from the hand, and its goal from the thing. The
network is never told the skill. It commands the arm in closed loop, is surprised by its own energy of each row,

    F_t = Σ_i ½ (ε_i/σ_i)²,   ε_t = [x_t, a_t] - [x̂_t, â_t](μ_t),   σ: of healthy rows;   ceilings by group of senses

leaves out a group that alone is over its ceiling, and yields where several are. Beside it, on the same episodes: a GRU
and an LSTM by backpropagation through time, the motor association that acts today, and a random forest for names.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.signal import lfilter
from sklearn.ensemble import RandomForestClassifier

from asm_gym import FaultInjection, NeuralASMSafety
from asm_gym.data.episode import Episode, load_episode, save_episode
from asm_gym.evaluation.figures import figure, look
from asm_gym.evaluation.statistics import auroc
from asm_gym.evaluation.tables import Table
from asm_gym.faults import Push
from asm_gym.faults.suite import possible, suite_fault
from asm_gym.memory.learning import Schedule
from asm_gym.memory.motor import learn_motor, situation
from asm_gym.memory.readout import KEPT, certainty, learn_readout
from asm_gym.memory.recall import follow, run_on, to_rows
from asm_gym.memory.settling import SettlingNetwork, learn_settling
from asm_gym.monitors.memory_policy import CommandReadout
from asm_gym.policies import make_policy
from asm_gym.policies.scripted.base import Style
from asm_gym.policies.scripted.geometry import about_vertical, matrix, yaw
from asm_gym.rollouts.run_folder import make_missing
from asm_gym.scaling import StreamScaler
from asm_gym.scripts.command import option
from asm_gym.scripts.reproduce import kit
from asm_gym.scripts.reproduce.expression import Backpropagated, read, trajectories
from asm_gym.scripts.reproduce.kit import Findings, Record, shown
from asm_gym.scripts.reproduce.recurrent import expected
from asm_gym.spec import MOTOR, Channel, StreamSpec

Floats = NDArray[np.float64]

SKILLS = ("Lift", "Stack", "PickPlaceCan", "PickPlaceMilk", "Door", "NutAssemblySquare")
THINGS = {"Lift": "cube", "Stack": "cubeA", "NutAssemblySquare": "SquareNut"} | {
    f"PickPlace{name}": name for name in ("Can", "Milk", "Cereal")
}
FAULTS = ("push", "held_by_person", "weak_joint", "frozen_encoder", "encoder_bias", "gripper_opens")
UNKNOWN = ("PickPlaceCereal", "sway")  # another thing to carry; and motion of no skill, in the scene of Lift
SPEC = StreamSpec(
    (
        Channel("joint_position", 7, "rad", 2e-4, "joint"),
        Channel("hand_position", 3, "m", 3e-4, "hand"),
        Channel("hand_orientation", 6, "1", 5e-4, "hand"),
        Channel("gripper_opening", 2, "m", 2e-4, "gripper"),
        Channel("hand_to_thing", 3, "m", group="object"),
        Channel("hand_to_thing_near", 3, group="object"),
        Channel("thing_to_goal", 3, "m", group="object"),
        Channel("thing_to_goal_near", 3, group="object"),
        Channel("turn", 2, "rad", group="object"),
        Channel("action", 7, group=MOTOR),
    ),
    0.05,
    "Panda",
)
JOINTS, HAND, SEEN = slice(0, 7), slice(7, 10), slice(18, 32)  # columns of the encoders, the hand, the objects
GROUPS = {
    "joint": JOINTS,
    "hand": slice(7, 16),
    "gripper": slice(16, 18),
    "object": SEEN,
    "action": SPEC.slices["action"],
}
NEAR = 0.02  # the second sense of a distance resolves less than this [m]
HANDLE = np.array([0.054, 0.0, 0.0])  # of the nut, in its own frame [m]
SHAKE, REST = 0.25, 12  # most noise on what experts command; rows recorded after success
EVENT, SECOND, YIELD = 30, 20, 12  # row of an event; rows of a second; rows for which a pushed arm yields
UNITS = {"settling": 160, "GRU": 80, "LSTM": 68}
"""All have about as many weights: 42,000."""
ACTORS = ("settling", "GRU", "LSTM", "association")
HOW = 64, 3e-3, 20, 1.0, 1.0, 0.0  # of ``Schedule``, chosen on seeds from 100 on
RATE = 0.05  # healthy episodes over a ceiling, as far as so few can tell


@dataclass(frozen=True)
class Config(kit.Config):
    """The papers' network on the Panda: six skills."""

    seeds: int = option(10, quick=1, least=1)
    """Number of repetitions; they take the seeds that follow."""
    episodes: int = option(48, quick=4, least=4)
    """Episodes of each skill that are recorded; a seed learns from three quarters, drawn anew, and is tested on others."""
    epochs: int = option(60, quick=4, least=1)
    """Passes of the network over its episodes."""
    updates: int = option(900, quick=20, least=1)
    """Batches of the recurrent networks."""
    trials: int = option(4, quick=1, least=1)
    """Times that each skill is expressed."""


# ------------------------------------------------------------------ the six tasks by the same senses


class Workspace:
    """A task, seen by the senses that all have."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        self.env = env
        self.inner: Any = env.unwrapped
        self.skill: str = self.inner.task.name

    def reset(self, seed: int) -> tuple[Any, Floats]:
        """Return the observation and the first row (D,)."""
        observation, _ = self.env.reset(seed=seed)
        self.start = self.thing()[0]
        return observation, self.row()

    def step(self, action: Any) -> tuple[Any, Floats, bool]:
        """Return the observation, the row (D,), and whether the task was solved."""
        observation, _, terminated, _, info = self.env.step(action)
        self.ended = terminated
        return observation, self.row(), bool(info["is_success"])

    def read(self, name: str) -> Floats:
        """Return what was measured last of a channel."""
        found: Floats = self.inner.measured[self.inner.measured_spec.slices[name]]
        return found

    def thing(self) -> tuple[Floats, Floats, Floats]:
        """Return where the thing is (3,), where to grasp it (3,), and how it is turned (3, 3)."""
        if self.skill == "Door":
            at = self.read("handle_pos")
            return at, at, about_vertical(float(self.read("hinge_qpos")[0]))
        name = THINGS[self.skill]
        at, turned = self.read(f"{name}_pos"), matrix(self.read(f"{name}_quat"))
        return at, at + turned @ HANDLE * (self.skill == "NutAssemblySquare"), turned

    def goal(self, at: Floats) -> Floats:
        """Return where (3,) the thing that is ``at`` (3,) is to go."""
        env, data = self.inner.robosuite_env, self.inner.simulation.data
        if self.skill == "Door":
            hinge = data.xanchor[self.inner.simulation.model.joint("Door_hinge").id]
            return np.asarray(hinge + about_vertical(0.36 - float(self.read("hinge_qpos")[0])) @ (at - hinge))
        if self.skill == "Stack":
            return np.asarray(self.read("cubeB_pos") + [0.0, 0.0, 0.045])
        if self.skill == "NutAssemblySquare":
            return np.array(env.sim.data.body_xpos[env.peg1_body_id])
        return (
            self.start + [0.0, 0.0, 0.1] if self.skill == "Lift" else np.array(env.target_bin_placements[env.object_id])
        )

    def row(self) -> Floats:
        """Return what is sensed now, and what was commanded (D,)."""
        (at, grip, turned), hand, facing = self.thing(), self.read("hand_position"), self.read("hand_orientation")
        reach, way, turn = grip - hand, self.goal(at) - at, np.zeros(2)
        if self.skill == "Door":
            turn[0] = float(self.read("handle_qpos")[0])
        elif self.skill != "PickPlaceCan":  # up to the thing's symmetry
            nut = self.skill == "NutAssemblySquare"
            turns = np.array([np.pi if nut else np.pi / 2, np.pi / 2])
            turn[:] = yaw(turned[:, 0]) + np.pi / 2 - yaw(facing[3:]), yaw(turned[:, 0]) * nut
            turn -= turns * np.round(turn / turns)
        body = self.read("joint_position"), hand - self.inner.robosuite_env.robots[0].base_pos, facing
        seen = reach, np.tanh(reach / NEAR), way, np.tanh(way / NEAR), turn
        return np.concatenate([*body, self.read("gripper_opening"), *seen, self.read("action")])


_MADE: dict[str, gym.Env[Any, Any]] = {}


def environment(skill: str) -> gym.Env[Any, Any]:
    """Return this process's environment of a skill."""
    if skill not in _MADE:
        _MADE[skill] = gym.make(f"asm_gym/{skill}-v0")
    return _MADE[skill]


class Demonstration(NamedTuple):
    """An episode to record: the skill, the seed, and the kind of fault from row ``EVENT`` on."""

    skill: str
    seed: int
    fault: str = ""

    @property
    def name(self) -> str:
        return f"{self.skill}-{self.seed}{self.fault and '-'}{self.fault}.npz"


def demonstrate(asked: Demonstration, folder: Path) -> Path:
    """Record an expert whose commands are shaken, so that it shows how to return; with a fault for two seconds of it."""
    env, rng = environment("Lift" if asked.skill == "sway" else asked.skill), np.random.default_rng([asked.seed, 1])
    faults = [suite_fault(asked.fault, env.unwrapped, "medium", EVENT, asked.seed)] if asked.fault else []
    work = Workspace(FaultInjection(env, faults))
    how: dict[str, Any] = {} if asked.skill == "sway" else {"style": Style(noise=0.0)}
    expert = make_policy("sway" if asked.skill == "sway" else "scripted", work.env, seed=asked.seed, **how)
    (observation, row), state, after, shake = work.reset(asked.seed), None, 0, rng.uniform(0.0, SHAKE)
    rows = [row]
    while len(rows) < (EVENT + 2 * SECOND if asked.fault else work.inner.horizon) and after <= REST:
        action, state = expert.predict(observation, state, deterministic=True)
        action[:6] = np.clip(action[:6] + shake * rng.standard_normal(6), -1.0, 1.0)
        observation, row, solved = work.step(action)
        rows.append(row)
        after += solved
    work.env.undo_faults()
    told = Episode.from_stream(np.array(rows), SPEC, success=after > 0, seed=asked.seed, info={"skill": asked.skill})
    return save_episode(folder / asked.name, told)


# ------------------------------------------------------------------ models in closed loop


class Settling:
    """The network that settles, as it reads rows one by one.

    Args:
        reader: how it reads a row.
        network: its weights.
        episodes: healthy ones, of which it learns the spreads of its errors.
    """

    def __init__(self, reader: StreamScaler, network: SettlingNetwork, episodes: Sequence[Episode]) -> None:
        self.reader, self.network, spec = reader, network, reader.spec
        columns = np.concatenate([spec.sensory, reader.slow, spec.motor])  # of each error
        self.members = {g: np.isin(columns, np.arange(spec.size)[where]) for g, where in GROUPS.items()}
        self.spread, self.ceilings = np.ones(len(columns)), dict.fromkeys(GROUPS, np.inf)
        self.spread = np.sqrt(np.mean(np.concatenate([self.felt(e.stream)[1] for e in episodes]) ** 2, axis=0)) + 1e-6

    def begin(self) -> None:
        """Forget the past."""
        self.c, self.rows = self.network.at_rest(1), list[Floats]()
        self.energy = dict.fromkeys(GROUPS, 0.0)

    def read(self, row: Floats) -> tuple[Floats, Floats]:
        """Read a row (D,), NaN where left out; return f(μ) (H,) and the errors (S + A,), and update ``energy``."""
        self.rows = [*self.rows[-2:], row[None]]
        seen = self.reader.read(*(self.rows[max(0, len(self.rows) - k)] for k in (1, 2, 3)))
        step = self.network.follow(self.c, seen.commands, seen.senses, seen.seen)
        now, known = np.hstack([seen.senses, seen.commands[:, :-1]]), np.hstack([seen.seen, seen.commands[:, :-1] ** 0])
        error = ((now - step.expected) * known / self.spread)[0] * (len(self.rows) > 1)
        self.c = step.traces
        for group, member in self.members.items():
            self.energy[group] += (0.5 * float(np.sum(error[member] ** 2)) - self.energy[group]) / 2
        return np.tanh(step.mu[0]), error

    def felt(self, stream: NDArray[Any]) -> tuple[Floats, Floats, Floats]:
        """Return f(μ) (T, H), errors (T, S + A) and energies by group (T, G) along a stream (T, D)."""
        self.begin()
        found = [(*self.read(row), list(self.energy.values())) for row in np.asarray(stream, np.float64)]
        states, errors, energies = (np.array(part) for part in zip(*found, strict=True))
        return states, errors, energies

    def command(self) -> Floats:
        """Return the action (A,) that it expects to be given next."""
        return rescaled(self.reader, self.network.run_on(self.c).expected[0, self.reader.size :])


class Recurrent:
    """A GRU or an LSTM."""

    def __init__(self, model: Backpropagated) -> None:
        self.model, self.reader = model, model.reader

    def begin(self) -> None:
        """Forget the past."""
        self.state: Any = None
        self.rows: list[Floats] = []

    def read(self, row: Floats) -> None:
        """Read a row (D,)."""
        self.rows = [*self.rows[-1:], row[None]]
        seen = self.reader.read(row[None], self.rows[0], self.rows[0])
        now = torch.from_numpy(np.hstack([seen.senses, seen.commands[:, :-1]]))[None]
        self.out, self.state = self.model.network.cell(now, self.state)

    def command(self) -> Floats:
        """Return the next action (A,)."""
        return rescaled(self.reader, self.model.network.act(self.out[0, 0]).numpy())


class Associated:
    """The motor association, which acts today."""

    def __init__(self, reader: StreamScaler, episodes: Sequence[Episode], rng: np.random.Generator) -> None:
        rows = [situation(reader, e.stream[:-1]) for e in episodes]
        commands = [e.stream[1:, reader.spec.motor] for e in episodes]
        self.reader, self.motor = reader, learn_motor(np.concatenate(rows), np.concatenate(commands), 256, rng)

    def begin(self) -> None:
        """It has no past."""

    def read(self, row: Floats) -> None:
        """Read a row (D,)."""
        self.row = row

    def command(self) -> Floats:
        """Return the next action (A,)."""
        return self.motor.command(situation(self.reader, self.row[None]))[0].astype(np.float64)


def rescaled(reader: StreamScaler, action: NDArray[Any]) -> Floats:
    """Return an action (A,) in its own units."""
    motor = reader.spec.motor
    return np.asarray(reader.mean[motor] + reader.spread[motor] * action, np.float64)


class Course(NamedTuple):
    """A run in closed loop."""

    solved: bool
    steps: int
    energies: Floats  # (T, G) of the groups; of the settling network
    left_out: str  # the group that was left out
    yielded: bool


def express(
    model: Any, env: gym.Env[Any, Any], seed: int, event: str = "", reacts: bool = False, goes_on: bool = False
) -> Course:
    """Let a model act until the task is solved.

    Args:
        model: acts.
        env: of the skill, with what happens to the body.
        seed: of the scene.
        event: ``"lie"``: all encoders of the joints stick from row ``EVENT`` on.
        reacts: a group that alone is over its ceiling is left out; where several are, the arm yields for a while.
        goes_on: the state is carried on from what went before, without notice.
    """
    work, readout = Workspace(env), CommandReadout(env)
    if not goes_on:
        model.begin()
    (_, row), grip, out, yields, yielded, energies = work.reset(seed), None, "", 0, False, []
    stuck, solved = row[JOINTS].copy(), False
    for t in range(work.inner.horizon):
        if event == "lie" and t >= EVENT:
            row[JOINTS] = stuck
        stuck = row[JOINTS].copy()
        if out:
            row[GROUPS[out]] = np.nan
        model.read(row)
        if isinstance(model, Settling):
            energies.append(list(model.energy.values()))
            over = [g for g in GROUPS if g != "action" and t > 2 and model.energy[g] > model.ceilings[g]]
            if reacts and len(over) == 1 and not out and over != ["object"] and not yields:
                out = over[0]
            elif reacts and len(over) > 1 and not yields:
                yields, yielded = YIELD, True
        action, grip = readout(model.command().astype(np.float32), grip)
        if yields:
            action[:6], yields = 0.0, yields - 1
        _, row, solved = work.step(action)
        if solved or work.ended:
            break
    return Course(solved, t + 1, np.array(energies), out, yielded)


# ------------------------------------------------------------------ one seed


def one(seed: int, config: Config, files: dict[str, list[Path]]) -> tuple[list[Record], dict[str, Floats]]:
    """Learn with one seed, and measure."""
    torch.set_num_threads(1)
    rng, records = np.random.default_rng(seed), list[Record]()
    parts: list[list[Episode]] = [[], [], []]  # to learn from, for ceilings and as tests
    for skill in SKILLS:
        own = [e for e in map(load_episode, files[skill]) if e.success]
        kept = max(1, len(own) // 8)
        for part, chosen in zip(parts, np.split(rng.permutation(len(own)), [-2 * kept, -kept]), strict=True):
            part += [own[i] for i in chosen]
    train, held, tests = parts

    def note(model: str, measure: str, **values: Any) -> None:
        records.append({"seed": seed, "model": model, "measure": measure, **values})

    reader, taught = StreamScaler.fit(SPEC, [e.stream for e in train]), None
    taught = trajectories(reader, train)
    network = learn_settling(taught, UNITS["settling"], Schedule(config.epochs, *HOW), rng, lambda: None).network
    assert isinstance(network, SettlingNetwork)
    ours = Settling(reader, network, train)
    highest = np.array([ours.felt(e.stream)[2][3:].max(axis=0) for e in held])  # (N, G)
    ours.ceilings = dict(zip(GROUPS, np.quantile(highest, 1.0 - RATE / len(GROUPS), axis=0), strict=True))
    recurrent = {
        c: Backpropagated.learned(train, UNITS[c], rng, config.updates, cell=c, rate=1e-2) for c in ("GRU", "LSTM")
    }
    models: dict[str, Any] = {"settling": ours, **{c: Recurrent(m) for c, m in recurrent.items()}}
    models["association"] = Associated(reader, train, rng)
    for model, measure, values in (*predicted(ours, recurrent, tests), *named(ours, train, tests, rng)):
        note(model, measure, **values)
    for model, measure, values in surprised(ours, tests, files):
        note(model, measure, **values)
    traces: dict[str, Floats] = {}
    scenes = range(10_000 + 100 * seed, 10_000 + 100 * seed + config.trials)
    for skill in SKILLS:
        env = environment(skill)
        for scene in scenes:
            for name, model in models.items():
                with torch.no_grad():
                    note(name, "expressed", skill=skill, solved=express(model, env, scene).solved)
            push = Push(newtons=20.0, direction=tuple(rng.standard_normal(3)), onset=EVENT, duration=10)
            for event, around in (("lie", env), ("push", FaultInjection(env, [push]))):
                for reacts in (False, True):
                    course = express(ours, around, scene, event, reacts)
                    right = course.left_out == "joint" if event == "lie" else course.yielded and not course.left_out
                    what = {"skill": skill, "solved": course.solved, "right": right if reacts else None}
                    note("settling", event + (", reacts" if reacts else ""), **what)
                    traces.setdefault(f"{skill} {event}", course.energies)
            if around is not env:
                around.undo_faults()
            course = express(ours, NeuralASMSafety(env), scene)
            note("settling", "guarded", skill=skill, solved=course.solved)
            before = SKILLS[SKILLS.index(skill) - 1]
            express(ours, environment(before), scene)
            note("settling", "after another", skill=skill, solved=express(ours, env, scene, goes_on=True).solved)
    return records, traces


Noted = tuple[str, str, Record]


def predicted(ours: Settling, recurrent: dict[str, Backpropagated], tests: Sequence[Episode]) -> list[Noted]:
    """Measure the error of the next row, and of a second from memory after ``EVENT`` rows."""
    X, network, found = len(SPEC.sensory), ours.network, list[Noted]()
    streams = np.stack([e.stream[: EVENT + SECOND] for e in tests if len(e) >= EVENT + SECOND], axis=1).astype(
        np.float64
    )
    senses, commands = read(ours.reader, streams)
    still = np.mean((senses[2:, :, :X] - senses[1:-1, :, :X]) ** 2)

    def off(rows: Floats) -> float:
        return 100 * float(np.linalg.norm(rows[:, :, HAND] - streams[EVENT:, :, HAND], axis=2).mean())

    rest = network.at_rest(streams.shape[1])
    for steps in (1, 5, network.iterations):
        online = follow(network.with_iterations(steps), rest, senses, commands).senses[2:, :, :X]
        found.append(
            ("settling", f"next row, {steps}", {"error": float(np.mean((online - senses[2:, :, :X]) ** 2) / still)})
        )
    cued = follow(network, rest, senses[:EVENT], commands[:EVENT]).traces
    found.append(("settling", "from memory", {"cm": off(to_rows(ours.reader, run_on(network, cued, SECOND)))}))
    for cell, model in recurrent.items():
        online, _ = expected(model.network, senses, commands, len(senses))
        found.append(
            (cell, "next row", {"error": float(np.mean((online[2:, :, :X] - senses[2:, :, :X]) ** 2) / still)})
        )
        found.append((cell, "from memory", {"cm": off(model.express(streams, EVENT)[EVENT:])}))
    found.append(("stands still", "from memory", {"cm": off(np.repeat(streams[EVENT - 1 : EVENT], SECOND, axis=0))}))
    return found


def hidden(stream: NDArray[Any], until: int | None) -> Floats:
    """Return a stream (T, D) in which no object is seen before row ``until``; None for never."""
    rows = np.array(stream, np.float64)
    rows[:until, SEEN] = np.nan
    return rows


def named(ours: Settling, train: Sequence[Episode], tests: Sequence[Episode], rng: np.random.Generator) -> list[Noted]:
    """Measure how soon the right skill is named, in whole rows, blind to objects, and after another skill."""
    seen = [e.stream.astype(np.float64) for e in train]
    both = [*seen, *(hidden(s, None) for s in seen)]
    labels = np.concatenate([np.full(len(e), SKILLS.index(str(e.info["skill"]))) for e in (*train, *train)])
    states = np.concatenate([ours.felt(s)[0] for s in both]).astype(np.float32)
    W_K, b_K = learn_readout(lambda chosen: states[chosen], labels, len(SKILLS), rng)

    def seen_by_forest(stream: Floats) -> Floats:
        """Return each row and its change over a quarter of a second; what is not seen is far off."""
        return np.nan_to_num(np.hstack([stream, stream - stream[np.maximum(np.arange(len(stream)) - 5, 0)]]), nan=-9.0)

    forest = RandomForestClassifier(100, min_samples_leaf=3, random_state=int(rng.integers(2**31)))
    every = slice(None, None, 3)
    forest.fit(np.concatenate([seen_by_forest(s) for s in both])[every], labels[every])
    tellers: dict[str, Callable[[Floats], Floats]] = {
        "settling": lambda stream: certainty(ours.felt(stream)[0].astype(np.float32), W_K, b_K),
        "forest": lambda stream: forest.predict_proba(seen_by_forest(stream)),
    }
    found: list[Noted] = []
    kinds = [SKILLS.index(str(e.info["skill"])) for e in tests]
    for teller, likely in tellers.items():

        def said(stream: Floats, likely: Callable[[Floats], Floats] = likely) -> NDArray[np.intp]:
            logs = np.log(likely(stream) + 1e-3)
            return np.asarray(lfilter([1.0], [1.0, -float(KEPT)], logs, axis=0).argmax(axis=1))

        for e, kind in zip(tests, kinds, strict=True):
            stream = e.stream.astype(np.float64)
            names, blind, late = (said(s) for s in (stream, hidden(stream, None), hidden(stream, SECOND)))
            for row in (2, 5, 10, 20, 40):
                values = {"rows": row, "right": bool(names[row - 1] == kind), "blind": bool(blind[row - 1] == kind)}
                found.append((teller, "named", values))
            if "PickPlace" in SKILLS[kind]:
                alike = "PickPlace" in SKILLS[late[SECOND - 1]]
                found.append(
                    (
                        teller,
                        "two fit",
                        {"alike": alike, "right": bool(late[SECOND - 1] == kind), "rows": until(late[SECOND:] == kind)},
                    )
                )
            n = int(rng.choice(np.flatnonzero(np.array(kinds) != kind)))
            changed = said(np.concatenate([tests[n].stream[:40], stream[:60]]).astype(np.float64))[40:] == kind
            found.append((teller, "changed", {"rows": until(changed), "right": bool(changed[SECOND - 1])}))
    return found


def until(right: NDArray[np.bool_]) -> int:
    """Return after how many rows it is right for good."""
    return int(len(right) - np.argmin(right[::-1])) if not right.all() else 1


def surprised(ours: Settling, tests: Sequence[Episode], files: dict[str, list[Path]]) -> list[Noted]:
    """Measure how well energy tells each kind of fault from its twin, and unknown skills from known ones."""
    around, found = slice(EVENT, EVENT + SECOND), list[Noted]()
    ceilings = np.array(list(ours.ceilings.values()))

    def over(episode: Episode, rows: slice = slice(3, None)) -> float:
        """Return the largest energy of any group, in its ceiling."""
        return float((ours.felt(episode.stream)[2] / ceilings)[rows].max())

    healthy = [over(e) for e in tests]
    twins = [over(load_episode(f), around) for f in files["twins"]]
    for kind in FAULTS:
        faulty = [over(load_episode(f), around) for f in files[kind]]
        found.append(
            (
                "settling",
                "faults",
                {"kind": kind, "auroc": auroc(faulty, twins), "found": float(np.mean(np.array(faulty) > 1.0))},
            )
        )
    for skill in UNKNOWN:
        unknown = [over(load_episode(f)) for f in files[skill]]
        found.append(
            (
                "settling",
                "unknown",
                {"kind": skill, "auroc": auroc(unknown, healthy), "found": float(np.mean(np.array(unknown) > 1.0))},
            )
        )
    found.append(("settling", "healthy", {"found": float(np.mean(np.array(healthy) > 1.0))}))
    return found
