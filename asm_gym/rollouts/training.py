"""Train one agent with stable-baselines3's SAC: clone an expert, learn on, keep the best of the evaluations.

    cloning    L = mean (tanh μ(o) - a)²   over the expert's steps (Pomerleau 1991)

So that the clone is not forgotten, critics learn its value first, with layer normalisation, or values explode where no
action was shown (Ball et al. 2023, RLPD); the actor learns slowly, and an update of cloning follows each of its steps.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
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
from asm_gym.rollouts.executed_sac import ExecutedSAC
from asm_gym.rollouts.parallel import Progress

ACTOR_SHARE = 0.05  # the actor's learning rate, as a share of the critic's
# Target entropy per number of the action: a third of the usual spread, or learned grasps are
# shaken off.
ENTROPY = -3.0
CRITIC_UPDATES = 2000  # of critics alone, between cloning and learning
BATCH = 256  # steps of an update of cloning
LOG_STD = -3.5  # the actor's log standard deviation before tanh, after cloning
CLONING_RATE = 1e-3  # learning rate of cloning
LATER_CLONING_RATE = 3e-4  # the same while the agent learns from its own steps

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class TrainingSettings:
    """How an agent is trained."""

    steps: int
    """Control steps of SAC; 0 for a clone."""
    cloning_updates: int
    """Updates of the actor in cloning."""
    evaluate_every: int
    """Control steps between evaluations."""
    evaluation_episodes: int
    """Episodes of each evaluation."""
    seed: int
    """Seed of all random draws."""


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
        for n, network in enumerate(critic.q_networks):
            layers = torch.nn.Sequential()
            for layer in network:
                layers.append(layer)
                if getattr(layer, "out_features", 1) > 1:  # a hidden layer
                    layers.append(torch.nn.LayerNorm(layer.out_features))
            critic.q_networks[n] = layers
            critic.add_module(f"qf{n}", layers)
        return critic


class GuardedSAC(ExecutedSAC):
    """SAC with a slow actor, whose replay buffer holds the actions that a safety wrapper executed."""

    def _update_learning_rate(self, optimizers: Any) -> None:
        super()._update_learning_rate(optimizers)
        for group in self.actor.optimizer.param_groups:
            group["lr"] *= ACTOR_SHARE


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
    make_env: Callable[[], gym.Env[Any, Any]],
    out: Path,
    demonstrations: Sequence[Episode],
    settings: TrainingSettings,
    progress: Progress,
) -> NetworkPolicy:
    """Return the agent that did best in the evaluations; the last one if there were none.

    Logs and the best model are kept in the folder ``out``.

    Raises:
        TypeError: spaces other than Boxes with one axis.
        ValueError: demonstrations of other sizes.
    """
    # Evaluations would reset the learner's environment amid an episode: they have their own.
    with closing(make_env()) as env, closing(make_env()) as evaluation_env:
        check_sizes(env, demonstrations)
        observations = np.concatenate([e.observations for e in demonstrations])
        mean = observations.mean(axis=0)
        spread = observations.std(axis=0)
        scale = np.where(spread > 1e-3, spread, 1.0).astype(np.float32)
        view = Standardised(env, mean, scale)

        formats = ["csv"]
        if find_spec("tensorboard"):
            formats.append("tensorboard")
        learner = make_learner(Monitor(view), settings.seed)
        learner.set_logger(configure(str(out / "log"), formats))
        fill_buffer(learner, demonstrations, view)
        cloning_update = clone(learner, settings.cloning_updates, settings.seed, progress)
        if settings.steps:
            # Critics learn the value of the clone first, while the actor stays as it is.
            learner.actor.requires_grad_(False)
            learner.train(min(CRITIC_UPDATES, settings.cloning_updates), BATCH)
            learner.actor.requires_grad_(True)
            evaluations = EvalCallback(
                Monitor(Standardised(evaluation_env, mean, scale)),
                n_eval_episodes=settings.evaluation_episodes,
                eval_freq=settings.evaluate_every,
                log_path=str(out / "log"),
                best_model_save_path=str(out),
                verbose=0,
            )
            evaluations.eval_env.seed(settings.seed + 1)

            def after_step(variables: dict[str, Any], _: Any) -> bool:
                cloning_update()
                done = variables["self"].num_timesteps
                progress(min(done, settings.steps), settings.steps)
                return True

            learner.learn(settings.steps, [evaluations, ConvertCallback(after_step)])
        was_evaluated = settings.steps >= settings.evaluate_every
        if was_evaluated:
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
                    f"demonstration {n} has {name} of {size} numbers, "
                    f"the environment {space.shape[0]}"
                )


def fill_buffer(learner: SAC, episodes: Sequence[Episode], view: Standardised) -> None:
    """Add episodes to a learner's replay buffer, as if the learner had acted in them."""
    assert learner.replay_buffer is not None
    space: Any = learner.action_space
    for episode in episodes:
        observations = view.observation(episode.observations)
        actions = learner.policy.scale_action(np.clip(episode.actions, space.low, space.high))
        is_last = np.arange(len(episode.rewards)) == len(episode.rewards) - 1
        for t, reward in enumerate(episode.rewards):
            truncated = bool(is_last[t]) and not episode.info.get("terminated", False)
            learner.replay_buffer.add(
                observations[[t]],
                observations[[t + 1]],
                actions[[t]],
                reward=np.array([reward]),
                done=is_last[[t]],
                infos=[{"TimeLimit.truncated": truncated}],
            )


def clone(
    learner: SAC, updates: int, seed: int = 0, progress: Progress = lambda *_: None
) -> Callable[[], None]:
    """Fit a learner's actor to the actions in its replay buffer; return a function that makes one more update."""
    buffer = learner.replay_buffer
    actor = learner.actor
    assert buffer is not None
    observations = torch.as_tensor(buffer.observations[: buffer.size(), 0].copy())
    actions = torch.as_tensor(buffer.actions[: buffer.size(), 0].copy())
    log_std_layer: Any = actor.log_std
    with torch.no_grad():
        log_std_layer.weight.zero_()
        log_std_layer.bias.fill_(LOG_STD)
    weights = [w for name, w in actor.named_parameters() if "log_std" not in name]
    optimiser = torch.optim.Adam(weights, lr=CLONING_RATE)
    decay = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, updates)
    generator = torch.Generator().manual_seed(seed)

    def update() -> None:
        batch = torch.randint(len(actions), (BATCH,), generator=generator)
        mean = torch.tanh(actor.get_action_dist_params(observations[batch])[0])
        optimiser.zero_grad()
        ((mean - actions[batch]) ** 2).mean().backward()  # type: ignore[no-untyped-call]
        optimiser.step()

    for n in range(updates):
        update()
        decay.step()
        progress(n + 1, updates)
    optimiser.param_groups[0]["lr"] = LATER_CLONING_RATE
    return update


def export(learner: SAC, view: Standardised) -> NetworkPolicy:
    """Return the learner's policy without noise; it takes observations that are not standardised."""
    layers = []
    for part in (*learner.actor.latent_pi, learner.actor.mu):
        if isinstance(part, torch.nn.Linear):
            weights = part.weight.detach().cpu().numpy().copy()
            bias = part.bias.detach().cpu().numpy().copy()
            layers.append((weights, bias))
    policy = NetworkPolicy(layers, mean=view.mean, scale=view.scale, trained_in=describe(view.env))
    return policy.fit_to(view.env, "the agent")
