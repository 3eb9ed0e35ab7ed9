"""The control period is measured by the simulator's clock, and wrappers that repeat actions count."""

from dataclasses import replace
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv
from gymnasium.wrappers import MaxAndSkipObservation

from asm_gym import StreamRecorder
from asm_gym.control_period import PeriodWarning, control_period
from asm_gym.monitors import NeuralASM
from asm_gym.spec import StreamSpec
from asm_gym.wrappers import NeuralASMSafety, VectorNeuralASMSafety
from tests.fakes import CueMonitor, FadingMonitor

ACTION = np.zeros(1, np.float32)


class Simulated(gym.Env):
    """A body whose simulator keeps time like MuJoCo's."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 50}  # noqa: RUF012
    observation_space = gym.spaces.Box(-10.0, 10.0, (1,), np.float32)
    action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)
    action_means = "delta"
    advance = 0.05  # [s]

    def __init__(self):
        self.simulator = SimpleNamespace(time=0.0)
        self.data = self.simulator

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.simulator.time = 0.0
        return self.observe(), {}

    def step(self, action):
        self.simulator.time += self.advance
        return self.observe(), 0.0, False, False, {}

    def observe(self):
        drawn = self.np_random.uniform() + np.random.uniform()  # noqa: NPY002 (as many do)
        return np.full(1, drawn, np.float32)


class Uncopied(Simulated):
    """One that says its period, and cannot be copied."""

    dt = 0.05

    def __deepcopy__(self, memo):
        raise TypeError("a window is open")


class OwnClock(gym.Env):
    """Keeps time itself."""

    observation_space = Simulated.observation_space
    action_space = Simulated.action_space
    time = 0.0
    advance = 0.05  # [s]

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.time = 0.0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.time += self.advance
        return np.zeros(1, np.float32), 0.0, False, False, {}


class Kitchen(Simulated):
    """Has its simulator in a robot, as those of Gymnasium-Robotics; its videos are faster."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 12}  # noqa: RUF012
    advance = 0.08

    def __init__(self):
        super().__init__()
        self.robot_env = SimpleNamespace(data=self.data, frame_skip=40)
        del self.data


class FourTimes(gym.Wrapper):
    """Repeats actions, and does not say so."""

    def step(self, action):
        for _ in range(4):
            outcome = self.env.step(action)
        return outcome


class Forwarding(gym.Wrapper):
    """Answers for the environment inside."""

    def __getattr__(self, name):
        return getattr(self.env, name)


def spec_of(dt):
    return StreamSpec.from_spaces(Simulated.observation_space, Simulated.action_space, dt)


@pytest.mark.parametrize(
    ("make", "dt"),
    [
        (lambda: gym.make("Pendulum-v1"), 0.05),
        (lambda: MaxAndSkipObservation(gym.make("Pendulum-v1"), 4), 0.2),
        (lambda: MaxAndSkipObservation(OwnClock(), 4), 0.2),
        (Simulated, 0.05),
        (lambda: MaxAndSkipObservation(Simulated(), 4), 0.2),
        (lambda: FourTimes(Simulated()), 0.2),
        (lambda: FourTimes(MaxAndSkipObservation(Simulated(), 2)), 0.4),
        (Kitchen, 0.08),
        (lambda: gym.make("Pusher-v5"), 0.05),
        (lambda: FourTimes(gym.make("Pusher-v5")), 0.2),
        (lambda: Forwarding(gym.make("Pusher-v5", render_mode="rgb_array")), 0.05),
    ],
)
def test_the_period_of_a_stream_is_the_simulated_time_of_an_outer_step(make, dt):
    assert StreamRecorder(make()).stream_spec.dt == pytest.approx(dt, rel=1e-6)


@pytest.mark.parametrize("make", [Simulated, lambda: gym.make("Pusher-v5")])
def test_measuring_leaves_the_environment_and_all_random_numbers_as_they_were(make):
    def course(wrap):
        np.random.seed(7)  # noqa: NPY002
        env = wrap(FourTimes(make()))
        still = np.zeros(env.action_space.shape, np.float32)
        first = env.reset(seed=0)[0]
        observations = first, env.step(still)[0], env.step(still)[0]
        return np.array(observations), env.unwrapped.data.time

    for mine, plain in zip(course(StreamRecorder), course(lambda env: env), strict=True):
        np.testing.assert_array_equal(mine, plain)


def test_an_environment_that_renders_or_has_a_stream_is_never_stepped():
    rendered = Simulated()
    rendered.render_mode = "rgb_array"
    rendered.__class__ = type("Rendered", (Simulated,), {"__deepcopy__": pytest.fail})
    with pytest.warns(PeriodWarning, match="render_fps"):
        assert control_period(rendered) == pytest.approx(0.02)
    streaming = type("Streaming", (Simulated,), {"__deepcopy__": pytest.fail})()
    streaming.stream_spec = spec_of(0.05)
    assert control_period(streaming) == pytest.approx(0.05)
    assert control_period(MaxAndSkipObservation(streaming, 4)) == pytest.approx(0.2)


def test_a_recorder_that_could_not_measure_corrects_the_period_before_it_keeps_an_episode():
    env = StreamRecorder(FourTimes(Uncopied()))
    assert env.stream_spec.dt == pytest.approx(0.05)
    env.reset(seed=0)
    with pytest.warns(PeriodWarning, match=r"0\.2 s and not 0\.05 s"):
        env.step(ACTION)
    env.step(ACTION)  # without another warning
    assert env.finish().spec.dt == pytest.approx(0.2)


@pytest.mark.parametrize("advance", [1.0, 0.0513])
def test_a_clock_that_counts_steps_or_shows_the_time_of_day_does_not_correct_a_declared_period(
    advance,
):
    bare = OwnClock()
    bare.dt = 0.05
    bare.advance = advance
    env = StreamRecorder(bare)
    env.reset(seed=0)
    env.step(ACTION)
    assert env.finish().spec.dt == pytest.approx(0.05)


def test_a_memory_of_another_period_is_refused_at_construction_and_both_are_named():
    env = FourTimes(Simulated())
    with pytest.raises(ValueError, match=r"0\.05 s against 0\.2 s(.|\n)*repeats actions"):
        NeuralASMSafety(env, CueMonitor(spec=spec_of(0.05)), "monitor")
    guarded = NeuralASMSafety(env, CueMonitor(spec=spec_of(0.2)), "monitor")
    guarded.reset(seed=0)
    assert not guarded.step(ACTION)[4]["asm_alarm"]


def test_a_memory_of_another_period_is_refused_in_the_first_step_where_nothing_could_be_measured():
    env = NeuralASMSafety(FourTimes(Uncopied()), CueMonitor(spec=spec_of(0.05)), "monitor")
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"0\.05 s against 0\.2 s(.|\n)*repeats actions"):
        env.step(ACTION)
    with pytest.raises(ValueError, match=r"0\.05 s against 0\.2 s"):
        env.reset(seed=0)
    env.monitor = CueMonitor(spec=spec_of(0.2))
    env.reset(seed=0)
    env.step(ACTION)


@pytest.mark.parametrize("many", [SyncVectorEnv, AsyncVectorEnv])
def test_a_vector_is_measured_by_a_member(many):
    envs = many([lambda: FourTimes(Simulated())] * 2)
    with pytest.raises(ValueError, match=r"0\.05 s against 0\.2 s"):
        VectorNeuralASMSafety(envs, FadingMonitor(spec=spec_of(0.05)), "monitor")
    guarded = VectorNeuralASMSafety(envs, FadingMonitor(spec=spec_of(0.2)), "monitor")
    guarded.reset(seed=0)
    guarded.step(np.zeros((2, 1), np.float32))
    guarded.close()


def test_a_vector_is_checked_in_its_first_step():
    envs = SyncVectorEnv([lambda: FourTimes(Uncopied())] * 2)
    guarded = VectorNeuralASMSafety(envs, FadingMonitor(spec=spec_of(0.05)), "monitor")
    guarded.reset(seed=0)
    with pytest.raises(ValueError, match=r"0\.05 s against 0\.2 s"):
        guarded.step(np.zeros((2, 1), np.float32))


def test_a_shipped_memory_does_not_watch_an_arm_whose_actions_are_repeated(lift):
    memory = NeuralASM.pretrained("panda")
    with pytest.raises(ValueError, match=r"0\.05 s against 0\.2 s"):
        NeuralASMSafety(MaxAndSkipObservation(lift, 4), memory)
    with pytest.raises(ValueError, match=r"0\.05 s against 0\.2 s"):
        NeuralASMSafety(MaxAndSkipObservation(lift, 4))
    env = NeuralASMSafety(FourTimes(lift), memory)
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"0\.05 s against 0\.2 s"):
        env.step(np.zeros(7, np.float32))
    recorder = StreamRecorder(MaxAndSkipObservation(lift, 4))
    assert recorder.stream_spec == replace(lift.unwrapped.stream_spec, dt=0.2)


def test_a_stream_that_is_faster_than_control_is_not_read_through_repeated_steps():
    fast = gym.make("asm_gym/Lift-v0", stream_freq=100)
    with pytest.raises(ValueError, match="5 rows"):
        StreamRecorder(MaxAndSkipObservation(fast, 4))
    assert StreamRecorder(fast).stream_spec.dt == pytest.approx(0.01)
    fast.close()
