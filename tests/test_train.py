"""Training: cloning, the learner's buffer and critics, and the command."""

import json
from dataclasses import replace
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.vec_env import DummyVecEnv

from asm_gym.data.episode import Episode
from asm_gym.data.minari_datasets import write_dataset
from asm_gym.policies.network import NetworkPolicy
from asm_gym.rollouts.training import (
    Standardised,
    TrainingSettings,
    clone,
    export,
    fill_buffer,
    make_learner,
    train,
)
from asm_gym.scripts.cli import main
from asm_gym.spec import StreamSpec
from asm_gym.wrappers import NeuralASMSafety
from tests.fakes import CueMonitor, FakeEnv


@pytest.fixture
def env():
    env = gym.make("Pendulum-v1")
    yield env
    env.close()


def linear_expert(count=4, steps=60, seed=0):
    """Episodes in which the action is a linear function of the observation."""
    rng = np.random.default_rng(seed)
    spec = StreamSpec.from_spaces(gym.spaces.Box(-1, 1, (3,)), gym.spaces.Box(-1, 1, (1,)))
    episodes = []
    for _ in range(count):
        observations = rng.uniform(-1, 1, (steps + 1, 3)).astype(np.float32)
        actions = 0.4 * observations[:-1, :1] - 0.3 * observations[:-1, 1:2]
        stream = np.concatenate([observations[1:], actions], axis=1)
        rewards = rng.normal(size=steps).astype(np.float32)
        episodes.append(
            Episode(stream, spec, actions=actions, observations=observations, rewards=rewards)
        )
    return episodes


def test_cloning_finds_the_experts_rule(env):
    learner = make_learner(env, 0)
    view = Standardised(env, np.zeros(3, np.float32), np.ones(3, np.float32))
    fill_buffer(learner, linear_expert(), view)
    clone(learner, 600)
    agent = export(learner, view)
    (fresh,) = linear_expert(1, seed=9)
    np.testing.assert_allclose(agent.predict(fresh.observations[:-1])[0], fresh.actions, atol=0.15)


def test_the_buffer_holds_the_demonstrations_and_which_of_them_were_cut_short(env):
    learner = make_learner(env, 0)
    (episode,) = linear_expert(1, steps=5)
    mean, scale = np.full(3, 0.5, np.float32), np.full(3, 2.0, np.float32)
    fill_buffer(learner, [episode], Standardised(env, mean, scale))
    buffer = learner.replay_buffer
    np.testing.assert_allclose(
        buffer.observations[:5, 0], (episode.observations[:-1] - mean) / scale, rtol=1e-5
    )
    np.testing.assert_allclose(
        buffer.next_observations[:5, 0], (episode.observations[1:] - mean) / scale, rtol=1e-5
    )
    # of the pendulum's ±2 N m
    np.testing.assert_allclose(buffer.actions[:5, 0], episode.actions / 2, rtol=1e-5)
    assert buffer.timeouts[:5, 0].tolist() == [0, 0, 0, 0, 1]
    assert not buffer.sample(64).dones.any()


def test_the_buffer_holds_the_action_that_was_executed():
    def watched():
        return NeuralASMSafety(FakeEnv(10), CueMonitor((3,)), on_alarm="hold", release_after=2)

    learner = make_learner(DummyVecEnv([watched]), 0)
    learner.learn(10)
    kept = learner.replay_buffer.actions[:10, 0]
    assert (kept[4:6, :2] == 0.0).all()  # the reflex rested in the two steps after the alarm
    assert np.abs(kept[[0, 1, 2, 3, 6, 7], :2]).min() > 0.0


def test_an_agent_is_cloned_improved_and_judged(tmp_path):
    settings = TrainingSettings(
        steps=30, cloning_updates=10, evaluate_every=15, evaluation_episodes=1, seed=3
    )
    how = {"settings": settings, "progress": lambda done, total: None}
    make = partial(gym.make, "Pendulum-v1")
    agent = train(make, tmp_path, linear_expert(), **how)
    assert np.load(tmp_path / "log" / "evaluations.npz")["timesteps"].tolist() == [15, 30]
    assert (agent.observation_size, agent.action_size) == (3, 1)
    again = train(make, tmp_path / "again", linear_expert(), **how)
    seen = np.random.default_rng(0).normal(size=(20, 3)).astype(np.float32)
    np.testing.assert_array_equal(agent.predict(seen)[0], again.predict(seen)[0])
    with pytest.raises(
        ValueError, match="demonstration 0 has observations of 3 numbers, the environment 2"
    ):
        train(partial(gym.make, "MountainCarContinuous-v0"), tmp_path, linear_expert(), **how)


@pytest.mark.slow
def test_what_was_cloned_is_not_lost_while_it_is_improved(tmp_path):
    few = ["--demonstrations", "60", "--cloning-updates", "4000", "--final-episodes", "20"]
    judged = ["--steps", "400", "--evaluate-every", "200", "--evaluation-episodes", "4"]
    assert main(["train", "Lift", *few, *judged, "--out", str(tmp_path)]) == 0
    # 0 where SAC destroys the clone
    assert json.loads((tmp_path / "result.json").read_text())["success"] >= 0.5


def test_the_command_clones_an_expert(tmp_path):
    assert main(["train", "Lift", "--quick", "--steps", "0", "--out", str(tmp_path)]) == 0
    assert json.loads((tmp_path / "result.json").read_text())["episodes"] == 2
    assert NetworkPolicy.load(tmp_path / "agent.npz").trained_in["robots"] == ["Panda"]


@pytest.mark.parametrize(
    ("made_in", "message"), [("asm_gym/Door-v0", "Door-v0"), ("asm_gym/Lift-v0", "damaged")]
)
def test_a_dataset_that_does_not_fit_is_refused_before_anything_is_learned(
    made_in, message, env, tmp_path, capsys
):
    episodes = [replace(e, faults=np.zeros(len(e), bool)) for e in linear_expert(2)]
    write_dataset(tmp_path / "data", "asm_gym/pendulum-v0", episodes, env, {})
    (data,) = (tmp_path / "data").rglob("metadata.json")
    about = json.loads(data.read_text())
    about["env_spec"] = json.dumps(json.loads(about["env_spec"]) | {"id": made_in})
    data.write_text(json.dumps(about))
    if message == "damaged":
        (recorded,) = (tmp_path / "data").rglob("main_data.hdf5")
        recorded.write_bytes(recorded.read_bytes()[:1000])
    assert (
        main(["train", "Lift", "--dataset", str(tmp_path / "data"), "--out", str(tmp_path / "out")])
        == 2
    )
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["Juggle"], "Juggle"),
        (["Lift", "--demonstrations", "0"], "demonstrations"),
        (["Pendulum-v1", "--steps", "10"], "no scripted expert"),
        (["Lift", "--dataset", "nowhere"], "nowhere"),
        (["Lift", "--final-episodes", "0"], "final_episodes"),
    ],
)
def test_impossible_arguments_are_refused(arguments, message, tmp_path, capsys):
    assert main(["train", *arguments, "--out", str(tmp_path / "out")]) == 2
    assert message in capsys.readouterr().err
