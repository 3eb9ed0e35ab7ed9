"""Registries: rows by name. What is added to one after it was made travels with work into other processes.

    KINDS = registry("asm_gym.faults.suite:KINDS", {...})

    register_task("Reach", "mypackage:ReachEnv", horizon=200)      asm_gym evaluate --tasks Reach
    register_fault("shake", make)                                  --faults shake
    register_monitor("persistence", Persistence)                   --monitors persistence
    register_policy("reacher", "mypackage:Reacher")                --policy reacher

All take a name and what makes it: an object, or ``module:name``, which is imported when it is needed.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Any, NamedTuple, TypeVar

from asm_gym.extras import needed_for
from asm_gym.validation import check_text

Row = TypeVar("Row")

Added = dict[str, dict[str, Any]]
"""Rows by name, by where their registry stands."""


class _Known(NamedTuple):
    rows: dict[str, Any]
    own: frozenset[str]  # names that were there when it was made


_REGISTRIES: dict[str, _Known] = {}


def registry(where: str, rows: dict[str, Row]) -> dict[str, Row]:
    """The same rows, of which those that are added from now on are known as ``added``.

    Args:
        where: ``module:name`` of the registry.
    """
    _REGISTRIES[where] = _Known(rows, frozenset(rows))
    return rows


def add(what: str, rows: dict[str, Row], name: str, row: Row) -> None:
    """Raises ValueError where the name is taken, or none."""
    if check_text(f"the name of a {what}", name) in rows:
        raise ValueError(f"there is a {what} {name!r} already")
    rows[name] = row


def added() -> Added:
    """What was added to each registry of this process."""
    found = {where: {n: row for n, row in rows.items() if n not in own} for where, (rows, own) in _REGISTRIES.items()}
    return {where: rows for where, rows in found.items() if rows}


def take(rows: Added) -> None:
    """Adds what another process had added."""
    for where, own in rows.items():
        target(where).update(own)


def knowing(rows: Added, task: Callable[[Any], Row], item: Any) -> Row:
    """``task(item)``, in a process that need not know of these rows yet."""
    take(rows)
    return task(item)


def target(found: Any) -> Any:
    """What ``module:name`` stands for; anything else is itself.

    Raises:
        ImportError: there is no such module; the message says what brings it.
        ValueError: the module has no such name.
    """
    if not isinstance(found, str):
        return found
    module, _, name = found.partition(":")
    with needed_for(name):
        home = import_module(module)
    if not hasattr(home, name):
        raise ValueError(f"module {module} has no {name!r}")
    return getattr(home, name)
