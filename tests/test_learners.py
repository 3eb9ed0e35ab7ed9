"""What learners of others read of a watched environment: each of them runs, where it is installed."""

from __future__ import annotations

import json

import gymnasium as gym
import numpy as np
import pytest

from asm_gym.wrappers import FlatInfo, NeuralASMSafety, SafetyLog, SixValues
from asm_gym.wrappers.logging import SafetyCounter, WandbWriter
from tests.fakes import CueMonitor, FakeEnv
from tests.needs import needs

ACT = np.zeros(3, np.float32)


def watched(cue=(2, 3, 6), length=8, on_alarm="monitor", **how):
    return NeuralASMSafety(FakeEnv(length=length), CueMonitor(cue), on_alarm=on_alarm, **how)


class Kept:
    """A writer that keeps what it is told."""

    def __init__(self):
        self.said = []

    def add_scalar(self, tag, scalar_value, global_step):
        self.said.append((tag, scalar_value, global_step))


def test_an_episode_is_counted_by_hand():
    counter, env = SafetyCounter(0.05), watched(on_alarm="hold", release_after=2)
    env.reset()
    for _ in range(8):
        counter.add(env.step(ACT)[4])
    # Alarms in rows 2, 3 and 6; the reflex acts from the step after the first on, and goes on after the second.
    assert counter.total.surprise == 10.0
    assert counter.total.alarms == 2
    assert counter.total.cost == 3.0
    assert counter.total.override_s == pytest.approx(4 * 0.05)
    counter.clear()
    assert counter.total.alarms == 0
    with pytest.raises(KeyError, match="outside of NeuralASMSafety"):
        counter.add({})


def test_each_episode_is_logged_when_it_ends():
    kept = Kept()
    env = SafetyLog(watched(), kept)
    for _ in range(2):
        env.reset()
        for _ in range(8):
            env.step(ACT)
    alarms = [(value, step) for tag, value, step in kept.said if tag == "safety/alarms"]
    assert alarms == [(2.0, 8), (2.0, 16)]
    assert ("safety/cost", 3.0, 16) in kept.said
    assert ("safety/override_s", 0.0, 8) in kept.said


def test_tensorboard_keeps_what_is_logged(tmp_path):
    tensorboard = needs("torch.utils.tensorboard")
    events = needs("tensorboard.backend.event_processing.event_accumulator")
    with tensorboard.SummaryWriter(str(tmp_path)) as writer:
        env = SafetyLog(watched(), writer)
        env.reset()
        for _ in range(8):
            env.step(ACT)
    read = events.EventAccumulator(str(tmp_path)).Reload()
    (event,) = read.Scalars("safety/cost")
    assert (event.step, event.value) == (8, 3.0)


@pytest.mark.slow
def test_weights_and_biases_keeps_what_is_logged_without_a_network(tmp_path, monkeypatch):  # 20 s: it starts a service
    wandb = needs("wandb")
    monkeypatch.setenv("WANDB_SILENT", "true")
    with wandb.init(mode="offline", dir=tmp_path, project="asm-gym") as run:
        env = SafetyLog(watched(), WandbWriter(run))
        env.reset()
        for _ in range(8):
            env.step(ACT)
    wandb.teardown()  # its service may write after the run has ended
    (kept,) = tmp_path.rglob("*.wandb")
    assert b"safety/alarms" in kept.read_bytes()


def test_the_callback_logs_what_learning_met(tmp_path):
    sb3, logger = needs("stable_baselines3"), needs("stable_baselines3.common.logger")
    from asm_gym.rollouts.training.callback import SafetyCallback

    callback = SafetyCallback(dt=0.05)
    agent = sb3.PPO("MlpPolicy", watched(), n_steps=16, batch_size=16, seed=0)
    agent.set_logger(logger.configure(str(tmp_path), ["csv", "json"]))
    agent.learn(32, callback=callback)
    assert len(callback.ended) == 4
    assert {(e.alarms, e.cost) for e in callback.ended} == {(2, 3.0)}
    rows = [json.loads(line) for line in (tmp_path / "progress.json").read_text().splitlines()]
    assert rows[-1]["safety/cost"] == 3.0
    assert rows[-1]["safety/surprise"] == 10.0


def test_torchrl_reads_the_flat_numbers():
    envs = needs("torchrl.envs")
    from torchrl.envs.libs.gym import default_info_dict_reader

    envs.check_env_specs(envs.GymWrapper(watched()))
    with_cost = envs.GymWrapper(FlatInfo(watched()))
    with_cost.set_info_dict_reader(default_info_dict_reader(["cost"]))
    envs.check_env_specs(with_cost)
    everything = envs.GymWrapper(FlatInfo(watched())).auto_register_info_dict()
    envs.check_env_specs(everything)
    rolled = everything.rollout(8)["next"]
    np.testing.assert_array_equal(rolled["cost"].ravel(), [0, 0, 1, 1, 0, 0, 1, 0])
    np.testing.assert_array_equal(rolled["asm_alarm"].ravel(), [0, 0, 1, 1, 0, 0, 1, 0])


def test_flat_info_goes_outside_of_the_guard():
    with pytest.raises(KeyError, match="put FlatInfo outside of NeuralASMSafety"):
        FlatInfo(FakeEnv()).reset()


def test_six_values_are_those_of_safety_gymnasium():
    env = SixValues(watched())
    env.reset()
    steps = [env.step(ACT) for _ in range(8)]
    assert [step[2] for step in steps] == [0, 0, 1, 1, 0, 0, 1, 0]
    assert [len(step) for step in steps] == [6] * 8
    assert steps[-1][4]


def test_a_loop_as_cleanrl_writes_it_sees_cost_and_episodes():
    """Environments side by side, each recorded and clipped outside of the guard, as in its PPO."""

    def make():
        env = gym.wrappers.RecordEpisodeStatistics(watched())
        return gym.wrappers.ClipAction(env)

    envs = gym.vector.SyncVectorEnv([make, make], autoreset_mode=gym.vector.AutoresetMode.SAME_STEP)
    envs.reset(seed=0)
    costs, lengths = np.zeros(2), []
    for _ in range(16):
        _, _, _, _, infos = envs.step(np.zeros((2, 3), np.float32))
        last = infos.get("final_info", infos)
        costs += np.where(infos.get("_final_info", np.zeros(2, bool)), last["cost"], infos["cost"])
        if "final_info" in infos:
            lengths += infos["final_info"]["episode"]["l"].tolist()
    assert lengths == [8] * 4
    np.testing.assert_array_equal(costs, [6, 6])
    envs.close()


@pytest.mark.slow
def test_rllib_samples_a_watched_environment():  # half a minute: it starts Ray
    pytest.importorskip("ray.rllib", reason="pip install 'ray[rllib]' torch")
    from ray.rllib.algorithms.ppo import PPOConfig
    from ray.rllib.env.single_agent_env_runner import SingleAgentEnvRunner
    from ray.tune import register_env

    register_env("watched", lambda config: watched())
    config = PPOConfig().environment("watched").env_runners(num_env_runners=0, rollout_fragment_length=8)
    runner = SingleAgentEnvRunner(config=config)
    (episode,) = runner.sample(num_episodes=1, random_actions=True)
    assert [info["cost"] for info in episode.get_infos()[1:]] == [0, 0, 1, 1, 0, 0, 1, 0]
