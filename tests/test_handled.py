"""The sense of a handled object: a tracker's noise and dropouts, its events, its faults, and who reads it."""

from __future__ import annotations

from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import SyncVectorEnv

from asm_gym import Channel, Episode, NeuralASM, StreamSpec
from asm_gym.envs.object_tracker import (
    ALPHA,
    BETA,
    CARRIED,
    NO_POSE,
    RESTS,
    SENSED,
    UNDECIDED,
    correct,
    decide,
    new_hand,
    new_track,
    predict,
    rotation,
    rotation_vector,
    write_sense,
)
from asm_gym.envs.simulated_tracker import (
    LONGEST_HIDDEN_S,
    LONGEST_UNSEEN_S,
    QUALITY,
    TrackedHand,
    TrackerQuality,
)
from asm_gym.exceptions import SpecMismatch
from asm_gym.spec import CARRIED_CHANNEL, HANDLED, MOTOR
from asm_gym.stream_view import StreamView
from asm_gym.wrappers import NeuralASMSafety, VectorNeuralASMSafety
from tests.fakes import SPEC as FAKE
from tests.fakes import CueMonitor, FadingMonitor, FakeEnv

DT = 0.05
NOISE = 0.005
OBJECT = (
    Channel("object_position", 3, "m", noise=0.0025, group=HANDLED),
    Channel("object_velocity", 3, "m/s", noise=0.0075, group=HANDLED),
    Channel("object_turn_rate", 3, "rad/s", noise=0.026, group=HANDLED),
    Channel(CARRIED_CHANNEL, 1, group=HANDLED),
)
HAND = (
    Channel("hand_position", 3, "m", noise=1e-4, group="hand"),
    Channel("hand_velocity", 3, "m/s", noise=1e-3, group="motion"),
    Channel("finger_speed", 1, "m/s", noise=1e-3, group="gripper"),
)
SPEC = StreamSpec((*HAND, *OBJECT, Channel("action", 4, group=MOTOR)), DT)
SENSE = slice(7, 7 + SENSED)


def moved(hand, step):
    """Move a hand by a step (3,) [m]."""
    hand.position[:] = hand.position + step
    hand.velocity[:] = step / DT


def track_at_rest(rng, rows=4000):
    """Return the estimates (rows, 3), (rows, 3) of an object that rests beside a hand that does."""
    track, hand = new_track(), new_hand()
    positions, velocities = np.empty((rows, 3)), np.empty((rows, 3))
    numbers = np.empty(SENSED)
    for t in range(rows):
        predict(track, hand, DT)
        correct(track, NOISE * rng.standard_normal(3), np.eye(3), DT)
        decide(track, hand, DT)
        write_sense(track, hand, numbers)
        positions[t], velocities[t] = numbers[:3], numbers[3:6]
    return positions, velocities


def test_the_filter_leaves_as_much_noise_as_its_gains_say():
    positions, velocities = track_at_rest(np.random.default_rng(0))
    left = ALPHA * (4 - 2 * ALPHA - BETA)
    position = NOISE * np.sqrt((2 * ALPHA**2 + BETA * (2 - 3 * ALPHA)) / left)
    velocity = NOISE / DT * np.sqrt(2 * BETA**2 / left)
    assert positions[100:].std() == pytest.approx(position, rel=0.1)
    assert velocities[100:].std() == pytest.approx(velocity, rel=0.1)


def test_rotation_vectors_are_the_logarithm_of_rotations():
    rng = np.random.default_rng(0)
    for vector in rng.normal(size=(20, 3)):
        np.testing.assert_allclose(rotation_vector(rotation(vector)), vector, atol=1e-9)


def run(path, carried_from=None, let_go_at=None, rng=None, drop=()):
    """Return the senses (T, SENSED) of an object, as a hand moves along steps (T, 3).

    The fingers close in the five rows before ``carried_from`` and open in those before ``let_go_at``; between these the
    object moves with the hand. In rows of ``drop`` no pose is measured.
    """
    rng = rng or np.random.default_rng(0)
    track, hand = new_track(), new_hand()
    place = np.array([0.02, 0.0, -0.01])
    sensed = np.empty((len(path), SENSED))
    for t, step in enumerate(path):
        moved(hand, step)
        starts = [time for time in (carried_from, let_go_at) if time is not None]
        hand.fingers_move = any(start - 5 <= t < start for start in starts)
        held = carried_from is not None and carried_from <= t < (let_go_at or len(path))
        if held:
            place = place + step
        predict(track, hand, DT)
        if t not in drop:
            correct(track, place + NOISE * rng.standard_normal(3), np.eye(3), DT)
        decide(track, hand, DT)
        write_sense(track, hand, sensed[t])
    return sensed


def lift(rows=60, start=20, speed=0.1):
    """Return the path (rows, 3) of a hand that stands, and rises at ``speed`` [m/s] from ``start`` on."""
    path = np.zeros((rows, 3))
    path[start:, 2] = speed * DT
    return path


@pytest.mark.parametrize("speed", [0.05, 0.2, 0.5])
def test_an_object_that_is_grasped_is_undecided_and_then_moves_with_the_hand(speed):
    sensed = run(lift(speed=speed), carried_from=20)
    carried = sensed[:, -1]
    assert carried[0] == NO_POSE
    assert set(carried[5:15]) == {RESTS}
    assert carried[18] == UNDECIDED
    assert set(carried[45:]) == {CARRIED}
    np.testing.assert_allclose(sensed[50:, :3], np.tile([0.02, 0.0, -0.01], (10, 1)), atol=0.01)
    assert np.abs(sensed[50:, 3:6]).max() < 0.02


def test_fingers_that_close_on_nothing_leave_the_object_at_rest():
    rng = np.random.default_rng(0)
    track, hand = new_track(), new_hand()
    place = np.array([0.02, 0.0, -0.01])
    for t, step in enumerate(lift()):
        moved(hand, step)
        hand.fingers_move = 15 <= t < 20
        predict(track, hand, DT)
        correct(track, place + NOISE * rng.standard_normal(3), np.eye(3), DT)
        decide(track, hand, DT)
    assert track.carrier == RESTS


def test_a_pose_that_is_missing_is_predicted_along_with_the_hand():
    seen = run(lift(), carried_from=20)
    gaps = run(lift(), carried_from=20, drop=range(45, 53))
    assert np.isfinite(gaps).all()
    np.testing.assert_allclose(gaps[45:53, :3], seen[45:53, :3], atol=0.02)


# ---------------------------------------------------------------- the tracker in the simulation


class Scene:
    """A scene with a hand at the origin and objects at rest."""

    def __init__(self, *places):
        bodies = len(places) + 1
        self.data = SimpleNamespace(
            time=0.0,
            site_xpos=np.zeros((1, 3)),
            xpos=np.vstack([np.zeros(3), *places]),
            xmat=np.tile(np.eye(3).ravel(), (bodies, 1)),
            qvel=np.zeros(2),
        )
        robot = SimpleNamespace(
            eef_site_id={"right": 0},
            robot_model=SimpleNamespace(eef_name={"right": "hand"}),
            gripper={"right": SimpleNamespace(joints=("finger",))},
            _ref_gripper_joint_vel_indexes={"right": [0, 1]},
        )
        self.parts = [(robot, "right")]
        self.model = SimpleNamespace(body=lambda name: SimpleNamespace(id=0))
        self.proprioception = SimpleNamespace(last=np.zeros((1, 64)))

    def tracked(self, noise=1.0, quality=QUALITY):
        hand = TrackedHand(self, 0, range(1, len(self.data.xpos)), noise, quality)
        hand.begin_episode(np.random.default_rng(1))
        return hand


def test_poses_drop_out_as_often_as_the_tracker_says_and_no_oftener_than_it_tolerates():
    hand = Scene([0.5, 0.0, 0.0]).tracked()
    rows = np.array([hand.read(DT) for _ in range(4000)])
    dropped = 1 - hand.track.poses / 4000
    assert dropped == pytest.approx(QUALITY.dropout, abs=0.007)
    assert np.isfinite(rows).all()


def test_a_hand_hides_objects_near_it_for_a_time_that_is_bounded():
    hand = Scene([0.05, 0.0, 0.0]).tracked()
    gaps = []
    for _ in range(8000):
        assert np.isfinite(hand.read(DT)).all()
        gaps.append(round(hand.track.unseen_s / DT))
    share = np.mean(np.array(gaps) > 0)
    assert 0.05 < share < 0.25
    assert max(gaps) <= 0.75 / DT


def test_poses_come_20_times_a_second_at_faster_rows_too():
    hand = Scene([0.5, 0.0, 0.0]).tracked()
    for _ in range(1000):
        hand.read(0.01)
    assert hand.track.poses == pytest.approx(200 * (1 - QUALITY.dropout), abs=8)


def test_the_nearest_object_does_not_flip_back_and_forth():
    scene = Scene([0.20, 0.0, 0.0], [-0.21, 0.0, 0.0])
    hand = scene.tracked()
    targets = []
    for t in range(200):
        scene.data.site_xpos[0, 0] = 0.008 * (-1) ** (t // 10)
        hand.read(DT)
        targets.append(hand.target)
    assert set(targets) == {1}
    scene.data.site_xpos[0, 0] = -0.15
    carried = [hand.read(DT)[-1] for _ in range(20)]
    assert hand.target == 2
    assert NO_POSE in carried


def test_an_object_that_is_gone_is_missing_for_longer_than_a_dropout():
    scene = Scene([0.5, 0.0, 0.0])
    hand = scene.tracked()
    for _ in range(40):
        hand.read(DT)
    scene.data.xpos[1] = [8.0, 8.0, 0.5]
    rows = np.array([hand.read(DT) for _ in range(20)])
    assert np.isfinite(rows[:4]).all()
    assert np.isnan(rows[10:]).all()


def hidden_and_lifted(longest_hidden):
    """Return the senses of an object that the hand hides and lifts, and how long it has been unseen in each row [s].

    The filter believes that the object rests, so that its estimate stays behind.
    """
    scene = Scene([0.05, 0.0, 0.0])
    quality = TrackerQuality(
        dropout=0.0, hiding=1.0, shown_again=0.0, longest_hidden=longest_hidden
    )
    hand = scene.tracked(quality=quality)
    rows, unseen = [], []
    for t in range(30):
        rows.append(hand.read(DT))
        unseen.append(hand.track.unseen_s)
        if 3 <= t < 11:
            scene.data.site_xpos[0, 2] += 0.02
            scene.data.xpos[1, 2] += 0.02
    return np.array(rows), np.array(unseen)


def test_an_object_that_is_lifted_while_the_hand_hides_it_is_not_lost():
    rows, unseen = hidden_and_lifted(QUALITY.longest_hidden)
    assert unseen.max() > LONGEST_UNSEEN_S + DT
    assert np.isfinite(rows).all()


def test_an_object_that_the_hand_hides_before_its_first_pose_is_not_lost():
    scene = Scene([0.05, 0.0, 0.0])
    hand = scene.tracked(quality=TrackerQuality(dropout=1.0))
    rows = np.array([hand.read(DT) for _ in range(30)])
    lost = np.isnan(rows).all(axis=1)
    assert not lost[: round(LONGEST_HIDDEN_S / DT) - 1].any()
    assert lost[-1]


def test_an_object_that_was_near_the_hand_is_lost_after_the_longest_time_that_it_may_be_hidden():
    rows, unseen = hidden_and_lifted(longest_hidden=100)
    is_lost = unseen > LONGEST_HIDDEN_S + 1e-9
    assert is_lost.any()
    np.testing.assert_array_equal(np.isnan(rows).all(axis=1), is_lost)
    np.testing.assert_array_equal(np.isnan(rows).any(axis=1), is_lost)


def test_without_objects_the_sense_says_so():
    rows = np.array([Scene().tracked().read(DT) for _ in range(3)])
    np.testing.assert_array_equal(rows[:, -1], NO_POSE)
    assert np.abs(rows[:, :-1]).max() < 0.05  # noise alone


# ---------------------------------------------------------------- in the stream of an environment


def played(stream, steps=12, seed=3):
    """Return the observations, the stream's rows and its spec of an episode."""
    pytest.importorskip("robosuite")
    env = gym.make("asm_gym/Lift-v0", robot="Panda", stream=stream)
    rng = np.random.default_rng(0)
    episodes = []
    for _ in range(2):
        observation, info = env.reset(seed=seed)
        observations, rows = [observation], [info["stream"]]
        for _ in range(steps):
            observation, *_, info = env.step(rng.uniform(-1, 1, 7).astype(np.float32))
            observations.append(observation)
            rows.append(info["stream"])
        episodes.append((np.array(observations), np.array(rows)))
        rng = np.random.default_rng(0)
    spec = env.unwrapped.stream_spec
    env.close()
    return episodes, spec


def test_the_group_changes_no_observation_and_no_other_channel_and_episodes_repeat():
    from asm_gym.envs.sensors import GROUPS

    without, narrow = played([group for group in GROUPS if group != HANDLED])
    with_group, wide = played(GROUPS)
    (observed, rows), (again, rows_again) = with_group
    np.testing.assert_array_equal(observed, without[0][0])
    np.testing.assert_array_equal(observed, again)
    np.testing.assert_array_equal(rows, rows_again)
    view = StreamView(offered=wide, wanted=narrow)
    np.testing.assert_array_equal(view.rows(rows), without[0][1])
    assert rows[-1, wide.slices[CARRIED_CHANNEL]] == RESTS


# ---------------------------------------------------------------- in a memory


def handling(seed, rows=90):
    """Return an episode in which a hand wanders, grasps an object, and carries it."""
    rng = np.random.default_rng(seed)
    grasp = int(rng.integers(35, 50))
    wish = np.cumsum(rng.normal(size=(rows, 3)), axis=0)
    wish = 0.006 * np.tanh(wish / 4.0)
    wish[grasp - 8 : grasp + 2] = 0.0
    wish[: grasp - 8] -= wish[: grasp - 8].mean(axis=0)
    wish[grasp + 2 :, 2] += 0.008
    sensed = run(wish, carried_from=grasp, rng=rng)
    position = np.cumsum(wish, axis=0)
    velocity = wish / DT
    finger = np.zeros((rows, 1))
    finger[grasp - 5 : grasp] = 0.1
    command = np.hstack([velocity, finger])
    command += 1e-3 * rng.normal(size=command.shape)
    noisy_position = position + 1e-4 * rng.normal(size=position.shape)
    noisy_velocity = velocity + 1e-3 * rng.normal(size=velocity.shape)
    noisy_finger = finger + 1e-3 * rng.normal(size=finger.shape)
    stream = np.hstack([noisy_position, noisy_velocity, noisy_finger, sensed, command])
    return Episode.from_stream(stream, SPEC)


@pytest.fixture(scope="module")
def memory():
    fitted = NeuralASM(SPEC, hidden_size=16, association_size=32, epochs=2)
    fitted.fit([handling(seed) for seed in range(60)])
    return fitted.calibrate([handling(seed) for seed in range(100, 140)], 0.05)


def alarm_rows(memory, stream):
    surprise = memory.score(Episode.from_stream(stream, SPEC))
    return np.flatnonzero(~(surprise.value <= memory.threshold)), surprise


def test_a_healthy_grasp_is_no_alarm(memory):
    alarms = [len(alarm_rows(memory, handling(seed).stream)[0]) > 0 for seed in range(200, 240)]
    assert sum(alarms) <= 6


@pytest.mark.parametrize("fault", ["freezes", "jumps", "missing"])
def test_a_tracker_that_fails_is_an_alarm_of_its_group(memory, fault):
    found = 0
    for seed in range(300, 310):
        stream = handling(seed).stream.copy()
        if fault == "freezes":
            stream[15:, SENSE] = stream[14, SENSE]
        elif fault == "jumps":
            stream[15:, 7:10] += (0.08, -0.05, 0.0)
        else:
            stream[15:, SENSE] = np.nan
        rows, surprise = alarm_rows(memory, stream)
        rows = rows[(rows >= 15) & (rows < 35)]
        if len(rows):
            share = surprise.attribution[rows[0]]
            found += not np.delete(share, np.arange(7, 17)).max() > share[SENSE].max()
    assert found >= 9


def test_what_an_object_does_while_it_is_undecided_is_expected(memory):
    stream = handling(400).stream
    undecided = stream[:, SENSE.stop - 1] == UNDECIDED
    row = int(np.flatnonzero(undecided)[4])
    jumped = stream.copy()
    jumped[row:, 7:10] += 0.02
    surely = jumped.copy()
    surely[:, SENSE.stop - 1] = np.where(undecided, RESTS, stream[:, SENSE.stop - 1])
    healthy = memory.score(Episode.from_stream(stream, SPEC)).value[row]
    excused = memory.score(Episode.from_stream(jumped, SPEC)).value[row]
    judged = memory.score(Episode.from_stream(surely, SPEC)).value[row]
    assert judged > excused >= healthy * 0.5


class Replayed(gym.Env):
    """Plays a stream (T, D) back, whatever the action is; the policy observes the hand."""

    def __init__(self, stream):
        self.stream = stream.astype(np.float32)
        self.stream_spec = SPEC
        self.dt = DT
        self.action_means = "velocity"
        self.observation_space = gym.spaces.Box(-100.0, 100.0, (7,), np.float32)
        self.laid_out_space = self.observation_space
        self.observation_layout = {channel.name: channel.size for channel in HAND}
        self.action_space = gym.spaces.Box(-1.0, 1.0, (4,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return self.stream[0, :7], {"stream": self.stream[0]}

    def step(self, action):
        row = self.stream[self.t]
        self.t += 1
        return row[:7], 0.0, False, self.t == len(self.stream), {"stream": row}


@pytest.mark.parametrize("fault", ["jumps", "missing"])
def test_an_alarm_of_the_object_alone_lets_the_policy_go_on(memory, fault):
    alarms = 0
    for seed in range(300, 305):
        stream = handling(seed).stream.copy()
        if fault == "jumps":
            stream[15:, 7:10] += (0.08, -0.05, 0.0)
        else:
            stream[15:, SENSE] = np.nan
        env = NeuralASMSafety(Replayed(stream), memory, on_alarm="graded")
        env.reset()
        infos = [env.step(np.zeros(4, np.float32))[-1] for _ in range(30)]
        alarms += any(info["asm_alarm"] for info in infos[15:25])
        assert not any(info["asm_intervened"] for info in infos[15:])
    assert alarms >= 4


# ---------------------------------------------------------------- commands, and parts of a stream


def test_what_a_controller_puts_out_predicts_and_is_not_judged():
    rng = np.random.default_rng(0)
    spec = StreamSpec(
        (
            Channel("speed", 1, "m/s", group="motion"),
            Channel("commanded_torque", 1, "N m", group="torque", commanded=True),
        ),
        dt=0.1,
    )
    assert spec.sensory.tolist() == [0]
    assert spec.commanded.tolist() == [1]
    assert spec.motor.tolist() == []
    assert StreamSpec.from_json(spec.to_json()) == spec

    def episode():
        torque = rng.normal(size=(80, 1))
        speed = np.cumsum(0.1 * torque, axis=0) + 0.01 * rng.normal(size=(80, 1))
        return Episode.from_stream(np.hstack([speed, torque]), spec)

    memory = NeuralASM(spec, hidden_size=8, association_size=8, epochs=2, values=False)
    memory.fit([episode() for _ in range(20)]).calibrate([episode() for _ in range(20)], 0.05)
    wrong = episode().stream.copy()
    wrong[40] += (0.0, 30.0)
    surprise = memory.score(Episode.from_stream(wrong, spec))
    assert not surprise.attribution[:, 1].any()
    assert surprise.attribution[40:42, 0].max() > memory.threshold  # it predicts the speed


def test_a_memory_reads_the_part_of_a_stream_that_it_knows():
    part = StreamSpec((HAND[1], SPEC.channels[-1]), DT)
    view = StreamView(offered=SPEC, wanted=part)
    rows = np.arange(2.0 * SPEC.size).reshape(2, SPEC.size)
    np.testing.assert_array_equal(view.rows(rows)[:, :3], rows[:, 3:6])
    assert view.left_out == ("hand_position", "finger_speed", *(c.name for c in OBJECT))
    written = view.written_back(-view.rows(rows)[0], rows[0])
    np.testing.assert_array_equal(written[3:6], -rows[0, 3:6])
    np.testing.assert_array_equal(written[:3], rows[0, :3])


class WiderEnv(FakeEnv):
    """Senses a temperature too, which stands before everything else."""

    def __init__(self):
        super().__init__(length=9)
        self.stream_spec = StreamSpec((Channel("temperature", 1, "°C"), *FAKE.channels), FAKE.dt)

    def _out(self, action):
        observation, info = super()._out(action)
        info["stream"] = np.concatenate([[80.0], info["stream"]]).astype(np.float32)
        return observation, info


def test_a_guard_gives_its_monitor_the_channels_that_it_knows_and_says_so_once(caplog):
    monitor = CueMonitor(cue=(3,), spec=FAKE)
    env = NeuralASMSafety(WiderEnv(), monitor, on_alarm="monitor")
    env.reset()
    infos = [env.step(np.zeros(3, np.float32))[-1] for _ in range(5)]
    assert [info["asm_alarm"] for info in infos] == [False, False, False, True, False]
    assert infos[0]["stream"].shape == (6,)
    assert list(infos[0]["asm"]["attribution"]) == list(FAKE.labels)
    np.testing.assert_array_equal(monitor.rows[-1][:2], (5.0, 5.0))
    assert sum("temperature" in record.message for record in caplog.records) == 1


def test_a_guard_of_many_gives_its_monitor_the_channels_that_it_knows():
    envs = SyncVectorEnv([WiderEnv, WiderEnv])
    guarded = VectorNeuralASMSafety(envs, FadingMonitor(cue=(3,), spec=FAKE), on_alarm="monitor")
    guarded.reset()
    alarms = [guarded.step(np.zeros((2, 3), np.float32))[-1]["asm_alarm"] for _ in range(4)]
    assert np.array(alarms).any(axis=1).tolist() == [False, False, True, True]
    guarded.close()


def test_a_robot_without_a_tracker_leaves_the_object_out(memory):
    without = StreamSpec((*HAND, SPEC.channels[-1]), DT)
    view = StreamView(offered=without, wanted=SPEC)
    assert view.filled == tuple(channel.name for channel in OBJECT)
    alarms = 0
    for seed in range(500, 520):
        stream = np.delete(handling(seed).stream, np.arange(7, 17), axis=1)
        filled = view.rows(stream)
        assert (filled[:, SENSE.stop - 1] == NO_POSE).all()
        alarms += len(alarm_rows(memory, filled)[0]) > 0
    assert alarms <= 5


def test_any_other_channel_that_is_missing_is_refused():
    part = StreamSpec((HAND[0], *OBJECT), DT)
    with pytest.raises(SpecMismatch, match="finger_speed"):
        StreamView(offered=part, wanted=SPEC)
    slower = StreamSpec(SPEC.channels, 2 * DT)
    with pytest.raises(SpecMismatch, match="dt"):
        StreamView(offered=slower, wanted=SPEC)
