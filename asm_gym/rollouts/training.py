"""Train one agent with stable-baselines3's SAC: clone an expert, learn on, keep the best of the evaluations.

    cloning    L = mean (tanh μ(o) - a)²   over the expert's steps (Pomerleau 1991)

So that the clone is not forgotten, critics learn its value first, with layer normalisation, or values explode where no
action was shown (Ball et al. 2023, RLPD); the actor learns slowly, and an update of cloning follows each of its steps.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import ConvertCallback, EvalCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.sac.policies import SACPolicy

from asm_gym.data.episode import Episode
from asm_gym.policies.network import NetworkPolicy, describe
from asm_gym.rollouts.parallel import Progress

ACTOR_SHARE = 0.05  # the actor's learning rate, as a share of the critic's
ENTROPY = -3.0  # target entropy per number of the action: a third of the usual spread, or learned grasps are shaken off
CRITIC_UPDATES = 2000  # of critics alone, between cloning and learning
BATCH, LOG_STD = 256, -3.5  # of cloning, and the actor's log standard deviation before tanh
# learning rates of cloning, before and while the agent learns from its steps
CLONING_RATE, ANCHOR_RATE = (
    1e-3,
    3e-4,
)

Floats = NDArray[np.float32]


class Standardised(gym.ObservationWrapper[Floats, Any, Any]):
    """Observations as the learner sees them."""

    def __init__(self, env: gym.Env[Any, Any], mean: Floats, scale: Floats) -> None:
        super().__init__(env)
        self.mean, self.scale = mean, scale
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, mean.shape, np.float32)

    def observation(self, observation: Any) -> Floats:
        """Return the standardised observation."""
        return np.asarray((observation - self.mean) / self.scale, np.float32)


class NormalisedCritic(SACPolicy):
    """SAC's policy, with critics that have layer normalisation after each hidden layer."""

    def make_critic(self, features_extractor: Any = None) -> Any:
        """Return the critics."""
        critic: Any = super().make_critic(features_extractor)
        for n, q in enumerate(critic.q_networks):
            parts = [
                (p, torch.nn.LayerNorm(p.out_features))
                if getattr(p, "out_features", 1) > 1
                else (p,)
                for p in q
            ]
            critic.q_networks[n] = torch.nn.Sequential(*(layer for some in parts for layer in some))
            critic.add_module(f"qf{n}", critic.q_networks[n])
        return critic


class GuardedSAC(SAC):
    """SAC with a slow actor, whose replay buffer holds the actions that a safety wrapper executed."""

    def _update_learning_rate(self, optimizers: Any) -> None:
        super()._update_learning_rate(optimizers)
        for group in self.actor.optimizer.param_groups:
            group["lr"] *= ACTOR_SHARE

    def _store_transition(
        self, buffer: Any, action: Any, seen: Any, reward: Any, dones: Any, infos: Any
    ) -> None:
        executed = [info.get("asm", {}).get("executed_action") for info in infos]
        scale = self.policy.scale_action
        kept = np.array(
            [
                own if other is None else scale(other)
                for own, other in zip(action, executed, strict=True)
            ]
        )
        super()._store_transition(buffer, kept, seen, reward, dones, infos)


def make_learner(env: gym.Env[Any, Any], seed: int) -> GuardedSAC:
    """Return a learner whose actor is going to be cloned."""
    return GuardedSAC(
        NormalisedCritic,
        env,
        learning_rate=3e-4,
        buffer_size=300_000,
        gamma=0.98,
        learning_starts=0,
        ent_coef="auto_0.005",
        target_entropy=ENTROPY * float(np.prod(env.action_space.shape or ())),
        seed=seed,
        device="cpu",
    )


def train(
    make: Callable[[], gym.Env[Any, Any]],
    out: Path,
    demonstrations: Sequence[Episode],
    progress: Progress,
    *,
    steps: int,
    cloning_updates: int,
    evaluate_every: int,
    evaluation_episodes: int,
    seed: int,
) -> NetworkPolicy:
    """Return the best agent of the evaluations; without any of them, the last one. ``make`` makes the environment.

    Raises:
        TypeError: spaces other than Boxes with one axis.
        ValueError: demonstrations of other sizes.
    """
    with closing(make()) as env, closing(make()) as other:  # the learner's own must not be reset
        check_sizes(env, demonstrations)
        observations = np.concatenate([e.observations for e in demonstrations])
        spread = observations.std(axis=0)
        standard = (
            observations.mean(axis=0),
            np.where(spread > 1e-3, spread, 1.0).astype(np.float32),
        )
        view = Standardised(env, *standard)
        learner = make_learner(Monitor(view), seed)
        learner.set_logger(
            configure(str(out / "log"), ["csv", *["tensorboard"] * bool(find_spec("tensorboard"))])
        )
        fill_buffer(learner, demonstrations, view)
        anchor = clone(learner, cloning_updates, seed, progress)
        if steps:
            learner.actor.requires_grad_(False)
            learner.train(min(CRITIC_UPDATES, cloning_updates), BATCH)
            learner.actor.requires_grad_(True)
            judge = EvalCallback(
                Monitor(Standardised(other, *standard)),
                n_eval_episodes=evaluation_episodes,
                eval_freq=evaluate_every,
                log_path=str(out / "log"),
                best_model_save_path=str(out),
                verbose=0,
            )
            judge.eval_env.seed(seed + 1)

            def follow(own: dict[str, Any], _: Any) -> bool:
                anchor()
                progress(min(own["self"].num_timesteps, steps), steps)
                return True

            learner.learn(steps, [judge, ConvertCallback(follow)])
        if steps >= evaluate_every:
            learner.set_parameters(str(out / "best_model.zip"))
        return export(learner, view)


def check_sizes(env: gym.Env[Any, Any], demonstrations: Sequence[Episode]) -> None:
    """Raise TypeError or ValueError where the learner cannot learn from these demonstrations."""
    for name, space in (("observations", env.observation_space), ("actions", env.action_space)):
        if not isinstance(space, gym.spaces.Box) or len(space.shape) != 1:
            raise TypeError(
                f"an agent is trained where {name} are a Box with one axis, got {space}"
            )
        for n, episode in enumerate(demonstrations):
            size = getattr(episode, name).shape[1]
            if size != space.shape[0]:
                raise ValueError(
                    f"demonstration {n} has {name} of {size} numbers, the environment {space.shape[0]}"
                )


def fill_buffer(learner: SAC, episodes: Sequence[Episode], view: Standardised) -> None:
    """Add episodes to a learner's replay buffer, as its own are."""
    assert learner.replay_buffer is not None
    space: Any = learner.action_space
    for episode in episodes:
        seen = view.observation(episode.observations)
        actions = learner.policy.scale_action(np.clip(episode.actions, space.low, space.high))
        for t, reward in enumerate(episode.rewards):
            last = t == len(episode.rewards) - 1
            info: dict[str, Any] = {
                "TimeLimit.truncated": last and not episode.info.get("terminated", False)
            }
            row = (
                seen[t][None],
                seen[t + 1][None],
                actions[t][None],
                np.array([reward]),
                np.array([last]),
            )
            learner.replay_buffer.add(*row, [info])


def clone(
    learner: SAC, updates: int, seed: int = 0, progress: Progress = lambda *_: None
) -> Callable[[], None]:
    """Fit a learner's actor to the actions in its replay buffer; return what makes one update more."""
    buffer, actor = learner.replay_buffer, learner.actor
    assert buffer is not None
    observations = torch.as_tensor(buffer.observations[: buffer.size(), 0].copy())
    actions = torch.as_tensor(buffer.actions[: buffer.size(), 0].copy())
    head: Any = actor.log_std
    with torch.no_grad():
        head.weight.zero_()
        head.bias.fill_(LOG_STD)
    optimiser = torch.optim.Adam(
        [p for name, p in actor.named_parameters() if "log_std" not in name], lr=CLONING_RATE
    )
    decay = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, updates)
    batches = torch.Generator().manual_seed(seed)

    def update() -> None:
        drawn = torch.randint(len(actions), (BATCH,), generator=batches)
        mean = torch.tanh(actor.get_action_dist_params(observations[drawn])[0])
        optimiser.zero_grad()
        ((mean - actions[drawn]) ** 2).mean().backward()  # type: ignore[no-untyped-call]
        optimiser.step()

    for n in range(updates):
        update()
        decay.step()
        progress(n + 1, updates)
    optimiser.param_groups[0]["lr"] = ANCHOR_RATE
    return update


def export(learner: SAC, view: Standardised) -> NetworkPolicy:
    """Return the learner's policy for unstandardised observations, without its noise, to act in the environment."""
    parts = [
        part
        for part in (*learner.actor.latent_pi, learner.actor.mu)
        if isinstance(part, torch.nn.Linear)
    ]
    layers = [
        (part.weight.detach().cpu().numpy().copy(), part.bias.detach().cpu().numpy().copy())
        for part in parts
    ]
    how: dict[str, Any] = {"mean": view.mean, "scale": view.scale, "trained_in": describe(view.env)}
    return NetworkPolicy(layers, **how).fit_to(view.env, "the agent")
