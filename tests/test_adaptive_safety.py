"""The running threshold in the wrappers: what they tell it, what they report, and a policy that really changes."""

from __future__ import annotations

import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from asm_gym.detection import AdaptiveThreshold
from asm_gym.monitors import Surprise, make_monitor
from asm_gym.wrappers import NeuralASMSafety, StreamRecorder, VectorNeuralASMSafety
from tests.fakes import CueMonitor, FakeEnv

HOW = AdaptiveThreshold(rate=0.1, step=0.5, ceiling=20.0)


class ScriptedMonitor(CueMonitor):
    """Says ``values`` of the steps of an episode; the threshold is 1."""

    def __init__(self, values):
        super().__init__()
        self.values = values

    def observe(self, state, stream):
        value = np.full(len(stream), self.values.get(state, 0.5))
        return state + 1, Surprise(value, np.zeros((len(stream), self.spec.size)))


def episode(env, steps=20):
    _, info = env.reset()
    for _ in range(steps):
        *_, info = env.step(np.zeros(3, np.float32))
    return info["asm"]


def test_a_false_alarm_raises_the_threshold_of_the_next_episode_and_not_of_its_own():
    env = NeuralASMSafety(FakeEnv(), ScriptedMonitor({5: 2.0}), on_alarm="monitor", adaptive_threshold=HOW)
    first, second = episode(env), episode(env)
    assert first["threshold"] == 1.0
    assert np.isnan(first["level"])
    assert first["ceiling"] == 20.0
    assert second["threshold"] == pytest.approx(np.exp(0.45))
    assert second["level"] == 1.0
    assert env.threshold == second["threshold"]


def test_without_adapt_nothing_moves_and_nothing_is_added():
    env = NeuralASMSafety(FakeEnv(), ScriptedMonitor({5: 2.0}), on_alarm="monitor")
    assert episode(env)["threshold"] == episode(env)["threshold"] == 1.0
    assert not {"level", "ceiling"} & episode(env).keys()


def test_what_goes_on_while_the_reflex_acts_is_no_drift():
    passing, lasting = {5: 2.0}, dict.fromkeys(range(5, 20), 2.0)
    for values, moved in ((passing, True), (lasting, False)):
        env = NeuralASMSafety(FakeEnv(), ScriptedMonitor(values), release_after=3, adaptive_threshold=HOW)
        episode(env)
        assert (episode(env)["threshold"] > 1.0) is moved


def test_surprise_of_the_reflex_itself_is_not_the_policys():
    env = NeuralASMSafety(FakeEnv(), ScriptedMonitor({5: 2.0, 6: 1000.0}), release_after=3, adaptive_threshold=HOW)
    episode(env)
    assert episode(env)["threshold"] == pytest.approx(np.exp(0.45))  # by the 2; 1000 is above the ceiling


def test_a_confirmed_alarm_and_one_above_the_ceiling_teach_nothing():
    env = NeuralASMSafety(FakeEnv(), ScriptedMonitor({5: 2.0}), on_alarm="monitor", adaptive_threshold=HOW)
    episode(env)
    env.confirm_alarm()
    assert episode(env)["threshold"] == 1.0
    assert episode(env)["threshold"] > 1.0  # the confirmation was of one episode
    env = NeuralASMSafety(FakeEnv(), ScriptedMonitor({5: 20.5}), on_alarm="monitor", adaptive_threshold=HOW)
    for _ in range(5):
        last = episode(env)
    assert last["threshold"] == 1.0


def test_many_environments_share_a_threshold_and_keep_it_to_the_end_of_their_episodes():
    class Monitor(ScriptedMonitor):
        def initial_state(self, batch=1):
            return np.zeros(batch, np.int64)

        def observe(self, state, stream):
            value = np.array([self.values.get(int(s), 0.5) for s in state])
            return state + 1, Surprise(value, np.zeros((len(stream), self.spec.size)))

    lengths = (6, 10)
    made = SyncVectorEnv([lambda n=n: FakeEnv(n) for n in lengths], autoreset_mode=AutoresetMode.NEXT_STEP)
    env = VectorNeuralASMSafety(made, Monitor({3: 2.0}), on_alarm="monitor", adaptive_threshold=HOW)
    env.reset()
    thresholds = []
    for _ in range(24):
        *_, infos = env.step(np.zeros((2, 3), np.float32))
        thresholds.append(infos["asm"]["threshold"])
    thresholds = np.array(thresholds)
    np.testing.assert_allclose(thresholds[0], [1.0, 1.0])
    once = np.exp(0.45)
    np.testing.assert_allclose(thresholds[7], [once, 1.0])  # the first has begun anew, the second is under way
    np.testing.assert_allclose(thresholds[12], [once, once**2])
    assert infos["asm"]["level"].shape == infos["asm"]["ceiling"].shape == (2,)
    np.testing.assert_allclose(env.threshold, thresholds[-1])


class Swing:
    """Drives the pendulum's energy up and catches it above; ``gain`` is how hard."""

    def __init__(self, gain):
        self.gain = gain

    def __call__(self, observation):
        cosine, sine, speed = observation
        if cosine > 0.9:
            return np.array([-16.0 * np.arctan2(sine, cosine) - 4.0 * speed]).clip(-2, 2)
        return np.array([self.gain * np.sign(speed or 1.0)])


def play(env, policy, seed):
    observation, info = env.reset(seed=seed)
    surprises, ended = [], False
    while not ended:
        observation, _, terminated, truncated, info = env.step(policy(observation).astype(np.float32))
        ended = terminated or truncated
        surprises.append(info.get("asm", {}).get("surprise", 0.0))
    return max(surprises), info


@pytest.mark.filterwarnings("ignore:.*rows under this policy alarm")
def test_a_policy_that_changes_alarms_no_more_than_was_promised_and_a_fault_still_does():
    rate, pendulum = 0.2, gym.make("Pendulum-v1", max_episode_steps=50)
    recorder, usual, rougher = StreamRecorder(pendulum), Swing(0.6), Swing(2.0)
    for seed in range(50):
        play(recorder, usual, seed)
    monitor = make_monitor("kalman+evidence", recorder.stream_spec).fit(recorder.episodes[:30])
    monitor.calibrate(recorder.episodes[30:], rate)
    alarms, how = {}, AdaptiveThreshold(rate, step=1.0, ceiling=60.0)
    for adapt, episodes in ((None, 20), (how, 90)):
        env = NeuralASMSafety(pendulum, monitor, on_alarm="monitor", adaptive_threshold=adapt, on_overrun="ignore")
        ends = [play(env, rougher, seed) for seed in range(200, 200 + episodes)]
        alarms[adapt is not None] = np.array([largest > info["asm"]["threshold"] for largest, info in ends])
    assert alarms[False].mean() > 2.5 * rate
    assert alarms[True].sum() <= rate * 90 + np.log(how.ceiling) / how.step + 1  # of 50 and more without it
    env.reset(seed=1)
    env.unwrapped.max_torque = 0.0  # the motor fails
    assert any(env.step(np.full(1, 2.0, np.float32))[-1]["asm"]["alarm"] for _ in range(20))


@pytest.mark.parametrize("on_alarm", ["monitor", "hold"])
def test_a_policy_so_strange_that_most_of_its_steps_alarm_is_named_once_with_what_to_do(on_alarm):
    strange = ScriptedMonitor(dict.fromkeys(range(0, 4000, 2), 2.0) | dict.fromkeys(range(0, 4000, 3), 2.0))
    env = NeuralASMSafety(FakeEnv(8000), strange, on_alarm=on_alarm, release_after=1, on_overrun="ignore")
    with pytest.warns(UserWarning, match=r"of the first 200 rows under this policy alarm: .* warm_start=True") as said:
        episode(env, 4000)
    assert len(said) == 1


def test_a_fault_that_passes_makes_no_policy_strange():
    passing = ScriptedMonitor(dict.fromkeys(range(20, 110), 2.0))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        episode(NeuralASMSafety(FakeEnv(400), passing, on_alarm="monitor", on_overrun="ignore"), 300)
