"""Compile functions, cached on disk for the whole folder they belong to.

The cache lies beside the code, else in the user's cache; ``NUMBA_CACHE_DIR`` names another place. Where none can be
written to, it lies in a temporary folder of this process and its workers.
"""

from __future__ import annotations

import atexit
import hashlib
import os
import shutil
import sys
import tempfile
from collections.abc import Callable
from contextlib import suppress
from functools import lru_cache, partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
from numba import types
from numba.core.config import reload_config
from numba.core.registry import cpu_target
from numba.experimental import structref

F = TypeVar("F", bound=Callable[..., Any])
T = TypeVar("T")
KEEP_NOWHERE = "asm-gym-numba-"  # begins the name of a folder that goes when the process ends


def compiled(
    function: F, fastmath: bool = False, calls: tuple[str, ...] = (), nogil: bool = False
) -> F:
    """Compile ``function``, once a machine.

    Args:
        function: to be compiled.
        fastmath: let loops use vector registers; inputs must then be finite. Callees are
            compiled into their callers, as the linker would take one of two copies that differ in
            the order of sums.
        calls: other folders of the package that hold functions which it calls; ``"."`` for the
            package's own.
        nogil: let other threads run Python meanwhile.
    """
    options: dict[str, Any] = {
        "nogil": nogil,
        "fastmath": fastmath,
        "forceinline": fastmath,
        "error_model": "numpy",
    }
    dispatcher: Any = somewhere(lambda: numba.njit(cache=True, **options)(function))
    cache = _cache_of(dispatcher)
    if cache is not None:
        # numba looks at the function's own file alone, and would keep code that a change of another
        # file made stale.
        folders = [Path(function.__code__.co_filename).parent]
        folders += [Path(__file__).parent / name for name in calls]
        cache._source_stamp = f"{options}" + "".join(map(_digest, folders))
        cache._load_index = partial(_index_of, cache._load_index)
    return cast(F, dispatcher)


def somewhere(make: Callable[[], T]) -> T:
    """Return what ``make`` returns, which keeps compiled code.

    Where no other folder can be written to, the code is kept in a temporary one. From then on all
    code of this process is kept there, robosuite's too.
    """
    try:
        return make()
    except RuntimeError as error:
        if "cannot cache" not in str(error):
            raise
    folder = os.environ["NUMBA_CACHE_DIR"] = tempfile.mkdtemp(prefix=KEEP_NOWHERE)
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    reload_config()  # type: ignore[no-untyped-call]
    print(
        "asm-gym: neither the install nor HOME is writable, so that compiled code is lost when "
        "this process ends: name a folder that is, export NUMBA_CACHE_DIR=FOLDER",
        file=sys.stderr,
    )
    return make()


def _index_of(load: Callable[[], dict[Any, str]]) -> dict[Any, str]:
    """Load the index; empty where it names types that are gone, which fails before numba compares stamps."""
    try:
        return load()
    except (AttributeError, ImportError):
        return {}


def must_compile(function: Any) -> bool:
    """Return whether the next call of a compiled function will take seconds, as far as is known."""
    cache = _cache_of(function)
    if cache is None or function.signatures:
        return False
    # code that another one compiled is none
    processor = cpu_target.target_context.codegen().magic_tuple()
    return not any(processor in key for key in cache._load_index())


def announce(function: Any, what: str) -> bool:
    """Return whether the next call of a compiled function compiles ``what``; say so on standard error."""
    if not must_compile(function):
        return False
    print(f"asm-gym: compiling {what}, once on this machine (up to a minute)", file=sys.stderr)
    return True


def kept_in(function: Any) -> Path | None:
    """Return the folder that holds the compiled code of a function; None where nothing keeps it."""
    cache = _cache_of(function)
    if cache is None:
        return None
    return Path(cache._cache_path)


def _cache_of(dispatcher: Any) -> Any:
    """Return numba's index of a function's compiled code; None where numba keeps none or elsewhere."""
    return getattr(getattr(dispatcher, "_cache", None), "_cache_file", None)


def inner(function: F, fastmath: bool = False, inlined: bool = False) -> F:
    """Compile ``function`` for compiled functions to call; ``inlined``, as a part of each of them."""
    options: dict[str, Any] = {
        "no_cpython_wrapper": True,
        "no_cfunc_wrapper": True,
        "error_model": "numpy",
        "fastmath": fastmath,
        "forceinline": fastmath,
    }
    if inlined:
        options["inline"] = "always"
    return cast(F, numba.njit(**options)(function))


@lru_cache
def _digest(folder: Path) -> str:
    """Return the digest of every source file in a folder, and of what compiles and links its code."""
    mujoco = "none"  # in a light install
    with suppress(PackageNotFoundError):
        mujoco = version("mujoco")
    digest = hashlib.sha256(f"{numba.__version__} {mujoco}".encode())
    for path in sorted(folder.glob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()


@structref.register
class _BoundType(types.StructRef):
    """The compiler's type of ``Bound``."""


class Bound(structref.StructRefProxy):
    """A tuple of arrays and records, ``parts``, that compiled functions take as one argument.

    A compiled function that Python calls looks through all arrays of its arguments; of a ``Bound`` it takes a pointer.
    """

    parts: tuple[Any, ...]


structref.define_proxy(Bound, _BoundType, ["parts"])  # type: ignore[no-untyped-call]


@compiled
def bind(*parts: Any) -> Bound:
    """Return arrays, numbers and named tuples of them as one object."""
    return Bound(parts)  # type: ignore[no-untyped-call]
