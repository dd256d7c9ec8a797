"""The link to nodes of ROS 2 by cyclonedds: its bytes, its frames, and a node in another process.

Where cyclonedds is not installed, conftest.py leaves this file out, and says so.

No ROS installation was available. The bytes are compared with some put together by hand from OMG's
rules of CDR (formal/02-06-51, 15.3), and with those of the independent serializer of `rosbags`.
"""

import contextlib
import itertools
import json
import math
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from cyclonedds.domain import DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from ros2_node import Full, Header, Place, Point, Pose, Stamp, Turn, numbers
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from test_ros2 import DOUBLE, UNICYCLE, facts

from echelon_flight import FlightError
from echelon_flight.links import open_link, ros2
from echelon_flight.links import ros2_messages as ros
from echelon_flight.links.attitude import quaternion_of, rotate
from echelon_flight.ros2_view import Ros2View
from echelon_flight.wire import Drop, Report

NODE = Path(__file__).with_name("ros2_node.py")
LOOPBACK = (
    "<CycloneDDS><Domain><General><Interfaces><NetworkInterface name='lo' multicast='false'/>"
    "</Interfaces><AllowMulticast>false</AllowMulticast></General><Discovery><Peers>"
    "<Peer address='127.0.0.1'/></Peers><ParticipantIndex>auto</ParticipantIndex></Discovery>"
    "</Domain></CycloneDDS>"
)

# A PoseStamped: 1.5 s, frame `map`, place (1, 2, 3), attitude (0, 0, 0, 1).
BY_HAND = bytes.fromhex(
    "00010000"  # plain CDR, little-endian, no options
    "01000000" "0065cd1d"  # int32 sec = 1, uint32 nanosec = 500 000 000
    "04000000" "6d617000"  # a string: its length with its zero, then `map`, zero
    "000000000000f03f" "0000000000000040" "0000000000000840"  # at a multiple of 8: 1, 2, 3
    "0000000000000000" "0000000000000000" "0000000000000000" "000000000000f03f"
)  # fmt: skip
NONE = math.nan
REPORT = Report(1, 0, 0, 0.0, 1.0, NONE, NONE, NONE, 0.0, 0.0, 0.01, NONE, (0,) * len(Drop))


def test_a_pose_is_the_bytes_that_the_rules_of_cdr_give():
    pose = ros.Pose(ros.Point(1.0, 2.0, 3.0), ros.Quaternion(0.0, 0.0, 0.0, 1.0))
    message = ros.PoseStamped(ros.Header(ros.Time(1, 500_000_000), "map"), pose)
    assert message.serialize() == BY_HAND
    assert ros.PoseStamped.deserialize(BY_HAND) == message
    # With a frame of 5 letters the doubles begin after 2 bytes of padding.
    longer = BY_HAND[:12] + b"\6\0\0\0world\0" + bytes(2 + 4) + BY_HAND[20:]
    message.header.frame_id = "world"
    assert message.serialize() == longer


FULL_STATE = """std_msgs/Header header
geometry_msgs/Pose pose
geometry_msgs/Twist twist
geometry_msgs/Vector3 acc
"""


def stores():
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(FULL_STATE, "crazyflie_interfaces/msg/FullState"))
    return store


KINDS = ["PoseStamped", "Odometry", "Twist", "FullState", "MarkerArray"]


def vary(message, draws):
    """Change all numbers and texts of a message in place."""
    for name in message.__dataclass_fields__:
        value = getattr(message, name)
        if hasattr(value, "__dataclass_fields__"):
            vary(value, draws)
        elif isinstance(value, float):
            setattr(message, name, float(draws.integers(-8, 8)) / 4.0)
        elif isinstance(value, str):
            setattr(message, name, "w" * int(draws.integers(0, 9)))
        elif isinstance(value, list) and value and isinstance(value[0], float):
            setattr(message, name, [float(x) for x in draws.integers(-8, 8, len(value))])
    return message


def compared(one, other):
    """Whether a message here and one of rosbags have the same content."""
    if hasattr(one, "__dataclass_fields__"):
        names = [*one.__dataclass_fields__]
        assert names == [n for n in other.__dataclass_fields__ if n.strip("_") == n == n.lower()]
        return all(compared(getattr(one, name), getattr(other, name)) for name in names)
    if isinstance(one, list):
        return len(one) == len(other) and all(map(compared, one, other))
    return one == other


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", range(3))
def test_messages_are_those_of_an_independent_reader_and_writer(kind, seed):
    draws, store = np.random.default_rng(seed), stores()
    message = vary(getattr(ros, kind)(), draws)
    if kind == "MarkerArray":
        message.markers = [vary(ros.Marker(), draws) for _ in range(2)]
        message.markers[1].points = [vary(ros.Point(), draws) for _ in range(2)]
    name = ros.ros_type(message.__idl__.idl_transformed_typename).replace("/", "/msg/")
    content = message.serialize()
    other = store.deserialize_cdr(content, name)
    assert compared(message, other)
    assert type(message).deserialize(bytes(store.serialize_cdr(other, name))) == message


def test_topics_and_types_have_the_names_of_ros():
    assert ros.dds_topic("/cf1/pose") == "rt/cf1/pose"
    name = ros.PoseStamped.__idl__.idl_transformed_typename
    assert name == "geometry_msgs::msg::dds_::PoseStamped_"
    assert ros.ros_type(name) == "geometry_msgs/PoseStamped"


def test_a_velocity_of_the_world_is_sent_in_the_frame_of_the_robot():
    twist = ros2.twist_of(("vx", "vy"), (0.3, -0.2), 0.7)
    back = rotate(quaternion_of(0.0, 0.0, 0.7), (twist.linear.x, twist.linear.y, 0.0))
    assert back == pytest.approx((0.3, -0.2, 0.0)) and twist.angular.z == 0.0
    turn = ros2.twist_of(("speed", "turn_rate"), (0.5, -1.5), 0.7)
    assert (turn.linear.x, turn.linear.y, turn.angular.z) == (0.5, 0.0, -1.5)


# ---- nodes in other processes --------------------------------------------------------------------


COUNT = itertools.count()


def domain():
    return int(os.environ["ROS_DOMAIN_ID"])


@pytest.fixture(autouse=True)
def loopback(monkeypatch):
    """A domain of its own for each test: others see a node that has ended for a while."""
    monkeypatch.setenv("CYCLONEDDS_URI", LOOPBACK)
    monkeypatch.setenv("ROS_DOMAIN_ID", str(1 + (31 * os.getpid() + next(COUNT)) % 200))


@contextlib.contextmanager
def node(**settings):
    """A node that runs in the block; the mapping has what it prints at its end."""
    command, end = [sys.executable, NODE, json.dumps(settings)], {}
    with subprocess.Popen(command, stdin=-1, stdout=-1, text=True, env={**os.environ}) as process:
        assert process.stdout.readline() == "ready\n"
        try:
            yield end
        finally:
            process.stdin.close()
            end.update(json.loads(process.stdout.read() or "{}"))


def test_a_crazyflie_of_crazyswarm2_is_read_and_obeys():
    """A law by hand, which brings a point to rest at (0.3, -0.2, 1.1), as any exported law does."""
    with node(start=[0.0, 0.0, 1.0, 0.5]) as end:
        link = open_link("ros2://cf1", facts(*DOUBLE, sinking_speed=0.4))
        for _ in range(1000):
            # None before there are poses enough for a velocity.
            if (reading := link.read(1.0)) is None:
                continue
            p, v = np.array(reading.x[:3]), np.array(reading.x[3:])
            link.send([*(8.0 * (np.array([0.3, -0.2, 1.1]) - p) - 4.0 * v)])
            if np.linalg.norm(p - [0.3, -0.2, 1.1]) < 1e-3 and np.linalg.norm(v) < 1e-3:
                break
        # It sinks at its last place, by the firmware's own controller, until it is at the ground.
        began = time.monotonic()
        while time.monotonic() < began + 0.2:
            link.level_descend()
        link.close()
    assert end["p"] == pytest.approx([0.3, -0.2, 1.1], abs=0.02)
    place, turn, motion = end["last"][:3], end["last"][3:7], end["last"][7:]
    assert place[:2] == pytest.approx(reading.x[:2]) and place[2] < reading.x[2]
    assert turn == pytest.approx([0.0, 0.0, math.sin(0.25), math.cos(0.25)])
    assert motion == [0.0, 0.0, -0.4, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]


def test_poses_that_are_none_are_left_out_or_refused():
    """By a participant of this process, whose messages a test chooses."""
    world = DomainParticipant(domain())
    topic, inputs = Topic(world, "rt/cf3/pose", Pose), Topic(world, "rt/cf3/cmd_full_state", Full)
    out, _reader = DataWriter(world, topic), DataReader(world, inputs)
    link = open_link("ros2://cf3", facts(*DOUBLE))

    def said(k, x=1.0, w=1.0):
        place = Place(Point(x, 2.0, 3.0), Turn(0.0, 0.0, 0.0, w))
        out.write(Pose(Header(Stamp(k, 0), "world"), place))
        return link.read(5.0)

    assert [said(k) is None for k in range(1, 6)] == [True] * 4 + [False]
    assert said(6, x=math.nan) is None and said(7, w=math.nan) is None
    assert said(5) is None and said(8).x == [1.0, 2.0, 3.0, 0.0, 0.0, 0.0]
    with pytest.raises(FlightError, match="the orientation on `/cf3/pose` has length 0, and must"):
        said(9, w=0.0)
    link.close()


def test_a_ground_robot_with_odometry_is_read_and_obeys():
    with node(name="r1", kind="odom", output="cmd_vel", start=[1.0, 2.0, 0.0, 0.5]) as end:
        link = open_link("ros2://r1?state=odom&output=cmd_vel&ahead=0.1", facts(*UNICYCLE))
        first = link.read(1.0).x
        assert first == pytest.approx([1.0 + 0.1 * math.cos(0.5), 2.0 + 0.1 * math.sin(0.5), 0.5])
        link.send([0.5, 1.0])
        while (x := link.read(1.0).x)[2] < 1.0:
            pass
        # The chord of an arc with a radius of 0.5 m.
        axle = np.array(x[:2]) - 0.1 * np.array([math.cos(x[2]), math.sin(x[2])])
        chord = 2.0 * 0.5 * math.sin(0.5 * (x[2] - 0.5))
        assert np.linalg.norm(axle - [1.0, 2.0]) == pytest.approx(chord, abs=0.02)
        link.level_descend()
        while end.get("last") is None and link.read(0.5).x[2] != x[2]:
            x = link.read(0.5).x
        link.close()
    assert end["last"] == [0.0] * 6


def test_what_no_node_serves_is_one_sentence(monkeypatch):
    soon = facts(*DOUBLE, ros2_patience=0.3)
    with pytest.raises(
        FlightError, match=f"no node publishes `/cf1/pose` in ROS domain {domain()}"
    ):
        open_link("ros2://cf1", soon)
    with node(name="cf2"):
        with pytest.raises(
            FlightError, match="it has `/cf2/pose`. Start the node, or name its top"
        ):
            open_link("ros2://cf1", facts(*DOUBLE))
        with pytest.raises(FlightError, match="no node reads `/cf2/cmd_vel`"):
            open_link("ros2://cf2?output=cmd_vel", facts(*UNICYCLE))
        words = (
            "a node publishes `/cf2/pose` as `geometry_msgs/PoseStamped`, and the link needs "
            "`nav_msgs/Odometry`."
        )
        with pytest.raises(FlightError, match=words):
            open_link("ros2://cf2?state=odom&from=/cf2/pose", facts(*DOUBLE))
    monkeypatch.setenv("ROS_DOMAIN_ID", "ten")
    with pytest.raises(FlightError, match="`ROS_DOMAIN_ID` is `ten`"):
        open_link("ros2://cf1", facts(*DOUBLE))


def test_the_ground_station_publishes_poses_goals_and_markers():
    """A second participant reads them, by its own classes of poses."""
    places = {0: (1.0, 2.0, 1.5), 1: (1.5, 2.1, 1.5)}
    offsets = {"every": 0.1, "rows": [[[0.0, 0.0, 0.0], [0.6, 0.0, 0.0]]]}
    facts = {"agents": 2, "leader": 0, "position": [0, 1, 2], "offsets": offsets}
    world, topics = (
        DomainParticipant(domain()),
        ["agent0/pose", "agent0/goal", "agent1/pose", "agent1/goal"],
    )
    readers = [DataReader(world, Topic(world, f"rt/echelon/{name}", Pose)) for name in topics]
    markers = DataReader(world, Topic(world, "rt/echelon/markers", ros.MarkerArray))
    view, seen = Ros2View(facts), [[], [], [], [], []]
    while not all(seen):
        for k, (x, y, z) in places.items():
            view.report(k, REPORT._replace(x=x, y=y, z=z))
        for k, reader in enumerate([*readers, markers]):
            seen[k] = seen[k] + reader.take(10)
    poses = [numbers(each[-1])[:3] for each in seen[:4]]
    assert poses == [[*places[0]], [*places[0]], [*places[1]], [1.6, 2.0, 1.5]]
    shapes = {(m.ns, m.id): m for m in seen[4][-1].markers}
    assert [*shapes] == [("agents", 0), ("errors", 0), ("agents", 1), ("errors", 1)]
    ends = [(p.x, p.y, p.z) for p in shapes["errors", 1].points]
    assert ends == [places[1], (1.6, 2.0, 1.5)]
    # Where no state was measured there is nothing to draw.
    view.report(1, REPORT)
    view.close()
