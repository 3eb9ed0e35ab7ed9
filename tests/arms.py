"""A planar arm that plays an episode back, a monitor that is surprised by it on cue, and one that names the cause."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from asm_gym.control_period import control_period
from asm_gym.guard.reflexes import FeltMotion
from asm_gym.guard.robot_facts import RobotFacts
from asm_gym.guard.robot_table import RobotTable
from asm_gym.guard.row_validation import RowValidator
from asm_gym.memory.completion import Completion
from asm_gym.monitors import Surprise
from asm_gym.monitors.diagnosis import CLASSES, Diagnosis
from asm_gym.scaling import StreamScaler
from asm_gym.spec import MOTOR, Channel, StreamSpec
from asm_gym.wrappers.capabilities import robots_of
from tests.fakes import CueMonitor

SPEC = StreamSpec(
    (
        Channel("joint_position", 2, "rad", 0.001, "joint"),
        Channel("hand_position", 2, "m", 0.001, "hand"),
        Channel("lone", 1, "1", 0.001, "alone"),
        Channel("action", 2, group=MOTOR),
    ),
    dt=0.05,
)
"""A planar arm of two joints: the hand is bent by sines and cosines; nothing tells of ``lone``."""


def arm(steps: int, seed: int) -> np.ndarray:
    """(T, 7) an episode of it: joints swing, and the hand is where they say."""
    rng = np.random.default_rng(seed)
    t = 0.05 * np.arange(steps)[:, None] + rng.uniform(0, 6, 2)
    q = np.array([0.4, 0.9]) + 0.35 * np.sin(t * np.array([1.0, 1.6]))
    hand = np.stack(
        [np.cos(q[:, 0]) + np.cos(q.sum(axis=1)), np.sin(q[:, 0]) + np.sin(q.sum(axis=1))], axis=1
    )
    lone = np.cumsum(0.1 * rng.standard_normal((steps, 1)), axis=0)
    sensed = np.hstack([q, hand, lone]) + 0.001 * rng.standard_normal((steps, 5))
    return np.hstack([sensed, np.cos(t)]).astype(np.float32)


STREAMS = [arm(120, seed) for seed in range(12)]
SENSES = StreamScaler.fit(SPEC, STREAMS)
MEMORY = Completion.fit(SENSES, STREAMS)


class Arm(gym.Env):
    """Plays an episode of the arm back; what is sensed is the observation, and there is no stream."""

    metadata = {"render_fps": 20}  # noqa: RUF012
    action_means = "delta"
    dt = 0.05

    def __init__(self, broken=lambda t, row: None):
        self.observation_space = spaces.Box(-50, 50, (5,), np.float32)
        self.action_space = spaces.Box(-1, 1, (2,), np.float32)
        self.broken = broken

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return self._observe(), {}

    def step(self, action):
        self.t += 1
        return self._observe(), 0.0, False, False, {}

    def _observe(self):
        row = arm(120, 31)[self.t, :5].copy()
        self.broken(self.t, row)
        return row


class Named:
    """Says which family it was; a read-out that needs no learning."""

    def __init__(self, family):
        self.p = 0.9 * np.eye(len(CLASSES))[list(CLASSES).index(family)] + 0.1 / len(CLASSES)

    def __call__(self, evidence):
        return self.p[None]


GENERIC = StreamSpec.from_spaces(Arm().observation_space, Arm().action_space, 0.05)


class Judge(CueMonitor):
    """Surprised in the steps of ``cue``; its diagnosis is that of the family it is given."""

    def __init__(self, cue, family="sensor"):
        super().__init__(cue, GENERIC)
        streams = STREAMS
        self.diagnosis_ = Diagnosis(
            Completion.fit(StreamScaler.fit(GENERIC, streams), streams), Named(family)
        )

    def observe(self, state, stream):
        attribution = np.zeros((1, self.spec.size))
        attribution[0, 0] = 10.0 if state in self.cue else 0.1
        return state + 1, Surprise(attribution.sum(axis=1), attribution)


def offset(t, row):
    row[0] += 0.3 * (t >= 20)


ACT = np.array([0.5, -0.5], np.float32)


class Acting(Arm):
    """Keeps the actions it was given, and feels that nothing presses, unless it is told to say something else."""

    felt: float | None = 0.1

    def reset(self, **kwargs):
        self.actions = []
        return super().reset(**kwargs)

    def step(self, action):
        self.actions.append(np.array(action))
        *out, info = super().step(action)
        return *out, info if self.felt is None else info | {"contact_load": self.felt}


def infos(env, steps):
    env.reset(seed=0)
    return [env.step(ACT)[4]["asm"] for _ in range(steps)]


EVERYONE = np.ones(1, bool)


class Repaired:
    """The rows of one arm, as a guard believes them."""

    def __init__(self):
        robots = RobotFacts.unknown(SPEC, np.ones(SPEC.size, bool))
        self.rows = RowValidator(robots, RobotTable(1, SPEC, 1.0), MEMORY, kept=10)

    def read(self, row):
        self.rows.drop_repairs()
        return self.rows.validate(row[None].astype(np.float32)).rows[0].copy()

    def suspect(self, columns):
        self.rows.suspect(0, columns)
        return self.rows.last(0)[-1].copy()

    @property
    def names(self):
        return self.rows.repairs[0].names if self.rows.repairs else ()

    @property
    def trusted(self):
        return self.rows.repairs[0].trusted if self.rows.repairs else True


def reflexes_of(env, name):
    """The reflexes of one robot."""
    spec = env.get_wrapper_attr("stream_spec")
    return FeltMotion.of(robots_of(env, spec, control_period(env))[0], spec, name)
