"""What the controllers and the torque estimate know of the robot, whatever a fault makes of its masses."""

from __future__ import annotations

import copy

import mujoco
import numpy as np
from numpy.typing import NDArray

from asm_gym.envs import compiled_substeps as kernels
from asm_gym.envs.mujoco_views import NominalViews, Views

_INERTIA = ("body_mass", "body_inertia", "body_ipos", "body_iquat")
"""Whoever edits these in the model edits the world, not the robot's knowledge of it."""


class NominalDynamics:
    """The dynamics of one model as it was loaded.

    Args:
        model: the live one, which others may edit.
        views: of the model and its data.
        robots: (R,) the bodies of the robots.
    """

    def __init__(self, model: mujoco.MjModel, views: Views, robots: NDArray[np.int64]) -> None:
        self._model, self._robots = model, robots
        self._live = {name: getattr(model, name).reshape(model.nbody, -1) for name in _INERTIA}
        self._frozen = {name: live.copy() for name, live in self._live.items()}
        v = views
        self.unedited = NominalViews(0, 0, v.qpos, v.qvel, v.mass, v.bias, v.damping.copy())
        """Those of the live model, which hold while its masses are as they were."""
        self._copy: tuple[mujoco.MjModel, mujoco.MjData, NominalViews] | None = None

    def now(self) -> NominalViews:
        """Those of the live model, and of a copy as soon as somebody has edited the robots' masses."""
        if not any(kernels.edited(self._live[n], self._frozen[n], self._robots) for n in _INERTIA):
            return self.unedited
        if self._copy is None:
            model = copy.copy(self._model)
            for name in _INERTIA:
                getattr(model, name)[:] = self._frozen[name].reshape(getattr(model, name).shape)
            data = mujoco.MjData(model)
            addresses, motion = (model._address, data._address), (data.qpos, data.qvel, data.qM)
            nominal = NominalViews(*addresses, *motion, np.zeros(model.nv), self.unedited.damping)
            self._copy = model, data, nominal
        return self._copy[2]
