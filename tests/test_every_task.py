"""Every registered task keeps the environment's contract."""

import hashlib
import json
import os
import subprocess
import sys
import warnings
from functools import cache

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as check_env_sb3

import asm_gym  # noqa: F401
from asm_gym.tasks import TASKS


def digest(env, seed=5, steps=20):
    """The hash of all that an episode returns for given actions."""
    sha = hashlib.sha256()
    actions = (
        np.random.default_rng(1).uniform(-1, 1, (steps, *env.action_space.shape)).astype(np.float32)
    )
    observation, info = env.reset(seed=seed)
    sha.update(observation.tobytes() + info["stream"].tobytes())
    for action in actions:
        observation, reward, terminated, truncated, info = env.step(action)
        sha.update(observation.tobytes() + info["stream"].tobytes())
        sha.update(
            repr((reward, terminated, truncated, info["success"], info["contact_force"])).encode()
        )
    # What comes after an unseeded reset is the seed's as well.
    observation, info = env.reset()
    sha.update(observation.tobytes() + info["stream"].tobytes())
    return sha.hexdigest()


@pytest.fixture(scope="module")
def elsewhere():
    """Function of the same hashes from another process with another hash seed, made in another order."""
    code = "import json, tests.test_every_task as t; print(json.dumps(t.all_digests()))"
    environment = {
        **os.environ,
        "PYTHONHASHSEED": "7",
        "PYTHONPATH": os.pathsep.join(p for p in sys.path if p),
    }
    process = subprocess.Popen(
        [sys.executable, "-c", code], env=environment, stdout=subprocess.PIPE, text=True
    )
    return cache(lambda: json.loads(process.communicate()[0]))


def all_digests():
    hashes = {}
    for name in reversed(TASKS):
        env = gym.make(TASKS[name].id)
        hashes[name] = digest(env)
        env.close()
    return hashes


@pytest.mark.parametrize("name", TASKS)
def test_a_task_keeps_the_contract(name, elsewhere):
    env = gym.make(TASKS[name].id, horizon=400)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # by NumPy 2.5
        warnings.filterwarnings("ignore", "Setting the shape", DeprecationWarning, "robosuite")
        check_env(env.unwrapped, skip_render_check=True, skip_close_check=True)
        check_env_sb3(env.unwrapped, skip_render_check=True)
    env.reset(seed=3)
    env.action_space.seed(3)
    for _ in range(300):
        observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
        assert env.observation_space.contains(observation)
        assert np.isfinite(info["stream"]).all()
        assert np.isfinite(reward)
        assert not terminated
        assert not truncated
        assert info["success"] in (True, False)
    assert env.unwrapped.stream_spec.size == len(info["stream"])
    here = digest(env)
    env.close()
    env.close()
    assert here == elsewhere()[name]


@pytest.mark.parametrize("name", TASKS)
def test_objects_are_where_robosuite_says(name):
    """Read in one pass, they equal what robosuite's observables settle on."""
    env = gym.make(TASKS[name].id, observation="dict", sensor_noise=0.0).unwrapped
    env.reset(seed=2)
    for _ in range(3):
        observation = env.step(0.3 * np.ones(env.action_space.shape, np.float32))[0]
    theirs = env.robosuite_env
    theirs._get_observations(force_update=True)
    # relative poses lag behind absolute ones by one update
    expected = theirs._get_observations(force_update=True)
    shown = [n for n in expected if n in observation]
    assert shown
    for n in shown:
        np.testing.assert_allclose(
            observation[n], np.reshape(expected[n], -1), atol=1e-6, err_msg=n
        )
    env.close()


@pytest.mark.parametrize("name", ["PickPlaceSingle", "NutAssemblySingle"])
def test_a_task_of_one_object_in_several_draws_each_of_them(name):
    env = gym.make(TASKS[name].id, observation="dict").unwrapped
    which = "obj_id" if name.startswith("Pick") else "nut_id"
    drawn = {int(env.reset(seed=seed)[0][which][0]) for seed in range(40)}
    assert drawn == set(range(4 if name.startswith("Pick") else 2))
    env.close()
