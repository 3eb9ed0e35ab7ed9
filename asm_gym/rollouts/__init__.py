"""Runs episodes: trials, collections, folders of runs, parallel work."""

from asm_gym.rollouts.body import harmless
from asm_gym.rollouts.collect import collect
from asm_gym.rollouts.parallel import ParallelConfig, parallel_map
from asm_gym.rollouts.trial import RolloutConfig, Trial

__all__ = ["ParallelConfig", "RolloutConfig", "Trial", "collect", "harmless", "parallel_map"]
