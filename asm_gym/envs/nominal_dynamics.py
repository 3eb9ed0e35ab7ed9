"""The robots' own model of their dynamics, which faults in the simulated world do not change."""

from __future__ import annotations

import copy

import mujoco
import numpy as np

from asm_gym.envs import compiled_substeps as kernels
from asm_gym.envs.mujoco_views import Ints, NominalViews, Views


class NominalDynamics:
    """The robots' own model of their dynamics, frozen when the model was loaded.

    A fault that edits masses in the live model edits the world, and not the knowledge of the robots.

    Args:
        model: the loaded model.
        views: its arrays.
        robots: (R,) bodies of the robots.
    """

    _INERTIA = ("body_mass", "body_inertia", "body_ipos", "body_iquat")

    def __init__(self, model: mujoco.MjModel, views: Views, robots: Ints) -> None:
        self._model = model
        self._robots = robots
        inertia = [getattr(model, name) for name in self._INERTIA]
        self._live = tuple(array.reshape(model.nbody, -1) for array in inertia)
        self._frozen = tuple(live.copy() for live in self._live)
        self.unedited = NominalViews(
            model=0,
            data=0,
            qpos=views.qpos,
            qvel=views.qvel,
            mass=views.M,
            bias=views.qfrc_bias,
            bias_at=0,
            damping=views.dof_damping.copy(),
        )
        """Views of the live model, valid while the robots' masses are as they were loaded."""
        self._copy: tuple[mujoco.MjModel, mujoco.MjData, NominalViews] | None = None

    def now(self) -> NominalViews:
        """Return views of the live model, or of a copy once somebody has edited the robots' masses."""
        if not kernels.edited(self._live, self._frozen, self._robots):
            return self.unedited
        if self._copy is None:
            self._copy = self._frozen_copy()
        return self._copy[2]

    def _frozen_copy(self) -> tuple[mujoco.MjModel, mujoco.MjData, NominalViews]:
        """Return a model with the robots' masses as they were loaded, its data, and views of both."""
        model = copy.copy(self._model)
        for name, frozen in zip(self._INERTIA, self._frozen, strict=True):
            getattr(model, name)[:] = frozen.reshape(getattr(model, name).shape)

        data = mujoco.MjData(model)
        bias = np.zeros(model.nv)
        views = NominalViews(
            model=model._address,
            data=data._address,
            qpos=data.qpos,
            qvel=data.qvel,
            mass=data.M,
            bias=bias,
            bias_at=bias.ctypes.data,
            damping=self.unedited.damping,
        )
        return model, data, views
