"""Objects whose shapes are drawn for every seeded episode, changed in the loaded model instead of loading it anew.

The object is made as robosuite makes it, from the same generator, and compiled alone. What MuJoCo's compiler finds of
its own shapes is written into the model; what depends on other bodies too, MuJoCo computes as it does after compiling.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator
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
    """Draws the shapes that robosuite's task ``env`` draws when it is loaded, into its object and its loaded model.

    Generator, object and every number of the model are then as loading would leave them; the data must be reset.

    Returns:
        Whether it was done: not for tasks that this module does not know, nor where others edit the model's text.
    """
    if env._xml_processors != [env.edit_model_xml]:
        return False
    made = _made(env)
    if made is None:
        return False
    thing, anew = made
    vars(thing).update(vars(anew))
    model, data, alone = env.sim.model._model, env.sim.data._data, _compiled_alone(env, anew)
    bodies = (m.body(thing.root_body).id for m in (model, alone))
    for (name, live), (_, drawn) in zip(*map(_rows, (model, alone), bodies), strict=True):
        if live.shape != drawn.shape:
            raise RuntimeError(f"{name} of {thing.name} has {len(live)} rows, and {len(drawn)} when drawn anew")
        live[:] = drawn
    mujoco.mj_resetData(model, data)
    mujoco.mj_setConst(model, data)
    return True


def _made(env: Any) -> tuple[Any, Any] | None:
    """Return the object whose shape is drawn, and the same drawn anew, sized as robosuite 1.5.2 does [m]."""
    objects = importlib.import_module("robosuite.models.objects")
    task = type(env).__name__
    if task == "Lift":
        return env.cube, objects.BoxObject("cube", size_min=[0.020] * 3, size_max=[0.022] * 3, rng=env.rng)
    if task == "TwoArmPegInHole":
        least, most = ((radius, env.peg_length) for radius in env.peg_radius)
        return env.peg, objects.CylinderObject("peg", size_min=least, size_max=most, joints=None, rng=env.rng)
    return None


def _compiled_alone(env: Any, thing: Any) -> mujoco.MjModel:
    """A model of one object, compiled under the settings of the task's, without its textures."""
    root = ElementTree.Element("mujoco")
    root.append(deepcopy(env.model.root.find("compiler")))
    world = ElementTree.SubElement(root, "worldbody")
    world.append(thing.get_obj())
    for geom in world.iter("geom"):
        geom.attrib.pop("material", None)
    return mujoco.MjModel.from_xml_string(ElementTree.tostring(root, encoding="unicode"))


def _rows(model: mujoco.MjModel, body: int) -> Iterator[tuple[str, NDArray[np.generic]]]:
    """Views of what the compiler found of one body's own shapes."""
    for kind, names in _OWN.items():
        first = body if kind == "body" else int(getattr(model, f"body_{kind}adr")[body])
        count = 1 if kind == "body" else int(getattr(model, f"body_{kind}num")[body])
        for name in names:
            yield f"{kind}_{name}", getattr(model, f"{kind}_{name}")[first : first + count]
