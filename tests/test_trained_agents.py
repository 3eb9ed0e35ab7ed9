"""Trained agents as files: read without running what they bring, and refused where they do not fit."""

import base64
import io
import itertools
import json
import os
import pickle
import shutil
import zipfile

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3 import A2C, DDPG, PPO, SAC, TD3

from asm_gym.checkpoint import write_checkpoint
from asm_gym.policies import make_policy, rollout
from asm_gym.policies.network import NetworkPolicy, read_archive
from asm_gym.policies.registry import SHIPPED, agents
from asm_gym.rollouts.seeds import episode_seeds
from tests.fakes import FakeEnv
from tests.rates import failures


class Uneven(FakeEnv):
    """Actions whose bounds differ."""

    def __init__(self):
        super().__init__()
        self.action_space = spaces.Box(np.array([-1, 0, -3], np.float32), np.array([1, 5, -1], np.float32))


KWARGS = {"net_arch": [7, 5], "activation_fn": torch.nn.ELU}


@pytest.mark.parametrize("kwargs", [{}, KWARGS], ids=["default", "elu"])
@pytest.mark.parametrize("algorithm", [SAC, TD3, DDPG, PPO, A2C])
def test_an_archive_acts_as_the_agent_that_was_saved(algorithm, kwargs, tmp_path):
    env = Uneven()
    model = algorithm("MlpPolicy", env, policy_kwargs=dict(kwargs), seed=1)
    with torch.no_grad():
        for parameter in model.policy.parameters():
            parameter.add_(0.05 * torch.randn_like(parameter))  # away from 0, where all of them are much the same
    model.save(tmp_path / "agent.zip")
    agent = make_policy(str(tmp_path / "agent.zip"), env)
    observations = np.random.default_rng(0).normal(size=(50, 2)).astype(np.float32)
    expected = model.predict(observations, deterministic=True)[0]
    np.testing.assert_allclose(agent.predict(observations, deterministic=True)[0], expected, atol=2e-6)
    np.testing.assert_allclose(agent.predict(observations[0], deterministic=True)[0], expected[0], atol=2e-6)
    assert expected.std(axis=0).max() > 0.01


@pytest.fixture
def archive(tmp_path):
    """Rewrites members of a good archive."""
    PPO("MlpPolicy", FakeEnv()).save(tmp_path / "good.zip")

    def rewritten(**members):
        with zipfile.ZipFile(tmp_path / "good.zip") as good, zipfile.ZipFile(tmp_path / "edited.zip", "w") as edited:
            for name in good.namelist():
                edit = members.pop(name.replace(".", "_"), lambda content: content)
                edited.writestr(name, edit(good.read(name)))
            for name, content in members.items():
                edited.writestr(name, content)
        return tmp_path / "edited.zip"

    return rewritten


class Evil:
    """Leaves a trace where it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (self.path,)


def edit_data(**entries):
    def edit(content):
        return json.dumps(json.loads(content) | entries).encode()

    return edit


def test_pickled_code_is_never_run(archive, tmp_path):
    trace = str(tmp_path / "trace")
    evil = {":type:": "<class 'function'>", ":serialized:": base64.b64encode(pickle.dumps(Evil(trace))).decode()}
    read_archive(archive(data=edit_data(lr_schedule=evil)))
    with pytest.raises(ValueError, match="Weights only load failed"):
        read_archive(archive(policy_pth=lambda _: pickle.dumps(Evil(trace))))
    assert not os.path.exists(trace)


def test_what_a_custom_policy_would_compute_is_not_guessed(archive):
    with pytest.raises(ValueError, match=r"policy is from somewhere\.else"):
        read_archive(archive(data=edit_data(policy_class={"__module__": "somewhere.else"})))
    with pytest.raises(ValueError, match="features_extractor_class"):
        read_archive(archive(data=edit_data(policy_kwargs={"features_extractor_class": "Mine"})))
    with pytest.raises(ValueError, match=r"activation 'swish'.*relu, tanh, elu"):
        read_archive(archive(data=edit_data(policy_kwargs={"activation_fn": "<class 'my.Swish'>"})))
    with pytest.raises(ValueError, match=r"edited\.zip is not an agent"):
        read_archive(archive(data=lambda _: b"{"))


def saved(content):
    """As torch writes it."""
    file = io.BytesIO()
    torch.save(content, file)
    return file.getvalue()


@pytest.mark.parametrize(
    "members",
    [
        {"data": edit_data(policy_class="MlpPolicy")},
        {"data": edit_data(policy_kwargs=["net_arch"])},
        {"data": lambda _: b"[1, 2]"},
        {"policy_pth": lambda _: saved(torch.zeros(3))},
        {"policy_pth": lambda _: saved({"action_net.weight": "many"})},
        {"policy_pth": lambda _: saved({1: torch.zeros(3)})},
        {"policy_pth": lambda _: saved({"action_net.weight": torch.zeros(3), "action_net.bias": torch.zeros(3)})},
        {"policy_pth": lambda _: saved({})},
        {"policy_pth": lambda _: b""},
        {"policy_pth": lambda content: content[:40]},
        {"policy_pth": lambda _: b"nonsense"},
    ],
)
def test_members_that_are_not_what_they_should_be_are_refused_with_a_reason(members, archive):
    with pytest.raises(ValueError, match=r"edited\.zip is not an agent that can be read: .+"):
        read_archive(archive(**members))


def test_an_archive_larger_than_its_file_may_be_is_refused_before_it_is_read(archive, monkeypatch):
    path = archive()
    with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as bomb:
        bomb.writestr("actor.optimizer.pth", bytes(10**8))
    monkeypatch.setattr(zipfile.ZipFile, "read", lambda *_: pytest.fail("it was read"))
    with pytest.raises(ValueError, match="its members claim 100"):
        read_archive(path)


def test_an_agent_with_more_than_its_layers_is_refused(tmp_path):
    arrays = {"W0": np.zeros((3, 2)), "b0": np.zeros(3), "mean": np.zeros(2), "scale": np.ones(2), "more": np.zeros(1)}
    write_checkpoint(tmp_path / "a.npz", "agent", {"activation": "relu", "squash": "tanh", "trained_in": {}}, arrays)
    with pytest.raises(ValueError, match=r"a\.npz is damaged: an agent has no more"):
        NetworkPolicy.load(tmp_path / "a.npz")


def test_an_agent_that_does_not_fit_is_refused_before_it_acts(tmp_path, lift):
    PPO("MlpPolicy", FakeEnv()).save(tmp_path / "fake.zip")
    with pytest.raises(ValueError, match=r"observations of 2 numbers.*\(37,\)"):
        make_policy(str(tmp_path / "fake.zip"), lift)
    with pytest.raises(FileNotFoundError, match="none"):
        make_policy(str(tmp_path / "none.zip"), lift)
    layers = [(np.zeros((7, 37), np.float32), np.zeros(7, np.float32))]
    path = tmp_path / "agent.npz"
    NetworkPolicy(layers, "relu", "tanh", trained_in={"env": "asm_gym/Door-v0"}).save(path)
    with pytest.raises(ValueError, match=r"env: asm_gym/Door-v0 there, asm_gym/Lift-v0 here"):
        make_policy(str(path), lift)
    NetworkPolicy(layers, "relu", "tanh", trained_in={"robots": ["Sawyer"], "other": 1}).save(path)
    with pytest.raises(ValueError, match=r"\['Sawyer'\] there, \['Panda'\] here"):
        make_policy(str(path), lift)
    NetworkPolicy([(np.zeros((6, 37)), np.zeros(6))], "relu", "tanh").save(path)
    with pytest.raises(ValueError, match="actions of 6 numbers"):
        make_policy(str(path), lift)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match=r"agent\.npz is damaged"):
        make_policy(str(path), lift)
    shutil.copy(SHIPPED.parents[1] / "README.md", path)
    with pytest.raises(ValueError, match="not a checkpoint"):
        make_policy(str(path), lift)


def test_an_agent_is_the_same_after_saving(tmp_path):
    rng = np.random.default_rng(0)
    sizes = (4, 6, 3)
    layers = [(rng.normal(size=(o, i)), rng.normal(size=o)) for i, o in itertools.pairwise(sizes)]
    agent = NetworkPolicy(layers, "tanh", "tanh", mean=rng.normal(size=4), scale=rng.uniform(1, 2, 4))
    agent.save(tmp_path / "agent.npz", success=0.5)
    loaded = NetworkPolicy.load(tmp_path / "agent.npz")
    observations = rng.normal(size=(20, 4))
    np.testing.assert_array_equal(loaded.predict(observations)[0], agent.predict(observations)[0])
    (W, b), (V, c) = layers
    x = (observations - agent.mean) / agent.scale
    by_hand = np.tanh(np.tanh(x @ W.T + b) @ V.T + c)
    np.testing.assert_allclose(agent.predict(observations)[0], by_hand, atol=1e-5)


@pytest.mark.parametrize(
    ("layers", "message"),
    [
        ([], "at least one layer"),
        ([(np.zeros((3, 2)), np.zeros(3)), (np.zeros((1, 4)), np.zeros(1))], "layer 1 takes 3"),
        ([(np.zeros((3, 2)), np.zeros(2))], "layer 0"),
        ([(np.full((3, 2), np.nan), np.zeros(3))], "finite"),
        ([(np.zeros(3), np.zeros(3))], r"two dimensions, got \[\(3,\)\]"),
    ],
)
def test_networks_that_do_not_hang_together_are_refused(layers, message):
    with pytest.raises(ValueError, match=message):
        NetworkPolicy(layers, "relu", "tanh")


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
    assert not failures(lambda s: "" if rollout(env, agent, s) else "not solved", episode_seeds(0, 10, stage=3), share)
    env.close()
