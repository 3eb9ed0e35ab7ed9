"""Limits of healthy motion: healthy rows stay within them, each format has what its robot reads, or is refused."""

from __future__ import annotations

import json

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from asm_gym import collect
from asm_gym.data.action_meaning import ActionMeaning
from asm_gym.data.episode import Episode
from asm_gym.detection.healthy_ranges import LEAD, healthy_ranges, share_beyond
from asm_gym.exceptions import LimitsLacking, NotFitted
from asm_gym.monitors import NeuralASM, load_monitor, make_monitor
from asm_gym.monitors.limit_formats import FORMATS
from asm_gym.monitors.robot_limits import EXTERNAL_TORQUE, NEAR, POSITION, TARGET_DISTANCE, kind_of
from asm_gym.policies.hostile import HOSTILE
from asm_gym.scripts.cli import main
from asm_gym.spec import MOTOR, Channel, StreamSpec

SPEC = StreamSpec(
    (
        Channel("joint_position", 2, "rad", stops=((-3.0, 3.0), (-1.0, 1.0))),
        Channel("joint_velocity", 2, "rad/s"),
        Channel("external_torque", 2, "N m"),
        Channel("motor_current", 2, "A"),
        Channel("action", 2, "rad", group=MOTOR, elements=("elbow.pos", "wrist.pos")),
    ),
    dt=0.05,
    source="Arm",
)
TARGETS = ActionMeaning(
    means=("target", "target"), senses=(0, 1), slopes=(1.0, 1.0), offsets=(0.0, 0.0)
)


def healthy(seed: int, rows: int = 60) -> Episode:
    """An arm that pursues targets ahead of it by at most 0.1 rad."""
    rng = np.random.default_rng(seed)
    time = np.arange(rows)[:, None] * SPEC.dt
    position = 0.8 * np.sin(time + rng.uniform(0, 6, 2))
    velocity = np.gradient(position, SPEC.dt, axis=0)
    torque = 3.0 * rng.uniform(-1, 1, (rows, 2))
    current = 0.5 + 0.1 * rng.normal(size=(rows, 2))
    target = np.roll(position, 1, axis=0) + rng.uniform(-0.1, 0.1, (rows, 2))
    target[0] = position[0]
    columns = [position, velocity, torque, current, target]
    return Episode.from_stream(np.hstack(columns).astype(np.float32), SPEC)


@pytest.fixture(scope="module")
def monitor():
    fitted = make_monitor("kalman", SPEC).fit([healthy(n) for n in range(10)])
    fitted.about["actions"] = TARGETS.to_json()
    return fitted.calibrate([healthy(n) for n in range(10, 40)], false_alarm_rate=0.05)


def test_a_healthy_hour_stays_within_the_limits_and_a_hard_push_does_not(monitor):
    limits = monitor.limits()
    hour = np.concatenate([healthy(n).stream for n in range(100, 1300)])
    low = np.array([limit.low for limit in limits.limits[:8]])
    high = np.array([limit.high for limit in limits.limits[:8]])
    assert (hour[:, :8] >= low).all()
    assert (hour[:, :8] <= high).all()
    assert limits.of(EXTERNAL_TORQUE)[0].high < 10.0
    loads = np.abs(np.concatenate([healthy(n).stream for n in range(10, 40)])[:, 4])
    near = np.mean(loads > NEAR * limits.of(EXTERNAL_TORQUE)[0].high)
    assert limits.of(EXTERNAL_TORQUE)[0].near == pytest.approx(near, abs=0.02)
    assert limits.of(POSITION)[1].high <= 1.0  # its stop


def test_an_episode_passes_the_limits_that_one_of_its_rows_is_beyond(monitor):
    limits = monitor.limits()
    episode = healthy(2000)
    assert limits.passed(episode) == ()
    episode.stream[7, 4] = 1.1 * limits.of(EXTERNAL_TORQUE)[0].high
    episode.stream[9, 1] = limits.of(POSITION)[1].low - 0.1
    assert [limit.label for limit in limits.passed(episode)] == [
        "joint_position[1]",
        "external_torque[0]",
    ]


@pytest.mark.parametrize("robot", ["panda", "sawyer", "iiwa"])
def test_healthy_lifts_stay_within_the_limits_of_a_shipped_memory_and_ramming_does_not(robot):
    memory = NeuralASM.pretrained(robot)
    limits = memory.limits()
    assert not limits.of(TARGET_DISTANCE)  # a controller of poses takes changes
    alone = {"workers": 1, "robot": memory.spec.source, "seed": 900}
    for episode in collect("asm_gym/Lift-v0", "scripted", episodes=2, **alone):
        assert limits.passed(episode) == ()
    ramming = collect("asm_gym/Lift-v0", lambda env: HOSTILE["down"](env, 0, 1.0), 1, **alone)
    assert limits.passed(ramming[0])


def test_the_margin_scales_what_is_limited_and_must_not_be_below_one(monitor):
    torque = monitor.limits(margin=2.0).of(EXTERNAL_TORQUE)[0]
    assert torque.high == pytest.approx(2.0 * max(-torque.least, torque.most))
    with pytest.raises(ValueError, match="margin"):
        monitor.limits(margin=0.5)


def test_the_distance_of_a_target_is_that_of_its_sense_a_row_before(monitor):
    streams = [healthy(n).stream for n in range(10, 40)]
    expected = max(np.abs(s[1:, 8] - s[:-1, 0]).max() for s in streams)
    target = monitor.limits().of(TARGET_DISTANCE)[0]
    assert target.most == pytest.approx(expected, rel=1e-5)
    # a number that is no target has none
    mixed = ActionMeaning(("target", "delta"), (0, 1), (1.0, 1.0), (0.0, 0.0))
    assert healthy_ranges(streams, SPEC, mixed)[LEAD, 9] == 0.0


@given(st.floats(-2, 2), st.floats(0, 3))
def test_the_share_of_rows_beyond_falls_as_the_limits_widen(low, width):
    streams = [healthy(n).stream for n in range(3)]
    ranges = healthy_ranges(streams, SPEC)
    inner = share_beyond(ranges, 4, low, low + width)
    outer = share_beyond(ranges, 4, low - 0.1, low + width + 0.1)
    assert 0.0 <= outer <= inner <= 1.0


def test_formats_hold_what_their_robots_read(monitor):
    limits = monitor.limits()
    torque = limits.of(EXTERNAL_TORQUE)
    franka = yaml.safe_load(FORMATS["franka"](limits))
    uppers = [limit.high for limit in torque]
    assert franka["upper_torque_thresholds_nominal"] == pytest.approx(uppers, rel=1e-3)
    lowers = franka["lower_torque_thresholds_nominal"]
    assert all(lower < upper for lower, upper in zip(lowers, uppers, strict=True))

    lerobot = yaml.safe_load(FORMATS["lerobot"](limits))
    assert lerobot["max_relative_target"].keys() == {"elbow", "wrist"}
    assert len(lerobot["stall_current"]) == 2

    ur = yaml.safe_load(FORMATS["ur"](limits))
    low, high = ur["joint_position_range_deg"]["joint_position[0]"]
    assert low == pytest.approx(np.rad2deg(limits.of(POSITION)[0].low), rel=1e-3)
    assert low < high
    moveit = yaml.safe_load(FORMATS["moveit"](limits))
    assert moveit["joint_limits"]["joint_velocity[0]"]["has_velocity_limits"] is True
    assert moveit["moveit_servo"]["scale"]["joint"] > 0

    plain = json.loads(FORMATS["json"](limits))
    assert len(plain["limits"]) == len(limits.limits)
    assert yaml.safe_load(FORMATS["yaml"](limits))["limits"][0]["kind"] == POSITION


def test_a_memory_without_the_sense_of_a_format_is_refused_naming_what_it_has():
    spec = StreamSpec((Channel("temperature", 2, "°C"), Channel("action", 1, group=MOTOR)), dt=0.05)
    rng = np.random.default_rng(0)
    episodes = [Episode.from_stream(rng.normal(size=(40, 3)), spec) for _ in range(40)]
    monitor = make_monitor("kalman", spec).fit(episodes[:20])
    with pytest.raises(NotFitted):
        monitor.limits()
    limits = monitor.calibrate(episodes[20:], false_alarm_rate=0.05).limits()
    for form in ("franka", "ur", "lerobot", "moveit"):
        with pytest.raises(LimitsLacking, match=rf"^{form} needs .*temperature"):
            FORMATS[form](limits)


def test_ranges_are_saved_and_a_memory_without_them_is_to_be_calibrated(monitor, tmp_path):
    monitor.save(tmp_path / "a.asm")
    kept = load_monitor(tmp_path / "a.asm").limits()
    assert kept.as_dict() == monitor.limits().as_dict()
    shipped = NeuralASM.pretrained("panda")
    shipped.ranges_ = None
    with pytest.raises(NotFitted, match="calibrate"):
        shipped.limits()


@pytest.mark.parametrize("name", ["panda", "sawyer", "iiwa"])
def test_the_command_prints_the_limits_of_shipped_memories(name, capsys):
    assert main(["limits", name, "--format", "franka"]) == 0
    printed = yaml.safe_load(capsys.readouterr().out)
    assert len(printed["upper_torque_thresholds_acceleration"]) == 7


def test_hands_and_grippers_are_told_apart_from_joints():
    kinds = {
        "wrist_force": "force",
        "wrist_torque_peak": "hand torque",
        "hand_angular_velocity": "turning speed",
        "tau_ext_hat_filtered": EXTERNAL_TORQUE,
        "gripper_force": "",
        "commanded_torque": "",
        "qd": "joint speed",
    }
    assert {name: kind_of(Channel(name, 1)) for name in kinds} == kinds


def test_a_servo_of_lerobot_is_limited_by_what_each_number_is_named():
    servos = ("elbow.pos", "elbow.current", "gripper.current", "elbow.temperature", "elbow.vel")
    state = Channel("observation.state", 5, elements=servos)
    action = Channel("action", 1, group=MOTOR, elements=("elbow.pos",))
    spec = StreamSpec((state, action), dt=0.05)
    rng = np.random.default_rng(0)
    episodes = [Episode.from_stream(rng.normal(size=(40, 6)), spec) for _ in range(40)]
    monitor = make_monitor("kalman", spec).fit(episodes[:20])
    limits = monitor.calibrate(episodes[20:], false_alarm_rate=0.05).limits()
    assert [(limit.kind, limit.label) for limit in limits.limits] == [
        ("joint position", "observation.state[elbow.pos]"),
        ("current", "observation.state[elbow.current]"),
        ("current", "observation.state[gripper.current]"),
        ("joint speed", "observation.state[elbow.vel]"),
    ]
    current = limits.of("current")[0]
    assert current.low == -current.high
    assert current.high == pytest.approx(1.25 * max(-current.least, current.most))
