"""Runs as ROS 2 bags: an MCAP file, or the folder of a rosbag2."""

import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Float

from echelon.core.errors import MissingExtraError
from echelon.experiments.results.recording import Recording, recording_of

if TYPE_CHECKING:
    from echelon.simulation.engine.result import Result

FRAME = "world"
_VERSION = 8
"""Of rosbag2's metadata: Humble reads it, and not the next one."""


def ros_library() -> Any:
    """Return the package `rosbags`, with `highlevel`, `rosbag2` and `typesys`.

    Raises:
        MissingExtraError: it is not installed.
    """
    try:
        import rosbags.highlevel
        import rosbags.rosbag2
        import rosbags.typesys
    except ImportError as error:
        raise MissingExtraError(
            "bags of ROS 2 need rosbags, which is not installed; "
            "`pip install '.[bags]'` in echelon's clone."
        ) from error
    return rosbags


def mcap_content(run: "Result | Recording") -> bytes:
    """Return a run as an MCAP file; see `save_bag`."""
    ros_library()
    with tempfile.TemporaryDirectory(prefix="echelon-bag-") as folder:
        save_bag(run, Path(folder) / "bag")
        return (Path(folder) / "bag" / "bag.mcap").read_bytes()


def save_bag(run: "Result | Recording", folder: Path) -> None:
    """Write a run as a rosbag2, a new folder with an MCAP file.

    Agent K has the topics `/agentK/pose` (PoseStamped), `/agentK/odom` (Odometry, whose twist is in
    the frame of the body), `/agentK/states` and `/agentK/inputs` (Float64MultiArray, labelled with
    their names). Stamps are the times of the run. What a model does not have is 0, except that
    velocities and rates which are no states are differences of the stored ones.

    Args:
        run: a result.
        folder: that does not exist.

    Raises:
        MissingExtraError: rosbags is not installed.
    """
    ros = ros_library()
    data = recording_of(run)
    store = ros.typesys.get_typestore(ros.typesys.Stores.ROS2_HUMBLE)
    plugin = ros.rosbag2.StoragePlugin.MCAP
    with ros.rosbag2.Writer(folder, version=_VERSION, storage_plugin=plugin) as bag:
        writers = [_writer(bag, store, data, k) for k in range(data.agents)]
        for row, time in enumerate(data.times):
            here = range(data.agents) if data.presence is None else data.presence[row].nonzero()[0]
            for k in here:
                writers[k](row, round(1e9 * time))


_KINDS = {
    "pose": "geometry_msgs/msg/PoseStamped",
    "odom": "nav_msgs/msg/Odometry",
    "states": "std_msgs/msg/Float64MultiArray",
    "inputs": "std_msgs/msg/Float64MultiArray",
}


def _writer(bag: Any, store: Any, data: Recording, agent: int) -> Callable[[int, int], None]:
    """Return what writes a frame of an agent, by its row and its stamp (ns)."""
    motion = motion_of(data, agent)
    ways = {
        topic: bag.add_connection(f"/agent{agent}/{topic}", kind, typestore=store)
        for topic, kind in _KINDS.items()
    }

    def write(row: int, stamp: int) -> None:
        header = _message(store, "std_msgs/Header", _time(store, stamp), FRAME)
        pose, twist = _pose(store, motion, row), _twist(store, motion, row)
        contents = {
            "pose": (header, pose.pose),
            "odom": (header, f"agent{agent}", pose, twist),
            "states": (_layout(store, data.state_names), data.states[row, agent]),
            "inputs": (_layout(store, data.input_names), data.inputs[row, agent]),
        }
        for topic, content in contents.items():
            message = store.types[_KINDS[topic]](*content)
            bag.write(ways[topic], stamp, store.serialize_cdr(message, _KINDS[topic]))

    return write


def _message(store: Any, kind: str, *content: Any) -> Any:
    return store.types[kind.replace("/", "/msg/")](*content)


def _time(store: Any, stamp: int) -> Any:
    return _message(store, "builtin_interfaces/Time", *divmod(stamp, 1_000_000_000))


def _layout(store: Any, names: tuple[str, ...]) -> Any:
    label = _message(store, "std_msgs/MultiArrayDimension", " ".join(names), len(names), len(names))
    return _message(store, "std_msgs/MultiArrayLayout", [label], 0)


def _pose(store: Any, motion: "BodyMotion", row: int) -> Any:
    place = _message(store, "geometry_msgs/Point", *motion.position[row].tolist())
    turn = _message(store, "geometry_msgs/Quaternion", *motion.quaternion[row].tolist())
    pose = _message(store, "geometry_msgs/Pose", place, turn)
    return _message(store, "geometry_msgs/PoseWithCovariance", pose, np.zeros(36))


def _twist(store: Any, motion: "BodyMotion", row: int) -> Any:
    parts = (
        _message(store, "geometry_msgs/Vector3", *part[row].tolist())
        for part in (motion.velocity, motion.rates)
    )
    twist = _message(store, "geometry_msgs/Twist", *parts)
    return _message(store, "geometry_msgs/TwistWithCovariance", twist, np.zeros(36))


class BodyMotion(NamedTuple):
    """How a body moves in space, at T times.

    Attributes:
        position: in the world, m.
        quaternion: (x, y, z, w), body to world.
        velocity: in the frame of the body, m/s.
        rates: about the axes of the body, rad/s.
    """

    position: Float[np.ndarray, "T 3"]
    quaternion: Float[np.ndarray, "T 4"]
    velocity: Float[np.ndarray, "T 3"]
    rates: Float[np.ndarray, "T 3"]


def motion_of(data: Recording, agent: int) -> BodyMotion:
    """Return how an agent of a run moves, by the names of its states."""
    from scipy.spatial.transform import Rotation

    states = dict(zip(data.state_names, data.states[:, agent].T, strict=True))
    states |= {"yaw": states["heading"]} if "heading" in states else {}

    def part(*names: str, of: np.ndarray | None = None) -> np.ndarray:
        """Return states by name; what is none of them is the slope of others, or 0."""
        rest = np.zeros((len(data.times), 3))
        if of is not None and len(of) > 1:
            rest = np.gradient(of, data.times, axis=0)
        return np.stack([states.get(x, rest[:, k]) for k, x in enumerate(names)], axis=1)

    position, angles = part("x", "y", "z"), np.unwrap(part("roll", "pitch", "yaw"), axis=0)
    turn = Rotation.from_euler("ZYX", angles[:, ::-1])
    velocity = turn.inv().apply(part("vx", "vy", "vz", of=position))
    rates = body_rates(angles, part("roll_rate", "pitch_rate", "yaw_rate", of=angles))
    rates = part("p", "q", "r") if "p" in states else rates
    return BodyMotion(position, turn.as_quat(), velocity, rates)


def body_rates(
    angles: Float[np.ndarray, "T 3"], rates: Float[np.ndarray, "T 3"]
) -> Float[np.ndarray, "T 3"]:
    """Return rates about the axes of the body from those of roll, pitch and yaw (rad/s)."""
    (roll, pitch, _), (a, b, c) = angles.T, rates.T
    return np.stack(
        [
            a - np.sin(pitch) * c,
            np.cos(roll) * b + np.sin(roll) * np.cos(pitch) * c,
            np.cos(roll) * np.cos(pitch) * c - np.sin(roll) * b,
        ],
        axis=1,
    )


def topics_in(connections: Any) -> Iterator[str]:
    """Yield the topics of a bag with their types, in back-ticks."""
    for each in sorted(connections, key=lambda each: each.topic):
        yield f"`{each.topic}` ({each.msgtype.replace('/msg/', '/')})"
