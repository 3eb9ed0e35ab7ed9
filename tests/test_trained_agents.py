"""Trained agents as files: kept to the last digit, and refused where they do not fit."""

import itertools
import json
import shutil
import zipfile

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3 import PPO, SAC

from asm_gym.checkpoint import write_checkpoint
from asm_gym.policies import make_policy, rollout
from asm_gym.policies.network import NetworkPolicy
from asm_gym.policies.registry import SHIPPED, agents
from asm_gym.rollouts.seeds import episode_seeds
from tests.fakes import FakeEnv
from tests.rates import failures


class Uneven(FakeEnv):
    """Actions whose bounds differ."""

    def __init__(self):
        super().__init__()
        self.action_space = spaces.Box(
            np.array([-1, 0, -3], np.float32), np.array([1, 5, -1], np.float32)
        )


@pytest.mark.parametrize("algorithm", [SAC, PPO])
def test_an_archive_of_stable_baselines3_acts_as_the_agent_that_was_saved(algorithm, tmp_path):
    env = Uneven()
    model = algorithm("MlpPolicy", env, seed=1)
    model.save(tmp_path / "agent.zip")
    agent = make_policy(f"{algorithm.__name__}:{tmp_path / 'agent.zip'}", env)
    observation = np.array([0.3, -0.2], np.float32)
    expected, found = (m.predict(observation, deterministic=True)[0] for m in (model, agent))
    np.testing.assert_array_equal(found, expected)


def test_an_agent_with_more_than_its_layers_is_refused(tmp_path):
    arrays = {
        "W0": np.zeros((3, 2)),
        "b0": np.zeros(3),
        "mean": np.zeros(2),
        "scale": np.ones(2),
        "more": np.zeros(1),
    }
    write_checkpoint(
        tmp_path / "a.npz",
        "agent",
        {"activation": "relu", "squash": "tanh", "trained_in": {}},
        arrays,
    )
    with pytest.raises(ValueError, match=r"a\.npz is damaged: an agent has no more"):
        NetworkPolicy.load(tmp_path / "a.npz")


def test_an_agent_that_does_not_fit_is_refused_before_it_acts(tmp_path, lift):
    PPO("MlpPolicy", FakeEnv()).save(tmp_path / "fake.zip")
    with pytest.raises(ValueError, match="spaces do not match"):
        make_policy(f"PPO:{tmp_path / 'fake.zip'}", lift)
    with pytest.raises(FileNotFoundError, match="none"):
        make_policy(f"SAC:{tmp_path / 'none.zip'}", lift)
    with pytest.raises(ValueError, match="algorithm"):
        make_policy(str(tmp_path / "fake.zip"), lift)
    layers = [(np.zeros((7, 37), np.float32), np.zeros(7, np.float32))]
    path = tmp_path / "agent.npz"
    NetworkPolicy(layers, trained_in={"env": "asm_gym/Door-v0"}).save(path)
    with pytest.raises(ValueError, match=r"env: asm_gym/Door-v0 there, asm_gym/Lift-v0 here"):
        make_policy(str(path), lift)
    NetworkPolicy(layers, trained_in={"robots": ["Sawyer"], "other": 1}).save(path)
    with pytest.raises(ValueError, match=r"\['Sawyer'\] there, \['Panda'\] here"):
        make_policy(str(path), lift)
    NetworkPolicy([(np.zeros((6, 37)), np.zeros(6))]).save(path)
    with pytest.raises(ValueError, match="actions of 6 numbers"):
        make_policy(str(path), lift)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match=r"agent\.npz is damaged"):
        make_policy(str(path), lift)
    shutil.copy(SHIPPED / "README.md", path)
    with pytest.raises(ValueError, match="not a checkpoint"):
        make_policy(str(path), lift)


def test_an_agent_is_the_same_after_saving(tmp_path):
    rng = np.random.default_rng(0)
    sizes = (4, 6, 3)
    layers = [(rng.normal(size=(o, i)), rng.normal(size=o)) for i, o in itertools.pairwise(sizes)]
    agent = NetworkPolicy(layers, mean=rng.normal(size=4), scale=rng.uniform(1, 2, 4))
    agent.save(tmp_path / "agent.npz", success=0.5)
    loaded = NetworkPolicy.load(tmp_path / "agent.npz")
    observations = rng.normal(size=(20, 4))
    np.testing.assert_array_equal(loaded.predict(observations)[0], agent.predict(observations)[0])
    (W, b), (V, c) = layers
    x = (observations - agent.mean) / agent.scale
    by_hand = np.tanh(np.maximum(x @ W.T + b, 0.0) @ V.T + c)
    np.testing.assert_allclose(agent.predict(observations)[0], by_hand, atol=1e-5)


@pytest.mark.parametrize(
    ("layers", "message"),
    [
        ([], "at least one layer"),
        ([(np.zeros((3, 2)), np.zeros(3)), (np.zeros((1, 4)), np.zeros(1))], "layer 1 takes 3"),
        ([(np.zeros((3, 2)), np.zeros(2))], "layer 0"),
        ([(np.full((3, 2), np.nan), np.zeros(3))], "finite"),
        ([(np.zeros(3), np.zeros(3))], r"two dimensions, got \(3,\)"),
    ],
)
def test_networks_that_do_not_hang_together_are_refused(layers, message):
    with pytest.raises(ValueError, match=message):
        NetworkPolicy(layers)


CHANCE = 0.05
"""By how much a share of 100 episodes may be above the truth."""


@pytest.mark.floats
@pytest.mark.parametrize("name", agents())
def test_shipped_agents_say_where_they_are_from_and_do_their_task(name):
    path = SHIPPED / f"{name}.npz"
    with zipfile.ZipFile(path) as archive:
        header = json.loads(archive.read("header.json"))
    about = header["about"]
    readme = (SHIPPED / "README.md").read_text(encoding="utf-8")
    assert about["command"] in readme
    assert path.stat().st_size < 500_000
    env = gym.make(header["trained_in"]["env"])
    agent = make_policy(name, env)
    share = about["success"] - CHANCE
    assert not failures(
        lambda s: "" if rollout(env, agent, s) else "not solved",
        episode_seeds(0, 10, stage=3),
        share,
    )
    env.close()
