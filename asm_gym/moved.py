"""Modules that have another name now: under the old one they are still found, and say where they went."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Sequence
from importlib import import_module
from importlib.abc import InspectLoader, MetaPathFinder
from importlib.machinery import ModuleSpec
from importlib.util import find_spec
from types import CodeType, ModuleType

MOVED = {
    "asm_gym.faults.catalogue": "asm_gym.faults.base",
    "asm_gym.memory.checkpoint": "asm_gym.checkpoint",
    "asm_gym.memory.senses": "asm_gym.scaling",
}
"""Old name to new name. A package above the core adds its own as it is imported, before any of its modules can be."""


class MovedModules(MetaPathFinder, InspectLoader):
    """Finds a module under its old name, as the very same module, or as code for ``python -m``."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        return ModuleSpec(fullname, self) if fullname in MOVED else None

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        warnings.warn(_said(spec.name), DeprecationWarning, stacklevel=2)
        module = import_module(MOVED[spec.name])
        spec.loader_state = module.__spec__
        return module

    def exec_module(self, module: ModuleType) -> None:
        if module.__spec__ is not None:  # the alias's, which the import system has put in place of the module's own
            module.__spec__ = module.__spec__.loader_state

    def get_code(self, fullname: str) -> CodeType | None:
        warnings.warn(_said(fullname), FutureWarning, stacklevel=2)  # shown to whoever typed it
        spec = find_spec(MOVED[fullname])
        return spec.loader.get_code(spec.name) if spec and isinstance(spec.loader, InspectLoader) else None

    def get_source(self, fullname: str) -> str | None:
        spec = find_spec(MOVED[fullname])
        return spec.loader.get_source(spec.name) if spec and isinstance(spec.loader, InspectLoader) else None


def _said(old: str) -> str:
    return f"{old} is {MOVED[old]} now"


def install() -> None:
    """Looks for modules under their old names, once and last of all."""
    if not any(isinstance(finder, MovedModules) for finder in sys.meta_path):
        sys.meta_path.append(MovedModules())
