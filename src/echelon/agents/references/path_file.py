"""Paths in files: tables of timed points or states, in metres or in latitude and longitude, GPX."""

import re
from collections.abc import Iterator, Sequence
from typing import NamedTuple, TypeVar

import numpy as np
from jaxtyping import Float

from echelon.core.errors import ReferenceError
from echelon.core.text_table import Column, Columns, TextTable, read_table, read_xml, seconds_of
from echelon.core.types import Array, PathLike

_TIME = Column(
    "t",
    "s",
    (
        *("time", "timestamp", "elapsed", "time_stamp", "stamp_sec", "stamp_secs", "stamp"),
        *("header_stamp_sec", "header_stamp_secs", "header_stamp", "field_header_stamp"),
        *("sec", "secs", "seconds"),
    ),
)
_REST = Column(
    "nanosec",
    "s",
    tuple(
        f"{before}{name}"
        for before in ("", "stamp_", "header_stamp_")
        for name in ("nanosec", "nanosecs", "nanoseconds", "nsec", "nsecs")
    ),
    "ns",
    optional=True,
)
"""What messages of ROS have beside whole seconds."""
_OTHERS = (
    *(
        "pos{}",
        "pos_{}",
        "position_{}",
        "pose_position_{}",
        "pose_pose_position_{}",
        "field_pose_position_{}",
        "field_pose_pose_position_{}",
        "p_{}",
        "p{}",
    ),
    *("{}_pos", "{}_position", "stateestimate_{}", "p_rs_r_{}", "t{}"),
)
_PLACE = [
    Column(axis, "m", tuple(other.format(axis) for other in _OTHERS), optional=axis == "z")
    for axis in "xyz"
]
_TURNED = Column(
    "qw",
    "",
    (
        *("q_w", "orientation_w", "pose_orientation_w", "pose_pose_orientation_w"),
        *("field_pose_orientation_w", "field_pose_pose_orientation_w", "q_rs_w", "heading"),
    ),
)
"""What states an orientation that is not read."""
_YAW = Column("yaw", "rad", ("yaw_angle", "psi", "theta"), optional=True)
_EARTH = [
    Column("lat", "rad", ("latitude", "gps_lat"), "deg"),
    Column("lon", "rad", ("long", "lng", "longitude", "gps_lon"), "deg"),
    Column("alt", "m", ("altitude", "ele", "elevation", "height", "gps_alt"), optional=True),
]
_EPOCH, _LASTS = (9e8, 4.1e9), 1e6
"""s; Unix time stamps of 1998 to 2099, and what a path with such lasts at most."""
_RECORDED, _GAP = 20, 5.0
"""From so many points on a path is a recording, with a gap where a step is so much longer."""
_SLOW = 5.0
"""s; points of a recording that are so far apart, at whole numbers, are probably in ms."""
_FOREIGN = {
    "xy_valid": "a log of PX4, whose axes point north, east and down and whose times are in us",
    "Format Version": "an export of Motive, whose y axis may point up",
}
"""Files whose axes are others, by a cell of their first line."""


class PathRows(NamedTuple):
    """The rows of a path in a file.

    Attributes:
        times: (K,) increasing, s.
        values: (K, c) the other columns.
        notes: what was seen that is probably not meant, a sentence each.
    """

    times: Float[Array, " K"]
    values: Float[Array, "K c"]
    notes: tuple[str, ...]


def read_points(
    file: PathLike,
    degrees: bool = False,
    columns: Sequence[str] = (),
    begin: float | None = None,
    spatial: bool = False,
) -> PathRows:
    """Return times and points (x, y, z, yaw) of a table, or of a GPX file; s, m and rad.

    Latitude, longitude and altitude become metres east, north and up of the first point. Yaw that
    is wrapped to one turn is unwrapped.

    Args:
        file: path of the file.
        degrees: whether a yaw without a unit is in degrees.
        columns: names of the columns, instead of the file's.
        begin: time of the first point, s; by default the file's, and 0 for Unix time stamps.
        spatial: whether a missing `z` is remarked.

    Raises:
        ReferenceError: the file cannot be read, lacks a column, or a line is wrong.
    """
    read, on_earth, turned = _read_places(file, columns, degrees)
    times, notes = _clock(file, read, begin)
    place, angle = read.values[:, 1:4], read.values[:, 4]
    if turned and "yaw" in read.absent:
        notes.append(f"the path `{file}` has `{turned}`, which is not read: the yaw is 0.")
    if on_earth:
        place = _east_north_up(file, place, read.lines, "alt" not in read.absent)
    elif spatial and "z" in read.absent:
        notes.append(f"the path `{file}` has no column `z`, which is 0.")
    notes += yaw_notes(f"`{file}`", angle, degrees or "yaw" not in read.unitless)
    unwrapped = _unwrapped(angle)
    for k in np.flatnonzero(np.abs(unwrapped - angle) > 1.0)[:1]:
        jump = f"`{file}:{read.lines[k]}` jumps by {angle[k] - angle[k - 1]:.3g} rad"
        notes.append(f"the yaw of {jump}; it is taken as wrapped to a turn, and unwrapped.")
    return PathRows(times, np.column_stack([place, unwrapped]), tuple(notes))


def _read_places(
    file: PathLike, columns: Sequence[str], degrees: bool
) -> tuple[Columns, bool, str]:
    """Return time, place and yaw, whether places are on the Earth, and an unread orientation."""
    if str(file).lower().endswith(".gpx"):
        return _read_gpx(file), True, ""
    table = _table(file, columns).headed([_TIME])
    k = table.find(_TURNED)
    turned = "" if table.head is None or k is None else table.head.cells[k]
    on_earth = not table.has(_PLACE[0]) and table.has(_EARTH[0]) and table.has(_EARTH[1])
    yaw = _YAW._replace(assumed="deg") if degrees else _YAW
    wanted = [_TIME, *(_EARTH if on_earth else _PLACE), yaw]
    k, cells = table.find(_TIME), () if table.head is None else table.head.cells
    # A Crazyflie's client writes whole ms.
    whole = k is not None and bool(table.rows) and table.rows[0].cells[k].isdigit()
    if whole and any("stateestimate" in cell.lower() for cell in cells):
        wanted[0] = _TIME._replace(assumed="ms")
    return _numbers(table, wanted), on_earth, turned


def _table(file: PathLike, columns: Sequence[str]) -> TextTable:
    """Return the table of a file whose axes are known."""
    table = read_table(file, "path", ReferenceError)
    for cell in table.head.cells if table.head else ():
        if cell in _FOREIGN:
            raise ReferenceError(
                f"the path `{file}` has `{cell}`: it is {_FOREIGN[cell]}; write a table of `t`, "
                "`x`, `y`, `z` in s and m, with z up."
            )
    return table.named(columns)


def _numbers(table: TextTable, wanted: Sequence[Column]) -> Columns:
    """Return the columns, of which the first is the time, in whole seconds and ns or in one."""
    table = table.headed(wanted)
    k = table.find(wanted[0])
    cells = () if table.head is None else table.head.cells
    if k is None or not re.search(r"sec(ond)?s?$", cells[k], re.IGNORECASE) or not table.has(_REST):
        return table.columns(wanted, least=2)
    read = table.columns([*wanted, _REST], least=2)
    values = read.values[:, :-1]
    values[:, 0] += read.values[:, -1]
    return read._replace(values=values)


def read_timed(
    file: PathLike,
    wanted: Sequence[Column],
    columns: Sequence[str] = (),
    begin: float | None = None,
) -> PathRows:
    """Return times and the wanted columns of a table; the rest as of `read_points`.

    Raises:
        ReferenceError: the file cannot be read, lacks a column, or a line is wrong.
    """
    table = _table(file, columns)
    time = _TIME._replace(others=()) if any(c.name in _TIME.others for c in wanted) else _TIME
    read = _numbers(table, [time, *wanted])
    times, notes = _clock(file, read, begin)
    return PathRows(times, read.values[:, 1:], tuple(notes))


_Path = TypeVar("_Path")


def noted(path: _Path, notes: tuple[str, ...]) -> _Path:
    """Return a path that was just made, whose field `notes` is that of its file."""
    # No argument of its class: a scenario would offer it.
    object.__setattr__(path, "notes", notes)
    return path


def _clock(file: PathLike, read: Columns, begin: float | None) -> tuple[Array, list[str]]:
    """Return the times of a run, and what is remarkable about the file's."""
    times, notes = read.values[:, 0], list[str]()
    for k in np.flatnonzero(np.diff(times) <= 0.0)[:1]:
        raise ReferenceError(
            f"`t` of the path at `{file}:{read.lines[k + 1]}` is {times[k + 1]:.10g} s, and must "
            f"be more than the {times[k]:.10g} s of the line before."
        )
    if (stamps := _unix(times, "t" in read.unitless)) is not None:
        unit, times = stamps
        notes.append(
            f"the times of `{file}` are taken as Unix time stamps in {unit}, and counted from the "
            "first."
        )
    if stamps is not None or begin is not None:
        times = times - times[0] + (begin or 0.0)
    unitless = stamps is None and "t" in read.unitless
    return times, [*notes, *_gaps(file, times, read.lines), *_coarse(file, times, unitless)]


def _coarse(file: PathLike, times: Float[Array, " K"], unitless: bool) -> Iterator[str]:
    usual = np.median(np.diff(times))
    if unitless and len(times) >= _RECORDED and usual >= _SLOW and not (times % 1.0).any():
        yield (
            f"points of the path `{file}` are mostly {usual:.3g} s apart; if its times have "
            "another unit, state it in the header, as in `t [ms]`."
        )


def _gaps(file: PathLike, times: Float[Array, " K"], lines: Sequence[int]) -> Iterator[str]:
    spans = np.diff(times)
    usual, widest = np.median(spans), int(spans.argmax())
    if len(times) >= _RECORDED and spans[widest] > _GAP * usual:
        yield (
            f"the path `{file}` has a gap of {spans[widest]:.3g} s after line {lines[widest]}, "
            f"where points are mostly {usual:.3g} s apart; the curve there is a guess."
        )


def yaw_notes(what: str, yaw: Float[Array, " K"], known: bool) -> tuple[str, ...]:
    """Return that angles are probably in degrees, unless their unit is known."""
    most = float(np.abs(yaw).max())
    if known or most <= 2.0 * np.pi:
        return ()
    return (
        f"the yaw of {what} reaches {most:.3g} rad, more than a turn; if it is in degrees, add "
        "`degrees: true`.",
    )


def _unix(times: Float[Array, " K"], unitless: bool) -> tuple[str, Array] | None:
    """Return the unit of Unix time stamps, and seconds since the first; None for other times."""
    # The number of digits states the unit.
    sizes = {"s": 1.0} | ({"ms": 1e-3, "us": 1e-6, "ns": 1e-9} if unitless else {})
    for unit, size in sizes.items():
        since = (times - times[0]) * size
        if _EPOCH[0] <= times[0] * size <= _EPOCH[1] and since[-1] <= _LASTS:
            return unit, since
    return None


def _unwrapped(yaw: Float[Array, " K"]) -> Float[Array, " K"]:
    """Return angles (rad) without jumps, if they lie within one turn, as recorders write them."""
    rounding = 5e-3
    # From 180 to -180 deg between few points is a turn that somebody wrote.
    turn = np.ptp(yaw) == 2.0 * np.pi and len(yaw) < _RECORDED
    centred = bool((np.abs(yaw) < np.pi + rounding).all()) and not turn
    positive = bool((yaw > -rounding).all() and (yaw < 2.0 * np.pi).all())
    return np.unwrap(yaw) if centred or positive else yaw


# ---- on the Earth --------------------------------------------------------------------------------

_RADIUS, _SQUARED = 6378137.0, 6.69437999014e-3
"""WGS 84: equatorial radius (m) and squared eccentricity."""


def _east_north_up(
    file: PathLike, places: Float[Array, "K 3"], lines: Sequence[int], heights: bool
) -> Float[Array, "K 3"]:
    """Return places (latitude and longitude in rad, altitude in m) in m about the first one."""
    _check_on_earth(file, places, lines)
    lat, lon, alt = places.T
    normal = _RADIUS / np.sqrt(1.0 - _SQUARED * np.sin(lat) ** 2)
    flat = (normal + alt) * np.cos(lat)
    fixed = np.stack(
        [flat * np.cos(lon), flat * np.sin(lon), (normal * (1.0 - _SQUARED) + alt) * np.sin(lat)]
    )
    (sp, sl), (cp, cl) = np.sin(places[0, :2]), np.cos(places[0, :2])
    axes = np.array([[-sl, cl, 0.0], [-sp * cl, -sp * sl, cp], [cp * cl, cp * sl, sp]])
    local = (axes @ (fixed - fixed[:, :1])).T
    local[:, 2] *= heights
    return local


def _check_on_earth(file: PathLike, places: Float[Array, "K 3"], lines: Sequence[int]) -> None:
    limits = np.array([np.pi / 2.0, 2.0 * np.pi])
    for k, axis in np.argwhere(np.abs(places[:, :2]) > limits)[:1]:
        name, most = (("lat", 90), ("lon", 360))[axis]
        raise ReferenceError(
            f"`{name}` of the path at `{file}:{lines[k]}` is {np.degrees(places[k, axis]):.10g} "
            f"deg, and must be from -{most} to {most} deg."
        )
    unknown = np.flatnonzero((places[:, :2] == 0.0).all(axis=1))
    if len(unknown) and np.abs(places[:, :2]).max() > 0.1:
        raise ReferenceError(
            f"`lat` and `lon` of the path at `{file}:{lines[unknown[0]]}` are 0, as receivers "
            "without a fix write; delete such lines."
        )


def _read_gpx(file: PathLike) -> Columns:
    """Return time, latitude, longitude, altitude and yaw of the points of a GPX file."""
    root = read_xml(file, "path", ReferenceError, "a GPX file")
    kinds = (root.findall(f".//{{*}}{kind}") for kind in ("trkpt", "rtept", "wpt"))
    points = next((found for found in kinds if found), [])
    rows = []
    for k, point in enumerate(points, 1):
        texts = [point.get("lat"), point.get("lon"), point.findtext("{*}ele", "0")]
        date = point.findtext("{*}time", "")
        try:
            place = [float(text or "") for text in texts]
            rows.append([seconds_of(date.strip()), *np.radians(place[:2]), place[2], 0.0])
        except ValueError:
            seen = f"the time `{date}`, latitude, longitude and altitude {texts}"
            raise ReferenceError(
                f"point {k} of the path `{file}` has {seen}, and must have each."
            ) from None
    if len(rows) < 2:
        raise ReferenceError(f"the path `{file}` must have 2 or more points, and has {len(rows)}.")
    absent = () if root.find(".//{*}ele") is not None else ("alt",)
    return Columns(np.array(rows), range(1, len(rows) + 1), absent, ())
