"""Cut lines of CSV into cells by the names of their header, as they come."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

from asm_gym.data.table_layout import is_key, named_columns, named_row
from asm_gym.data.text import DOUBLED, Dialect, check_cells, header_of


class CsvLines:
    """The header of lines of CSV.

    Args:
        header: its line.

    Attributes:
        header: its line.
        dialect: how lines are cut, and numbers read.
        names: of the columns; a name that comes again has a number, as in a file.

    Raises:
        ValueError: it is no header.
    """

    def __init__(self, header: str) -> None:
        self.header = header.strip()
        self.dialect = Dialect.of(header)
        self.names: list[str] = []
        self._first: dict[str, str] = {}  # the first column of a name, by those that repeat it
        names = header_of(self.dialect.cells(header))
        for place, name in enumerate(names):
            unique = name
            if name in self.names:
                unique = f"{name}{DOUBLED}{names[:place].count(name) + 1}"
                self._first[unique] = name
            self.names.append(unique)
        self._named = named_columns(self.names)

    @property
    def names_all_columns(self) -> bool:
        """Whether the header names all columns, and no cell does."""
        return not self._named and not any(map(is_key, self.names))

    def cells(self, line: str, read: Collection[str]) -> dict[str, Any]:
        """Return the cells of a line by name.

        Args:
            line: a row.
            read: names of columns that are read, so that others of their name may differ.

        Raises:
            ValueError: it is no row of this header.
        """
        texts = self.dialect.cells(line)
        check_cells(texts, len(self.names), "it has")
        cells = dict(zip(self.names, map(self.dialect.plain, texts), strict=False))
        for name, first in self._first.items():
            if name not in read and cells[name] != cells[first]:
                raise ValueError(f"its columns of the same name differ: {first!r}")
        return named_row(cells, self._named)
