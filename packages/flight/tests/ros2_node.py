"""A node of ROS 2 that is none: a participant of its own, with message classes written apart.

    python ros2_node.py '{"name": "cf1", "kind": "pose"}'

publishes the state of a point that obeys accelerations from `cmd_full_state`, or of a robot that
obeys `cmd_vel`, 100 times a second until its standard input ends, and prints what it was sent last.
"""

import json
import math
import os
import sys
import threading
import time
from dataclasses import dataclass

from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.annotations import final
from cyclonedds.idl.types import array, float64, int32, uint32
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

# As the files of rosidl say: DDS compares the names of types and members, and their order.


@dataclass
@final
class Stamp(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    sec: int32
    nanosec: uint32


@dataclass
@final
class Header(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
    stamp: Stamp
    frame_id: str


@dataclass
@final
class Vector(IdlStruct, typename="geometry_msgs::msg::dds_::Vector3_"):
    x: float64
    y: float64
    z: float64


@dataclass
@final
class Point(IdlStruct, typename="geometry_msgs::msg::dds_::Point_"):
    x: float64
    y: float64
    z: float64


@dataclass
@final
class Turn(IdlStruct, typename="geometry_msgs::msg::dds_::Quaternion_"):
    x: float64
    y: float64
    z: float64
    w: float64


@dataclass
@final
class Place(IdlStruct, typename="geometry_msgs::msg::dds_::Pose_"):
    position: Point
    orientation: Turn


@dataclass
@final
class Pose(IdlStruct, typename="geometry_msgs::msg::dds_::PoseStamped_"):
    header: Header
    pose: Place


@dataclass
@final
class Twist(IdlStruct, typename="geometry_msgs::msg::dds_::Twist_"):
    linear: Vector
    angular: Vector


@dataclass
@final
class Known(IdlStruct, typename="geometry_msgs::msg::dds_::PoseWithCovariance_"):
    pose: Place
    covariance: array[float64, 36]


@dataclass
@final
class Moving(IdlStruct, typename="geometry_msgs::msg::dds_::TwistWithCovariance_"):
    twist: Twist
    covariance: array[float64, 36]


@dataclass
@final
class Odom(IdlStruct, typename="nav_msgs::msg::dds_::Odometry_"):
    header: Header
    child_frame_id: str
    pose: Known
    twist: Moving


@dataclass
@final
class Full(IdlStruct, typename="crazyflie_interfaces::msg::dds_::FullState_"):
    header: Header
    pose: Place
    twist: Twist
    acc: Vector


def numbers(message):
    """All numbers of a message but its stamp, in order."""
    parts = [getattr(message, name) for name in message.__dataclass_fields__ if name != "header"]
    return [x for part in parts for x in ([part] if isinstance(part, float) else numbers(part))]


def build(kind, values):
    """A message of a kind without texts from numbers in order."""
    names = kind.__dataclass_fields__
    return kind(*(next(values) if each.type is float64 else build(each.type, values)
                  for each in names.values()))  # fmt: skip


def quality(*more):
    return Qos(*more, Policy.DataRepresentation(use_cdrv0_representation=True))


def entities(name, kind, output):
    world = DomainParticipant(int(os.environ.get("ROS_DOMAIN_ID", "0")))
    message, topic = (Pose, "pose") if kind == "pose" else (Odom, "odom")
    best = quality(Policy.Reliability.BestEffort)
    out = DataWriter(world, Topic(world, f"rt/{name}/{topic}", message), qos=best)
    taken, topic = (Full, "cmd_full_state") if output == "full_state" else (Twist, "cmd_vel")
    # ROS's default for subscriptions.
    whole = quality(Policy.Reliability.Reliable(10**8), Policy.History.KeepLast(10))
    return out, DataReader(world, Topic(world, f"rt/{name}/{topic}", taken), qos=whole)


def serve(name="cf1", kind="pose", output="full_state", start=(0.0, 0.0, 1.0, 0.0), turn=0.0):
    out, inputs = entities(name, kind, output)
    (x, y, z, yaw), v, last, dt = start, [0.0] * 3, [], 0.01
    going = threading.Event()
    threading.Thread(target=lambda: (sys.stdin.read(), going.set()), daemon=True).start()
    print("ready", flush=True)
    due = time.monotonic()
    while not going.is_set():
        for each in inputs.take(10):
            last = numbers(each) if isinstance(each, Full | Twist) else last
        rate = turn
        if last and output == "full_state":
            v = [a + dt * b for a, b in zip(v, last[13:], strict=True)]
        elif last:
            c, s, rate = math.cos(yaw), math.sin(yaw), last[5]
            v = [c * last[0] - s * last[1], s * last[0] + c * last[1], 0.0]
        x, y, z = (a + dt * b for a, b in zip((x, y, z), v, strict=True))
        yaw += dt * rate
        stamp = Stamp(*divmod(time.time_ns(), 10**9))
        turned = [0.0, 0.0, math.sin(0.5 * yaw), math.cos(0.5 * yaw)]
        place = build(Place, iter([x, y, z, *turned]))
        if kind == "pose":
            out.write(Pose(Header(stamp, "world"), place))
        else:
            c, s, none = math.cos(yaw), math.sin(yaw), [0.0] * 36
            body = [c * v[0] + s * v[1], c * v[1] - s * v[0], v[2], 0.0, 0.0, rate]
            first, second = Known(place, none), Moving(build(Twist, iter(body)), none)
            out.write(Odom(Header(stamp, "odom"), "base_link", first, second))
        due += dt
        time.sleep(max(0.0, due - time.monotonic()))
    print(json.dumps({"last": last, "p": [x, y, z], "yaw": yaw}))


if __name__ == "__main__":
    serve(**json.loads(sys.argv[1]))
