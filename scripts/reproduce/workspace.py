"""Six tasks of the Panda seen by the same senses, experts recorded in them, and networks that act in closed loop.

A row holds the body, where the thing is from the hand, its goal from the thing, and what was commanded; nothing in it
names the task. Distances have a second sense that resolves millimetres and saturates beyond centimetres.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.linear_model import Ridge

from asm_gym.data.episode import Episode, save_episode
from asm_gym.faults.suite import suite_fault
from asm_gym.memory.motor import learn_motor, situation
from asm_gym.memory.settling import SettlingNetwork
from asm_gym.monitors.memory_policy import CommandReadout
from asm_gym.policies import make_policy
from asm_gym.policies.scripted.base import Style
from asm_gym.policies.scripted.geometry import about_vertical, matrix, yaw
from asm_gym.scaling import StreamScaler
from asm_gym.scripts.reproduce.expression import Backpropagated
from asm_gym.spec import MOTOR, Channel, StreamSpec
from asm_gym.wrappers.faults import FaultInjection

Floats = NDArray[np.float64]

SKILLS = ("Lift", "Stack", "PickPlaceCan", "PickPlaceMilk", "Door", "NutAssemblySquare")
THINGS = {"Lift": "cube", "Stack": "cubeA", "NutAssemblySquare": "SquareNut"} | {
    f"PickPlace{name}": name for name in ("Can", "Milk", "Cereal")
}
FAULTS = ("push", "held_by_person", "weak_joint", "frozen_encoder", "encoder_bias", "gripper_opens")
# another thing to carry; and motion of no skill, in the scene of Lift
UNKNOWN = (
    "PickPlaceCereal",
    "sway",
)
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
# columns of the encoders, the hand, the objects
JOINTS, HAND, SEEN = (
    slice(0, 7),
    slice(7, 10),
    slice(18, 32),
)
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
# row of an event; rows of a second; rows for which a pushed arm yields
EVENT, SECOND, YIELD = (
    30,
    20,
    12,
)
SMOOTH = 0.5  # gain of energies
# smallest variance of an error, in its mean; ridge of the regression on the state
SHARPEST, PRIOR = (
    0.01,
    150.0,
)
LONGEST = 250  # rows of an expression


class Workspace:
    """A task, seen by the senses that all have."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        inner: Any = env.unwrapped
        self.env, self.inner, self.skill = env, inner, str(inner.task.name)

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
        return self.inner.measured[self.inner.measured_spec.slices[name]]

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
            return np.asarray(
                hinge + about_vertical(0.36 - float(self.read("hinge_qpos")[0])) @ (at - hinge)
            )
        if self.skill == "Stack":
            return np.asarray(self.read("cubeB_pos") + np.array([0.0, 0.0, 0.045]))
        if self.skill == "NutAssemblySquare":
            return np.array(env.sim.data.body_xpos[env.peg1_body_id])
        if self.skill == "Lift":
            return np.asarray(self.start + np.array([0.0, 0.0, 0.1]))
        return np.array(env.target_bin_placements[env.object_id])

    def row(self) -> Floats:
        """Return what is sensed now, and what was commanded (D,)."""
        (at, grip, turned), hand, facing = (
            self.thing(),
            self.read("hand_position"),
            self.read("hand_orientation"),
        )
        reach, way, turn = grip - hand, self.goal(at) - at, np.zeros(2)
        if self.skill == "Door":
            turn[0] = float(self.read("handle_qpos")[0])
        elif self.skill != "PickPlaceCan":  # up to the thing's symmetry
            nut = self.skill == "NutAssemblySquare"
            turns = np.array([np.pi if nut else np.pi / 2, np.pi / 2])
            turn[:] = yaw(turned[:, 0]) + np.pi / 2 - yaw(facing[3:]), yaw(turned[:, 0]) * nut
            turn -= turns * np.round(turn / turns)
        body = (
            self.read("joint_position"),
            hand - self.inner.robosuite_env.robots[0].base_pos,
            facing,
        )
        seen = reach, np.tanh(reach / NEAR), way, np.tanh(way / NEAR), turn
        return np.concatenate([*body, self.read("gripper_opening"), *seen, self.read("action")])


@cache
def environment(skill: str) -> gym.Env[Any, Any]:
    """Return this process's environment of a skill."""
    return gym.make(f"asm_gym/{skill}-v0", render_mode="rgb_array", render_size=(200, 200))


class Demonstration(NamedTuple):
    """An episode to record: the skill, the seed, and the kind of fault from row ``EVENT`` on."""

    skill: str
    seed: int
    fault: str = ""

    @property
    def name(self) -> str:
        return f"{self.skill}-{self.seed}{self.fault and '-'}{self.fault}.npz"


def demonstrate(asked: Demonstration, folder: Path) -> Path:
    """Record an expert whose commands are shaken, so that it shows how to return, with a fault for two seconds."""
    env, rng = (
        environment("Lift" if asked.skill == "sway" else asked.skill),
        np.random.default_rng([asked.seed, 1]),
    )
    inner: Any = env.unwrapped
    faults = [suite_fault(asked.fault, inner, "medium", EVENT, asked.seed)] if asked.fault else []
    faulty = FaultInjection(env, faults)
    work = Workspace(faulty)
    how: dict[str, Any] = {} if asked.skill == "sway" else {"style": Style(noise=0.0)}
    expert = make_policy(
        "sway" if asked.skill == "sway" else "scripted", work.env, seed=asked.seed, **how
    )
    (observation, row), state, after, shake = (
        work.reset(asked.seed),
        None,
        0,
        rng.uniform(0.0, SHAKE),
    )
    rows = [row]
    while len(rows) < (EVENT + 2 * SECOND if asked.fault else work.inner.horizon) and after <= REST:
        action, state = expert.predict(observation, state, deterministic=True)
        action[:6] = np.clip(action[:6] + shake * rng.standard_normal(6), -1.0, 1.0)
        observation, row, solved = work.step(action)
        rows.append(row)
        after += solved
    faulty.undo_faults()
    told = Episode.from_stream(
        np.array(rows), SPEC, success=after > 0, seed=asked.seed, info={"skill": asked.skill}
    )
    return save_episode(folder / asked.name, told)


class Settling:
    """The network that settles, as it reads rows one by one.

    Args:
        reader: how it reads a row.
        network: its weights.
        episodes: healthy ones, of which it learns how far its errors spread in each state: log σ² = W f(μ).

    Attributes:
        ceilings: (G,) of the energies of ``GROUPS``.
    """

    def __init__(
        self, reader: StreamScaler, network: SettlingNetwork, episodes: Sequence[Episode]
    ) -> None:
        self.reader, self.network, spec = reader, network, reader.spec
        columns = np.concatenate([spec.sensory, reader.slow, spec.motor])  # of each error
        self.members = np.array(
            [np.isin(columns, np.arange(spec.size)[where]) for where in GROUPS.values()]
        )
        self.spread, self.least, self.ceilings = (
            Ridge(PRIOR),
            np.zeros(len(columns)),
            np.ones(len(GROUPS)),
        )
        self.spread.coef_, self.spread.intercept_ = (
            np.zeros((len(columns), network.hidden_size)),
            self.least,
        )
        felt = [self.felt(e.stream) for e in episodes]
        states, squares = (
            np.concatenate([f[0] for f in felt]),
            np.concatenate([f[1] for f in felt]) ** 2,
        )
        self.least = np.log(SHARPEST * squares.mean(axis=0) + 1e-12)
        self.spread.fit(states, np.log(squares + np.exp(self.least)))
        self.spread.intercept_ += np.log(
            np.mean(squares / np.exp(self.spread.predict(states)), axis=0)
        )

    def begin(self) -> None:
        """Forget the past."""
        self.c, self.rows, self.energy = (
            self.network.at_rest(1),
            list[Floats](),
            np.zeros(len(GROUPS)),
        )

    def read(self, row: Floats) -> tuple[Floats, Floats, Floats]:
        """Read a row (D,), NaN where left out; return f(μ) (H,), errors in σ, and energies in their ceilings (G,)."""
        self.rows = [*self.rows[-2:], row[None]]
        seen = self.reader.read(*(self.rows[max(0, len(self.rows) - k)] for k in (1, 2, 3)))
        step = self.network.follow(self.c, seen.commands, seen.senses, seen.seen)
        left = np.hstack([seen.senses, seen.commands[:, :-1]]) - step.expected
        left[:, : self.reader.size] *= seen.seen
        state = np.tanh(step.mu[0])
        spread = np.exp(
            0.5 * np.maximum(self.spread.coef_ @ state + self.spread.intercept_, self.least)
        )
        error = left[0] / spread * (len(self.rows) > 1)
        self.c, self.energy = (
            step.traces,
            self.energy + SMOOTH * (0.5 * self.members @ error**2 - self.energy),
        )
        return state, error, self.energy / self.ceilings

    def felt(self, stream: NDArray[Any]) -> tuple[Floats, Floats, Floats]:
        """Return what ``read`` does of each row of a stream (T, D)."""
        self.begin()
        states, errors, energies = zip(
            *(self.read(row) for row in np.asarray(stream, np.float64)), strict=True
        )
        return np.array(states), np.array(errors), np.array(energies)

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
        with torch.no_grad():
            self.out, self.state = self.model.network.cell(now, self.state)

    def command(self) -> Floats:
        """Return the next action (A,)."""
        return rescaled(self.reader, self.model.network.act(self.out[0, 0]).numpy())


class Associated:
    """The motor association, which acts today."""

    def __init__(
        self, reader: StreamScaler, episodes: Sequence[Episode], rng: np.random.Generator
    ) -> None:
        rows = [situation(reader, e.stream[:-1]) for e in episodes]
        commands = [e.stream[1:, reader.spec.motor] for e in episodes]
        self.reader, self.motor = (
            reader,
            learn_motor(np.concatenate(rows), np.concatenate(commands), 256, rng),
        )

    def begin(self) -> None:
        """It has no past."""

    def read(self, row: Floats) -> None:
        """Read a row (D,)."""
        self.row = row

    def command(self) -> Floats:
        """Return the next action (A,)."""
        return np.asarray(self.motor.command(situation(self.reader, self.row[None]))[0], np.float64)


def rescaled(reader: StreamScaler, action: NDArray[Any]) -> Floats:
    """Return an action (A,) in its own units."""
    motor = reader.spec.motor
    return np.asarray(reader.mean[motor] + reader.spread[motor] * action, np.float64)


class Course(NamedTuple):
    """A run in closed loop."""

    solved: bool
    energies: Floats  # (T, G) in their ceilings; of the settling network
    left_out: str  # the group that was left out
    yielded: bool


def express(
    model: Any,
    env: gym.Env[Any, Any],
    seed: int,
    stuck: bool = False,
    reacts: bool = False,
    goes_on: bool = False,
    steps: int = LONGEST,
    watch: Callable[[str], None] = lambda doing: None,
) -> Course:
    """Let a model act until the task is solved.

    Args:
        model: acts.
        env: of the skill, with what happens to the body.
        seed: of the scene.
        stuck: all encoders of the joints stick from row ``EVENT`` on.
        reacts: a group that alone is over its ceiling is left out; where several are, the arm yields for a while.
        goes_on: the state is carried on from what went before, without notice.
        steps: after which it is left, if the task has not ended before.
        watch: is told after every step what the network does.
    """
    work, readout, energies, grip, out, yields, yielded = (
        Workspace(env),
        CommandReadout(env),
        [],
        None,
        "",
        0,
        False,
    )
    if not goes_on:
        model.begin()
    (_, row), solved = work.reset(seed), False
    encoders = row[JOINTS].copy()
    for t in range(min(steps, work.inner.horizon)):
        encoders = encoders if stuck and t >= EVENT else row[JOINTS].copy()
        row[JOINTS] = encoders
        if out:
            row[GROUPS[out]] = np.nan
        felt = model.read(row)
        if felt is not None:
            energies.append(felt[2])
            over = [
                group
                for group, energy in zip(GROUPS, felt[2], strict=True)
                if energy > 1.0 and group != "action"
            ]
            if reacts and not yields and t > EVENT // 2:
                if len(over) > 1:  # once: it hands back, and goes on
                    yields, yielded = YIELD * (not yielded), True
                elif over and not out:
                    out = over[0]
        action, grip = readout(model.command().astype(np.float32), grip)
        watch(
            "yields"
            if yields
            else f"without the {out} sense"
            if out
            else "goes on"
            if yielded
            else ""
        )
        if yields:
            action[:6], yields = 0.0, yields - 1
        _, row, solved = work.step(action)
        if solved or work.ended:
            break
    return Course(solved, np.array(energies), out, yielded)
