"""What learners of others read of a watched environment: each of them runs, where it is installed."""

from __future__ import annotations

import json

import gymnasium as gym
import numpy as np
import pytest

from asm_gym.wrappers import NeuralASMSafety
from tests.fakes import CueMonitor, FakeEnv
from tests.needs import needs

ACT = np.zeros(3, np.float32)


def watched(cue=(2, 3, 6), length=8, on_alarm="monitor", **how):
    return NeuralASMSafety(FakeEnv(length=length), CueMonitor(cue), on_alarm=on_alarm, **how)


def test_the_callback_logs_what_learning_met(tmp_path):
    sb3, logger = needs("stable_baselines3"), needs("stable_baselines3.common.logger")
    from asm_gym.rollouts.safety_callback import SafetyCallback

    callback = SafetyCallback(dt=0.05)
    guarded = watched(on_alarm="hold", release_after=2)
    agent = sb3.PPO("MlpPolicy", guarded, n_steps=16, batch_size=16, seed=0)
    agent.set_logger(logger.configure(str(tmp_path), ["csv", "json"]))
    agent.learn(32, callback=callback)
    # Alarms in rows 2, 3 and 6; the reflex acts from the step after the first on, and goes on after the second.
    assert [(e.surprise, e.alarms, e.cost) for e in callback.ended] == [(10.0, 2, 3.0)] * 4
    assert callback.ended[0].override_s == pytest.approx(4 * 0.05)
    rows = [json.loads(line) for line in (tmp_path / "progress.json").read_text().splitlines()]
    assert (rows[-1]["safety/cost"], rows[-1]["safety/surprise"]) == (3.0, 10.0)
    with pytest.raises(KeyError, match="wrap the environment in NeuralASMSafety"):
        sb3.PPO("MlpPolicy", guarded.env, n_steps=16, batch_size=16).learn(16, callback=SafetyCallback(dt=0.05))


def with_cost():
    """A watched environment as TorchRL reads it, its cost among the observations."""
    torch, envs, data = needs("torch"), needs("torchrl.envs"), needs("torchrl.data")
    from torchrl.envs.libs.gym import default_info_dict_reader

    env = envs.GymWrapper(watched())
    cost = data.Unbounded(shape=(), dtype=torch.float64)
    return env.set_info_dict_reader(default_info_dict_reader(["cost"], spec={"cost": cost}))


def test_torchrl_reads_the_cost():
    envs = needs("torchrl.envs")
    env = with_cost()
    envs.check_env_specs(env)
    np.testing.assert_array_equal(env.rollout(8)["next"]["cost"].ravel(), [0, 0, 1, 1, 0, 0, 1, 0])


def test_a_callback_finds_out_the_control_period():
    sb3 = needs("stable_baselines3")
    from asm_gym.rollouts.safety_callback import SafetyCallback

    callback = SafetyCallback()
    guarded = watched(range(20), length=20, on_alarm="hold")
    sb3.PPO("MlpPolicy", guarded, n_steps=20, batch_size=20).learn(20, callback=callback)
    assert callback.ended[0].override_s == pytest.approx(19 * 0.05)


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


STEPS, SIDE_BY_SIDE = 256, 2
COST = 3 * STEPS // 8
"""Three of eight steps."""


def side_by_side():
    """As CleanRL makes its environments."""

    def make():
        return gym.wrappers.ClipAction(gym.wrappers.RecordEpisodeStatistics(watched()))

    mode = gym.vector.AutoresetMode.SAME_STEP
    return gym.vector.SyncVectorEnv([make] * SIDE_BY_SIDE, autoreset_mode=mode)


def costs_of(infos):
    """(N,) of a step: where an episode has just ended, that of its last step."""
    last = infos.get("final_info", infos)
    return np.where(infos.get("_final_info", np.zeros(SIDE_BY_SIDE, bool)), last["cost"], infos["cost"])


def network(torch, inputs, outputs):
    torch.manual_seed(0)
    return torch.nn.Sequential(torch.nn.Linear(inputs, 16), torch.nn.Tanh(), torch.nn.Linear(16, outputs))


def descend(optimiser, loss):
    optimiser.zero_grad()
    loss.backward()
    optimiser.step()


def test_ppo_as_cleanrl_writes_it_learns_and_meets_every_cost():
    torch = needs("torch")
    envs, actor, critic = side_by_side(), network(torch, 2, 3), network(torch, 2, 1)
    log_std = torch.zeros(3, requires_grad=True)
    optimiser = torch.optim.Adam([*actor.parameters(), *critic.parameters(), log_std], 1e-2)
    before, met, losses = actor[0].weight.detach().clone(), 0.0, []
    seen, _ = envs.reset(seed=0)
    for _ in range(STEPS // 32 // SIDE_BY_SIDE):
        rows = []
        for _ in range(32):
            state = torch.as_tensor(seen) / 8
            chosen = torch.distributions.Normal(actor(state), log_std.exp())
            action = chosen.sample()
            seen, reward, ended, cut, infos = envs.step(action.numpy())
            met += costs_of(infos).sum()
            told = chosen.log_prob(action).sum(-1).detach()
            done = torch.as_tensor(ended | cut, dtype=torch.float32)
            rows.append((state, action, told, torch.as_tensor(reward - costs_of(infos), dtype=torch.float32), done))
        states, actions, told, rewards, done = map(torch.stack, zip(*rows, strict=True))
        returns, after = torch.zeros_like(rewards), critic(torch.as_tensor(seen) / 8)[:, 0].detach()
        for t in reversed(range(32)):
            returns[t] = after = rewards[t] + 0.99 * (1 - done[t]) * after
        for _ in range(4):
            value = critic(states)[..., 0]
            ratio = (torch.distributions.Normal(actor(states), log_std.exp()).log_prob(actions).sum(-1) - told).exp()
            gain = (returns - value).detach()
            policy = -torch.minimum(ratio * gain, ratio.clamp(0.8, 1.2) * gain).mean()
            loss = policy + 0.5 * (returns - value).pow(2).mean()
            descend(optimiser, loss)
        losses.append(float((returns - critic(states)[..., 0]).pow(2).mean().detach()))
    assert met == COST
    assert losses[-1] < losses[0]
    assert not torch.equal(before, actor[0].weight)


def test_sac_as_cleanrl_writes_it_learns_and_meets_every_cost():
    torch = needs("torch")
    envs, rng = side_by_side(), np.random.default_rng(0)
    actor, critic, target = network(torch, 2, 6), network(torch, 5, 1), network(torch, 5, 1)
    optimisers = torch.optim.Adam(actor.parameters(), 3e-3), torch.optim.Adam(critic.parameters(), 3e-3)

    def act(state):
        mean, log_std = actor(state).chunk(2, -1)
        chosen = torch.distributions.Normal(mean, log_std.clamp(-5, 2).exp())
        raw = chosen.rsample()
        action = torch.tanh(raw)
        return action, (chosen.log_prob(raw) - torch.log(1 - action.pow(2) + 1e-6)).sum(-1)

    kept, met, before = [], 0.0, actor[0].weight.detach().clone()
    seen, _ = envs.reset(seed=0)
    for step in range(STEPS // SIDE_BY_SIDE):
        action, _ = act(torch.as_tensor(seen) / 8)
        after, reward, ended, cut, infos = envs.step(action.detach().numpy())
        met += costs_of(infos).sum()
        # The observation of an episode's last step is not the first of the next.
        real = np.stack([infos["final_obs"][i] if cut[i] else after[i] for i in range(SIDE_BY_SIDE)])
        kept += zip(seen / 8, action.detach().numpy(), reward - costs_of(infos), real / 8, ended, strict=True)
        assert (real[:, 0] == seen[:, 0] + 1).all()
        seen = after
        if step < 16:
            continue
        batch = [kept[i] for i in rng.integers(len(kept), size=32)]
        s, a, r, n, d = (torch.as_tensor(np.array(x), dtype=torch.float32) for x in zip(*batch, strict=True))
        with torch.no_grad():
            b, told = act(n)
            wanted = r + 0.99 * (1 - d) * (target(torch.cat([n, b], -1))[:, 0] - 0.2 * told)
        descend(optimisers[1], (critic(torch.cat([s, a], -1))[:, 0] - wanted).pow(2).mean())
        b, told = act(s)
        descend(optimisers[0], (0.2 * told - critic(torch.cat([s, b], -1))[:, 0]).mean())
        for old, new in zip(target.parameters(), critic.parameters(), strict=True):
            old.data.lerp_(new.data, 0.01)
    assert met == COST
    assert not torch.equal(before, actor[0].weight)


@pytest.mark.parametrize("kind", ["PPO", "SAC"])
def test_stable_baselines_learns_and_meets_every_cost(kind: str):
    sb3 = needs("stable_baselines3")
    from asm_gym.rollouts.safety_callback import SafetyCallback

    how = {"n_steps": 64, "batch_size": 32} if kind == "PPO" else {"learning_starts": 32, "batch_size": 32}
    callback = SafetyCallback(dt=0.05)
    agent = getattr(sb3, kind)("MlpPolicy", watched(), seed=0, **how)
    before = [p.detach().clone() for p in agent.policy.parameters()]
    agent.learn(STEPS, callback=callback)
    assert sum(e.cost for e in callback.ended) == COST
    assert any((p != q).any() for p, q in zip(before, agent.policy.parameters(), strict=True))


def test_torchrl_collects_and_meets_every_cost():
    collectors = needs("torchrl.collectors")
    kind = getattr(collectors, "Collector", None) or collectors.SyncDataCollector  # the name of before
    collector = kind(with_cost, None, frames_per_batch=64, total_frames=STEPS)
    assert sum(float(batch["next", "cost"].sum()) for batch in collector) == COST
    collector.shutdown()


def test_tianshou_collects_and_meets_every_cost():
    data, env, algorithm = needs("tianshou.data"), needs("tianshou.env"), needs("tianshou.algorithm.algorithm_base")
    envs = env.DummyVectorEnv([watched] * SIDE_BY_SIDE)
    buffer = data.VectorReplayBuffer(STEPS, SIDE_BY_SIDE)
    collector = data.Collector(algorithm.RandomActionPolicy(watched().action_space), envs, buffer)
    collector.collect(n_step=STEPS, random=True, reset_before_collect=True)
    assert buffer.info["cost"].sum() == COST


@pytest.mark.slow
def test_rllib_trains_on_a_watched_environment():  # a minute: it starts Ray
    pytest.importorskip("ray.rllib", reason="pip install 'ray[rllib]' torch")
    from ray.rllib.algorithms.ppo import PPOConfig
    from ray.tune import register_env

    register_env("watched", lambda config: watched())
    config = PPOConfig().environment("watched").env_runners(num_env_runners=0)
    algorithm = config.training(train_batch_size_per_learner=STEPS, minibatch_size=64, num_epochs=1).build_algo()
    found = algorithm.train()
    assert found["env_runners"]["num_env_steps_sampled"] >= STEPS
    assert found["env_runners"]["episode_len_mean"] == 8
    algorithm.stop()
