"""A memory that acts: what it learns against closed forms, and the policy in a world small enough to be sure of."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from numpy.typing import NDArray

from asm_gym.data.episode import Episode
from asm_gym.memory import motor
from asm_gym.memory.motor import FINE, PLACED, fineness, learn_motor, situation
from asm_gym.monitors import NeuralASM
from asm_gym.monitors.memory_policy import (
    CHANGE_AFTER,
    FORGETTING_TIME,
    CommandReadout,
    NeuralASMPolicy,
)
from asm_gym.monitors.memory_skills import learn_to_act, next_commands
from asm_gym.policies import make_policy, rollout
from asm_gym.scaling import StreamScaler
from asm_gym.spec import Channel, StreamSpec

SMALL: dict[str, Any] = {"hidden_size": 8, "association_size": 8, "epochs": 1}


class Point(gym.Env[Any, Any]):
    """A point in the plane that a command moves by a tenth; solved near the origin, where a gripper is to be closed."""

    metadata = {"render_fps": 20}  # noqa: RUF012

    def __init__(self, dt: float = 0.05) -> None:
        self.dt = dt
        self.observation_space = spaces.Box(-5.0, 5.0, (2,), np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (3,), np.float32)
        self.gripper_actions = (2,)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.at, self.steps = self.np_random.uniform(-1.0, 1.0, 2), 0
        return self.at.astype(np.float32), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.at, self.steps = self.at + 0.1 * action[:2], self.steps + 1
        won = bool(np.linalg.norm(self.at) < 0.15 and action[2] > 0)
        return self.at.astype(np.float32), 0.0, won, self.steps >= 60, {"success": won}


def taught(env: Point, episodes: int = 30) -> list[Episode]:
    """Straight to the origin, disturbed; the gripper closes there."""
    spec = StreamSpec.from_spaces(env.observation_space, env.action_space, 0.05)
    rng, made = np.random.default_rng(0), []
    for seed in range(episodes):
        observation, _ = env.reset(seed=seed)
        action, rows, actions = np.zeros(3, np.float32), [], []
        for _ in range(40):
            rows.append(np.concatenate([observation, action]))
            intended = np.append(
                np.clip(-2 * observation, -1, 1), 1.0 if np.linalg.norm(observation) < 0.1 else -1.0
            )
            actions.append(intended)
            action = np.clip(intended + 0.5 * np.append(rng.normal(size=2), 0.0), -1, 1).astype(
                np.float32
            )
            observation, *_ = env.step(action)
        shifted = np.concatenate([np.zeros((1, 3)), actions[:-1]]).astype(np.float32)
        made.append(Episode.from_stream(np.stack(rows), spec, actions=shifted))
    return made


@pytest.fixture(scope="module")
def pilot() -> NeuralASM:
    episodes = taught(Point())
    return learn_to_act(NeuralASM(episodes[0].spec, **SMALL).fit(episodes), episodes, 64)


def test_what_is_linear_is_learned_as_least_squares_would(monkeypatch):
    rng = np.random.default_rng(0)
    m = np.hstack([rng.normal(size=(8000, 4)), np.ones((8000, 1))]).astype(np.float32)
    commands = (m @ rng.normal(size=(5, 2)) + 0.1 * rng.normal(size=(8000, 2))).astype(np.float32)
    best = m @ np.linalg.lstsq(m, commands, rcond=None)[0]
    monkeypatch.setattr(motor, "FORGETTING", 0.0)
    found = learn_motor(m, commands, 4, np.random.default_rng(1)).command(m)
    assert np.sqrt(np.mean((found - best) ** 2)) < 0.03


def scene() -> StreamSpec:
    channels = (
        Channel("hand_position", 2, "m", group="hand"),
        Channel("hand_velocity", 2, "m/s", group="hand"),
        Channel("cube_pos", 2, group="object"),
        Channel("gripper_to_cube_pos", 2, group="object"),
        Channel("action", 2, group="action"),
    )
    return StreamSpec(channels, 0.05, "Panda")


def test_rates_and_commands_are_not_read_and_distances_finely():
    spec = scene()
    assert fineness(spec).tolist() == [PLACED, PLACED, 0, 0, 1, 1, FINE, FINE, 0, 0]
    senses = StreamScaler(spec, np.full(10, 1.0), np.full(10, 2.0), np.ones(10))
    row = np.arange(10.0)[None]
    expected = [PLACED * (0 - 1) / 2, 0.0, 3 / 2, 4 / 2, FINE * 5 / 2, FINE * 6 / 2, 1.0]
    np.testing.assert_allclose(situation(senses, row)[0], expected)
    row[0, 0] = np.nan
    assert situation(senses, row)[0, 0] == 0.0


def test_a_situation_is_paired_with_what_was_intended_next():
    spec = scene()
    senses = StreamScaler(spec, np.zeros(10), np.ones(10), np.ones(10))
    stream = np.arange(40.0).reshape(4, 10)
    done = Episode.from_stream(stream, spec)
    intended = replace(done, actions=np.full((4, 2), 7.0, np.float32))
    m, commands = next_commands(senses, [done])
    np.testing.assert_array_equal(m[:, 0], PLACED * stream[:3, 0])
    np.testing.assert_array_equal(commands, stream[1:, 8:])
    np.testing.assert_array_equal(next_commands(senses, [intended])[1], np.full((3, 2), 7.0))


def test_the_memory_steers_to_the_goal_and_closes_there(pilot):
    env = Point()
    policy = NeuralASMPolicy(pilot, env)
    assert sum(rollout(env, policy, seed) for seed in range(1000, 1020)) >= 19


def test_a_memory_file_is_a_policy_and_acts_the_same(pilot, tmp_path):
    env = Point()
    pilot.save(tmp_path / "skills.asm")
    policies = [NeuralASMPolicy(pilot, env), make_policy(str(tmp_path / "skills.asm"), env)]
    observation, _ = env.reset(seed=5)
    states: list[Any] = [None, None]
    for _ in range(5):
        actions = []
        for i, policy in enumerate(policies):
            action, states[i] = policy.predict(observation, states[i])
            actions.append(action)
        np.testing.assert_array_equal(*actions)
        assert env.action_space.contains(actions[0])
        observation, *_ = env.step(actions[0])


def told(shares: list[float], dt: float = 0.05) -> NDArray[np.float64]:
    """What a gripper is told while these are expected, from -1 to 1."""
    readout, grip, actions = CommandReadout(Point(dt)), None, []
    for share in shares:
        action, grip = readout(np.array([2.0, np.nan, share], np.float32), grip)
        actions.append(action)
    np.testing.assert_array_equal(np.stack(actions)[:, :2], [[1.0, 0.0]] * len(shares))
    return np.stack(actions)[:, 2]


@pytest.mark.parametrize("sure", [1.0, 0.5, 0.2, 0.1])
def test_a_gripper_changes_once_the_sum_of_what_speaks_for_it_reaches_the_bound(sure):
    ratio = np.exp(-0.05 / FORGETTING_TIME)
    reached = np.cumsum(0.05 * sure * ratio ** np.arange(200)) > CHANGE_AFTER  # a geometric series
    waits = int(np.argmax(reached))
    found = told([1.0] + [1.0 - 2 * sure] * (waits + 1))[1:]
    np.testing.assert_array_equal(found, [1.0] * waits + [-1.0])
    assert reached.any()


def memory_of(spec: StreamSpec) -> NeuralASM:
    rng = np.random.default_rng(0)
    episodes = [Episode.from_stream(rng.normal(size=(20, spec.size)), spec) for _ in range(6)]
    return NeuralASM(spec, **SMALL).fit(episodes)


def test_a_memory_that_does_not_fit_is_refused_with_what_differs(lift, pilot):
    own = lift.unwrapped.measured_spec
    common = replace(
        own, channels=tuple(c for c in own.channels if c.group in ("hand", "object", "action"))
    )
    strange = Channel("whisker", 2, "m", group="hand")
    ball = Channel("ball_pos", 3, group="object")
    hand, action = [c for c in common.channels if c.group == "hand"], common.channels[-1]
    bad = {
        r"predicts no command.*hand_position": replace(common, channels=tuple(hand)),
        r"predicts 2 commands, the environment takes \(7,\)": replace(
            common, channels=(*hand, replace(action, size=2))
        ),
        r"whisker: missing": replace(common, channels=(*hand, strange, action)),
        r"robot: Sawyer against Panda": replace(common, source="Sawyer"),
        r"objects: ball_pos are known, none of which is here": replace(
            common, channels=(*hand, ball, action)
        ),
        r"a row every 0.1 s, and is asked to act every 0.05 s": replace(common, dt=0.1),
    }
    for message, spec in bad.items():
        with pytest.raises(ValueError, match=message):
            NeuralASMPolicy(memory_of(spec), lift)
    with pytest.raises(ValueError, match="predicts 3 commands"):
        NeuralASMPolicy(pilot, lift)
    with pytest.raises(RuntimeError, match="learned nothing yet"):
        NeuralASMPolicy(NeuralASM(common), lift)


def test_learning_to_act_refuses_what_it_cannot_learn_from(pilot):
    silent = memory_of(StreamSpec((Channel("x", 3),), 0.05))
    with pytest.raises(ValueError, match="nothing is commanded in this stream; it has: x"):
        learn_to_act(silent, [Episode.from_stream(np.zeros((5, 3)), silent.spec)])
    with pytest.raises(ValueError, match="units must be at least 1, got 0"):
        learn_to_act(pilot, taught(Point(), 2), 0)
