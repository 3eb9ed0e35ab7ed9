"""Infos of environments that run side by side: what one of them said, and one row exchanged for another."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from copy import deepcopy
from typing import Any

import numpy as np
from numpy.typing import NDArray

Mask = NDArray[np.bool_]


def put(batch: Any, i: int, value: Any) -> Any:
    """A copy of a batch, an array or a dict of such, with ``value`` at ``i``."""
    if isinstance(batch, dict):
        return {key: put(part, i, value[key]) for key, part in batch.items()}
    changed = np.array(batch)
    changed[i] = value
    return changed


def replace(infos: dict[str, Any], by: dict[str, Any], mask: Mask, keep: Collection[str] = ()) -> dict[str, Any]:
    """Infos in which the environments of ``mask`` (n,) have what ``by`` says of them, and nothing else.

    Args:
        keep: keys, with their masks, to leave as they are.
    """
    merged = dict(infos)
    for key in infos.keys() | by.keys():
        if key.removeprefix("_") in keep:
            continue
        old, new = infos.get(key), by.get(key)
        if isinstance(old, dict) or isinstance(new, dict):
            merged[key] = replace(old or {}, new or {}, mask)
            continue
        old = _blank(new) if old is None else old
        new = _blank(old) if new is None else new
        merged[key] = np.where(mask.reshape(-1, *[1] * (old.ndim - 1)), new, old)
    return merged


def final(infos: dict[str, Any], observations: Sequence[Any], mask: Mask) -> dict[str, Any]:
    """Infos with ``final_obs`` and ``final_info`` of the environments of ``mask`` (n,), from what is theirs now."""
    ends = ("final_obs", "final_info", "_final_obs", "_final_info")
    now = {key: value for key, value in infos.items() if key not in ends}
    last = np.array(infos.get("final_obs", np.full(len(mask), None, object)))
    for i in np.flatnonzero(mask):
        last[i] = deepcopy(observations[i])
    known = {"_final_obs": mask | infos.get("_final_obs", False), "_final_info": mask | infos.get("_final_info", False)}
    return {**infos, **known, "final_obs": last, "final_info": replace(infos.get("final_info", {}), now, mask)}


def _blank(like: Any) -> NDArray[Any]:
    return np.full(like.shape, None, object) if like.dtype == object else np.zeros_like(like)


def said_by(infos: dict[str, Any], i: int, last: bool, names: tuple[str, ...]) -> dict[str, Any]:
    """What environment ``i`` said of ``names`` in its step, the ``last`` of an episode or not."""
    said = infos.get("final_info", {}) if last else infos
    there = {name: said.get(f"_{name}") for name in names if name in said}
    return {name: said[name][i] for name, mask in there.items() if mask is None or mask[i]}
