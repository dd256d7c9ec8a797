"""Recordings of others as tracks of agents: rosbag2, MCAP, ULog of PX4, CSV logs of a Crazyflie."""

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, final

import numpy as np
from jaxtyping import Float

from echelon.core.errors import MissingExtraError, OutputError
from echelon.core.text_table import Column, read_table
from echelon.output.archive.bags import ros_library, topics_in

_ANGLES = ("roll", "pitch", "yaw")
_POSE, _MOTION = ("x", "y", "z", *_ANGLES), ("vx", "vy", "vz", "p", "q", "r")
_ORDER = ("x", "y", "z", "vx", "vy", "vz", *_ANGLES, "p", "q", "r")
"""Of a quadrotor's states."""


@final
@dataclasses.dataclass(frozen=True, eq=False)
class Track:
    """What was recorded of one agent at T times, in the frames of echelon's models.

    World axes are east, north, up (those of ROS), body axes forward, left, up.

    Attributes:
        times: s, increasing.
        states: in the order of `names`; angles are unwrapped, rad.
        names: of the states.
    """

    times: Float[np.ndarray, " T"]
    states: Float[np.ndarray, "T n"]
    names: tuple[str, ...]

    def at(self, times: Float[np.ndarray, " K"]) -> Float[np.ndarray, "K n"]:
        """Return states at other times (s), by lines between neighbours; NaN outside."""
        columns = [np.interp(times, self.times, x, np.nan, np.nan) for x in self.states.T]
        return np.stack(columns, axis=1)


@final
@dataclasses.dataclass(frozen=True, eq=False)
class Recorded:
    """Agents that others recorded.

    Attributes:
        tracks: by the number of the agent; each has times of its own.
    """

    tracks: dict[int, Track]

    @property
    def times(self) -> Float[np.ndarray, " T"]:
        """The times (s) of the agent that is named first, while all are recorded."""
        tracks = [*self.tracks.values()]
        first = max(track.times[0] for track in tracks)
        last = min(track.times[-1] for track in tracks)
        times = tracks[0].times
        return times[(times >= first) & (times <= last)]

    @property
    def state_names(self) -> tuple[str, ...]:
        """The states that all agents have."""
        shared = set.intersection(*({*track.names} for track in self.tracks.values()))
        return tuple(name for name in _ORDER if name in shared)

    @property
    def states(self) -> Float[np.ndarray, "T N n"]:
        """The states of all agents, in the order they were named, at `times`."""
        rows = []
        for track in self.tracks.values():
            columns = [track.names.index(name) for name in self.state_names]
            rows.append(track.at(self.times)[:, columns])
        return np.stack(rows, axis=1)


def recorded(place: Path, agents: Mapping[int, str]) -> Recorded:
    """Return the recording in a bag (folder, `.mcap`, `.db3`), a `.ulg` or a `.csv`.

    Args:
        place: of the recording.
        agents: the topic of each agent: of PoseStamped or Odometry in a bag, `vehicle_odometry` or
            `vehicle_local_position` in a ULog, a group such as `stateEstimate` in a CSV log.

    Raises:
        OutputError: it cannot be read, or lacks a topic; with the topics that it has.
        MissingExtraError: its library is not installed.
    """
    if not agents:
        raise OutputError("`agents` names no topic; give as `agents={0: '/cf1/pose'}`.")
    readers = {".ulg": _ulog, ".csv": _csv}
    read = readers.get(place.suffix.lower(), _bag)
    found = {number: read(place, topic) for number, topic in agents.items()}
    return Recorded({number: _track(place, found[number], agents[number]) for number in agents})


def _track(place: Path, numbers: dict[str, np.ndarray], topic: str) -> Track:
    times = numbers.pop("time")
    order = np.concatenate([[True], times[1:] > np.maximum.accumulate(times)[:-1]])
    order &= np.isfinite(times) & np.all([np.isfinite(x) for x in numbers.values()], axis=0)
    if not order.any():
        raise OutputError(f"`{topic}` in `{place}` has no message with finite numbers.")
    for name in _ANGLES:
        if name in numbers:
            numbers[name][order] = np.unwrap(numbers[name][order])
    states = np.stack([*numbers.values()], axis=1)[order]
    return Track(times[order], states, tuple(numbers))


def _named(
    time: np.ndarray,
    position: np.ndarray,
    quaternion: np.ndarray,
    velocity: np.ndarray | None = None,
    rates: np.ndarray | None = None,
) -> dict[str, np.ndarray]:
    """Return columns by name; quaternions are (x, y, z, w), and need not have length 1."""
    from scipy.spatial.transform import Rotation

    if not np.all(np.linalg.norm(quaternion, axis=1) > 0.0):
        raise OutputError("an orientation has length 0, and must be a quaternion.")
    yaw, pitch, roll = Rotation.from_quat(quaternion).as_euler("ZYX").T
    columns = [time, *position.T, roll, pitch, yaw]
    if velocity is not None and rates is not None:
        columns += [*velocity.T, *rates.T]
    return dict(zip(("time", *_POSE, *_MOTION), columns, strict=False))


def _missing(place: Path, topic: str, seen: str) -> OutputError:
    return OutputError(f"`{place}` has no topic `{topic}` that can be read; it has {seen}.")


# ---- bags of ROS 2 -------------------------------------------------------------------------------


def _bag(place: Path, topic: str) -> dict[str, np.ndarray]:
    from scipy.spatial.transform import Rotation

    table = np.array(_rows(place, topic))
    if not len(table):
        raise OutputError(f"`{topic}` in `{place}` has no messages.")
    if table.shape[1] == 8:
        return _named(table[:, 0], table[:, 1:4], table[:, 4:])
    velocity = Rotation.from_quat(table[:, 4:8]).apply(table[:, 8:11])
    return _named(table[:, 0], table[:, 1:4], table[:, 4:8], velocity, table[:, 11:])


def _rows(place: Path, topic: str) -> list[list[float]]:
    ros = ros_library()
    store = ros.typesys.get_typestore(ros.typesys.Stores.ROS2_HUMBLE)
    kinds = {"geometry_msgs/msg/PoseStamped": _of_pose, "nav_msgs/msg/Odometry": _of_odom}
    try:
        with ros.highlevel.AnyReader([place], default_typestore=store) as bag:
            ways = [x for x in bag.connections if x.topic == topic and x.msgtype in kinds]
            if not ways:
                raise _missing(place, topic, ", ".join(topics_in(bag.connections)) or "none")
            kind = ways[0].msgtype
            messages = (bag.deserialize(raw, kind) for _, _, raw in bag.messages(ways[:1]))
            return [kinds[kind](message) for message in messages]
    except (ros.highlevel.AnyReaderError, OSError, ValueError) as error:
        why = str(error).partition("\n")[0].rstrip(".")
        raise OutputError(f"`{place}` cannot be read as a bag of ROS 2: {why}.") from error


def _of_pose(message: Any) -> list[float]:
    stamp, p, q = message.header.stamp, message.pose.position, message.pose.orientation
    return [stamp.sec + 1e-9 * stamp.nanosec, p.x, p.y, p.z, q.x, q.y, q.z, q.w]


def _of_odom(message: Any) -> list[float]:
    stamp, p, q = message.header.stamp, message.pose.pose.position, message.pose.pose.orientation
    v, w = message.twist.twist.linear, message.twist.twist.angular
    place = [stamp.sec + 1e-9 * stamp.nanosec, p.x, p.y, p.z, q.x, q.y, q.z, q.w]
    return [*place, v.x, v.y, v.z, w.x, w.y, w.z]


# ---- logs of autopilots --------------------------------------------------------------------------


def _ulog(place: Path, topic: str) -> dict[str, np.ndarray]:
    """Return a log of PX4, whose axes are north, east, down and forward, right, down."""
    try:
        from pyulog import ULog
    except ImportError as error:
        raise MissingExtraError(
            "ULog files need pyulog, which is not installed; "
            "`pip install '.[bags]'` in echelon's clone."
        ) from error
    try:
        log = ULog(str(place))
    # Bytes that are no log lead its reader to errors of any kind.
    except Exception as error:
        raise OutputError(f"`{place}` cannot be read as a ULog: {error}.") from error
    readers: dict[str, Callable[[dict[str, np.ndarray]], dict[str, np.ndarray]]]
    readers = {"vehicle_odometry": _of_px4, "vehicle_local_position": _of_local}
    found = {each.name: each.data for each in log.data_list if each.multi_id == 0}
    if topic not in found or topic not in readers:
        raise _missing(place, topic, ", ".join(f"`{name}`" for name in sorted(found)) or "none")
    return readers[topic](found[topic])


def _swapped(data: dict[str, np.ndarray], *names: str) -> np.ndarray:
    """Return a vector of north, east, down as one of east, north, up."""
    north, east, down = (data[name].astype(float) for name in names)
    return np.stack([east, north, -down], axis=1)


def _of_px4(data: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    from scipy.spatial.transform import Rotation

    def vector(name: str, size: int = 3) -> np.ndarray:
        return np.stack([data[f"{name}[{k}]"].astype(float) for k in range(size)], axis=1)

    w, *rest = vector("q", 4).T
    given = Rotation.from_quat(np.stack([*rest, w], axis=1))
    # Half turns that swap the frames of world and body.
    world = Rotation.from_quat([np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0])
    turn = world * given * Rotation.from_quat([1.0, 0.0, 0.0, 0.0])
    # 3: the velocity is in the frame of the body.
    of_body = data["velocity_frame"] == 3 if "velocity_frame" in data else np.array([False])
    velocity = np.where(of_body[:, None], given.apply(vector("velocity")), vector("velocity"))
    rates = vector("angular_velocity") * [1.0, -1.0, -1.0]
    position = world.apply(vector("position"))
    return _named(1e-6 * data["timestamp"], position, turn.as_quat(), world.apply(velocity), rates)


def _of_local(data: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    place, speed = _swapped(data, "x", "y", "z"), _swapped(data, "vx", "vy", "vz")
    columns = dict(zip(("x", "y", "z", "vx", "vy", "vz"), [*place.T, *speed.T], strict=True))
    # A heading of 0 is north, and a yaw of 0 east.
    yaw = 0.5 * np.pi - data["heading"].astype(float)
    return {"time": 1e-6 * data["timestamp"]} | columns | {"yaw": yaw}


def _csv(place: Path, topic: str) -> dict[str, np.ndarray]:
    """Return the group `stateEstimate` of a CSV log, whose pitch is negated."""
    units = {"time": ("s", "ms"), **dict.fromkeys("xyz", ("m", "m"))}
    units |= dict.fromkeys(("vx", "vy", "vz"), ("m/s", "m/s"))
    units |= dict.fromkeys(_ANGLES, ("rad", "deg"))
    columns = [
        Column(name, unit, names, assumed, optional=name not in ("time", "x", "y"))
        for name, (unit, assumed) in units.items()
        for names in [("timestamp", "t") if name == "time" else (f"{topic}_{name}".lower(),)]
    ]
    read = read_table(place, "log", OutputError).columns(columns)
    found = dict(zip(units, read.values.T, strict=True))
    found["pitch"] *= -1.0
    return {name: values for name, values in found.items() if name not in read.absent}
