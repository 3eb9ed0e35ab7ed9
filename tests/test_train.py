"""Training: cloning, checkpoints, and going on after a kill."""

import json
import signal
import subprocess
import sys
import time
from dataclasses import replace

import gymnasium as gym
import h5py
import numpy as np
import pytest
import torch
from asm_gym.rollouts.training.state import TrainingState, newest, resume, save
from rich.console import Console
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import DummyVecEnv
from torch.utils._pytree import tree_leaves

from asm_gym.data.datasets import write_dataset
from asm_gym.episode import Episode
from asm_gym.policies.network import NetworkPolicy
from asm_gym.rollouts.training.cloning import Anchor, Cloner, fill_buffer, steps_of
from asm_gym.rollouts.training.learners import ALGORITHMS, RECIPES, export, make_learner, warm_critic
from asm_gym.rollouts.training.run import ObservationScale, Plan, TrainingRun
from asm_gym.scripts.cli import main
from asm_gym.scripts.train import Args, train_and_report
from asm_gym.spec import StreamSpec
from asm_gym.wrappers import NeuralASMSafety
from tests.fakes import CueMonitor, FakeEnv

PENDULUM = ["train", "Pendulum-v1", "--demonstrations", "0", "--evaluation-episodes", "1", "--final-episodes", "1"]


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
        episodes.append(Episode(stream, spec, actions=actions, observations=observations, rewards=rewards))
    return episodes


def small(algorithm, env, **kwargs):
    return make_learner(algorithm, env, 0, kwargs.pop("cloned", True), 100)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_cloning_finds_the_experts_rule(algorithm, env):
    learner = small(algorithm, env)
    observations, actions = steps_of(linear_expert())
    error = Cloner(learner, observations, actions).clone(600)
    assert error < 1e-3
    agent = export(learner, algorithm, np.zeros(3, np.float32), np.ones(3, np.float32), env)
    fresh, wanted = steps_of(linear_expert(seed=9))
    np.testing.assert_allclose(agent.predict(fresh)[0], wanted, atol=0.15)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_the_exported_agent_acts_as_the_learner_does_on_standardised_observations(algorithm, env):
    learner = small(algorithm, env)
    standard = ObservationScale.of(np.random.default_rng(0).normal(2.0, 3.0, (100, 3)).astype(np.float32))
    agent = export(learner, algorithm, standard.mean, standard.scale, env)
    wrapped = standard.around(gym.make("Pendulum-v1"))
    seen, _ = wrapped.reset(seed=3)
    plain, _ = gym.make("Pendulum-v1").reset(seed=3)
    np.testing.assert_allclose(seen, (plain - standard.mean) / standard.scale, rtol=1e-5)
    np.testing.assert_allclose(agent.predict(plain)[0], learner.predict(seen, deterministic=True)[0], atol=1e-5)
    assert agent.trained_in["env"] == "Pendulum-v1"


def test_the_buffer_holds_the_demonstrations_and_knows_what_was_cut_short(env):
    learner = small("sac", env)
    (episode,) = linear_expert(1, steps=5)
    mean, scale = np.full(3, 0.5, np.float32), np.full(3, 2.0, np.float32)
    fill_buffer(learner, [episode], mean, scale)
    buffer = learner.replay_buffer
    assert buffer.size() == 5
    np.testing.assert_allclose(buffer.observations[:5, 0], (episode.observations[:-1] - mean) / scale, rtol=1e-5)
    np.testing.assert_allclose(buffer.next_observations[:5, 0], (episode.observations[1:] - mean) / scale, rtol=1e-5)
    np.testing.assert_allclose(buffer.actions[:5, 0], episode.actions / 2, rtol=1e-5)  # of the pendulum's ±2 N m
    np.testing.assert_array_equal(buffer.rewards[:5, 0], episode.rewards)
    assert buffer.timeouts[:5, 0].tolist() == [0, 0, 0, 0, 1]
    drawn = buffer.sample(64)
    assert not drawn.dones.any()  # the episode was cut short: its end is worth what would have followed


def test_warming_the_critic_leaves_the_actor_as_it_is(env):
    learner = small("sac", env)
    fill_buffer(learner, linear_expert(), 0.0, 1.0)
    learner.set_logger(configure(None, []))
    before = {n: p.detach().clone() for n, p in learner.policy.named_parameters()}
    warm_critic(learner, 5)
    for name, parameter in learner.policy.named_parameters():
        same = torch.equal(before[name], parameter)
        assert same if name.startswith("actor.") else (not same or "critic" not in name)
    learner.train(2, 32)
    assert not torch.equal(before["actor.mu.weight"], learner.policy.actor.mu.weight)
    rates = [optimiser.param_groups[0]["lr"] for optimiser in (learner.actor.optimizer, learner.critic.optimizer)]
    assert rates[0] == pytest.approx(RECIPES["sac"].actor_share * rates[1])


@pytest.mark.parametrize("kind", ["sac", "td3"])
def test_our_learners_keep_the_action_that_was_executed(kind):
    def watched():
        return NeuralASMSafety(FakeEnv(10), CueMonitor((3,)), on_alarm="hold", release_after=2)

    learner = make_learner(kind, DummyVecEnv([watched]), 0, False, 10)
    learner.learn(10)
    kept = learner.replay_buffer.actions[:10, 0]
    assert (kept[4:6, :2] == 0.0).all()  # the reflex rested in the two steps after the alarm
    assert np.abs(kept[[0, 1, 2, 3, 6, 7], :2]).min() > 0.0


def test_critics_have_layer_normalisation(env):
    for algorithm in ("sac", "td3"):
        critic = small(algorithm, env).policy.critic
        for q in critic.q_networks:
            assert [type(layer).__name__ for layer in q] == ["Linear", "LayerNorm", "ReLU"] * 2 + ["Linear"]
        assert len(list(critic.parameters())) == 2 * (3 * 2 + 2 * 2)  # and their optimiser knows it
        assert len(critic.optimizer.param_groups[0]["params"]) == 2 * (3 * 2 + 2 * 2)


def test_an_anchored_actor_stays_with_its_expert(env):
    learner = small("td3", env)
    observations, actions = steps_of(linear_expert())
    cloner = Cloner(learner, observations, actions)
    cloner.clone(200)
    with torch.no_grad():
        learner.policy.actor.mu[0].weight.add_(0.3)
    moved = learner.predict(observations, deterministic=True)[0]
    anchor = Anchor(cloner, 300)
    anchor._on_rollout_start()
    kept = learner.predict(observations, deterministic=True)[0]
    assert np.abs(kept - actions).mean() < 0.3 * np.abs(moved - actions).mean()


def test_demonstrations_of_another_size_are_refused(tmp_path):
    plan = Plan("MountainCarContinuous-v0", {}, "sac", 0, 1, 1, 1, 1, 0)
    with pytest.raises(ValueError, match="demonstration 0 has observations of 3 numbers, the environment 2"):
        TrainingRun(plan, tmp_path, linear_expert())


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_a_checkpoint_gives_back_the_learner(algorithm, env, tmp_path):
    learner = small(algorithm, env, cloned=False)
    learner.learn(120)
    progressed = TrainingState(120, 0.5, ((100, 0.25), (120, 0.5)))
    save(tmp_path, learner, TrainingState(7, 0.0, ()))
    learner.num_timesteps += 1
    folder = save(tmp_path, learner, progressed)
    assert newest(tmp_path) == folder
    assert len(list(tmp_path.iterdir())) == 1  # the older one is gone
    other = small(algorithm, env, cloned=False)
    assert resume(folder, other) == TrainingState(learner.num_timesteps, 0.5, ((100, 0.25), (120, 0.5)))
    assert other.num_timesteps == learner.num_timesteps
    for a, b in zip(learner.policy.parameters(), other.policy.parameters(), strict=True):
        assert torch.equal(a, b)
    if algorithm != "ppo":
        assert other.replay_buffer.size() == learner.replay_buffer.size() == 120
        np.testing.assert_array_equal(other.replay_buffer.rewards, learner.replay_buffer.rewards)
    if algorithm == "sac":
        assert torch.equal(learner.log_ent_coef, other.log_ent_coef)
    (folder / "state.json").write_text("{")
    with pytest.raises(ValueError, match="no checkpoint to go on from"):
        resume(folder, other)


@pytest.mark.usefixtures("small_disk")
def test_a_checkpoint_that_no_disk_holds_is_a_line_that_names_the_file(env, tmp_path):
    learner = small("td3", env)
    with pytest.raises(OSError, match=r"File too large: '.*learner\.zip'"):
        save(tmp_path, learner, TrainingState(0, 0.0, ()))
    assert newest(tmp_path) is None


def test_a_killed_run_goes_on_from_its_last_checkpoint(tmp_path):
    few = {"evaluation_episodes": 1, "final_episodes": 1, "checkpoint_every": 100, "evaluate_every": 400}
    how = {"task": "Pendulum-v1", "algorithm": "td3", "demonstrations": 0, **few}
    begun = f"Args(**{how}, steps=100000, out=Path({str(tmp_path)!r})), Console()"
    begun = f"from pathlib import Path; from asm_gym.scripts.train import *; train_and_report({begun})"
    process = subprocess.Popen([sys.executable, "-c", begun], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 120
    while (newest(tmp_path) is None or newest(tmp_path).name == "checkpoint_0") and time.monotonic() < deadline:
        time.sleep(0.05)
    process.send_signal(signal.SIGKILL)
    process.wait()
    folder = newest(tmp_path)
    assert folder is not None
    done = int(folder.name.rsplit("_", 1)[-1])
    assert done >= 100
    steps = done + 150
    train_and_report(Args(**how, steps=steps, out=tmp_path), Console())
    assert (tmp_path / "log" / f"from_{done}" / "progress.csv").is_file()
    assert newest(tmp_path).name == f"checkpoint_{steps}"
    result = json.loads((tmp_path / "result.json").read_text())
    assert result["curve"][-1][0] == steps
    agent = NetworkPolicy.load(tmp_path / "agent.npz")
    assert (agent.observation_size, agent.action_size) == (3, 1)


class Killed(BaseException):
    """Ends a run wherever it is."""


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_a_run_that_was_killed_ends_in_the_same_weights_as_one_that_was_not(algorithm, tmp_path, monkeypatch):
    recipe = RECIPES[algorithm]
    few = {"batch_size": 8} | ({"n_steps": 16} if algorithm == "ppo" else {})
    few = replace(recipe, settings=recipe.settings | few, critic_updates=4, anchor=1)
    monkeypatch.setitem(RECIPES, algorithm, few)
    plan = Plan("Pendulum-v1", {}, algorithm, 70, 10, 30, 1, 21, 3)

    def train(name, killed_at=()):
        for end in (*killed_at, None):

            def tick(done, total, end=end):
                if done == end:
                    raise Killed

            run = TrainingRun(plan, tmp_path / name, linear_expert())
            try:
                run.begin(lambda done, total: None)
                run.learn(tick)
            except Killed:
                continue
            finally:
                run.close()
        return run

    whole, killed = train("whole"), train("killed", (10, 21, 35))
    assert whole.state == killed.state
    assert [step for step, _ in whole.state.curve] == [0, 30, 60, 80 if algorithm == "ppo" else 70]
    for name, value in whole.learner.get_parameters().items():
        found = killed.learner.get_parameters()[name]
        leaves, others = (tree_leaves(x) for x in (value, found))
        assert all(np.array_equal(a, b) for a, b in zip(leaves, others, strict=True)), name
    for name in ("clone.npz", "best.npz"):
        agents = [NetworkPolicy.load(tmp_path / folder / name) for folder in ("whole", "killed")]
        seen = np.random.default_rng(0).normal(size=(20, 3)).astype(np.float32)
        np.testing.assert_array_equal(*(agent.predict(seen)[0] for agent in agents))


def test_an_expert_is_cloned_and_improved_end_to_end(tmp_path):
    assert main(["train", "Lift", "--quick", "--steps", "0", "--out", str(tmp_path)]) == 0
    result = json.loads((tmp_path / "result.json").read_text())
    assert [step for step, _ in result["curve"]] == [0]
    assert NetworkPolicy.load(tmp_path / "agent.npz").trained_in["robots"] == ["Panda"]


@pytest.fixture(scope="module")
def datasets(tmp_path_factory):
    """Folders of Minari datasets: one of Door, and two that claim to be of Lift but are damaged or hold no streams."""
    folder = tmp_path_factory.mktemp("datasets")
    env = gym.make("Pendulum-v1")
    episodes = [replace(e, faults=np.zeros(len(e), bool)) for e in linear_expert(2)]
    for name, env_id in (("door", "asm_gym/Door-v0"), ("damaged", "asm_gym/Lift-v0"), ("bare", "asm_gym/Lift-v0")):
        write_dataset(folder / name, "asm_gym/pendulum-v0", episodes, env, {})
        (data,) = (folder / name).rglob("metadata.json")
        about = json.loads(data.read_text())
        if name == "bare":
            del about["stream_spec"]
        about["env_spec"] = json.dumps(json.loads(about["env_spec"]) | {"id": env_id})
        data.write_text(json.dumps(about))
        data.with_name("SHA256SUMS").unlink()  # changed on purpose
    env.close()
    (damaged,) = (folder / "damaged").rglob("main_data.hdf5")
    damaged.write_bytes(damaged.read_bytes()[:1000])
    (bare,) = (folder / "bare").rglob("main_data.hdf5")
    with h5py.File(bare, "a") as file:
        for episode in file.values():
            del episode["infos"]
    return folder


@pytest.mark.parametrize(
    ("name", "message"),
    [("door", "asm_gym/Door-v0, not in 'asm_gym/Lift-v0'"), ("damaged", "damaged"), ("bare", "holds no streams")],
)
def test_a_dataset_that_does_not_fit_is_refused_before_anything_is_learned(name, message, datasets, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["train", "Lift", "--dataset", str(datasets / name), "--out", str(out)]) == 2
    assert message in capsys.readouterr().err
    assert not out.exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["Lift", "--algorithm", "dqn"], "sac, td3, ppo"),
        (["Juggle"], "Juggle"),
        (["Lift", "--steps", "0", "--demonstrations", "0"], "nothing to learn from"),
        (["Pendulum-v1", "--steps", "10"], "no scripted expert"),
        (["Lift", "--dataset", "nowhere"], "nowhere"),
        (["Lift", "--final-episodes", "0"], "final_episodes"),
        (["CartPole-v1", "--demonstrations", "0"], "actions are a Box"),
    ],
)
def test_what_makes_no_sense_is_refused(arguments, message, tmp_path, capsys):
    assert main(["train", *arguments, "--out", str(tmp_path / "out")]) == 2
    assert message in capsys.readouterr().err
