"""A dict that is filled when somebody reads it: most steps' reports are never read."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any


class LazyInfo(dict[str, Any]):
    """A dict whose content is made when it is first read; copied or pickled it is a plain dict.

    Args:
        make: returns the content, from values that never change.
    """

    def __init__(self, make: Callable[[], Mapping[str, Any]]) -> None:
        super().__init__()
        self._make: Callable[[], Mapping[str, Any]] | None = make

    def __missing__(self, key: str) -> Any:
        if self._make is None:
            raise KeyError(key)
        self.fill()
        return self[key]

    def fill(self) -> None:
        """Make the content now; what was written before stays."""
        make, self._make = self._make, None
        if make is not None:
            written = dict.copy(self)
            dict.clear(self)
            dict.update(self, make(), **written)

    def __reduce_ex__(self, protocol: Any) -> tuple[Any, ...]:
        return dict, (dict(self),)


def _filled_first(name: str) -> Callable[..., Any]:
    own = getattr(dict, name)

    def method(self: LazyInfo, *args: Any, **kwargs: Any) -> Any:
        self.fill()
        return own(self, *args, **kwargs)

    return method


for _name in (
    *("__iter__", "__reversed__", "__len__", "__contains__", "__eq__", "__ne__", "__repr__", "__delitem__", "__or__"),
    *("__ror__", "__ior__", "keys", "values", "items", "get", "pop", "popitem", "setdefault", "copy", "clear"),
):
    setattr(LazyInfo, _name, _filled_first(_name))
