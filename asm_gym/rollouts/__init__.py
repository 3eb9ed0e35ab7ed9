"""Run episodes: trials, collections, folders of runs, parallel work."""

from typing import Any

from asm_gym.extras import needed_for

with needed_for("running episodes"):
    from asm_gym.rollouts.parallel import parallel_map
try:
    with needed_for("a robosuite environment or a fault in one"):
        from asm_gym.rollouts.collect import collect
        from asm_gym.rollouts.pretraining.healthy import harmless
        from asm_gym.rollouts.trial import RolloutConfig, Trial
except ImportError as error:
    # An install for logs has no simulator; the missing package is named when one of these is accessed. They are not
    # imported on access, as in ``asm_gym.wrappers``: ``collect`` is a module too, which would be found first.
    _missing = error

__all__ = ["RolloutConfig", "Trial", "collect", "harmless", "parallel_map"]


def __getattr__(name: str) -> Any:
    raise _missing if name in __all__ else AttributeError(f"module {__name__!r} has no attribute {name!r}")
