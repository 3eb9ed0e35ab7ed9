"""One way to refuse arguments of other types than a function is annotated with.

    @typed
    def load_monitor(path: str | Path) -> CalibratedMonitor: ...

    load_monitor(3)                    ArgumentTypeError: path must be str | Path, got 3

Looked at is what can be told cheaply: classes, methods of protocols, unions of them, items of sequences. Numbers are
not: ``checks`` knows their bounds. Nor are names that a module imports for type checkers only.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from functools import cache, wraps
from types import SimpleNamespace, UnionType
from typing import Any, ParamSpec, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np

from asm_gym.checks import shown

P = ParamSpec("P")
R = TypeVar("R")


class ArgumentTypeError(TypeError, ValueError):
    """An argument of another type than annotated: no value of it would do."""


def typed(call: Callable[P, R]) -> Callable[P, R]:
    """``call``, which raises an ``ArgumentTypeError`` that names argument and value before it begins."""
    signature = inspect.signature(call)

    @wraps(call)
    def checked(*args: P.args, **kwargs: P.kwargs) -> R:
        kinds = _kinds(call)
        for name, value in signature.bind(*args, **kwargs).arguments.items():
            if name in kinds and not _fits(value, kinds[name]):
                raise ArgumentTypeError(f"{name} must be {signature.parameters[name].annotation}, got {shown(value)}")
        return call(*args, **kwargs)

    return checked


@cache
def _kinds(call: Callable[..., Any]) -> dict[str, Any]:
    """What each parameter takes, where that is known at run time."""
    many = inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD
    there: dict[str, Any] = getattr(inspect.unwrap(call), "__globals__", {})
    found: dict[str, Any] = {}
    for name, parameter in inspect.signature(call).parameters.items():
        if parameter.kind in many or parameter.annotation is inspect.Parameter.empty:
            continue
        try:
            found |= get_type_hints(SimpleNamespace(__annotations__={name: parameter.annotation}), there)
        except NameError:  # imported for type checkers only
            continue
    return found


def _fits(value: Any, kind: Any) -> bool:
    origin = get_origin(kind) or kind
    if origin in (Union, UnionType):
        return any(_fits(value, each) for each in get_args(kind))
    if origin in (int, float, bool, np.ndarray):
        return True
    if origin is Sequence:
        return _is_sequence(value) and all(_fits(item, each) for each in get_args(kind) for item in value)
    if not isinstance(origin, type) or origin in (object, Any):
        return True
    if getattr(origin, "_is_protocol", False):
        return all(callable(getattr(value, name, None)) for name in _methods(origin))
    return isinstance(value, origin)


@cache
def _methods(protocol: type) -> list[str]:
    """Its public ones; properties are not asked for, since asking runs them."""
    bases = [base for base in protocol.__mro__ if getattr(base, "_is_protocol", False)]
    return [name for base in bases for name, m in vars(base).items() if inspect.isfunction(m) and name[0] != "_"]


def _is_sequence(value: Any) -> bool:
    try:
        len(value)
    except TypeError:
        return False
    return not isinstance(value, (str, bytes, dict, set))
