"""CSV files of paths: a line of column names, then lines of numbers."""

import csv
import itertools
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from echelon.core.errors import ReferenceError, listing
from echelon.core.types import Array, PathLike
from echelon.core.words import amount

_MOST = 100_000
"""Rows; a path of an hour with 25 points per second has fewer."""


class Columns(NamedTuple):
    """The numbers of a file.

    Attributes:
        values: one row per line and one column per requested name; an absent column is zero.
        lines: the number of each row's line in the file, from 1.
    """

    values: Float[Array, "K c"]
    lines: Sequence[int]


def read_columns(file: PathLike, names: Sequence[str], optional: Sequence[str] = ()) -> Columns:
    """Return the named columns of a CSV file, in the order of the names.

    The file's first line names its columns, in any order. Times in a column `t` increase.

    Args:
        file: path of the file.
        names: names of all columns.
        optional: those of them that the file may lack.

    Raises:
        ReferenceError: the file cannot be read, lacks a column, has another one, or a line does not
            consist of finite numbers.
    """
    try:
        # The byte order mark that spreadsheets write does not belong to the first name.
        with Path(file).open(encoding="utf-8-sig", newline="") as stream:
            reader = csv.reader(stream)
            rows = ((reader.line_num, cells) for cells in reader if "".join(cells).strip())
            return _columns(file, rows, names, optional)
    except OSError as error:
        raise ReferenceError(
            f"the path `{file}` cannot be read: {error.strerror or error}."
        ) from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise ReferenceError(f"the path `{file}` is not a CSV file: {error}.") from error


def _columns(
    file: PathLike,
    rows: Iterator[tuple[int, list[str]]],
    names: Sequence[str],
    optional: Sequence[str],
) -> Columns:
    line, head = next(rows, (1, []))
    head = _head(f"`{file}:{line}`", head, names, optional)
    numbers, lines = [], []
    for line, cells in itertools.islice(rows, _MOST + 1):
        numbers.append(_row(f"`{file}:{line}`", head, cells))
        lines.append(line)
    if not 2 - ("t" not in names) <= len(numbers) <= _MOST:
        count = f"more than {_MOST}" if len(numbers) > _MOST else str(len(numbers))
        raise ReferenceError(
            f"the path `{file}` must have from {2 - ('t' not in names)} to {_MOST} lines of "
            f"numbers, and has {count}."
        )
    table = np.array(numbers)
    absent = np.zeros(len(table))
    values = [table[:, head.index(name)] if name in head else absent for name in names]
    if "t" in names:
        _check_times(file, values[names.index("t")], lines)
    return Columns(np.stack(values, axis=1), lines)


def _head(place: str, cells: list[str], names: Sequence[str], optional: Sequence[str]) -> list[str]:
    # NumPy writes its header as a comment, and other programs end lines with a comma.
    head = [cell.strip() for cell in ",".join(cells).lstrip("# ").rstrip(", ").split(",")]
    known = {name.lower(): name for name in names}
    head = [known.get(name.lower(), name) for name in head]
    missing = [name for name in names if name not in (*head, *optional)]
    surplus = [name for name in head if name not in names or head.count(name) > 1]
    if missing or surplus:
        which = f"lacks {listing(missing)}" if missing else f"has {listing(dict.fromkeys(surplus))}"
        free = f" ({listing(optional)} may be left out)" if optional else ""
        raise ReferenceError(
            f"the first line of the path at {place} {which}, and must name each of the columns "
            f"{listing(names)} once{free}, separated by commas."
        )
    return head


def _row(place: str, head: Sequence[str], cells: Sequence[str]) -> list[float]:
    cells = cells[:-1] if len(cells) == len(head) + 1 and not cells[-1].strip() else cells
    if len(cells) != len(head):
        raise ReferenceError(
            f"the line of the path at {place} has {amount(len(cells), 'number')}, and must have "
            f"{len(head)}."
        )
    try:
        numbers = list(map(float, cells))
    except ValueError:
        numbers = [math.nan]
    if not all(map(math.isfinite, numbers)):
        name, cell = next(pair for pair in zip(head, cells, strict=True) if not _finite(pair[1]))
        raise ReferenceError(
            f"`{name}` of the path at {place} is `{cell.strip()[:40]}`, and must be a finite "
            "number."
        )
    return numbers


def _finite(cell: str) -> bool:
    try:
        return math.isfinite(float(cell))
    except ValueError:
        return False


def _check_times(file: PathLike, times: Array, lines: Sequence[int]) -> None:
    for k in np.flatnonzero(np.diff(times) <= 0.0)[:1]:
        raise ReferenceError(
            f"`t` of the path at `{file}:{lines[k + 1]}` is {times[k + 1]:g} s, and must be more "
            f"than the {times[k]:g} s of the line before."
        )
