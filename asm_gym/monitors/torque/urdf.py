"""Read body models (URDF), pared to the joints of a body and the inertia of its links."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

LARGEST_FILE = 10_000_000  # characters of a file: no arm has more
LEAST_MOMENT = 1e-12  # of inertia [kg m²]

KEPT_PARTS = {
    "robot": ("link", "joint"),
    "joint": ("origin", "parent", "child", "axis", "mimic"),
    "link": ("inertial",),
    "inertial": ("origin", "mass", "inertia"),
}
"""Parts of each element that weight and inertia need."""

TENSOR = (("ixx", "ixy", "ixz"), ("ixy", "iyy", "iyz"), ("ixz", "iyz", "izz"))
"""Names of the entries of an inertia tensor."""


def read_urdf(path: str | Path) -> str:
    """Return the text of a body model, pared to what weight and inertia need.

    Raises:
        ValueError: the file is no URDF.
    """
    with Path(path).open(encoding="utf-8", errors="replace") as file:
        text = file.read(LARGEST_FILE)
    try:
        return ElementTree.tostring(parsed_urdf(text), encoding="unicode")
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def parsed_urdf(text: str) -> Element:
    """Return the pared tree of a body model.

    Raises:
        ValueError: it is no URDF, or declares entities, which could grow without end.
    """
    if "<!DOCTYPE" in text:
        raise ValueError("the body is no URDF: it declares a document type")
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise ValueError(f"the body is no URDF: {error}") from None
    if root.tag != "robot":
        raise ValueError(f"the body is no URDF: its root is <{root.tag}>, not <robot>")
    pared = _pared(root)
    pared.attrib = {"name": root.get("name", "")}
    for inertial in pared.iter("inertial"):
        _mend(inertial)
    return pared


def _pared(element: Element) -> Element:
    """Return a copy of an element with the parts that are kept."""
    copy = Element(element.tag, dict(element.attrib))
    copy.extend(_pared(part) for part in element if part.tag in KEPT_PARTS.get(element.tag, ()))
    return copy


def _mend(inertial: Element) -> None:
    """Turn a tensor into its link's axes, for MuJoCo leaves ``rpy`` of an inertial out, and make it positive."""
    tensor = inertial.find("inertia")
    if tensor is None:
        return
    turn = _turn_of(inertial.find("origin"))
    given = np.array([[float(tensor.get(name, 0.0)) for name in row] for row in TENSOR])
    inertia = turn @ given @ turn.T
    if np.isfinite(inertia).all():
        moments, axes = np.linalg.eigh(inertia)
        inertia = axes * np.maximum(moments, LEAST_MOMENT) @ axes.T
    for name, value in zip(np.ravel(TENSOR), inertia.ravel(), strict=True):
        tensor.set(str(name), repr(float(value)))


def _turn_of(origin: Element | None) -> NDArray[np.float64]:
    """Return the rotation (3, 3) of an origin, and take its ``rpy`` out."""
    from scipy.spatial.transform import Rotation  # takes a while to import

    angles = ""
    if origin is not None:
        angles = origin.attrib.pop("rpy", "")
    angles = angles or "0 0 0"
    return Rotation.from_euler("xyz", [float(word) for word in angles.split()]).as_matrix()
