"""The best that acting on a contact could do: a reflex that is told when something touches the arm."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, SupportsFloat

import gymnasium as gym

from asm_gym.faults import Fault
from asm_gym.policies.reflexes import Begun, Hold

STAYS_S = 0.5
"""For so long after the last substep in which something pressed the arm stays [s]."""


class OracleReflex(gym.Wrapper[Any, Any, Any, Any]):
    """Stays in every step in which one of ``faults`` acts, from its first physics substep on; no monitor is as quick.

    Args:
        env: of this package, with the faults injected inside.
        faults: what to react to.
        beyond: contact force [N] to react to as well, as the simulator knows it: the arm stays from the physics substep
            after that in which it was more.
    """

    def __init__(self, env: gym.Env[Any, Any], faults: Sequence[Fault] = (), beyond: float = math.inf) -> None:
        super().__init__(env)
        self._faults, self._hold, self._beyond = tuple(faults), Hold(env), beyond
        self._arm: Any = env.unwrapped
        self._state: Begun | None = None

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        self._steps, self._pressed, self._state = 0, -math.inf, None
        return self.env.reset(**kwargs)

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        pressed = self._steps - self._pressed <= STAYS_S * self._arm.metadata["render_fps"]
        touched = pressed or any(fault.active(self._steps) for fault in self._faults)
        if touched:
            self._state = self._state or self._hold.begin(action)
            action, self._state = self._hold.predict(None, self._state)
        else:
            self._state = None
        self._action, self._stays = action, touched
        if math.isfinite(self._beyond):
            self._arm.substep_hooks.append(self._feel)
        try:
            *rest, info = self.env.step(action)
        finally:
            if self._feel in self._arm.substep_hooks:
                self._arm.substep_hooks.remove(self._feel)
        self._steps += 1
        return *rest, info | {"overridden": touched}

    def _feel(self, substep: int) -> None:
        """After a physics substep."""
        if self._arm.simulation.contact_forces[-1] <= self._beyond:
            return
        self._pressed = self._steps
        if not self._stays:
            self._stays = self._arm.holding = True
            self._arm.command(self._action)
