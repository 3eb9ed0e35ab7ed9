"""Registries: rows by name, such as tasks, faults, monitors, policies, reflexes and sources.

    KINDS: Registry[Kind] = Registry("kind of fault", "asm_gym.faults.suite:KINDS", {"push": make_push})
    KINDS.register("shake", make)                       raises where the name is taken
    KINDS.find("shaek")                                 raises, and names the nearest known one

Rows that are added to a registry after it was made travel with the work into other processes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any, TypeVar

from asm_gym.extras import needed_for
from asm_gym.validation import check_choice, check_text

Row = TypeVar("Row")
Result = TypeVar("Result")

Added = dict[str, dict[str, Any]]  # added rows by name, by the place of their registry

_REGISTRIES: dict[str, Registry[Any]] = {}


class Registry(dict[str, Row]):
    """Rows by name, called ``what`` in messages; ``where`` is ``module:name`` of the registry itself."""

    def __init__(self, what: str, where: str, rows: Mapping[str, Row] | None = None) -> None:
        super().__init__(rows or {})
        self.what = what
        self.own = frozenset(self)  # names of the rows that it was made with
        _REGISTRIES[where] = self

    def register(self, name: str, row: Row) -> None:
        """Add a row; raise ValueError where the name is taken or no name."""
        if check_text(f"the name of a {self.what}", name) in self:
            raise ValueError(f"there is a {self.what} {name!r} already")
        self[name] = row

    def find(self, name: str) -> Row:
        """Return the row of a name; raise ValueError, listing the known names, where there is none."""
        check_choice(self.what, name, self)
        return self[name]


def added() -> Added:
    """Return the rows that were added to each registry of this process."""
    new: Added = {}
    for where, registry in _REGISTRIES.items():
        rows = {name: row for name, row in registry.items() if name not in registry.own}
        if rows:
            new[where] = rows
    return new


def knowing(rows: Added, task: Callable[[Any], Result], item: Any) -> Result:
    """Return ``task(item)``, in a process that first adds these rows."""
    for where, own in rows.items():
        target(where).update(own)
    return task(item)


def target(place: Any) -> Any:
    """Return the object that ``module:name`` names; any other object is returned as it is.

    Raises:
        ImportError: there is no such module; the message says what installs it.
        ValueError: the module has no such name.
    """
    if not isinstance(place, str):
        return place
    module, _, name = place.partition(":")
    with needed_for(name):
        home = import_module(module)
    if not hasattr(home, name):
        raise ValueError(f"module {module} has no {name!r}")
    return getattr(home, name)
