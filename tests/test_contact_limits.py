"""Limits on what an arm may feel and how fast its hand may go: on the arm, side by side, and learned."""

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest

from asm_gym import Episode, collect
from asm_gym.data.episode import EpisodeLabel
from asm_gym.detection.contact_limits import ContactLimits, healthy_forces
from asm_gym.detection.hand_speed_map import HandSpeedMap
from asm_gym.envs.arm_brake import BESIDE_BASE
from asm_gym.envs.robots import ROBOTS, robot_named
from asm_gym.guard.episode_limits import EpisodeLimits, limits_of
from asm_gym.guard.robot_facts import RobotFacts
from asm_gym.monitors import NeuralASM, make_monitor
from asm_gym.monitors.monitor_registry import load_monitor
from asm_gym.policies import make_policy
from asm_gym.spec import Channel, StreamSpec
from asm_gym.wrappers import NeuralASMSafety
from asm_gym.wrappers.capabilities import robots_of
from tests.hand_motion import hand_momentum, hand_speed, present_twist

FOLDED = 0.0, -0.2, 2.5, -2.95, 1.34, 2.3, -2.73  # the fingers are in the pedestal, 9 mm deep [rad]


def down(env, steps, seed=0):
    """The largest contact force of a hand that is driven down [N], and what was said."""
    env.reset(seed=seed)
    action = np.array([0, 0, -1, 0, 0, 0, -1], np.float32)
    forces, said = [], []
    for _ in range(steps):
        *_, terminated, truncated, info = env.step(action)
        forces.append(info["contact_force"])
        said.append(info)
        if terminated or truncated:
            break
    return max(forces), said


def test_a_hand_that_rams_the_table_is_stopped_by_default(lift):
    alone, _ = down(lift, 60)
    guarded = NeuralASMSafety(lift, NeuralASM.pretrained("panda"))
    force, said = down(guarded, 100)
    assert alone > 500.0
    assert force < 0.5 * alone
    assert said[-1]["asm"]["gave_up"]
    assert any(i["asm"]["reason"] == "contact" for i in said)
    speeds = [i["asm"]["severity"]["speed"] for i in said]
    assert max(speeds) < 2.2 * ContactLimits().hand_speed
    assert np.isnan(lift.unwrapped.measured).sum() == 0


def test_a_held_cube_that_is_slammed_on_the_table_and_pressed_is_an_alarm_and_held(lift):
    env, expert = (
        NeuralASMSafety(lift, NeuralASM.pretrained("panda")),
        make_policy("scripted", lift, seed=0),
    )
    observation, _ = env.reset(seed=1000)
    action, state = np.array([0, 0, -1, 0, 0, 0, 1], np.float32), None
    while lift.unwrapped.simulation.data.body("cube_main").xpos[2] < 0.9:
        up, state = expert.predict(observation, state, np.array([state is None]))
        observation, *_ = env.step(up)
    said = []
    reason = ""
    while not (reason == "contact" and said[-1]["asm"]["intervened"]):
        said.append(env.step(action)[4])
        reason = said[-1]["asm"]["reason"]
    felt = [i["asm"]["severity"]["force"] for i in said]
    assert sum(force > 40.0 for force in felt) * 0.05 < 0.4
    assert max(i["contact_force"] for i in said) < 120.0


def test_fingers_of_a_held_arm_close_no_further_while_it_presses(lift):
    def closed(limits):
        """How far the fingers' targets move in a step in which the arm is held while they are closing."""
        lift.reset(seed=0)
        arm = lift.unwrapped
        arm.contact_limits, close = limits, np.array([0, 0, 0, 0, 0, 0, 1], np.float32)
        lift.step(close)
        before, arm.holding = arm.simulation.data.ctrl[7:9].copy(), True
        lift.step(close)
        return np.abs(arm.simulation.data.ctrl[7:9] - before).max()

    assert closed(ContactLimits(1e-6, 1e-6)) == 0.0
    assert closed(ContactLimits(1e3, 1e3)) > 0.001


def test_limits_are_forgotten_by_reset_and_change_nothing_of_gentle_motion(lift):
    gentle = np.array([0.2, 0.1, 0.1, 0, 0, 0, -1], np.float32)

    def rows(limits):
        lift.reset(seed=3)
        lift.unwrapped.contact_limits = limits
        return np.stack([lift.step(gentle)[4]["stream"] for _ in range(10)])

    np.testing.assert_array_equal(rows(ContactLimits()), rows(None))
    lift.reset(seed=3)
    assert lift.unwrapped.contact_limits is None


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"wrist_force": 0.0}, "wrist_force must be a number above 0, got 0.0"),
        ({"hand_speed": float("nan")}, "hand_speed must be a number above 0, got nan"),
        ({"healthy": (1.0, -2.0)}, "healthy must be a number of at least 0, got -2.0"),
    ],
)
def test_limits_that_are_none_are_refused(given, message):
    with pytest.raises(ValueError, match=message):
        ContactLimits(**given)


def test_limits_of_another_arm_are_refused_at_construction(lift):
    with pytest.raises(ValueError, match="healthy must say 10 numbers"):
        NeuralASMSafety(
            lift, NeuralASM.pretrained("panda"), contact_limits=ContactLimits(healthy=(1.0, 2.0))
        )
    with pytest.raises(ValueError, match="contact_limits must be ContactLimits"):
        NeuralASMSafety(lift, NeuralASM.pretrained("panda"), contact_limits="none")


def test_who_has_pressed_too_hard_may_press_half_as_hard_and_go_a_quarter_as_fast_for_a_second(
    lift,
):
    spec, yes, no = lift.unwrapped.stream_spec, np.ones(1, bool), np.zeros(1, bool)
    limits = EpisodeLimits(robots_of(lift, spec, spec.dt)[0], ContactLimits(), True)
    limits.begin(yes)
    limits.follow(yes, yes)
    told = []
    for _ in range(21):
        told.append(limits.now[0])
        limits.follow(yes, no)
    assert (
        told[:20]
        == [ContactLimits(wrist_force=40.0, external_torque=20.0, hand_speed=0.15 / 4)] * 20
    )
    assert told[20] == ContactLimits()


def test_the_healthy_range_is_learned_from_calibration_less_the_hardest_of_twenty_and_saved(
    tmp_path, lift
):
    spec = lift.unwrapped.stream_spec
    streams = [np.zeros((5, spec.size), np.float32) for _ in range(40)]
    torque, force = spec.slices["external_torque_peak"], spec.slices["wrist_force_peak"]
    for n, stream in enumerate(streams):
        stream[2, torque.start + 1] = -(45.0 + 0.1 * n)
        stream[3, force.start] = 10.0
    streams[7][3, force.start + 2] = 600.0  # a knock
    healthy = healthy_forces(streams, spec)
    assert healthy[1] == pytest.approx(45.0 + 0.1 * 37, abs=0.11)
    assert healthy[7:] == (10.0, 0.0, 0.0)
    for stream in streams:
        stream[3, force.start + 2] = 600.0
    assert healthy_forces(streams, spec)[9] == 200.0
    assert healthy_forces(streams, StreamSpec((Channel("position", spec.size, "m"),), 0.05)) == ()


def test_a_memory_knows_what_its_calibration_felt_like_and_a_guard_takes_it(tmp_path):
    monitor = make_monitor("kalman", gym.make("asm_gym/Lift-v0").unwrapped.stream_spec)
    episodes = collect("asm_gym/Lift-v0", policy="hold", episodes=4, horizon=10)
    monitor.fit(episodes[:2]).calibrate(episodes[2:], 0.5)
    peaks = np.concatenate([e.stream[:, e.spec.slices["wrist_force_peak"]] for e in episodes[2:]])
    np.testing.assert_allclose(monitor.healthy_[7:], np.abs(peaks).max(axis=0), rtol=1e-6)
    monitor.save(tmp_path / "limit.asm")
    loaded = load_monitor(tmp_path / "limit.asm")
    assert loaded.healthy_ == monitor.healthy_
    np.testing.assert_equal(loaded.pace_, monitor.pace_)
    facts = RobotFacts.unknown(monitor.spec)
    assert limits_of("memory", loaded, facts).pace is not None
    assert limits_of("memory", NeuralASM.pretrained("panda"), facts).hand_speed == 0.15


def test_a_guard_takes_the_limits_of_its_arm(lift, monkeypatch):
    gentle = replace(robot_named("Panda"), contact_limits=ContactLimits(wrist_force=30.0))
    monkeypatch.setitem(ROBOTS, "Panda", gentle)
    env = NeuralASMSafety(lift, NeuralASM.pretrained("panda"))
    env.reset(seed=0)
    assert env.unwrapped.contact_limits.wrist_force == 30.0


@pytest.mark.parametrize("controller", ["OSC_POSE", "OSC_POSITION", "JOINT_POSITION", "IK_POSE"])
@pytest.mark.parametrize("turns", [False, True])
def test_no_part_of_a_hand_goes_faster_than_its_limit_under_any_controller(controller, turns):
    env, rng, speeds = (
        gym.make("asm_gym/Lift-v0", controller=controller),
        np.random.default_rng(0),
        [],
    )
    env.reset(seed=0)
    arm = env.unwrapped
    arm.contact_limits = ContactLimits(1e3, 1e3, hand_speed=0.15)
    arm.substep_hooks.append(lambda k: speeds.append(hand_speed(present_twist(arm.simulation, 0))))
    for step in range(12):
        if step % 4 == 0:
            action = rng.choice([-1.0, 1.0], env.action_space.shape).astype(np.float32)
            action[: 3 * (turns and controller.endswith("POSE"))] = 0.0
        env.step(action)
    env.close()
    # that one pulls between substeps
    assert 0.1 < max(speeds) < (0.3 if controller == "IK_POSE" else 0.2)


def test_an_arm_that_is_stretched_out_has_no_more_momentum_than_it_may(lift, surrounded):
    def most(pace):
        """The greatest momentum of a hand that is driven forwards for three seconds [N s]."""
        lift.reset(seed=0)
        simulation = lift.unwrapped.simulation
        lift.unwrapped.contact_limits = ContactLimits(1e3, 1e3, pace=pace)
        found = []
        for _ in range(60):
            lift.step(np.float32([1, 0, -0.3, 0, 0, 0, 0]))
            found.append(hand_momentum(simulation, 0, present_twist(simulation, 0)))
        return max(found)

    momentum = 2.0
    elsewhere = HandSpeedMap(np.array([[0, 20, 20, 20, *[0.1] * 12]]), momentum)
    assert most(elsewhere) < 1.2 * momentum < most(None) / 1.5


def test_a_hand_beside_its_own_mount_goes_half_as_fast_and_meets_it_gently():
    env = gym.make("asm_gym/Lift-v0", robot="Sawyer", horizon=150)
    env.reset(seed=0)
    arm, found = env.unwrapped, []
    arm.contact_limits = ContactLimits()

    def feel(_):
        simulation = arm.simulation
        hand, base = (
            simulation.views.site_xpos[simulation.arms.site[0]],
            np.array([-0.56, 0.0, 0.912]),
        )
        speed = hand_speed(present_twist(simulation, 0))
        found.append((np.hypot(*(hand - base)[:2]), speed, simulation.contact_forces[-1]))

    arm.substep_hooks.append(feel)
    for _ in range(150):
        env.step(np.float32([-1, 0, -0.3, 0, 0, 0, 0]))  # towards itself
    env.close()
    distance, speed, force = np.array(found).T
    assert speed[distance > BESIDE_BASE + 0.05].max() > 0.12
    assert speed[distance < BESIDE_BASE - 0.05].max() < 0.1
    assert 20.0 < force.max() < 280.0


def test_what_is_fixed_to_the_world_belongs_to_it(lift):
    lift.reset(seed=0)
    arm = lift.unwrapped
    arm.simulation.data.qpos[:7] = FOLDED
    *_, info = lift.step(np.zeros(7, np.float32))
    assert info["contact_force"] > 100.0


def hands(*twists, place=(0.1, 0.2, 0.91)):
    """A spec of one hand, and a stream in which it has these twists at one place."""
    spec = StreamSpec(
        tuple(Channel(f"hand_{n}", 3, "m") for n in ("position", "velocity", "angular_velocity")),
        0.05,
    )
    return spec, np.array([[*place, *twist] for twist in twists], np.float32)


def test_pace_is_that_of_healthy_hands_by_place_and_direction_and_else_the_usual_one(tmp_path):
    spec, stream = hands([0.4, 0.0, -0.1, 0, 0, 1.0], [0.0, 0.0, -0.3, 0, 0, 0])
    limits, here = (
        ContactLimits(pace=HandSpeedMap(HandSpeedMap.learned([stream], spec))),
        np.array([0.1, 0.2, 0.91]),
    )

    def most(*twist, place=here, soon=1.0, momentum=0.0):
        speed = float(np.linalg.norm(twist[:3]) + 0.15 * np.linalg.norm(twist[3:]))
        return limits.share(0, place, np.array(twist, float), speed, soon, momentum)

    assert most(0.4, 0, 0, 0, 0, 1.0) >= 1.0  # as healthy hands did
    assert most(-0.4, 0, 0, 0, 0, 0) == pytest.approx(0.15 / 0.4)  # another direction
    assert most(0.4, 0, 0, 0, 0, 0, place=here + 0.3) == pytest.approx(0.15 / 0.4)  # another place
    assert most(0, 0, -0.3, 0, 0, 0) == pytest.approx(0.15 / 0.3)  # downwards no faster than usual
    # where nothing is near, up to twice the usual speed
    for soon, speed in ((0.8, 0.15 / 0.8), (0.1, 0.3), (0.0, 0.3)):
        free = most(0, 0, -0.6, 0, 0, 0, place=here - 0.1, soon=soon)
        assert free == pytest.approx(speed / 0.6)
    # what is behind it counts, less where a healthy hand went
    there = most(0, 0, -0.3, 0, 0, 0, momentum=9.0)
    elsewhere = most(0, 0, -0.3, 0, 0, 0, place=here - 0.1, momentum=9.0)
    assert elsewhere < there < 0.4
    assert ContactLimits().share(0, here, np.array([0.3, 0, 0, 0, 0, 0]), 0.3) == 0.5
    assert HandSpeedMap.learned([stream], StreamSpec((Channel("position", 9, "m"),), 0.05)) is None
    for bad in (
        np.zeros((0, 16)),
        np.full((1, 16), np.nan),
        np.full((1, 16), 1e9),
        np.zeros((1, 15)),
    ):
        with pytest.raises(ValueError, match="pace must be rows"):
            HandSpeedMap(bad)


def test_a_task_with_enough_healthy_episodes_has_a_pace_of_its_own(tmp_path):
    def episodes(task, count, velocity):
        spec, stream = hands([velocity, 0, 0, 0, 0, 0], [0] * 6)
        label = EpisodeLabel(task, "nominal")
        return [Episode.from_stream(stream, spec, label=label) for _ in range(count)]

    every = [*episodes("Lift", 40, 0.2), *episodes("Stack", 40, 0.4), *episodes("Door", 3, 0.6)]
    known, here = HandSpeedMap.by_task(every, every[0].spec), np.array([0.1, 0.2, 0.91])
    maps = {task: HandSpeedMap.of(known, task) for task in ("Lift", "Stack", "Door", "Wipe")}
    fastest = {task: float(own.fastest_near(0, here)[0, 0]) for task, own in maps.items()}
    assert fastest == pytest.approx({"Lift": 0.2, "Stack": 0.4, "Door": 0.6, "Wipe": 0.6})
    assert HandSpeedMap.of({}, "Lift") is None
