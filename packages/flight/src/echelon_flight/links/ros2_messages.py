"""The messages of ROS 2 that flights use, as DDS has them.

ROS 2 writes a type such as `geometry_msgs/PoseStamped` as `geometry_msgs::msg::dds_::PoseStamped_`,
a topic `/cf1/pose` as `rt/cf1/pose`, and the fields of a message as plain CDR in their order.
`Marker` is as from Humble on.
"""

# The library's types are lists in Python.
# pyright: reportAssignmentType=false

import time
from dataclasses import dataclass, field

from cyclonedds.idl import IdlStruct
from cyclonedds.idl.annotations import final
from cyclonedds.idl.types import array, float32, float64, int32, sequence, uint8, uint32


def dds_topic(topic: str) -> str:
    """Return the name that DDS has for a topic such as `/cf1/pose`."""
    return "rt/" + topic.lstrip("/")


def ros_type(dds_type: str) -> str:
    """Return the name that ROS has for a type of DDS."""
    return dds_type.replace("::msg::dds_::", "/").removesuffix("_")


@dataclass
@final
class Time(IdlStruct, typename="builtin_interfaces.msg.dds_.Time_"):
    """A time since 1970."""

    sec: int32 = 0
    nanosec: uint32 = 0

    @classmethod
    def now(cls) -> "Time":
        """Return the time of this machine's clock."""
        return cls(*divmod(time.time_ns(), 1_000_000_000))


@dataclass
@final
class Duration(IdlStruct, typename="builtin_interfaces.msg.dds_.Duration_"):
    """A duration."""

    sec: int32 = 0
    nanosec: uint32 = 0


@dataclass
@final
class Header(IdlStruct, typename="std_msgs.msg.dds_.Header_"):
    """When and in which frame."""

    stamp: Time = field(default_factory=Time.now)
    frame_id: str = "world"


@dataclass
@final
class Point(IdlStruct, typename="geometry_msgs.msg.dds_.Point_"):
    """A place, m."""

    x: float64 = 0.0
    y: float64 = 0.0
    z: float64 = 0.0


@dataclass
@final
class Vector3(IdlStruct, typename="geometry_msgs.msg.dds_.Vector3_"):
    """A vector."""

    x: float64 = 0.0
    y: float64 = 0.0
    z: float64 = 0.0


@dataclass
@final
class Quaternion(IdlStruct, typename="geometry_msgs.msg.dds_.Quaternion_"):
    """An attitude, body to world."""

    x: float64 = 0.0
    y: float64 = 0.0
    z: float64 = 0.0
    w: float64 = 1.0


@dataclass
@final
class Pose(IdlStruct, typename="geometry_msgs.msg.dds_.Pose_"):
    """Place and attitude."""

    position: Point = field(default_factory=Point)
    orientation: Quaternion = field(default_factory=Quaternion)


@dataclass
@final
class PoseStamped(IdlStruct, typename="geometry_msgs.msg.dds_.PoseStamped_"):
    """A pose at a time."""

    header: Header = field(default_factory=Header)
    pose: Pose = field(default_factory=Pose)


@dataclass
@final
class Twist(IdlStruct, typename="geometry_msgs.msg.dds_.Twist_"):
    """Velocity (m/s) and rates (rad/s)."""

    linear: Vector3 = field(default_factory=Vector3)
    angular: Vector3 = field(default_factory=Vector3)


def _zeros() -> list[float]:
    return [0.0] * 36


@dataclass
@final
class PoseWithCovariance(IdlStruct, typename="geometry_msgs.msg.dds_.PoseWithCovariance_"):
    """A pose, and how uncertain it is."""

    pose: Pose = field(default_factory=Pose)
    covariance: array[float64, 36] = field(default_factory=_zeros)


@dataclass
@final
class TwistWithCovariance(IdlStruct, typename="geometry_msgs.msg.dds_.TwistWithCovariance_"):
    """A twist, and how uncertain it is."""

    twist: Twist = field(default_factory=Twist)
    covariance: array[float64, 36] = field(default_factory=_zeros)


@dataclass
@final
class Odometry(IdlStruct, typename="nav_msgs.msg.dds_.Odometry_"):
    """A pose in the frame of the header, and a twist in the frame of the body."""

    header: Header = field(default_factory=Header)
    child_frame_id: str = ""
    pose: PoseWithCovariance = field(default_factory=PoseWithCovariance)
    twist: TwistWithCovariance = field(default_factory=TwistWithCovariance)


@dataclass
@final
class FullState(IdlStruct, typename="crazyflie_interfaces.msg.dds_.FullState_"):
    """A setpoint of Crazyswarm2: place, velocity, attitude, rates, acceleration (m/s^2)."""

    header: Header = field(default_factory=Header)
    pose: Pose = field(default_factory=Pose)
    twist: Twist = field(default_factory=Twist)
    acc: Vector3 = field(default_factory=Vector3)


# ---- what RViz and Foxglove draw -----------------------------------------------------------------


@dataclass
@final
class ColorRGBA(IdlStruct, typename="std_msgs.msg.dds_.ColorRGBA_"):
    """A colour, each part from 0 to 1."""

    r: float32 = 0.0
    g: float32 = 0.0
    b: float32 = 0.0
    a: float32 = 1.0


@dataclass
@final
class CompressedImage(IdlStruct, typename="sensor_msgs.msg.dds_.CompressedImage_"):
    """A picture; markers here have none."""

    header: Header = field(default_factory=Header)
    format: str = ""
    data: sequence[uint8] = field(default_factory=list)


@dataclass
@final
class UVCoordinate(IdlStruct, typename="visualization_msgs.msg.dds_.UVCoordinate_"):
    """A place in a picture."""

    u: float32 = 0.0
    v: float32 = 0.0


@dataclass
@final
class MeshFile(IdlStruct, typename="visualization_msgs.msg.dds_.MeshFile_"):
    """A file; markers here have none."""

    filename: str = ""
    data: sequence[uint8] = field(default_factory=list)


@dataclass
@final
class Marker(IdlStruct, typename="visualization_msgs.msg.dds_.Marker_"):
    """A shape: `type` 2 is a sphere, 4 a line through `points`, 9 a text."""

    header: Header = field(default_factory=Header)
    ns: str = ""
    id: int32 = 0
    type: int32 = 0
    action: int32 = 0
    pose: Pose = field(default_factory=Pose)
    scale: Vector3 = field(default_factory=Vector3)
    color: ColorRGBA = field(default_factory=ColorRGBA)
    lifetime: Duration = field(default_factory=Duration)
    frame_locked: bool = False
    points: sequence[Point] = field(default_factory=list)
    colors: sequence[ColorRGBA] = field(default_factory=list)
    texture_resource: str = ""
    texture: CompressedImage = field(default_factory=CompressedImage)
    uv_coordinates: sequence[UVCoordinate] = field(default_factory=list)
    text: str = ""
    mesh_resource: str = ""
    mesh_file: MeshFile = field(default_factory=MeshFile)
    mesh_use_embedded_materials: bool = False


@dataclass
@final
class MarkerArray(IdlStruct, typename="visualization_msgs.msg.dds_.MarkerArray_"):
    """Several shapes."""

    markers: sequence[Marker] = field(default_factory=list)
