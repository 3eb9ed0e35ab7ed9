"""What was done is told: slowed actions, ends of episodes for wrappers that count them, missing numbers."""

from __future__ import annotations

import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import ClipAction, RecordEpisodeStatistics
from gymnasium.wrappers.vector import RecordEpisodeStatistics as CountMany

from asm_gym.detection.contact_limits import ContactLimits
from asm_gym.spec import flat
from asm_gym.wrappers import NeuralASMSafety, StreamRecorder, VectorNeuralASMSafety
from tests.fakes import CueMonitor, FadingMonitor, FakeEnv
from tests.needs import needs

LIMITS = ContactLimits(wrist_force=1e3, external_torque=1e3, hand_speed=0.1)
STEPS = 30


def lift(limits=LIMITS, **more):
    env = gym.make("asm_gym/Lift-v0")
    return NeuralASMSafety(
        env, CueMonitor(spec=env.unwrapped.stream_spec), "hold", contact_limits=limits, **more
    )


def joints(env):
    return env.unwrapped.simulation.data.qpos.copy()


@pytest.mark.parametrize("scale", [0.05, 1.0])
def test_the_action_that_is_told_moves_the_bare_environment_in_the_same_way(scale):
    guarded, bare = lift(), gym.make("asm_gym/Lift-v0")
    guarded.reset(seed=0)
    bare.reset(seed=0)
    slowed = []
    for _ in range(STEPS if scale < 1 else 6):  # then the arm is braked as well
        asked = np.float32(scale * np.array([0.6, -0.4, -1.0, 0.1, -0.2, 0.3, 0.5]))
        asm = guarded.step(asked)[4]["asm"]
        bare.step(asm["executed_action"])
        np.testing.assert_array_equal(joints(guarded), joints(bare))
        slowed.append(asm["slowed"])
        if not asm["slowed"]:
            np.testing.assert_array_equal(asm["executed_action"], asked)
        else:
            part = asm["executed_action"][:6] / asked[:6]
            np.testing.assert_allclose(1 - part, asm["slowed"], atol=1e-5)
            assert not asm["intervened"]
    assert np.mean(np.array(slowed) > 0) == (0.0 if scale < 1 else 1.0)
    guarded.close()
    bare.close()


@pytest.mark.parametrize("controller", ["OSC_POSE", "OSC_POSITION", "JOINT_POSITION"])
@pytest.mark.parametrize("stream_freq", [20, 100])
def test_under_every_controller_that_scales_actions_the_one_that_is_told_moves_the_bare_environment(
    controller, stream_freq
):
    how = {"controller": controller, "stream_freq": stream_freq}
    env, bare = gym.make("asm_gym/Lift-v0", **how), gym.make("asm_gym/Lift-v0", **how)
    guarded = NeuralASMSafety(
        env, CueMonitor(spec=env.unwrapped.stream_spec), "hold", contact_limits=LIMITS
    )
    guarded.reset(seed=0)
    bare.reset(seed=0)
    acted, braked = set(), []
    for k in (0, 1, 3) if controller == "JOINT_POSITION" else (0, 1, 2):
        action = np.zeros(guarded.action_space.shape, np.float32)
        action[k] = -1.0
        for _ in range(3):
            info = guarded.step(action)[4]
            bare.step(info["asm"]["executed_action"])
            if not any(braked) and not info["braked"]:
                acted.add(info["asm"]["slowed"] > 0)
                np.testing.assert_array_equal(joints(guarded), joints(bare))
            braked.append(info["braked"])
    assert True in acted
    assert all(0 <= share <= 1 for share in braked)
    guarded.close()
    bare.close()


@pytest.mark.parametrize(("controller", "quiet"), [("OSC_POSE", 3), ("IK_POSE", 0)])
def test_steps_in_which_the_brake_slowed_the_arm_are_told_and_no_others_differ_from_the_bare_environment(
    controller, quiet
):
    env, bare = (gym.make("asm_gym/Lift-v0", controller=controller) for _ in range(2))
    guarded = NeuralASMSafety(
        env, CueMonitor(spec=env.unwrapped.stream_spec), "hold", contact_limits=LIMITS
    )
    guarded.reset(seed=0)
    bare.reset(seed=0)
    braked = []
    for t in range(6):
        action = np.zeros(guarded.action_space.shape, np.float32)
        action[0 if t < quiet else 3] = -1.0  # the hand turns faster than it may move
        info = guarded.step(action)[4]
        bare.step(info["asm"]["executed_action"])
        braked.append(info["braked"])
        assert np.array_equal(joints(guarded), joints(bare)) == (max(braked) == 0.0)
    assert [share > 0 for share in braked] == [t >= quiet for t in range(6)]
    guarded.close()
    bare.close()


def test_where_a_wrapper_inside_changes_actions_what_was_slowed_is_unknown_and_no_zero():
    env = gym.make("asm_gym/Lift-v0")
    spec, inside = (
        env.unwrapped.stream_spec,
        gym.wrappers.RescaleAction(env, np.float32(-2), np.float32(2)),
    )
    guarded = NeuralASMSafety(inside, CueMonitor(spec=spec), "hold", contact_limits=LIMITS)
    guarded.reset(seed=0)
    assert np.isnan(guarded.step(guarded.action_space.high)[4]["asm"]["slowed"])
    outside = gym.wrappers.RescaleAction(lift(), np.float32(-2), np.float32(2))
    outside.reset(seed=0)
    assert outside.step(outside.action_space.high)[4]["asm"]["slowed"] > 0.5
    guarded.close()
    outside.close()


def test_many_environments_tell_it_as_one_does():
    envs = gym.make_vec("asm_gym/Lift-v0", num_envs=2)
    monitor = FadingMonitor(spec=envs.get_attr("stream_spec")[0])
    many = VectorNeuralASMSafety(envs, monitor, "hold", contact_limits=LIMITS)
    one = lift()
    many.reset(seed=[0, 1])
    one.reset(seed=0)
    for action in np.random.default_rng(0).uniform(-1, 1, (10, 2, 7)).astype(np.float32):
        asm, told = many.step(action)[4]["asm"], one.step(action[0])[4]["asm"]
        np.testing.assert_array_equal(asm["executed_action"][0], told["executed_action"])
        assert asm["slowed"][0] == told["slowed"]
    many.close()
    one.close()


def watched(wrapper=lambda env: env, cue=(2,), **more):
    return NeuralASMSafety(
        wrapper(FakeEnv(6)), CueMonitor(cue), **{"on_alarm": "terminate", **more}
    )


def test_stable_baselines_counts_every_episode_that_the_guard_ends_and_what_it_reports():
    util = needs("stable_baselines3.common.env_util")
    counted = {"info_keywords": ("cost", "cost_sum", "is_success")}
    envs = util.make_vec_env(watched, monitor_kwargs=counted)
    envs.reset()
    ended = [
        info["episode"]
        for _ in range(24)
        for info in envs.step(np.zeros((1, 3)))[3]
        if "episode" in info
    ]
    assert [(e["l"], e["r"], e["cost"], e["cost_sum"], e["is_success"]) for e in ended] == [
        (3, 3.0, 1.0, 1.0, False)
    ] * 8
    with pytest.raises(
        ValueError, match=r"Monitor\(NeuralASMSafety.*make_vec_env\(lambda: NeuralASMSafety"
    ):
        util.make_vec_env(
            lambda: FakeEnv(6),
            wrapper_class=NeuralASMSafety,
            wrapper_kwargs={"monitor": CueMonitor()},
        )


def test_a_counting_wrapper_that_would_not_see_ends_is_refused():
    for on_alarm in ("terminate", "hold", "graded", None):
        with pytest.raises(
            ValueError, match=r"RecordEpisodeStatistics\(NeuralASMSafety\(env, monitor\)\)"
        ):
            watched(lambda env: ClipAction(RecordEpisodeStatistics(env)), on_alarm=on_alarm)
        with pytest.raises(ValueError, match=r"RecordEpisodeStatistics\(NeuralASMSafety"):
            watched(RecordEpisodeStatistics, on_alarm=on_alarm)
    watched(lambda env: ClipAction(RecordEpisodeStatistics(env)), on_alarm="monitor")


def test_what_counts_inside_a_guard_of_many_is_refused_and_outside_it_sees_every_end():
    class Cued(FadingMonitor):
        def observe(self, state, stream):
            state, surprise = super().observe(state, stream)
            return state, surprise._replace(value=np.where(state.steps == 3, 10.0, 0.0))

    def counted():
        return RecordEpisodeStatistics(FakeEnv(6))

    for kind in (gym.vector.SyncVectorEnv, gym.vector.AsyncVectorEnv):
        for on_alarm, made in (
            ("terminate", kind([counted] * 2)),
            ("hold", CountMany(kind([FakeEnv] * 2))),
        ):
            with pytest.raises(ValueError, match=r"RecordEpisodeStatistics\(VectorNeuralASMSafety"):
                VectorNeuralASMSafety(made, Cued(), on_alarm)
            VectorNeuralASMSafety(made, Cued(), "monitor").close()
    many = CountMany(
        VectorNeuralASMSafety(gym.vector.SyncVectorEnv([FakeEnv] * 2), Cued(), "terminate")
    )
    many.reset(seed=0)
    steps = [many.step(np.zeros((2, 3), np.float32)) for _ in range(16)]
    lengths = [found[4]["episode"]["l"].tolist() for found in steps if "episode" in found[4]]
    assert sum(int((found[2] | found[3]).sum()) for found in steps) == 2 * len(lengths) == 8
    assert lengths == [[3, 3]] * 4


def test_a_guard_of_many_tells_whose_action_was_overridden():
    class Cued(FadingMonitor):
        def observe(self, state, stream):
            state, surprise = super().observe(state, stream)
            return state, surprise._replace(value=np.array([0.0, 10.0]) * (state.steps == 3))

    many = VectorNeuralASMSafety(
        gym.vector.SyncVectorEnv([FakeEnv] * 2), Cued(), "hold", release_after=2
    )
    many.reset(seed=0)
    told = np.array(
        [many.step(np.full((2, 3), 0.5, np.float32))[4]["overridden"] for _ in range(7)]
    )
    np.testing.assert_array_equal(told, np.array([[False, 3 <= t < 5] for t in range(7)]))


SPACES = {
    "whole numbers": gym.spaces.Box(-5, 5, (2,), np.int64),
    "bytes": gym.spaces.Box(0, 255, (2,), np.uint8),
    "a dict": gym.spaces.Dict(
        arm=gym.spaces.Box(-1, 1, (2,), np.float32), grip=gym.spaces.Discrete(2)
    ),
    "a tuple": gym.spaces.Tuple((gym.spaces.Discrete(3), gym.spaces.Box(-1, 1, (1,), np.float32))),
    "several choices": gym.spaces.MultiDiscrete([3, 2]),
}


def parts(action):
    return list(action.values()) if isinstance(action, dict) else list(action)


@pytest.mark.parametrize("space", SPACES)
@pytest.mark.parametrize("on_alarm", ["monitor", "terminate"])
def test_actions_of_any_space_are_recorded_watched_and_reach_the_environment_in_their_type(
    space, on_alarm
):
    class Strict(FakeEnv):
        def __init__(self):
            super().__init__(8, own_stream=False)
            self.action_space = SPACES[space]

        def step(self, action):
            assert self.action_space.contains(action)
            return *super().step(np.zeros(3))[:4], {}

    recorder = StreamRecorder(Strict())
    recorder.reset(seed=0)
    actions = [recorder.action_space.sample() for _ in range(8)]
    for action in actions:
        recorder.step(action)
    (episode,) = recorder.episodes
    np.testing.assert_array_equal(
        episode.stream[:, 2:],
        [flat(SPACES[space], action).astype(np.float32) for action in actions],
    )
    env = NeuralASMSafety(Strict(), CueMonitor((3,), recorder.stream_spec), on_alarm)
    env.reset(seed=0)
    for step, action in enumerate(actions[:4]):
        _, _, terminated, _, info = env.step(action)
        done = info["asm"]["executed_action"]
        assert all(np.array_equal(x, y) for x, y in zip(parts(done), parts(action), strict=True))
        assert terminated == (step == 3 and on_alarm == "terminate")


def test_success_is_told_by_the_name_that_learners_read():
    class Solved(FakeEnv):
        def step(self, action):
            *out, info = super().step(action)
            return *out, {**info, "success": self.t == 2}

    env = NeuralASMSafety(Solved(6), CueMonitor())
    for _ in range(2):
        env.reset(seed=0)
        told = [env.step(np.zeros(3, np.float32))[4]["is_success"] for _ in range(6)]
        assert told == [False, True, True, True, True, True]
    bare = gym.make("asm_gym/Lift-v0")
    assert bare.reset(seed=0)[1]["is_success"] is False
    bare.close()


def test_a_closed_environment_says_so():
    env = lift()
    env.reset(seed=0)
    env.close()
    env.close()
    with pytest.raises(gym.error.ClosedEnvironmentError, match="after close"):
        env.reset(seed=0)
    with pytest.raises(gym.error.ResetNeeded):
        env.step(np.zeros(7, np.float32))


@pytest.mark.filterwarnings("ignore:completion. too much is missing")
@pytest.mark.parametrize("share", [0.0, 0.7, 1.0])
def test_senses_that_repeat_bit_for_bit_are_missing_and_the_arm_is_held(share):
    env = NeuralASMSafety(gym.make("asm_gym/Lift-v0"))
    env.reset(seed=0)
    inner, kept = env.unwrapped, []

    def freeze(row):
        kept.append(row.copy())
        at = np.random.default_rng(0).permutation(len(row))[: round(share * len(row))]
        row[at] = kept[0][at]

    for t in range(30):
        if t == 10:
            inner.corruptions.append(freeze)
        info = env.step(np.float32([0.3, 0, 0.3, 0, 0, 0, 0]))[4]
        if not share or t < 11:
            assert not info["cost"]
        elif share == 1.0:
            assert info["asm"]["intervened"] == (t > 11)
        # half of all is too much
        assert t != 11 or not share or info["asm"]["reason"] in ("failure", "missing")
    assert bool(info["asm"]["state"] == "policy") == (not share)
    env.close()


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("channel", ["joint_position", "wrist_force", "joint_velocity"])
def test_a_number_that_a_sense_of_the_environment_lacks_is_missing_and_completed(channel, value):
    env = NeuralASMSafety(gym.make("asm_gym/Lift-v0"))
    env.reset(seed=0)
    inner = env.unwrapped
    place = inner.measured_spec.slices[channel].start
    reasons = []
    for t in range(20):
        if t == 5:
            inner.corruptions.append(lambda row: row.__setitem__(place, value))
        observation, _, terminated, truncated, info = env.step(np.zeros(7, np.float32))
        assert not any((terminated, truncated, info["unstable"]))
        assert np.isfinite(observation).all()
        reasons.append(info["asm"]["reason"])
        if t >= 6:
            assert info["asm"]["completed"]
            assert not info["asm"]["intervened"]
    assert reasons[:5] == [""] * 5
    assert reasons[5] == "missing"
    env.close()


@pytest.mark.parametrize("actions", [np.zeros((2, 2)), np.zeros(3), np.zeros((3, 3)), "none"])
def test_actions_of_a_wrong_shape_end_no_episode(actions):
    made = gym.vector.SyncVectorEnv([FakeEnv, FakeEnv])
    many = VectorNeuralASMSafety(made, FadingMonitor(), "hold")
    many.reset(seed=0)
    with pytest.raises((ValueError, TypeError)):
        many.step(actions)
    many.step(np.zeros((2, 3), np.float32))
    one = NeuralASMSafety(FakeEnv(), CueMonitor())
    one.reset(seed=0)
    with pytest.raises((ValueError, TypeError)):
        one.step(actions[:2] if np.shape(actions) == (3,) else actions)
    one.step(np.zeros(3, np.float32))


def test_an_action_at_the_limit_exactly_is_not_slowed_and_one_beyond_is_and_none_ends_the_episode():
    env = lift(limits=ContactLimits(hand_speed=0.1))
    env.reset(seed=0)
    kept = 1.0 - env.step(np.float32([0, 0, 1, 0, 0, 0, 0]))[4]["asm"]["slowed"]
    at = np.float32([0, 0, kept * (1 - 1e-6), 0, 0, 0, 0])
    assert env.step(at)[4]["asm"]["slowed"] == 0.0
    assert env.step(1.01 * at)[4]["asm"]["slowed"] > 0.0
    for wild in (
        np.full(7, 1e30),
        np.array([0, 0, 0, 0, 0, 0, np.inf]),
        [0, "up", 0, 0, 0, 0, 0],
        None,
    ):
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                info = env.step(wild)[4]
        except (ValueError, TypeError):
            env.step(np.zeros(7, np.float32))
        else:
            assert np.isfinite(info["asm"]["executed_action"]).all()
            assert env.action_space.contains(info["asm"]["executed_action"].astype(np.float32))
    env.close()
