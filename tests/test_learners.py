"""What learners of others read of a watched environment: each of them runs, where it is installed."""

from __future__ import annotations

import json

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

    callback = SafetyCallback()
    guarded = watched(on_alarm="hold", release_after=2)
    agent = sb3.PPO("MlpPolicy", guarded, n_steps=16, batch_size=16, seed=0)
    agent.set_logger(logger.configure(str(tmp_path), ["csv", "json"]))
    agent.learn(32, callback=callback)
    # Alarms in rows 2, 3 and 6; the reflex acts from the step after the first on, and goes on after the second.
    assert [(e["surprise"], e["alarms"], e["cost"]) for e in callback.ended] == [(10.0, 2, 3.0)] * 4
    assert callback.ended[0]["overridden"] == 4
    rows = [json.loads(line) for line in (tmp_path / "progress.json").read_text().splitlines()]
    assert (rows[-1]["safety/cost"], rows[-1]["safety/surprise"]) == (3.0, 10.0)
    with pytest.raises(KeyError, match="wrap the environment in NeuralASMSafety"):
        sb3.PPO("MlpPolicy", guarded.env, n_steps=16, batch_size=16).learn(
            16, callback=SafetyCallback()
        )


def with_cost():
    """A watched environment as TorchRL reads it, its cost among the observations."""
    torch, envs, data = needs("torch"), needs("torchrl.envs"), needs("torchrl.data")
    from torchrl.envs.libs.gym import default_info_dict_reader

    env = envs.GymWrapper(watched())
    cost = data.Unbounded(shape=(), dtype=torch.float64)
    return env.set_info_dict_reader(default_info_dict_reader(["cost"], spec={"cost": cost}))


STEPS = 256
COST = 3 * STEPS // 8
"""Three of eight steps."""


@pytest.mark.parametrize("kind", ["PPO", "SAC"])
def test_stable_baselines_learns_and_meets_every_cost(kind: str):
    sb3 = needs("stable_baselines3")
    from asm_gym.rollouts.safety_callback import SafetyCallback

    how = (
        {"n_steps": 64, "batch_size": 32}
        if kind == "PPO"
        else {"learning_starts": 32, "batch_size": 32}
    )
    callback = SafetyCallback()
    agent = getattr(sb3, kind)("MlpPolicy", watched(), seed=0, **how)
    before = [p.detach().clone() for p in agent.policy.parameters()]
    agent.learn(STEPS, callback=callback)
    assert sum(e["cost"] for e in callback.ended) == COST
    assert any((p != q).any() for p, q in zip(before, agent.policy.parameters(), strict=True))


def test_torchrl_collects_and_meets_every_cost():
    collectors = needs("torchrl.collectors")
    # the name of before
    kind = getattr(collectors, "Collector", None) or collectors.SyncDataCollector
    collector = kind(with_cost, None, frames_per_batch=64, total_frames=STEPS)
    assert sum(float(batch["next", "cost"].sum()) for batch in collector) == COST
    collector.shutdown()
