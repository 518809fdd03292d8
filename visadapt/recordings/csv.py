"""Recordings of states as CSV: columns `episode,time,<states>,<actions>`, SI units, one row per instant.

Without a column `episode` the file is one episode. Rates of change may be missing. Other common names (`columns.py`),
separators (commas or semicolons, as spreadsheets write them) and clocks (`clock.py`) are understood too.
"""

from __future__ import annotations

import csv
import io
import math
import os
import re
import string
from collections.abc import Generator, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from itertools import chain, count, islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from visadapt.progress import Progress
from visadapt.recordings.clock import Note, RawEpisode
from visadapt.recordings.columns import convert, match
from visadapt.recordings.episode import RecordingError
from visadapt.recordings.runs import runs
from visadapt.recordings.slow_sensors import with_empty_cells
from visadapt.recordings.thinning import STRETCH, thinned
from visadapt.systems import System

SEPARATORS = "\t;,"
"""The first that is as often in the line of names as in the next line separates: names and numbers may have commas."""

UTF_16_MARKS = (b"\xff\xfe", b"\xfe\xff")

EMPTY = ("", "na", "n/a", "none", "null")  # Cells without a number, as tables are written

PLAIN = frozenset(string.printable) - frozenset('"#_')  # Characters of lines without quoted cells and comments


@dataclass(frozen=True)
class Rows:
    """Rows of a file as numbers."""

    values: NDArray[np.float64]
    """(N, columns)"""
    numbers: NDArray[np.intp]
    """(N,) row numbers from 1, not counting the header, comments (lines that begin with #) and blank lines"""
    lines: NDArray[np.intp]
    """(N,) line numbers, as in an editor"""
    total: int
    """rows of the file, of which N are kept"""

    def place(self, row: int) -> str:
        """The name in messages of a row, counted from 0."""
        return f"row {self.numbers[row]} (line {self.lines[row]})"


@dataclass(frozen=True)
class Table:
    """A file of which only the header has been read."""

    path: Path
    header: tuple[str, ...]
    separator: str

    @classmethod
    def open(cls, path: Path) -> Table:
        """Read a file's header.

        Raises:
            RecordingError: the file is missing, unreadable, not text, empty, or has no header.
        """
        with closing(_lines(path)) as lines:
            number, first = next(lines, (0, ""))
            _, second = next(lines, (0, ""))
        if not number:
            raise RecordingError(f"{path}: is empty; a line of names and rows of numbers below it are right")
        if "\0" in first:
            raise RecordingError(f"{path}: line {number} holds NUL bytes, as no text in UTF-8; CSV in UTF-8 is right")
        names, cells = (re.sub(r'"[^"]*"', "", line) for line in (first, second))
        as_often = [one for one in SEPARATORS if 0 < names.count(one) == cells.count(one)]
        separator = as_often[0] if as_often else max(SEPARATORS, key=names.count)
        if separator not in names:
            raise RecordingError(f"{path}: line {number}: names separated by commas, semicolons or tabs are right")
        try:
            header = tuple(name.strip() for name in next(csv.reader([first], delimiter=separator, strict=True)))
        except csv.Error as error:
            raise RecordingError(f"{path}: line {number} is no line of names: {error}") from error
        if all(_is_number(name) for name in header):
            raise RecordingError(
                f"{path}: line {number} holds numbers where the columns' names belong "
                "(say episode,time,x,theta,command, without # before it)"
            )
        return cls(path, header, separator)

    def rows(self, columns: Sequence[int], most: float = math.inf, progress: Progress | None = None) -> Rows:
        """The rows' numbers in some columns; the other columns may hold anything.

        The file is read a stretch of rows at a time. Where it has more than `most` rows, every second stretch is kept,
        or every fourth, and so on.

        Raises:
            RecordingError: no rows, a row with more or fewer cells than the header, or a cell that is not a number;
                the message names row, line and column.
        """
        stretches: list[NDArray[np.float64]] = []
        every, total = 1, 0
        with closing(_lines(self.path, progress)) as lines:
            next(lines)  # the header
            for block in self._stretches(lines, columns):
                if total // STRETCH % every == 0:
                    stretches.append(block)
                total += len(block)
                if len(stretches) * STRETCH > most:
                    stretches, every = stretches[::2], 2 * every
        if not total:
            raise RecordingError(f"{self.path}: has no rows below its line of names")
        table = np.concatenate(stretches)
        return Rows(table[:, 2:], table[:, 0].astype(np.intp), table[:, 1].astype(np.intp), total)

    def _stretches(self, lines: Iterator[tuple[int, str]], columns: Sequence[int]) -> Iterator[NDArray[np.float64]]:
        """The rows as `_parsed` gives them, STRETCH at a time; cell by cell, which takes far longer, from the first
        stretch on that is not `_plain`."""
        read = 0
        while stretch := [*islice(lines, STRETCH)]:
            block = self._plain(stretch, columns, read)
            if block is None:
                rows = self._parsed(chain(stretch, lines), columns, read)
                while some := [*islice(rows, STRETCH)]:
                    yield np.array(some)
                return
            yield block
            read += len(block)

    def _plain(
        self, stretch: Sequence[tuple[int, str]], columns: Sequence[int], before: int
    ) -> NDArray[np.float64] | None:
        """What `_parsed` gives of lines without quotation marks and comments whose cells in `columns` are numbers; None
        of others."""
        numbers, texts = zip(*stretch, strict=True)
        if not PLAIN.issuperset("".join(texts)) or max(map(len, texts)) > csv.field_size_limit():
            return None
        if any(text.count(self.separator) != len(self.header) - 1 for text in texts):
            return None
        try:
            values = np.loadtxt(texts, delimiter=self.separator, comments=None, usecols=columns, ndmin=2)
        except ValueError:
            return None
        return np.column_stack((before + 1 + np.arange(len(texts)), numbers, values))

    def _parsed(self, lines: Iterator[tuple[int, str]], columns: Sequence[int], before: int) -> Iterator[list[float]]:
        """For each row its number, `before` and on, its line number, and its values in `columns`."""
        pulled: list[int] = []

        def texts() -> Iterator[str]:
            for line, text in lines:
                pulled.append(line)
                yield text

        reader = csv.reader(texts(), delimiter=self.separator, strict=True)
        for number in count(before + 1):
            pulled.clear()
            try:
                cells = next(reader, None)
            except csv.Error as error:
                where = f"{self.path}: row {number} (line {pulled[0]})"
                raise RecordingError(f"{where} is no row of CSV: {error}; is a quotation mark left open?") from error
            if cells is None:
                return
            line, *more = pulled
            where = f"{self.path}: row {number} (line {line})"
            if more:
                raise RecordingError(f"{where}: a quotation mark is left open, so that the next lines are part of it")
            if len(cells) < len(self.header):
                raise RecordingError(
                    f"{where} is cut short: {len(cells)} of {len(self.header)} cells; is the file incomplete?"
                )
            if len(cells) > len(self.header):
                raise RecordingError(f"{where} has {len(cells)} cells, the line of names {len(self.header)}")
            used = [cells[column].partition("#")[0] for column in columns]
            try:
                values = [math.nan if cell.strip().lower() in EMPTY else _number(cell) for cell in used]
            except ValueError:
                column, cell = next(each for each in zip(columns, used, strict=True) if not _is_number(each[1]))
                raise RecordingError(f"{where}, column {self.header[column]!r} {_complaint(cell)}") from None
            yield [number, line, *values]


def _lines(path: Path, progress: Progress | None = None) -> Generator[tuple[int, str], None, None]:
    """Number and text of each line that is neither blank nor a comment."""
    try:
        with path.open("rb") as raw, io.TextIOWrapper(raw, encoding="utf-8-sig") as file:  # line ends become \n
            size = os.fstat(raw.fileno()).st_size
            try:
                for number, line in enumerate(file, 1):
                    if progress is not None and number % STRETCH == 0:
                        progress(raw.tell() // 10**6, size // 10**6 + 1, math.nan)
                    text = line.strip()
                    names_separator = number == 1 and re.fullmatch("sep=.", text)  # as Excel writes it
                    if text and not text.startswith("#") and not names_separator:
                        yield number, line.removesuffix("\n")
            except UnicodeDecodeError as error:
                byte = raw.tell() - len(error.object) + error.start
                coded = ", but in UTF-16" if not byte and error.object[:2] in UTF_16_MARKS else f" (byte {byte})"
                raise RecordingError(f"{path}: not text in UTF-8{coded}; CSV in UTF-8 is right") from error
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror}") from error


def read_rows(
    path: Path,
    system: System,
    given: Mapping[str, str],
    note: Note,
    most_bytes: float = math.inf,
    progress: Progress | None = None,
) -> list[RawEpisode]:
    """The episodes of a file; `given` maps our names of columns to the file's, where these are not evident.

    Where the values take more than `most_bytes`, stretches of rows are left out, with a note.

    Raises:
        RecordingError: the file or a column is missing, or a cell is not a number.
    """
    table = Table.open(path)
    found = match(path, table.header, system, given)
    rows = table.rows(list(found.values()), most_bytes / (8 * len(found)), progress)
    if len(rows.values) < rows.total:
        note(thinned(len(rows.values), rows.total), str(path))
    values = convert(dict(zip(found, rows.values.T, strict=True)), given, table.header)
    measured = tuple(variable.name for variable in system.states if variable.name in found)
    state = np.column_stack([values[name] for name in measured])
    action = np.column_stack([values[variable.name] for variable in system.actions])
    names = {name: table.header[index] for name, index in found.items()}
    whole = RawEpisode(path, values["time"], action, state, measured, rows.place, names, given)
    if "episode" not in found:
        return [with_empty_cells(whole, system, note)]
    label = values["episode"]
    if np.isnan(label).any():
        raise RecordingError(f"{path}: {rows.place(int(np.isnan(label).argmax()))}, column 'episode' is not a number")
    parts = list(runs(label))
    if len(parts) > max(len(label) / 2 - 1, 2 * len(np.unique(label))):
        raise RecordingError(
            f"{path}: the rows of episodes are mixed, {label[0]:g} and {label[parts[0][1]]:g} in turn; all rows of an "
            "episode one below the other are right"
        )
    episodes = [replace(whole.part(start, end), number=float(label[start])) for start, end in parts]
    return [with_empty_cells(raw, system, note) for raw in episodes]


def _number(cell: str) -> float:
    """The number in a cell; raises ValueError also for underscores and non-ASCII digits, which `float` accepts."""
    if "_" in cell or not cell.isascii():
        raise ValueError(cell)
    return float(cell)


def _is_number(cell: str) -> bool:
    try:
        _number(cell)
    except ValueError:
        return False
    return True


def _complaint(cell: str) -> str:
    if not cell.isascii() and _is_number(cell.strip()):
        return f"is {cell!r}, with a space that is not ASCII; a plain number is right"
    cell = cell.strip()
    if _is_number(cell.replace(",", ".", 1)) and math.isfinite(float(cell.replace(",", ".", 1))):
        return f"is {cell!r}; a decimal point is right"
    return f"is {cell[:40]!r}; a number is right"
