"""Tables of numbers in text files, as spreadsheets, recorders and programs write them.

Columns are separated by commas, semicolons, tabs, bars or blanks; decimals by points or commas.
"""

import csv
import itertools
import math
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple
from xml.etree.ElementTree import Element, ParseError, fromstring

import numpy as np
from jaxtyping import Float

from echelon.core.errors import EchelonError, listing
from echelon.core.types import Array, PathLike
from echelon.core.words import amount

_MOST = 100_000
"""Rows; a path of an hour with 25 points per second has fewer."""
_LARGEST = 2**26
"""Bytes; what is larger is no table of so few rows."""
_SAMPLE = 50
"""Rows from which the delimiter is recognized."""
_COMMENTS = ("#", "%", "//")
_BEHIND = re.compile(r"\s(?:#|//)")
"""Where a comment behind numbers begins."""
_DELIMITERS = {";": "semicolons", "\t": "tabs", "|": "bars", ",": "commas", " ": "blanks"}
_NUMBER = re.compile(r"[+-]?(?:\d+(?:[.,]\d+)?|\d+\.|\.\d+)(?:[eE][+-]?\d+)?", re.ASCII)
_THOUSANDS = re.compile(r"[+-]?[1-9]\d{0,2}(?:,\d{3})+")
_UNITS = {
    **dict.fromkeys(("s", "sec", "secs", "second", "seconds"), ("s", 1.0)),
    **dict.fromkeys(("ms", "msec", "millisecond", "milliseconds"), ("s", 1e-3)),
    **dict.fromkeys(("us", "\u00b5s", "\u03bcs", "usec", "microseconds"), ("s", 1e-6)),
    **dict.fromkeys(("ns", "nsec", "nanoseconds"), ("s", 1e-9)),
    **dict.fromkeys(("min", "minutes"), ("s", 60.0)),
    **dict.fromkeys(("hour", "hours"), ("s", 3600.0)),
    **dict.fromkeys(("m", "meter", "meters", "metre", "metres"), ("m", 1.0)),
    **{"mm": ("m", 1e-3), "cm": ("m", 1e-2), "km": ("m", 1e3)},
    **dict.fromkeys(("ft", "foot", "feet"), ("m", 0.3048)),
    **dict.fromkeys(("inch", "inches"), ("m", 0.0254)),
    **dict.fromkeys(("rad", "radian", "radians"), ("rad", 1.0)),
    **dict.fromkeys(("deg", "degree", "degrees", "\u00b0"), ("rad", math.pi / 180.0)),
    **{"": ("", 1.0), "1": ("", 1.0), "-": ("", 1.0)},
}


class Column(NamedTuple):
    """A column that is read.

    Attributes:
        name: its name.
        unit: of the values that are returned, such as `m/s`.
        others: other names that files have for it, in small letters, the likeliest first.
        assumed: the unit in the file where the file states none; by default the same.
        optional: whether the file may lack it; it is zero then.
    """

    name: str
    unit: str = ""
    others: tuple[str, ...] = ()
    assumed: str = ""
    optional: bool = False


class Columns(NamedTuple):
    """The numbers of a file.

    Attributes:
        values: (K, c), one row per line and one column per requested one; an absent one is zero.
        lines: the number of each row's line in the file, from 1.
        absent: names of the absent columns.
        unitless: names of those whose unit the file does not state.
    """

    values: Float[Array, "K c"]
    lines: Sequence[int]
    absent: tuple[str, ...]
    unitless: tuple[str, ...]


class _Row(NamedTuple):
    line: int
    cells: list[str]


class TextTable(NamedTuple):
    """The cells of a file, its delimiter, and its header where it has one.

    Attributes:
        what: what the file is, such as "path".
        fault: the error that is raised.
        remarks: commented rows before the first number, which may be the header.
    """

    file: PathLike
    what: str
    fault: type[EchelonError]
    delimiter: str
    head: _Row | None
    rows: list[_Row]
    remarks: list[_Row]

    @property
    def separated(self) -> str:
        """What separates its columns, in words."""
        return f"separated by {_DELIMITERS[self.delimiter]}"

    def place(self, line: int) -> str:
        """Return the name of a line for a message."""
        return f"the {self.what} at `{self.file}:{line}`"

    def named(self, names: Sequence[str] = ()) -> "TextTable":
        """Return the table whose header is replaced by names, where there are any.

        Raises:
            EchelonError: the number of names is not the number of columns.
        """
        if not names:
            return self
        first = self.head or self.rows[0]
        if len(names) != len(first.cells):
            raise self.fault(
                f"`columns` has {amount(len(names), 'name')}, and {self.place(first.line)} has "
                f"{amount(len(first.cells), 'column')}, {self.separated}."
            )
        return self._replace(head=_Row(first.line, list(names)))

    def has(self, column: Column) -> bool:
        """Tell whether the header names a column."""
        return self.find(column) is not None

    def find(self, column: Column) -> int | None:
        """Return the number of a column, from 0; None where the header does not name it.

        Raises:
            EchelonError: the header names it twice.
        """
        if self.head is None:
            return None
        found = [(k, _stated(cell, column)) for k, cell in enumerate(self.head.cells)]
        ranks = [(stated[0], k) for k, stated in found if stated is not None]
        best = [k for rank, k in ranks if rank == min(ranks)[0]]
        if len(best) > 1:
            cells = listing(self.head.cells[k] for k in best)
            raise self.fault(
                f"{self.place(self.head.line)} has {cells} for `{column.name}`, and must have one "
                "column for it."
            )
        return best[0] if best else None

    def columns(self, wanted: Sequence[Column], least: int = 1) -> Columns:
        """Return the numbers of the wanted columns, in their order; others are not read.

        Raises:
            EchelonError: a column is missing, is there twice or has another unit; a cell is no
                finite number; there are too few or too many rows.
        """
        table = self.headed(wanted)
        if table.head is None or not all(table.has(c) for c in wanted if not c.optional):
            raise self.fault(table._lacks(wanted))
        places = [table.find(column) for column in wanted]
        units = [_scale(table, c, k) for c, k in zip(wanted, places, strict=True)]
        table._check_rows(least, len(table.head.cells))
        values = np.zeros((len(table.rows), len(wanted)))
        for j, (column, k) in enumerate(zip(wanted, places, strict=True)):
            if k is not None:
                values[:, j] = [_number(table, column, row, k) for row in table.rows]
        _check_decimals(table, [k for k in places if k is not None])
        values *= [factor for factor, _ in units]
        absent = tuple(c.name for c, k in zip(wanted, places, strict=True) if k is None)
        unitless = tuple(c.name for c, (_, stated) in zip(wanted, units, strict=True) if not stated)
        return Columns(values, [row.line for row in table.rows], absent, unitless)

    def headed(self, wanted: Sequence[Column]) -> "TextTable":
        """Return the table with a header that names the wanted columns; itself if there is none.

        NumPy and ROS write the header as a comment, and instruments write lines before it.
        """
        rows = self.rows
        # Numbers beside text, as names of frames, are no header.
        if self.head is not None and any(number_in(cell) is not None for cell in self.head.cells):
            rows = [self.head, *rows]
        tables = [self, *(self._replace(head=row, rows=rows) for row in reversed(self.remarks))]
        first = [] if self.head is None else enumerate(self.rows[:_SAMPLE], 1)
        tables += [self._replace(head=row, rows=self.rows[k:]) for k, row in first]
        needed = [column for column in wanted if not column.optional]
        found = (table for table in tables if all(table.has(column) for column in needed))
        return next(found, self)

    def _lacks(self, wanted: Sequence[Column]) -> str:
        """Return the sentence on columns that are missing, with what was seen."""
        needed = [column for column in wanted if not column.optional]
        optional = [column.name for column in wanted if column.optional]
        free = f" ({listing(optional)} may be left out)" if optional else ""
        every = f"{listing(column.name for column in needed)}{free}"
        if self.head is None:
            first = self.rows[0]
            return (
                f"{self.place(first.line)} has {amount(len(first.cells), 'column')} of numbers, "
                f"{self.separated}, without names; name them in `columns`: {every}."
            )
        lacks = listing(column.name for column in needed if not self.has(column))
        return (
            f"{self.place(self.head.line)} lacks {lacks}: it names "
            f"{listing(self.head.cells[:12])}, {self.separated}; needed are {every}."
        )

    def _check_rows(self, least: int, width: int) -> None:
        if not least <= len(self.rows) <= _MOST:
            count = f"more than {_MOST}" if len(self.rows) > _MOST else str(len(self.rows))
            raise self.fault(
                f"the {self.what} `{self.file}` must have from {least} to {_MOST} lines of "
                f"numbers, and has {count}."
            )
        for row in self.rows:
            if len(row.cells) != width:
                raise self.fault(
                    f"{self.place(row.line)} has {amount(len(row.cells), 'number')}, "
                    f"{self.separated}, and must have {width}."
                )


# ---- from bytes to cells -------------------------------------------------------------------------


def read_table(file: PathLike, what: str, fault: type[EchelonError]) -> TextTable:
    """Return the cells of a text file.

    Lines that begin with `#`, `%` or `//` are comments, and so is what follows a blank and `#`
    or `//`.

    Args:
        file: path of the file, in UTF-8, UTF-16 with a byte order mark, or cp1252.
        what: what messages call it, such as "path".
        fault: the error to raise.

    Raises:
        EchelonError: the file cannot be read, or is no table.
    """
    text = read_text(file, what, fault)
    split = enumerate(re.split("\r\n|\n|\r", text), 1)
    lines = [(k, line.strip(" ")) for k, line in split if line.strip(" \t;,|\"'")]
    # A spreadsheet states it in its first line.
    stated = re.fullmatch(r'"?sep=([;,|\t])"?', lines[0][1], re.IGNORECASE) if lines else None
    lines = lines[1:] if stated else lines
    remarks = [(k, line) for k, line in lines if line.startswith(_COMMENTS)]
    body = [(k, _BEHIND.split(x)[0]) for k, x in lines if not x.startswith(_COMMENTS)]
    if not body:
        raise fault(f"the {what} `{file}` has no line of numbers.")
    delimiter = stated[1] if stated else _delimiter([line for _, line in body[:_SAMPLE]])
    try:
        rows = [_Row(k, _cells(line, delimiter)) for k, line in body[: _MOST + 2]]
        notes = [_Row(k, _cells(line.lstrip("#%/ "), delimiter)) for k, line in remarks]
    except csv.Error as error:
        raise fault(f"the {what} `{file}` is not a CSV file: {error}.") from error
    head, rows = _headed(rows)
    width, first = len((head or rows[0]).cells), rows[0].line if rows else math.inf
    rows = [row._replace(cells=_trimmed(row.cells, width)) for row in rows]
    notes = [note for note in notes if note.line < first and len(note.cells) == width]
    return TextTable(file, what, fault, delimiter, head, rows, notes)


def read_text(file: PathLike, what: str, fault: type[EchelonError]) -> str:
    """Return the text of a file in UTF-8, UTF-16 with a byte order mark, or cp1252.

    Raises:
        EchelonError: the file cannot be read, is too large, or is no text.
    """
    try:
        with Path(file).open("rb") as stream:
            data = stream.read(_LARGEST + 1)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise fault(f"the {what} `{file}` cannot be read: {reason}.") from error
    if len(data) > _LARGEST:
        raise fault(f"the {what} `{file}` has more than {_LARGEST >> 20} MB, which is too large.")
    wide = data.startswith((b"\xff\xfe", b"\xfe\xff"))
    # cp1252 has five bytes without a meaning.
    for encoding in ("utf-16",) if wide else ("utf-8-sig", "cp1252"):
        try:
            text = data.decode(encoding)
        except UnicodeDecodeError:
            continue
        if "\0" not in text:
            return text
    raise fault(f"the {what} `{file}` is not a text file.")


def read_xml(file: PathLike, what: str, fault: type[EchelonError], kind: str) -> Element:
    """Return the root of an XML file, such as of a `kind` GPX; else raise `fault`."""
    text = read_text(file, what, fault)
    # Its entities may grow without bound, and none of these kinds needs one.
    if "<!DOCTYPE" in text:
        raise fault(f"the {what} `{file}` has a `<!DOCTYPE`, which is not read; delete it.")
    try:
        return fromstring(text)
    except (ParseError, ValueError) as error:
        raise fault(f"the {what} `{file}` is not {kind}: {error}.") from None


def _delimiter(lines: list[str]) -> str:
    """Return what separates most lines into cells."""
    most = {mark: 2 * sum(mark in line for line in lines) > len(lines) for mark in _DELIMITERS}
    for mark in (";", "\t", "|"):
        if most[mark]:
            return mark
    first, *others = map(str.split, lines)
    # Of blanks and decimal commas, as `0,5 1,5`: each cell is a number.
    decimal = all(len(cells) > 1 and all(map(_NUMBER.fullmatch, cells)) for cells in others)
    decimal &= all(map(_NUMBER.fullmatch, first)) if "," in "".join(first) else bool(others)
    return "," if most[","] and not (decimal and len(first) > 1) else " "


def _cells(line: str, delimiter: str) -> list[str]:
    if delimiter == " ":
        # The blank before a unit separates nothing.
        return [cell.strip("\"'") for cell in re.sub(r"\s+(?=[\[(])", "", line).split()]
    cells = next(csv.reader([line], delimiter=delimiter, skipinitialspace=True))
    return _trimmed([cell.strip() for cell in cells])


def _trimmed(cells: list[str], width: int = 0) -> list[str]:
    """Return cells without one empty cell at the end, which some programs write."""
    return cells[:-1] if len(cells) > max(width, 1) and not cells[-1] else cells


def _headed(rows: list[_Row]) -> tuple[_Row | None, list[_Row]]:
    """Return the header, with the units of a second line, and the rows of numbers."""
    head = rows[0]
    if all(map(_is_value, head.cells)):
        return None, rows
    second = rows[1].cells if len(rows) > 1 else []
    units = [cell.strip("[]() ") for cell in second]
    if (
        len(units) != len(head.cells)
        or not all(map(_measure, units))
        or all(map(_is_value, second))
    ):
        return head, rows[1:]
    names = [f"{name} [{unit}]" for name, unit in zip(head.cells, units, strict=True)]
    return _Row(head.line, names), rows[2:]


def _is_value(cell: str) -> bool:
    return not cell or cell.lower() in ("nan", "inf", "-inf") or number_in(cell) is not None


# ---- columns, units, numbers ---------------------------------------------------------------------


def _plain(name: str) -> str:
    return re.sub(r"[\s._-]+", "_", name.strip().lower()).strip("_")


def _names(cell: str) -> Iterator[tuple[str, str | None]]:
    """Yield what a cell of a header may name: a column, and its unit where it is stated."""
    yield cell, None
    if bracketed := re.fullmatch(r"(.+?)\s*[\[({<]([^\[({<]*)[\])}>]", cell):
        yield bracketed[1], bracketed[2].strip()
    elif joined := re.fullmatch(r"(.+?)(?:\s*[,/]\s*|[\s_.-]+)([^\s_.,-]+)", cell):
        if _measure(joined[2]) is not None and not joined[2].isdigit():
            yield joined[1], joined[2]


def _stated(cell: str, column: Column) -> tuple[int, str | None] | None:
    """Return how well a cell names a column, 0 for best, and its unit; None if it does not."""
    for name, unit in _names(cell):
        plain = _plain(name)
        names = [_plain(column.name), *column.others]
        if name == column.name or plain in names:
            return 0 if name == column.name else 1 + names.index(plain), unit
    return None


def _scale(table: TextTable, column: Column, k: int | None) -> tuple[float, bool]:
    """Return the factor from the file's unit of a column to its own, and whether it is stated."""
    assert table.head is not None
    stated = None if k is None else _stated(table.head.cells[k], column)
    unit = None if stated is None else stated[1]
    own = _measure(column.unit)
    seen = _measure((column.assumed or column.unit) if unit is None else unit)
    if unit == column.unit or not column.unit or unit is None and own is None:
        return 1.0, unit is not None
    if own is None or seen is None or seen[0] != own[0]:
        raise table.fault(
            f"the unit of `{column.name}` of {table.place(table.head.line)} is `{unit}`, and must "
            f"be one such as `{column.unit or '1'}`."
        )
    return seen[1] / own[1], unit is not None


def _measure(text: str) -> tuple[Counter[str], float] | None:
    """Return the base units of a unit, with their powers, and its size in them; None if unknown."""
    base, size = Counter[str](), 1.0
    parts = text.replace("\u00b2", "^2").replace("**", "^").replace(" ", "").lower().split("/")
    for part, sign in zip(parts, itertools.chain([1], itertools.repeat(-1))):
        match = re.fullmatch(r"(.*?)(?:\^?(\d))?", part)
        name, power = (part, 1) if match is None else (match[1], sign * int(match[2] or 1))
        if name not in _UNITS:
            return None
        unit, factor = _UNITS[name]
        base[unit] += power if unit else 0
        size *= factor**power
    return Counter({unit: power for unit, power in base.items() if power}), size


def number_in(cell: str) -> float | None:
    """Return the number in a cell, or the seconds of a date in ISO 8601; None for anything else."""
    text = cell.replace("\u2212", "-")
    if _NUMBER.fullmatch(text):
        return float(text.replace(",", "."))
    try:
        return seconds_of(cell) if cell[:4].isdigit() and ":" in cell else None
    except ValueError:
        return None


def seconds_of(date: str) -> float:
    """Return the Unix time of a date in ISO 8601, s; `ValueError` where it is none."""
    time = datetime.fromisoformat(date)
    # Without a zone it is UTC: clocks of a zone jump twice a year.
    return (time if time.tzinfo else time.replace(tzinfo=UTC)).timestamp()


def _number(table: TextTable, column: Column, row: _Row, k: int) -> float:
    cell = row.cells[k]
    value = number_in(cell)
    thousands = table.delimiter == "," and _THOUSANDS.fullmatch(cell)
    date = value is not None and ":" in cell and column.unit != "s"
    if value is None or not math.isfinite(value) or thousands or date:
        seen = f"`{cell[:40]}`" if cell else "empty"
        raise table.fault(
            f"`{column.name}` of {table.place(row.line)} is {seen}, and must be a finite number."
        )
    return value


def _check_decimals(table: TextTable, places: list[int]) -> None:
    """Refuse decimal commas beside decimal points: one of them may separate thousands."""
    first: dict[str, tuple[str, int]] = {}
    for row, k in itertools.product(table.rows, places):
        cell = row.cells[k]
        for mark in {",", "."} & {*cell} if ":" not in cell else ():
            first.setdefault(mark, (cell, row.line))
    if len(first) == 2:
        (one, here), (other, there) = first["."], first[","]
        raise table.fault(
            f"{table.place(max(here, there))} has `{one}` in line {here} and `{other}` in line "
            f"{there}: decimals are points or commas, not both."
        )
    if "," in first:
        _check_thousands(table, places, *first[","])


def _check_thousands(table: TextTable, places: list[int], cell: str, line: int) -> None:
    """Refuse commas that all stand before three digits, beside whole numbers."""
    cells = [row.cells[k] for row, k in itertools.product(table.rows, places)]
    marked = [cell for cell in cells if "," in cell]
    # Who writes decimals with three digits writes them in all cells, and few are above 1 in all.
    if len(marked) < len(cells) and all(map(_THOUSANDS.fullmatch, marked)):
        raise table.fault(
            f"{table.place(line)} has `{cell}`, which may be {cell.replace(',', '')} or "
            f"{cell.replace(',', '.', 1)}; write numbers without separators of thousands."
        )
