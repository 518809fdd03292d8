"""Tables of numbers as text with a header line, separated by commas or semicolons, as spreadsheets write them."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from visadapt.recordings.episode import RecordingError


@dataclass(frozen=True)
class Table:
    """A file's text, split into the header and the rows, which are not parsed yet.

    Row numbers start from 1 and leave out the header, comments (lines that begin with #) and blank lines; line numbers
    are those of an editor.
    """

    path: Path
    header: tuple[str, ...]
    separator: str
    rows: tuple[tuple[int, str], ...]
    """number and text of each row's line"""

    @classmethod
    def open(cls, path: Path) -> Table:
        """Read a file and parse its header.

        Raises:
            RecordingError: the file is missing, unreadable, not text, empty, or has no header.
        """
        try:
            text = path.read_text(encoding="utf-8-sig")  # line ends of any kind become \n
        except UnicodeDecodeError as error:
            raise RecordingError(f"{path}: not text in UTF-8 (byte {error.start}); a CSV file is right") from error
        except OSError as error:
            raise RecordingError(f"{path}: cannot be read: {error.strerror}") from error
        lines = [(number, line.strip()) for number, line in enumerate(text.split("\n"), 1)]
        lines = [(number, line) for number, line in lines if line and not line.startswith("#")]
        if not lines:
            raise RecordingError(f"{path}: is empty; a line of names and rows of numbers below it are right")
        (number, first), *rows = lines
        separator = ";" if first.count(";") > first.count(",") else ","
        header = tuple(name.strip().strip('"') for name in first.split(separator))
        if all(_is_number(name) for name in header):
            raise RecordingError(
                f"{path}: line {number} holds numbers where the columns' names belong "
                "(say episode,time,x,theta,command)"
            )
        return cls(path, header, separator, tuple(rows))

    def numbers(self, columns: Sequence[int]) -> NDArray[np.float64]:
        """Some columns (rows, len(columns)); the other columns may hold anything.

        Raises:
            RecordingError: no rows, a row with more or fewer cells than the header, or a cell that is not a number;
                the message names row, line and column.
        """
        if not self.rows:
            raise RecordingError(f"{self.path}: has no rows below its line of names")
        values = []
        for row, (_, line) in enumerate(self.rows):
            (cells,) = csv.reader([line], delimiter=self.separator)
            where = f"{self.path}: {self.place(row)}"
            if len(cells) < len(self.header):
                raise RecordingError(
                    f"{where} is cut short: {len(cells)} of {len(self.header)} cells; is the file incomplete?"
                )
            if len(cells) > len(self.header):
                raise RecordingError(f"{where} has {len(cells)} cells, the line of names {len(self.header)}")
            try:
                values.append([float(cells[column].partition("#")[0]) for column in columns])
            except ValueError:
                column = next(column for column in columns if not _is_number(cells[column]))
                raise RecordingError(f"{where}, column {self.header[column]!r} {_complaint(cells[column])}") from None
        return np.array(values)

    def place(self, row: int) -> str:
        """The name in messages of a row, counted from 0."""
        return f"row {row + 1} (line {self.rows[row][0]})"


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _complaint(cell: str) -> str:
    cell = cell.strip()
    if not cell:
        return "is empty; a number is right (leave out rows without a measurement)"
    if _is_number(cell.replace(",", ".", 1)) and math.isfinite(float(cell.replace(",", ".", 1))):
        return f"is {cell!r}; a decimal point is right"
    return f"is {cell[:40]!r}; a number is right"
