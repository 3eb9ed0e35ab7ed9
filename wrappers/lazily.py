"""A dict that is put together when somebody reads it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any


class Lazily(dict[str, Any]):
    """A dict of which a part is known now, and the rest is made when something else of it is read first.

    Whatever it is made from must never change, so that it is right whenever it is read. Pickled or copied it is a dict.

    Args:
        now: what is known.
        later: makes all of it, in order; what stands there by then has precedence.
    """

    def __init__(self, now: Mapping[str, Any], later: Callable[[], Mapping[str, Any]]) -> None:
        super().__init__(now)
        self._later: Callable[[], Mapping[str, Any]] | None = later

    def __missing__(self, key: str) -> Any:
        if self._later is None:
            raise KeyError(key)
        self.make()
        return self[key]

    def make(self) -> None:
        """Makes the rest now."""
        if self._later is not None:
            later, self._later = self._later, None
            known = dict.copy(self)
            dict.clear(self)
            dict.update(self, later(), **known)

    def __reduce__(self) -> tuple[Any, ...]:
        return dict, (dict(self),)

    def __reduce_ex__(self, protocol: Any) -> tuple[Any, ...]:
        return self.__reduce__()


def _whole(name: str) -> Callable[..., Any]:
    own = getattr(dict, name)

    def method(self: Lazily, *args: Any, **kwargs: Any) -> Any:
        self.make()
        return own(self, *args, **kwargs)

    method.__name__, method.__doc__ = name, own.__doc__
    return method


for _name in (
    *("__iter__", "__reversed__", "__len__", "__contains__", "__eq__", "__ne__", "__repr__", "__delitem__"),
    *(
        "__or__",
        "__ror__",
        "__ior__",
        "keys",
        "values",
        "items",
        "get",
        "pop",
        "popitem",
        "setdefault",
        "copy",
        "clear",
    ),
):
    setattr(Lazily, _name, _whole(_name))
