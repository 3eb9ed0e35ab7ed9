"""Cut lines of CSV into cells by the names of their header, as they come."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection
from typing import Any

from asm_gym.data.table_layout import is_key, named_columns, named_row
from asm_gym.data.text_files import DOUBLED, Dialect, check_cells, header_of


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
        self._originals: dict[str, str] = {}  # the first column of a name, by those that repeat it
        count = Counter[str]()
        for name in header_of(self.dialect.cells(header)):
            count[name] += 1
            unique = name
            if count[name] > 1:
                unique = f"{name}{DOUBLED}{count[name]}"
                self._originals[unique] = name
            self.names.append(unique)
        self._named = named_columns(self.names)

    @property
    def is_of_words(self) -> bool:
        """Whether it is a header for certain: words behind separators, and no number."""
        has_numbers = self.dialect.count_numbers(self.names)
        return self.dialect.separator != " " and len(self.names) > 1 and not has_numbers

    @property
    def names_all_columns(self) -> bool:
        """Whether the header names all columns, and no cell does."""
        has_key = any(map(is_key, self.names))
        return not self._named and not has_key

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
        plain = map(self.dialect.plain, texts)
        cells = dict(zip(self.names, plain, strict=False))
        for name, original in self._originals.items():
            differs = cells[name] != cells[original]
            if differs and name not in read:
                raise ValueError(f"its columns of the same name differ: {original!r}")
        return named_row(cells, self._named)
