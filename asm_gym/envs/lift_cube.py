"""The shape of Lift's cube, drawn for every seeded episode in the loaded model instead of loading it anew.

The cube is made as robosuite makes it, from the same generator, and compiled alone. What MuJoCo's compiler finds of
its own shapes is written into the model; what depends on other bodies too, MuJoCo computes as it does after compiling.
"""

from __future__ import annotations

import importlib
from copy import deepcopy
from typing import Any
from xml.etree import ElementTree

import mujoco
import numpy as np
from numpy.typing import NDArray

_OWN = {
    "body": ("mass", "inertia", "ipos", "iquat", "sameframe"),
    "geom": ("size", "pos", "quat", "aabb", "rbound", "friction", "sameframe"),
    "bvh": ("aabb", "child", "depth"),
    "dof": ("length",),
}
"""What the compiler finds of one body's own shapes."""


def draw(env: Any) -> bool:
    """Draw the shape that Lift draws when it is loaded, into its cube and its loaded model.

    Generator, object and every number of the model are then as loading would leave them; the data must be reset.
    False where it was not done: in other tasks, or where others edit the model's text.
    """
    if type(env).__name__ != "Lift" or env._xml_processors != [env.edit_model_xml]:
        return False
    objects: Any = importlib.import_module("robosuite.models.objects")
    # Sized as robosuite 1.5.2 does [m].
    cube = objects.BoxObject("cube", size_min=[0.020] * 3, size_max=[0.022] * 3, rng=env.rng)
    vars(env.cube).update(vars(cube))
    model = env.sim.model._model
    alone = _compiled_alone(env, cube)
    drawn = _rows(alone, alone.body(cube.root_body).id)
    for name, live in _rows(model, model.body(cube.root_body).id).items():
        if live.shape != drawn[name].shape:
            raise RuntimeError(
                f"{name} of the cube has {len(live)} rows, and {len(drawn[name])} when drawn anew"
            )
        live[:] = drawn[name]

    data = env.sim.data._data
    mujoco.mj_resetData(model, data)
    mujoco.mj_setConst(model, data)
    return True


def _compiled_alone(env: Any, thing: Any) -> mujoco.MjModel:
    """A model of one object, compiled under the settings of the task's, without its textures."""
    root = ElementTree.Element("mujoco")
    root.append(deepcopy(env.model.root.find("compiler")))
    world = ElementTree.SubElement(root, "worldbody")
    world.append(thing.get_obj())
    for geom in world.iter("geom"):
        geom.attrib.pop("material", None)
    return mujoco.MjModel.from_xml_string(ElementTree.tostring(root, encoding="unicode"))


def _rows(model: mujoco.MjModel, body: int) -> dict[str, NDArray[np.generic]]:
    """Return views of what the compiler found of one body's own shapes, by name."""
    rows: dict[str, NDArray[np.generic]] = {}
    for kind, names in _OWN.items():
        first = body
        count = 1
        if kind != "body":
            first = int(getattr(model, f"body_{kind}adr")[body])
            count = int(getattr(model, f"body_{kind}num")[body])
        for name in names:
            array = f"{kind}_{name}"
            rows[array] = getattr(model, array)[first : first + count]
    return rows
