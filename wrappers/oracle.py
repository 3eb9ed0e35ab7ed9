"""The best that acting on a contact could do: a reflex that is told when something touches the arm."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, SupportsFloat

import gymnasium as gym

from asm_gym.faults import Fault
from asm_gym.policies.holding import Begun, Hold


class OracleReflex(gym.Wrapper[Any, Any, Any, Any]):
    """Stays in every step in which one of ``faults`` acts, from its first physics substep on; no monitor is as quick.

    Args:
        env: of this package, with the faults injected inside.
        faults: what to react to.
    """

    def __init__(self, env: gym.Env[Any, Any], faults: Sequence[Fault]) -> None:
        super().__init__(env)
        self._faults, self._hold = tuple(faults), Hold(env)
        self._state: Begun | None = None

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        self._steps, self._state = 0, None
        return self.env.reset(**kwargs)

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        touched = any(fault.active(self._steps) for fault in self._faults)
        if touched:
            self._state = self._state or self._hold.begin(action)
            action, self._state = self._hold.predict(None, self._state)
        else:
            self._state = None
        self._steps += 1
        *rest, info = self.env.step(action)
        return *rest, info | {"overridden": touched}
