"""Refusing at the edge what will not do, in one line that names the argument and what it was.

Numbers within bounds (NaN and booleans are none), names that exist, and arguments of the types that a function is
annotated with:

    @typed
    def load_monitor(path: str | Path) -> CalibratedMonitor: ...

    load_monitor(3)                    ArgumentTypeError: path must be str | Path, got 3

``typed`` looks at what can be told cheaply: classes, methods of protocols, unions of them, items of sequences. Numbers
are not looked at: the checks know their bounds. Nor are names that a module imports for type checkers only.
"""

from __future__ import annotations

import difflib
import inspect
import math
from collections.abc import Callable, Iterable, Sequence
from functools import cache, wraps
from numbers import Integral, Real
from types import SimpleNamespace, UnionType
from typing import Any, Literal, ParamSpec, TypeVar, Union, get_args, get_origin, get_type_hints, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

P = ParamSpec("P")
R = TypeVar("R")

SHOWN = 80
"""How many characters of a refused value a message shows."""


@overload
def check_number(
    name: str,
    value: object,
    *,
    low: float | None = None,
    high: float | None = None,
    above: float | None = None,
    below: float | None = None,
    whole: Literal[True],
    infinite: bool = False,
) -> int: ...


@overload
def check_number(
    name: str,
    value: object,
    *,
    low: float | None = None,
    high: float | None = None,
    above: float | None = None,
    below: float | None = None,
    whole: Literal[False] = False,
    infinite: bool = False,
) -> float: ...


def check_number(
    name: str,
    value: object,
    *,
    low: float | None = None,
    high: float | None = None,
    above: float | None = None,
    below: float | None = None,
    whole: bool = False,
    infinite: bool = False,
) -> float:
    """``value`` as a Python number, once it is one and within its bounds.

    Args:
        name: the argument's, for the message.
        low, high: the least and the greatest that will do.
        above, below: what it must stay strictly between.
        whole: only integers will do, and an int comes back.
        infinite: infinity will do, where the bounds allow it.

    Raises:
        ValueError: naming the argument, what it must be, and what it was.
    """
    wanted = _described("whole number" if whole else "number", low, high, above, below)
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, Integral if whole else Real):
        raise ValueError(f"{name} must be a {wanted}, got {short_repr(value)}")
    number: float = int(value) if isinstance(value, Integral) else float(value)
    # NaN alone differs from itself.
    if number != number or not _within(number, low, high, above, below):
        raise ValueError(f"{name} must be a {wanted}, got {short_repr(value)}")
    if not infinite and abs(number) > np.finfo(np.float64).max:
        raise ValueError(f"{name} must be finite, got {short_repr(value)}")
    return number


def check_numbers(
    name: str,
    values: ArrayLike,
    *shape: int,
    low: float | None = None,
    high: float | None = None,
    above: float | None = None,
    below: float | None = None,
) -> NDArray[np.float64]:
    """``values`` as a float64 array of this shape, once all of them are finite and within their bounds.

    Raises:
        ValueError: naming the argument, what it must be, and what it was.
    """
    wanted = f"{_described('finite numbers', low, high, above, below)} in the shape {shape}"
    try:
        given: NDArray[Any] = np.asarray(values)
    except ValueError:  # rows of several lengths
        given = np.array(None)
    if given.dtype.kind not in "iuf" or given.shape != shape:
        raise ValueError(f"{name} must be {wanted}, got {short_repr(values)}")
    array = given.astype(np.float64)
    bad = [v for v in array.ravel().tolist() if not math.isfinite(v) or not _within(v, low, high, above, below)]
    if bad:
        raise ValueError(f"{name} must be {wanted}, got {short_repr(bad[0])} among them")
    return array


def check_text(name: str, value: object) -> str:
    """``value``, once it is a string that is not empty. Raises ValueError."""
    if not isinstance(value, str) or not value:
        raise ValueError(f"{name} must be a name, got {short_repr(value)}")
    return value


def check_flag(name: str, value: object) -> bool:
    """``value``, once it is True or False. Raises ValueError."""
    if not isinstance(value, (bool, np.bool_)):
        raise ValueError(f"{name} must be True or False, got {short_repr(value)}")
    return bool(value)


def check_choice(what: str, got: Any, known: Iterable[Any]) -> None:
    """Raises ValueError unless ``got`` is one of ``known``, naming them all and the nearest."""
    names = list(known)
    try:
        if got in names:
            return
    except ValueError:  # of arrays, which compare number by number
        pass
    near = difflib.get_close_matches(got[:SHOWN], map(str, names), 1, 0.75) if isinstance(got, str) else []
    hint = f"; did you mean {near[0]!r}?" if near else ""
    raise ValueError(f"unknown {what} {short_repr(got)}; known: {', '.join(map(str, names))}{hint}")


def as_float32(values: ArrayLike, name: str = "values") -> NDArray[np.float32]:
    """``values`` as a stream and an action hold them: what is too large for that is infinite, and nothing is said.

    Raises:
        ValueError: naming the argument and what it was, where that is no array of numbers.
    """
    if type(values) is np.ndarray and values.dtype == np.float32:
        return values
    if isinstance(values, np.ma.MaskedArray) and bool(np.any(values.mask)):
        raise ValueError(f"{name} must be numbers, and some are masked: {short_repr(values)}")
    try:
        given: NDArray[Any] = np.asarray(values)
        if given.dtype.kind not in "biufO":  # complex numbers would lose a part, and text would pass for numbers
            raise TypeError(given.dtype)
        with np.errstate(over="ignore"):
            return given.astype(np.float32)
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"{name} must be numbers, got {short_repr(values)}") from error


def short_repr(value: object) -> str:
    """``value`` as a message shows it: in full where it is short."""
    try:
        text = repr(value.item() if isinstance(value, np.generic) else value)
    except ValueError:  # more digits than Python converts
        text = "a number of thousands of digits"
    return text if len(text) <= SHOWN else f"{text[: SHOWN - 1]}…"


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
                raise ArgumentTypeError(
                    f"{name} must be {signature.parameters[name].annotation}, got {short_repr(value)}"
                )
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


def _within(number: float, low: float | None, high: float | None, above: float | None, below: float | None) -> bool:
    return (
        (low is None or number >= low)
        and (high is None or number <= high)
        and (above is None or number > above)
        and (below is None or number < below)
    )


def _described(what: str, low: float | None, high: float | None, above: float | None, below: float | None) -> str:
    """For example ``whole number of at least 1``, or ``number in (0, 1]``."""
    least, greatest = low if above is None else above, high if below is None else below
    if least is not None and greatest is not None:
        brackets = ("[" if above is None else "(", "]" if below is None else ")")
        return f"{what} in {brackets[0]}{least:g}, {greatest:g}{brackets[1]}"
    if least is not None:
        return f"{what} of at least {least:g}" if above is None else f"{what} above {least:g}"
    if greatest is not None:
        return f"{what} of at most {greatest:g}" if below is None else f"{what} below {greatest:g}"
    return what
