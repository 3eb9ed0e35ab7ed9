"""Everything that acts, behind stable-baselines3's ``predict``."""

from asm_gym.policies.policy import Policy, PolicyState, rollout
from asm_gym.policies.registry import POLICIES, make_policy

__all__ = ["POLICIES", "Policy", "PolicyState", "make_policy", "rollout"]
