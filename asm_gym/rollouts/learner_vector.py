"""A vector environment of Gymnasium, guarded or not, as stable-baselines3's learners take it."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from asm_gym.control_period import layers
from asm_gym.exceptions import UnsupportedEnvironment
from asm_gym.guard.step_info import LazyInfo


class LearnerVector(VecEnv):
    """The members of a vector environment, for a learner of stable-baselines3.

    ``VectorNeuralASMSafety`` guards all members in one call, which costs less than a guard for each. A member whose
    episode has ended begins the next one in the same step, as stable-baselines3 expects.

    Args:
        envs: made with ``autoreset_mode=AutoresetMode.DISABLED``.

    Raises:
        UnsupportedEnvironment: another autoreset mode.

    Example:
        >>> import gymnasium as gym
        >>> from stable_baselines3 import PPO
        >>> from asm_gym import VectorNeuralASMSafety
        >>> from asm_gym.rollouts.learner_vector import LearnerVector
        >>> envs = gym.make_vec("asm_gym/Lift-v0", 2, autoreset_mode=gym.vector.AutoresetMode.DISABLED)
        >>> agent = PPO("MlpPolicy", LearnerVector(VectorNeuralASMSafety(envs)), n_steps=32, batch_size=64)
        >>> agent.learn(64).num_timesteps
        64
    """

    def __init__(self, envs: VectorEnv[Any, Any, Any]) -> None:
        mode = AutoresetMode(envs.metadata.get("autoreset_mode", AutoresetMode.NEXT_STEP))
        if mode != AutoresetMode.DISABLED:
            raise UnsupportedEnvironment(
                f"a learner's vector resets its members itself, got autoreset_mode {mode.name}",
                advice="make it with autoreset_mode=gymnasium.vector.AutoresetMode.DISABLED",
            )
        self.envs = envs
        self._members: Any = envs.unwrapped
        super().__init__(envs.num_envs, envs.single_observation_space, envs.single_action_space)

    def reset(self) -> Any:
        """Begin an episode of each member; return their observations."""
        seeds: Any = None
        if self._seeds[0] is not None:
            seeds = list(self._seeds)
        observations, infos = self.envs.reset(seed=seeds)
        self.reset_infos = of_each(infos, self.num_envs)
        self._reset_seeds()
        self._reset_options()
        return observations

    def step_async(self, actions: NDArray[Any]) -> None:
        """Take up the actions (n, A) of a step."""
        self._actions = actions

    def step_wait(self) -> Any:
        """Step all members, and begin the next episode of those that ended."""
        observations, rewards, terminated, truncated, infos = self.envs.step(self._actions)
        ended = np.asarray(terminated | truncated, bool)
        info_of_each = of_each(infos, self.num_envs)
        if ended.any():
            for member in np.flatnonzero(ended):
                info = info_of_each[member]
                info["terminal_observation"] = np.array(observations[member])
                info["TimeLimit.truncated"] = bool(truncated[member] and not terminated[member])
            observations, fresh = self.envs.reset(options={"reset_mask": ended})
            begun = of_each(fresh, self.num_envs)
            for member in np.flatnonzero(ended):
                self.reset_infos[member] = begun[member]
        return observations, np.asarray(rewards, np.float32), ended, info_of_each

    def close(self) -> None:
        self.envs.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return an attribute of the members, or else of the vector, once for each."""
        if hasattr(self.envs, attr_name):
            values = [getattr(self.envs, attr_name)] * self.num_envs
        else:
            values = list(self._members.get_attr(attr_name))
        return [values[member] for member in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set an attribute of the vector."""
        setattr(self.envs, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of each member."""
        results = self._members.call(method_name, *method_args, **method_kwargs)
        return [results[member] for member in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """Return whether the vector is wrapped so, once for each member."""
        wrapped = any(isinstance(layer, wrapper_class) for layer in layers(self.envs))
        return [wrapped for _ in self._get_indices(indices)]


def of_each(infos: dict[str, Any], count: int) -> list[dict[str, Any]]:
    """Return the infos of each of ``count`` members; ``asm`` is read when it is asked for."""
    arrays = {
        name: values
        for name, values in infos.items()
        if isinstance(values, np.ndarray) and not name.startswith("_")
    }
    members = [{name: values[n] for name, values in arrays.items()} for n in range(count)]
    asm = infos.get("asm")
    if asm is not None:
        # ``dict.copy`` would read ``asm``, and so make the rest
        written = list(dict.items(asm))
        for n, member in enumerate(members):
            member["asm"] = LazyInfo(partial(_of_member, asm, n))
            for name, values in written:
                member["asm"][name] = _of_member(values, n)
    return members


def _of_member(values: Any, member: int) -> Any:
    if isinstance(values, dict):
        return {name: _of_member(value, member) for name, value in values.items()}
    if values is None:
        return None
    return values[member]
