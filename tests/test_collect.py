"""Episodes of any policy in any environment with Box spaces: the same ones, whoever records them."""

import resource
import sys
import threading
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import SAC

from asm_gym.rollouts import collect
from asm_gym.rollouts.collect import record_episode
from asm_gym.rollouts.seeds import episode_seeds
from asm_gym.rollouts.staging import Latest
from asm_gym.rollouts.trial import RolloutConfig
from asm_gym.tasks import env_spec
from tests.fakes import FakeEnv

PENDULUM = "Pendulum-v1"


class Damp:
    """Torque against the velocity; keeps nothing. The class is a factory, too."""

    def __init__(self, env=None):
        pass

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        return np.array([-2.0 * observation[2]], np.float32).clip(-2, 2), state


def streams(**how):
    return [e.stream for e in collect(PENDULUM, episodes=3, seed=4, **how)]


def test_an_object_and_a_factory_give_the_same_episodes_with_any_number_of_workers():
    expected = streams(policy=Damp(), workers=1)
    assert expected[0].shape == (200, 3 + 1)  # where info has no stream, observation and action are it
    for policy in (Damp(), Damp, lambda env: Damp()):
        for workers in (1, 2):
            for a, b in zip(expected, streams(policy=policy, workers=workers), strict=True):
                np.testing.assert_array_equal(a, b)


def test_an_agent_that_draws_is_seeded_anew_for_every_episode():
    agent = SAC("MlpPolicy", PENDULUM, seed=0, buffer_size=10)
    agent.env = None
    one, two = streams(policy=agent, workers=1), streams(policy=agent, workers=2)
    for a, b in zip(one, two, strict=True):
        np.testing.assert_array_equal(a, b)
    assert not np.array_equal(one[0], one[1])


def test_a_policy_that_cannot_be_sent_is_refused_with_a_way_out():
    policy = Damp()
    policy.lock = threading.Lock()
    with pytest.raises(TypeError, match=r"cannot be sent.*factory"):
        streams(policy=policy, workers=2)


def test_a_name_that_this_environment_has_no_policy_for_is_refused():
    with pytest.raises(ValueError, match="no scripted expert"):
        streams(workers=1)


def test_an_environment_that_only_this_process_registered_is_known_to_the_workers():
    gym.register("tests/Fake-v0", entry_point=lambda **kwargs: FakeEnv(length=4, own_stream=False))
    try:
        episodes = collect("tests/Fake-v0", policy="hold", episodes=2, workers=2)
    finally:
        del gym.registry["tests/Fake-v0"]
    assert [len(e) for e in episodes] == [4, 4]


def test_arguments_of_the_environment_may_be_lists_and_dictionaries():
    made, sizes, lengths = [], {"length": [3]}, []

    def make(sizes, **kwargs):
        made.append(FakeEnv(length=sizes["length"][0]))
        return made[-1]

    gym.register("tests/Any-v0", entry_point=make)
    try:
        for sizes["length"][0] in (3, 3, 5):  # the caller's own list changes
            episodes = collect("tests/Any-v0", policy="hold", episodes=2, workers=1, sizes=sizes)
            lengths.append([len(e) for e in episodes])
    finally:
        del gym.registry["tests/Any-v0"]
    assert lengths == [[3, 3], [3, 3], [5, 5]]
    assert len(made) == 2  # one environment for what equals what it was made of


def test_what_was_made_of_an_array_is_made_again():
    latest, made = Latest(), []
    for scale in (np.ones(2), np.ones(2)):  # whose equality is not one answer
        latest(("id", (("scale", scale),)), lambda: made.append(1) or len(made))
    assert len(made) == 2


class Lean:
    """Left or right, whichever way the pole falls."""

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        return int(observation[2] > 0), state


def test_discrete_actions_are_a_number_for_each():
    (episode,) = collect("CartPole-v1", policy=Lean(), episodes=1, workers=1)
    assert episode.stream.shape[1] == 4 + 2
    np.testing.assert_array_equal(episode.stream[:, 4:].sum(axis=1), 1)
    np.testing.assert_array_equal(episode.stream[1:, 5] > 0, episode.stream[:-1, 2] > 0)


@pytest.mark.slow  # 80 resets of robosuite
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="looks into /proc")
def test_a_process_that_records_for_long_does_not_grow():
    """It once grew by 4 MB an episode."""
    spec, config, sizes = env_spec("asm_gym/Lift-v0"), RolloutConfig(env_kwargs=(("horizon", 5),)), []
    for seed in episode_seeds(0, 80):
        record_episode(seed, spec, config)
        sizes.append(int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() / 1e6)
    assert sizes[-1] - sizes[19] < 60.0
