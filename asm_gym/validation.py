"""Check arguments at the public boundary: refuse them in one line that names the argument and what it was.

Numbers lie within bounds (NaN and booleans are none), names exist, and ``typed`` compares arguments with a function's
annotations: classes, methods of protocols, unions of them and items of sequences. It leaves numbers to
``check_number``, and skips names that a module imports for type checkers only.
"""

from __future__ import annotations

import difflib
import inspect
import math
import operator
import sys
import typing
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from functools import cache, wraps
from numbers import Integral, Real
from types import SimpleNamespace, UnionType
from typing import (
    Any,
    Literal,
    NamedTuple,
    ParamSpec,
    TypeVar,
    get_args,
    get_origin,
    get_type_hints,
)

import numpy as np
from numpy.typing import ArrayLike, NDArray

P = ParamSpec("P")
R = TypeVar("R")
SHOWN_CHARACTERS = 80  # characters of a refused value that a message shows
UNCHECKED = (int, float, bool, np.ndarray, object, Any)  # by ``typed``


class _Bound(NamedTuple):
    """One kind of bound of a number."""

    holds: Callable[[float, float], bool]
    words: str  # of a message
    bracket: str  # of an interval


# The lower ones first, as an interval shows them.
BOUNDS = {
    "low": _Bound(operator.ge, "of at least", "["),
    "above": _Bound(operator.gt, "above", "("),
    "high": _Bound(operator.le, "of at most", "]"),
    "below": _Bound(operator.lt, "below", ")"),
}


@typing.overload
def check_number(
    name: str,
    value: object,
    *,
    whole: Literal[True],
    infinite: bool = False,
    **bounds: float | None,
) -> int: ...


@typing.overload
def check_number(
    name: str,
    value: object,
    *,
    whole: Literal[False] = False,
    infinite: bool = False,
    **bounds: float | None,
) -> float: ...


def check_number(
    name: str, value: object, *, whole: bool = False, infinite: bool = False, **bounds: float | None
) -> float:
    """Return ``value`` as a Python number within ``bounds``.

    It must be ``whole``, or may be ``infinite``, where that is said. ``low`` and ``high`` are
    allowed, ``above`` and ``below`` are not.

    Raises:
        ValueError: it is no such number; the message begins with ``name``.
    """
    kind: type = Real
    noun = "number"
    if whole:
        kind = Integral
        noun = "whole number"
    if isinstance(value, bool | np.bool_) or not isinstance(value, kind):
        raise _refused(name, noun, bounds, value)
    convert: Any = float
    if isinstance(value, Integral):
        convert = int
    number: float = convert(value)
    # NaN alone differs from itself; math.isnan takes no integer of thousands of digits.
    if number != number or not _within(number, bounds):
        raise _refused(name, noun, bounds, value)
    if not infinite and abs(number) > sys.float_info.max:  # NumPy would convert a long integer
        raise ValueError(f"{name} must be finite, got {short_repr(value)}")
    return number


def _refused(name: str, noun: str, bounds: Mapping[str, float | None], value: object) -> ValueError:
    """Return the error of a value that is no such number."""
    return ValueError(f"{name} must be a {_described(noun, bounds)}, got {short_repr(value)}")


def check_numbers(
    name: str, values: ArrayLike, *shape: int, **bounds: float | None
) -> NDArray[np.float64]:
    """Return ``values`` as float64. Raises ValueError unless they are finite, within bounds and of this shape."""
    wanted = f"{_described('finite numbers', bounds)} in the shape {shape}"
    try:
        given: NDArray[Any] = np.asarray(values)
    except ValueError:  # rows of several lengths
        given = np.array(None)
    if given.dtype.kind not in "iuf" or given.shape != shape:
        raise ValueError(f"{name} must be {wanted}, got {short_repr(values)}")
    array = given.astype(np.float64)
    for number in array.ravel().tolist():
        if not math.isfinite(number) or not _within(number, bounds):
            raise ValueError(f"{name} must be {wanted}, got {short_repr(number)} among them")
    return array


def check_shapes(arrays: Mapping[str, NDArray[Any]], shapes: Mapping[str, tuple[int, ...]]) -> None:
    """Raise ValueError naming an array that is missing or of another shape."""
    for name, shape in shapes.items():
        got = getattr(arrays.get(name), "shape", "none")
        if got != shape:
            raise ValueError(f"{name} should be of shape {shape}, found {got}")


def check_text(name: str, value: object) -> str:
    """Return ``value``. Raises ValueError unless it is a string that is not empty."""
    if not isinstance(value, str) or not value:
        raise ValueError(f"{name} must be a name, got {short_repr(value)}")
    return value


def check_flag(name: str, value: object) -> bool:
    """Return ``value``. Raises ValueError unless it is True or False."""
    if not isinstance(value, (bool, np.bool_)):
        raise ValueError(f"{name} must be True or False, got {short_repr(value)}")
    return bool(value)


def check_choice(what: str, got: Any, known: Iterable[Any]) -> None:
    """Raise ValueError unless ``got`` is one of ``known``, naming them all and the nearest."""
    names = list(known)
    with suppress(ValueError):  # of arrays, which compare number by number
        if got in names:
            return
    known_names = list(map(str, names))
    hint = ""
    if isinstance(got, str):
        for near in difflib.get_close_matches(got[:SHOWN_CHARACTERS], known_names, 1):
            hint = f"; did you mean {near!r}?"
    raise ValueError(f"unknown {what} {short_repr(got)}; known: {', '.join(known_names)}{hint}")


def as_float32(values: ArrayLike, name: str = "values") -> NDArray[np.float32]:
    """Return ``values`` as float32, infinite where too large. Raises ValueError where they are no array of numbers."""
    if type(values) is np.ndarray and values.dtype == np.float32:
        return values
    if isinstance(values, np.ma.MaskedArray) and bool(np.any(values.mask)):
        raise ValueError(f"{name} must be numbers, and some are masked: {short_repr(values)}")
    try:
        given: NDArray[Any] = np.asarray(values)
        # Complex numbers would lose a part, and text would pass for numbers.
        if given.dtype.kind not in "biufO":
            raise TypeError(given.dtype)
        with np.errstate(over="ignore"):
            return given.astype(np.float32)
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"{name} must be numbers, got {short_repr(values)}") from error


def short_repr(value: object) -> str:
    """Return ``value`` as a message shows it: in full where it is short."""
    if isinstance(value, np.generic):
        value = value.item()
    try:
        text = repr(value)
    except ValueError:  # more digits than Python converts
        return "a number of thousands of digits"
    if len(text) > SHOWN_CHARACTERS:
        return f"{text[: SHOWN_CHARACTERS - 1]}…"
    return text


class ArgumentTypeError(TypeError, ValueError):
    """An argument is of another type than annotated: no value of it would do."""


def typed(call: Callable[P, R]) -> Callable[P, R]:
    """Return ``call``, which first raises an ``ArgumentTypeError`` for an argument of another type than annotated."""
    signature = inspect.signature(call)

    @wraps(call)
    def checked(*args: P.args, **kwargs: P.kwargs) -> R:
        kinds = _kinds(call)
        for name, value in signature.bind(*args, **kwargs).arguments.items():
            if name in kinds and not _fits(value, kinds[name]):
                wanted = signature.parameters[name].annotation
                if _is_union(kinds[name]):  # which may be hidden by an alias
                    wanted = _in_words(kinds[name])
                raise ArgumentTypeError(f"{name} must be {wanted}, got {short_repr(value)}")
        return call(*args, **kwargs)

    return checked


@cache
def _kinds(call: Callable[..., Any]) -> dict[str, Any]:
    """Return the annotated type of each parameter, where it is known at run time."""
    several = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
    namespace: dict[str, Any] = getattr(inspect.unwrap(call), "__globals__", {})
    kinds: dict[str, Any] = {}
    for name, parameter in inspect.signature(call).parameters.items():
        if parameter.kind in several or parameter.annotation is inspect.Parameter.empty:
            continue
        annotated = SimpleNamespace(__annotations__={name: parameter.annotation})
        with suppress(NameError):  # imported for type checkers only
            kinds |= get_type_hints(annotated, namespace)
    return kinds


def _fits(value: Any, kind: Any) -> bool:
    """Return whether a value is of an annotated type."""
    origin = get_origin(kind) or kind
    if _is_union(kind):
        return any(_fits(value, each) for each in get_args(kind))
    if origin is Sequence:
        (item_kind,) = get_args(kind)
        return _is_listed(value) and all(_fits(item, item_kind) for item in value)
    if origin in UNCHECKED or not isinstance(origin, type):
        return True
    if getattr(origin, "_is_protocol", False):
        return all(callable(getattr(value, name, None)) for name in _methods(origin))
    return isinstance(value, origin)


def _is_union(kind: Any) -> bool:
    return get_origin(kind) in (typing.Union, UnionType)


def _in_words(kind: Any) -> str:
    """Return an annotated type as a message names it, such as ``str, an object with predict() or a function``."""
    if _is_union(kind):
        *others, last = [_in_words(each) for each in get_args(kind)]
        return f"{', '.join(others)} or {last}"
    origin = get_origin(kind) or kind
    if origin is Callable:
        return "a function"
    if getattr(origin, "_is_protocol", False):
        methods = [f"{method}()" for method in _methods(origin)]
        return f"an object with {' and '.join(methods)}"
    if origin is type(None):
        return "None"
    return getattr(origin, "__name__", str(kind))


def _is_listed(value: Any) -> bool:
    """Return whether a value has items in an order, and is no text."""
    if isinstance(value, str | bytes | dict | set):
        return False
    return hasattr(value, "__len__") and getattr(value, "ndim", 1) > 0


@cache
def _methods(protocol: type) -> list[str]:
    """Return the public methods; properties are not asked for, since asking runs them."""
    methods = inspect.getmembers_static(protocol, inspect.isfunction)
    return [name for name, _ in methods if not name.startswith("_")]


def _within(number: float, bounds: Mapping[str, float | None]) -> bool:
    """Return whether a number lies within its bounds."""
    given = {name: bound for name, bound in bounds.items() if bound is not None}
    return all(BOUNDS[name].holds(number, bound) for name, bound in given.items())


def _described(what: str, bounds: Mapping[str, float | None]) -> str:
    """Return for example ``whole number of at least 1``, or ``number in (0, 1]``."""
    given = []
    for name, bound in BOUNDS.items():
        number = bounds.get(name)
        if number is not None:
            given.append((bound, number))
    if len(given) == 2:
        (lower, least), (upper, greatest) = given
        return f"{what} in {lower.bracket}{least:g}, {greatest:g}{upper.bracket}"
    for bound, number in given:
        return f"{what} {bound.words} {number:g}"
    return what
