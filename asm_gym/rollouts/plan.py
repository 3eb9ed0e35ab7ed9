"""The trials of an evaluation: nominal episodes by role, faulty twins of some, and harmless variations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym

from asm_gym.envs.robosuite_env import RobosuiteEnv
from asm_gym.faults import anywhere
from asm_gym.faults.anywhere import FaultyInterface
from asm_gym.faults.suite import KINDS, kinds_of, possible
from asm_gym.policies import make_policy
from asm_gym.rollouts.seeds import draw_onset, role_seeds
from asm_gym.rollouts.trial import EXECUTIONS, RolloutConfig, Trial, faulty_trial, horizon_of, nominal_trials


def kinds_in(env: gym.Env[Any, Any], faults: Sequence[str], harmless: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return the kinds of fault, and of harmless variation, that are possible in ``env``; all faults for none."""
    inner = env.unwrapped
    if not isinstance(inner, RobosuiteEnv):
        FaultyInterface(env)  # refuses spaces that no fault can act on
        return list(faults or anywhere.KINDS), []
    kinds = [k for k in kinds_of(faults or tuple(KINDS)) if possible(k, inner)]
    return kinds, [k for k in harmless if k in EXECUTIONS or possible(k, inner)]


def evaluation_trials(
    env_id: str,
    name: str,
    config: RolloutConfig,
    episodes: Mapping[str, int],
    faults: Sequence[str],
    severities: Sequence[str],
    harmless: Sequence[str],
    seed: int,
) -> list[Trial]:
    """Return every trial of one task.

    Args:
        env_id: of the environment.
        name: of the task; decides the seeds.
        config: how episodes are made, by a policy of a name or a path.
        episodes: how many, by role.
        faults: kinds or splits of the suite; all of them for none.
        severities: of the faults.
        harmless: kinds of harmless variations.
        seed: of the evaluation.

    Raises:
        ValueError: the policy cannot act in the environment.
    """
    env = gym.make(env_id, **dict(config.settings))
    try:
        make_policy(str(config.policy), env, seed=0)
        kinds, variations = kinds_in(env, faults, harmless)
        horizon = horizon_of(env)
    finally:
        env.close()
    seeds = {role: role_seeds(seed, name, role, count) for role, count in episodes.items() if role != "faulty"}
    trials = [t for role in ("fit", "calibration", "nominal") for t in nominal_trials(env_id, role, seeds[role])]
    twins = seeds["nominal"][: episodes["faulty"]]
    trials += [faulty_trial(env_id, k, severity, s, horizon) for k in kinds for severity in severities for s in twins]
    others = seeds["harmless"]
    return trials + [
        Trial(env_id, s, k, onset=draw_onset(s, horizon), role="harmless") for k in variations for s in others
    ]
