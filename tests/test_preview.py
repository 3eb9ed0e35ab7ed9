"""A chunk of actions is held against what healthy motion did, before the first of them is done."""

from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import ClipAction, RescaleAction, TransformAction

from asm_gym.data.episode import Episode
from asm_gym.detection.commands import healthy_commands, learned_motion
from asm_gym.detection.contact_limits import ContactLimits
from asm_gym.detection.hand_speed_map import HandSpeedMap
from asm_gym.exceptions import UnsupportedEnvironment
from asm_gym.guard.chunk_preview import preview_chunk
from asm_gym.monitors import NeuralASM, load_monitor, make_monitor
from asm_gym.spec import MOTOR, Channel, StreamSpec
from asm_gym.wrappers import NeuralASMSafety
from tests.fakes import CueMonitor, FakeEnv
from tests.test_lerobot import MOTORS, LeRobotGuard, recorded

HAND = StreamSpec(
    (
        Channel("hand_position", 3, "m"),
        Channel("hand_velocity", 3, "m/s"),
        Channel("action", 2, group=MOTOR),
    ),
    dt=0.05,
)
UP = np.tile([0, 0, 0.5, 0, 0, 0, 0], (16, 1))
DOWN = -UP


def path(speed, commands=(0.0, 0.5)):
    """A hand that goes along x for 0.4 m."""
    x = np.arange(0.0, 0.4, 0.05 * speed)
    rows = np.zeros((len(x), 8))
    rows[:, 0], rows[:, 3], rows[:, 6:] = x, speed, commands
    return rows


def test_what_healthy_policies_commanded_is_their_range_and_their_greatest_step():
    found = healthy_commands(
        [path(0.2, (0.0, 0.5)), np.vstack([path(0.2, (1.0, 0.5)), path(0.2, (0.4, 0.5))])],
        HAND.motor,
    )
    np.testing.assert_allclose(found, [[0.0, 0.5], [1.0, 0.5], [0.6, 0.0]], atol=1e-6)


def test_the_motion_that_streams_show_is_found():
    rng, truth = np.random.default_rng(0), np.random.default_rng(1).normal(0.0, 0.2, (5, 3))
    rows = rng.normal(size=(400, 8))
    for t in range(1, 400):
        rows[t, 3:6] = np.concatenate([rows[t - 1, 3:6], rows[t, 6:]]) @ truth
    np.testing.assert_allclose(learned_motion([rows], HAND), truth, atol=1e-9)


@pytest.fixture(scope="module")
def memory(lift):
    """It knows the places of a hand that went up from where it begins, and back."""
    lift.reset(seed=0)
    rows = [lift.step(action.astype(np.float32))[4]["stream"] for action in [*UP, *-UP]]
    memory = NeuralASM.pretrained("panda")
    memory.pace_ = {"": HandSpeedMap.learned([np.array(rows)], memory.spec)}
    memory.motion_ = learned_motion([np.array(rows)], memory.spec)
    return memory


def test_a_hand_that_would_go_faster_than_any_was_there_is_the_end_of_a_chunk():
    spec = StreamSpec(
        (*HAND.channels[:2], Channel("hand_angular_velocity", 3), HAND.channels[2]), HAND.dt
    )
    rows = np.insert(path(0.2, (0.2, 0.0)), 6, np.zeros((3, 1)), axis=1)
    known = SimpleNamespace(
        spec=spec, pace_={"": HandSpeedMap.learned([rows], spec)}, motion_=np.zeros((5, 3))
    )
    known.motion_[3, 0] = 1.0  # the hand has the velocity that is commanded
    row, last = rows[10], rows[10, 9:]

    def at(speed):
        return preview_chunk(np.float32([[speed, 0.0]] * 2), row, last, known, HAND.dt)[:2]

    assert at(0.2) == (None, "")
    assert at(0.3) == (0, "pace")
    assert at(-0.3) == (0, "pace")


@pytest.mark.parametrize("on_alarm", ["graded", "monitor"])
def test_a_chunk_is_kept_up_to_the_action_that_leads_where_no_healthy_hand_was(
    on_alarm, memory, lift
):
    env = NeuralASMSafety(lift, memory, on_alarm)
    env.reset(seed=0)
    assert env.preview(UP).at is None
    assert env.preview(UP).kept.shape == (16, 7)
    for action in UP[:8]:
        env.step(action.astype(np.float32))
    told = env.preview(DOWN)
    assert told.reason in ("place", "pace")
    assert told.known
    assert told.seconds == pytest.approx(0.05 * told.at)
    assert 0 < told.at < 16
    assert len(told.kept) == (16 if on_alarm == "monitor" else told.at)
    ahead = [env.step(np.zeros(7, np.float32))[4]["asm"]["preview"] for _ in range(told.at + 2)]
    assert [told["at"] for told in ahead[: told.at]] == list(range(told.at - 1, -1, -1))
    assert ahead[-1] is None


def test_the_limit_of_speed_counts_in_a_preview(memory, lift):
    free = NeuralASMSafety(lift, memory, contact_limits=None)
    free.reset(seed=0)
    early = free.preview(DOWN).at
    slow = NeuralASMSafety(lift, memory, contact_limits=ContactLimits(hand_speed=0.08))
    slow.reset(seed=0)
    assert slow.preview(DOWN).at > early


@pytest.mark.parametrize(
    "chunk", [np.zeros((0, 7)), np.zeros((4, 6)), np.zeros(7), np.zeros((2, 3, 7)), "down"]
)
def test_what_is_no_chunk_is_refused(chunk, memory, lift):
    env = NeuralASMSafety(lift, memory)
    env.reset(seed=0)
    with pytest.raises((ValueError, TypeError)):
        env.preview(chunk)


@pytest.mark.parametrize("number", [np.nan, np.inf, -np.inf])
def test_a_number_that_is_not_finite_is_the_end_of_a_chunk(number, memory, lift):
    env = NeuralASMSafety(lift, memory)
    env.reset(seed=0)
    chunk = UP.astype(np.float32)
    chunk[3, 5] = number
    told = env.preview(chunk)
    assert (told.at, told.reason, len(told.kept)) == (3, "no action", 3)
    huge = UP.astype(np.float32)
    huge[:, 2] = 1e30
    assert env.preview(huge).at is not None


def test_a_monitor_that_knows_no_places_says_so_and_an_episode_must_run(lift):
    env = NeuralASMSafety(FakeEnv(), CueMonitor())
    with pytest.raises(Exception, match="preview"):
        env.preview(np.zeros((4, 3)))
    env.reset()
    told = env.preview(np.zeros((4, 3)))
    assert told.at is None
    assert not told.known


def test_motion_and_commands_are_learned_by_calibrate_and_kept_in_files(tmp_path):
    rng = np.random.default_rng(0)
    noisy = [
        Episode.from_stream(path(0.2) + 0.01 * rng.normal(size=(40, 8)), HAND) for _ in range(12)
    ]
    monitor = make_monitor("kalman", HAND).fit(noisy[:6])
    assert monitor.motion_ is None
    monitor.calibrate(noisy[6:], 0.5).save(tmp_path / "hand.asm")
    loaded = load_monitor(tmp_path / "hand.asm")
    np.testing.assert_array_equal(loaded.commands_, monitor.commands_)
    np.testing.assert_array_equal(loaded.motion_, monitor.motion_)


def test_a_lerobot_chunk_is_held_against_the_range_of_healthy_commands():
    monitor = make_monitor("kalman", recorded(0).spec).fit([recorded(n) for n in range(4)])
    monitor.calibrate([recorded(10 + n) for n in range(4)], 0.5)
    guard, rest = LeRobotGuard(monitor), dict.fromkeys(MOTORS, 0.0)
    assert guard.preview(rest, [rest] * 8).at is None
    far = {**rest, MOTORS[2]: 80.0}
    assert guard.preview(rest, [rest, rest, far]).at == 2
    assert guard.preview(rest, [rest, {**rest, MOTORS[0]: np.nan}]).reason == "no action"
    assert guard.preview(rest, [rest, {MOTORS[0]: 0.0}]).at == 1
    with pytest.raises(ValueError, match="chunk"):
        guard.preview(rest, [])
    with pytest.raises(ValueError, match=r"knows no action called tail\.pos"):
        guard.preview(rest, [rest, {**rest, "tail.pos": 1e30}])


class Halved(gym.ActionWrapper):
    """Changes actions, and no one knows how."""

    def action(self, action):
        return 0.5 * action


def height(numbers):
    """An action of one number as one of the arm: up and down."""
    return np.insert(np.zeros(6, np.float32), 2, numbers[0])


UPWARDS = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)


def guarded(env, memory):
    env = NeuralASMSafety(env, memory, "monitor")
    env.reset(seed=0)
    return env


def test_a_preview_judges_actions_as_wrappers_inside_change_them(memory, lift):
    single = DOWN[:, 2:3]  # (16, 1)
    plain = guarded(lift, memory).preview(DOWN)
    assert plain.at is not None
    assert guarded(ClipAction(lift), memory).preview(DOWN).at == plain.at
    assert guarded(TransformAction(lift, height, UPWARDS), memory).preview(single).at == plain.at
    wide = guarded(RescaleAction(lift, np.float32(-10.0), np.float32(10.0)), memory)
    assert wide.preview(10.0 * DOWN)[:3] == plain[:3]
    assert wide.preview(0.1 * DOWN).at != plain.at
    turned = TransformAction(lift, np.negative, lift.action_space)
    assert guarded(turned, memory).preview(UP)[:3] == plain[:3]


def test_a_preview_judges_actions_as_wrappers_outside_change_them(memory, lift):
    guard = guarded(lift, memory)
    plain = guard.preview(DOWN)
    outer = RescaleAction(guard, np.float32(-10.0), np.float32(10.0))
    told = guard.preview(10.0 * DOWN, outer)
    assert told[:3] == plain[:3]
    np.testing.assert_array_equal(told.kept, 10.0 * DOWN)
    outer = TransformAction(guard, height, UPWARDS)
    assert guard.preview(DOWN[:, 2:3], outer)[:3] == plain[:3]
    with pytest.raises(ValueError, match="not the environment around this guard"):
        guard.preview(DOWN, lift)


def test_a_preview_refuses_what_it_cannot_know(memory, lift):
    with pytest.raises(UnsupportedEnvironment, match=r"Halved changes actions.*TransformAction"):
        guarded(Halved(lift), memory).preview(DOWN)
    guard = guarded(lift, memory)
    with pytest.raises(UnsupportedEnvironment, match="Halved changes actions"):
        guard.preview(DOWN, Halved(guard))


def test_a_preview_refuses_actions_of_another_size_than_the_memory_reads():
    known = SimpleNamespace(spec=HAND, commands_=np.zeros((3, 2), np.float32))
    with pytest.raises(UnsupportedEnvironment, match=r"hold 3 numbers.* 2 commands"):
        preview_chunk(np.zeros((4, 3), np.float32), path(0.2)[0], np.zeros(3), known, HAND.dt)


def test_a_number_that_is_not_finite_ends_a_chunk_whatever_wrappers_make_of_it(memory, lift):
    mended = TransformAction(lift, np.nan_to_num, lift.action_space)
    chunk = UP.astype(np.float32)
    chunk[3, 5] = np.inf
    assert guarded(mended, memory).preview(chunk)[:2] == (3, "no action")
