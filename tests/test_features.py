"""Features as senses: they stand in the stream, are recorded and guarded, and are refused where they do not fit."""

import numpy as np
import pytest

from asm_gym.monitors import make_monitor
from asm_gym.spec import Channel
from asm_gym.wrappers import NeuralASMSafety, StreamFeatures, StreamRecorder
from tests.fakes import SPEC, FakeEnv

TWICE = Channel("twice", 2, group="camera")


def seen(env, features=lambda observation, info: 2 * observation):
    return StreamFeatures(env, TWICE, features)


@pytest.mark.parametrize("own", [True, False])
def test_what_is_made_of_each_step_stands_behind_the_row(own):
    recorder = StreamRecorder(seen(FakeEnv(5, own)))
    recorder.reset(seed=0)
    for _ in range(5):
        recorder.step(np.zeros(3, np.float32))
    (episode,) = recorder.episodes
    assert episode.spec.labels[-2:] == ("twice[0]", "twice[1]")
    np.testing.assert_array_equal(episode.stream[:, -1], [2, 4, 6, 8, 10])
    assert episode.stream.shape == (5, episode.spec.size)
    if own:
        assert episode.spec.channels[:-1] == SPEC.channels


def test_a_guard_watches_them_and_what_is_not_finite_is_an_alarm():
    def features(observation, info):
        return np.full(2, np.nan if observation[0] == 12 else np.sin(observation[0]))

    recorder = StreamRecorder(seen(FakeEnv(10), features))
    for seed in range(24):
        recorder.reset(seed=seed)
        for _ in range(10):
            recorder.step(np.zeros(3, np.float32))
    monitor = make_monitor("window_pca", recorder.stream_spec)
    monitor.fit(recorder.episodes[:4]).calibrate(recorder.episodes[4:], false_alarm_rate=0.05)
    env = NeuralASMSafety(seen(FakeEnv(20), features), monitor, on_alarm="monitor", on_overrun="ignore")
    env.reset(seed=0)
    alarms = [env.step(np.zeros(3, np.float32))[-1]["asm"]["alarm"] for _ in range(12)]
    assert alarms[-1]


def test_a_wrong_number_of_them_or_a_name_that_is_taken_is_refused():
    with pytest.raises(ValueError, match="twice has 2 numbers, got 3"):
        seen(FakeEnv(), lambda observation, info: np.zeros(3)).reset()
    with pytest.raises(ValueError, match="unique"):
        StreamFeatures(FakeEnv(), SPEC.channels[0], lambda observation, info: 0)
