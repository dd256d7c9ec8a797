"""A vehicle that nodes of ROS 2 move, by their DDS messages; no ROS installation is needed.

`ros2://cf1` reads `/cf1/pose` (PoseStamped) and writes `/cf1/cmd_full_state` of Crazyswarm2.
Options behind a `?`, joined by `&`:

- `state=odom` reads `/cf1/odom` (Odometry), with its velocities.
- `output=cmd_vel` writes `/cf1/cmd_vel` (Twist), as ground robots take it.
- `from=/TOPIC` and `to=/TOPIC` name other topics.
- `ahead=0.1` takes a point that is so far (m) in front of the measured one for the vehicle's place.

The environment variable `ROS_DOMAIN_ID` chooses the domain. World axes are those of ROS: a yaw of 0
is along x, z is up. Poses have no velocities: they are differences over the last five poses.
"""

import math
import os
import re
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final, NamedTuple, final
from urllib.parse import parse_qsl

from echelon_flight import FlightError, MissingLibraryError
from echelon_flight.links import Link, Reading, listing
from echelon_flight.links.attitude import (
    Numbers,
    check_states,
    named_state,
    product,
    quaternion_of,
    rotate,
)
from echelon_flight.parameters import DEFAULTS

if TYPE_CHECKING:
    from echelon_flight.links.ros2_messages import FullState, Twist

_POSES: Final = 5
"""Over which velocities are differences: over two, 0.1 mm of noise are 14 mm/s at 100 Hz."""
_STATES: Final = {"pose": "PoseStamped", "odom": "Odometry"}
_OUTPUTS: Final = {
    "full_state": ("cmd_full_state", "FullState", [("ax", "ay", "az")]),
    "cmd_vel": ("cmd_vel", "Twist", [("speed", "turn_rate"), ("vx", "vy"), ("vx", "vy", "vz")]),
}
"""Option -> topic, type, and the inputs of the laws that it can carry."""
_OPTIONS: Final = ("state", "output", "from", "to", "ahead")


class Ros2Address(NamedTuple):
    """What the address of a vehicle says.

    Attributes:
        state: `pose` or `odom`.
        output: `full_state` or `cmd_vel`.
        source, target: topics, such as `/cf1/pose`.
        ahead: of the vehicle's place in front of the measured one, m.
    """

    state: str
    output: str
    source: str
    target: str
    ahead: float = 0.0


def read_ros2_address(text: str) -> Ros2Address:
    """Return what an address such as `cf1?output=cmd_vel` says.

    Raises:
        FlightError: it has no name of a vehicle, or an option that there is not.
    """
    name, _, rest = text.partition("?")
    given = dict(parse_qsl(rest, keep_blank_values=True))
    if not re.fullmatch(r"[A-Za-z_]\w*(/[A-Za-z_]\w*)*", name, re.ASCII):
        raise FlightError(f"`--link` is `ros2://{text}`, and must be as `ros2://cf1`.")
    for key in given:
        if key not in _OPTIONS:
            raise FlightError(f"`{key}` in `ros2://{text}` must be one of {listing(_OPTIONS)}.")
    state, output = given.get("state", "pose"), given.get("output", "full_state")
    for key, value, known in (("state", state, _STATES), ("output", output, _OUTPUTS)):
        if value not in known:
            raise FlightError(
                f"`{key}={value}` in `ros2://{text}` must be one of {listing(known)}."
            )
    source = given.get("from", f"/{name}/{state}")
    target = given.get("to", f"/{name}/{_OUTPUTS[output][0]}")
    return Ros2Address(state, output, source, target, _ahead(text, given.get("ahead", "0")))


def _ahead(text: str, number: str) -> float:
    try:
        ahead = float(number)
    except ValueError:
        ahead = math.nan
    if not math.isfinite(ahead):
        raise FlightError(f"`ahead={number}` in `ros2://{text}` must be a number, in m.")
    return ahead


@final
class Ros2Link(Link):
    """Reads poses or odometry, and sends accelerations or velocities.

    Raises:
        FlightError: the law has other inputs or states, or nodes or their topics are missing.
        MissingLibraryError: cyclonedds is not installed.
    """

    def __init__(self, address: str, facts: Mapping[str, Any]) -> None:
        """Find the nodes that publish the state and take the inputs."""
        self._address, self._inputs = read_ros2_address(address), tuple(facts["inputs"])
        _check_inputs(self._address.output, self._inputs)
        names = {"yaw" if name == "heading" else name: "" for name in facts["states"]}
        self._states = check_states(names)
        self._poses, self._limits = Differences(), facts.get("parameters", DEFAULTS)
        self._known: dict[str, float] = {}
        self._descent: tuple[float, float] | None = None
        self._node = Node()
        kinds = _STATES[self._address.state], _OUTPUTS[self._address.output][1]
        self._reader = self._node.reader(self._address.source, kinds[0])
        self._writer = self._node.writer(self._address.target, kinds[1])
        try:
            self._node.wait_for(self._address, *kinds, self._limits["ros2_patience"])
        except FlightError:
            self._node.close()
            raise

    def read(self, wait: float) -> Reading | None:
        """Return the newest state that was not yet returned."""
        message = self._reader.newest(wait)
        if message is None:
            return None
        now = time.monotonic()
        pose = message.pose if self._address.state == "pose" else message.pose.pose
        place, q = (pose.position.x, pose.position.y, pose.position.z), pose.orientation
        # Motion capture says NaN of a body that it does not see.
        if not all(map(math.isfinite, (*place, q.w, q.x, q.y, q.z))):
            return None
        q = self._unit(q)
        if (motion := self._motion(message, now, place, q)) is None:
            return None
        speed, body = motion
        place, speed = _in_front(self._address.ahead, place, speed, q, body)
        self._known = named_state(place, speed, q, body)
        return Reading(now, [self._known[name] for name in self._states])

    def _motion(
        self, message: Any, now: float, place: Numbers, q: Numbers
    ) -> tuple[Numbers, Numbers] | None:
        """Return velocity (m/s) and rates of the body (rad/s); None where they are not known."""
        if self._address.state == "odom":
            twist = message.twist.twist
            body = twist.angular.x, twist.angular.y, twist.angular.z
            return rotate(q, (twist.linear.x, twist.linear.y, twist.linear.z)), body
        stamp = message.header.stamp
        # A source without a clock has stamps of 0.
        return self._poses.add(stamp.sec + 1e-9 * stamp.nanosec or now, place, q)

    def _unit(self, q: Any) -> Numbers:
        size = math.hypot(q.w, q.x, q.y, q.z)
        if not 0.9 < size < 1.1:
            raise FlightError(
                f"the orientation on `{self._address.source}` has length {size:.3g}, and must be a "
                "quaternion of length 1."
            )
        return q.w / size, q.x / size, q.y / size, q.z / size

    def send(self, u: Sequence[float]) -> None:
        """Send an input; a full state not before the first measured one."""
        if self._address.output == "cmd_vel":
            self._writer.write(twist_of(self._inputs, u, self._known.get("yaw", 0.0)))
        elif self._known:
            self._writer.write(full_state_of(self._known, u))

    def level_descend(self) -> None:
        """Stop a ground robot; let a Crazyflie sink at its place, by its own controller.

        On the ground nothing is sent: without setpoints its motors stop after 2 s.
        """
        if self._address.output == "cmd_vel":
            self._writer.write(twist_of(("speed", "turn_rate"), (0.0, 0.0), 0.0))
        elif self._known:
            now, speed = time.monotonic(), self._limits["sinking_speed"]
            ground = self._limits["landed_height"]
            self._descent = self._descent or (now, self._known["z"])
            z = self._descent[1] - speed * (now - self._descent[0])
            if self._known["z"] > ground and z > -ground:
                still = dict.fromkeys(("vx", "vy"), 0.0) | {"vz": -speed, "z": z}
                self._writer.write(full_state_of(self._known | still, (0.0, 0.0, 0.0)))

    def close(self) -> None:
        """Leave the domain."""
        self._node.close()


def _check_inputs(output: str, inputs: tuple[str, ...]) -> None:
    possible = _OUTPUTS[output][2]
    if inputs not in possible:
        others = [name for name, (_, _, each) in _OUTPUTS.items() if inputs in each]
        instead = f"; use `output={others[0]}`" if others else ""
        raise FlightError(
            f"the law has the inputs {listing(inputs)}, and `output={output}` carries "
            f"{'; or '.join(listing(names) for names in possible)}{instead}."
        )


@final
class Differences:
    """Velocities of a body by its last poses."""

    def __init__(self) -> None:
        """Begin without any."""
        self._poses = deque[tuple[float, Numbers, Numbers]](maxlen=_POSES)

    def add(self, at: float, place: Numbers, q: Numbers) -> tuple[Numbers, Numbers] | None:
        """Take a pose, and return velocity (m/s) and rates of the body (rad/s).

        None before there are enough, and of a pose that is not newer.

        Args:
            at: when it was measured, s.
            place: m.
            q: quaternion (w, x, y, z), body to world.
        """
        if self._poses and at <= self._poses[-1][0]:
            return None
        self._poses.append((at, place, q))
        if len(self._poses) < _POSES:
            return None
        then, before, (w, x, y, z) = self._poses[0]
        step = at - then
        speed = tuple((b - a) / step for a, b in zip(before, place, strict=True))
        turn, *axis = product((w, -x, -y, -z), q)
        # Of the two quaternions of a turn the one of the smaller angle.
        sign, size = math.copysign(1.0, turn), math.hypot(*axis)
        rate = 2.0 * math.atan2(size, abs(turn)) / step
        return speed, tuple(sign * rate * part / size if size else 0.0 for part in axis)


def _in_front(
    ahead: float, place: Numbers, speed: Numbers, q: Numbers, body: Numbers
) -> tuple[Numbers, Numbers]:
    """Return place and velocity of a point in front of the measured one."""
    lever = rotate(q, (ahead, 0.0, 0.0))
    swing = rotate(q, (0.0, ahead * body[2], -ahead * body[1]))
    return (
        tuple(a + b for a, b in zip(place, lever, strict=True)),
        tuple(a + b for a, b in zip(speed, swing, strict=True)),
    )


# ---- messages ------------------------------------------------------------------------------------


def full_state_of(x: Mapping[str, float], acceleration: Sequence[float]) -> "FullState":
    """Return the setpoint of an acceleration (m/s^2) at a state, which is not corrected then."""
    from echelon_flight.links import ros2_messages as ros

    q = quaternion_of(0.0, 0.0, x["yaw"])
    pose = ros.Pose(ros.Point(x["x"], x["y"], x["z"]), ros.Quaternion(q[1], q[2], q[3], q[0]))
    twist = ros.Twist(ros.Vector3(x["vx"], x["vy"], x["vz"]))
    return ros.FullState(ros.Header(), pose, twist, ros.Vector3(*acceleration))


def twist_of(inputs: Sequence[str], u: Sequence[float], yaw: float) -> "Twist":
    """Return the command of speed and turn rate, or of a velocity of the world (m/s).

    `cmd_vel` is in the frame of the robot, which has a yaw (rad).
    """
    from echelon_flight.links import ros2_messages as ros

    if inputs[0] == "speed":
        return ros.Twist(ros.Vector3(float(u[0])), ros.Vector3(0.0, 0.0, float(u[1])))
    c, s = math.cos(yaw), math.sin(yaw)
    return ros.Twist(ros.Vector3(c * u[0] + s * u[1], c * u[1] - s * u[0], sum(u[2:])))


# ---- DDS -----------------------------------------------------------------------------------------


def _domain() -> int:
    text = os.environ.get("ROS_DOMAIN_ID", "") or "0"
    if not (text.isdecimal() and int(text) <= 232):
        raise FlightError(f"`ROS_DOMAIN_ID` is `{text}`, and must be a number from 0 to 232.")
    return int(text)


@final
class Node:
    """Takes part in a domain of ROS 2.

    Raises:
        FlightError: the domain cannot be joined.
        MissingLibraryError: cyclonedds is not installed.
    """

    def __init__(self) -> None:
        """Join the domain."""
        try:
            from cyclonedds.builtin import (
                BuiltinDataReader,
                BuiltinTopicDcpsPublication,
                BuiltinTopicDcpsSubscription,
            )
            from cyclonedds.core import DDSException
            from cyclonedds.domain import DomainParticipant
        except ImportError:
            raise MissingLibraryError(
                "ROS 2 needs cyclonedds, which is not installed; `pip install 'cyclonedds>=11'`."
            ) from None
        self.domain = _domain()
        try:
            self._participant: Any = DomainParticipant(self.domain)
        except DDSException as error:
            raise FlightError(f"ROS domain {self.domain} cannot be joined: {error.msg}.") from None
        kinds = BuiltinTopicDcpsPublication, BuiltinTopicDcpsSubscription
        self._finders = [BuiltinDataReader(self._participant, kind) for kind in kinds]
        self._found: list[dict[str, set[str]]] = [{}, {}]
        self._ends = list[Callable[[], None]]()

    def reader(self, topic: str, kind: str) -> "Reader":
        """Return a reader of the newest message of a topic, of a type by its name."""
        result = Reader(self._participant, self._topic(topic, kind))
        self._ends.append(result.close)
        return result

    def writer(self, topic: str, kind: str) -> "Writer":
        """Return a writer of a topic, of a type by its name."""
        result = Writer(self._participant, self._topic(topic, kind))
        self._ends.append(result.close)
        return result

    def _topic(self, topic: str, kind: str) -> Any:
        from cyclonedds.topic import Topic

        from echelon_flight.links import ros2_messages

        name = ros2_messages.dds_topic(topic)
        return Topic(self._participant, name, getattr(ros2_messages, kind))

    def close(self) -> None:
        """Leave the domain; readers and writers end too."""
        # The library deletes what nobody refers to.
        for end in self._ends:
            end()
        self._finders, self._participant = [], None

    def topics(self) -> list[dict[str, set[str]]]:
        """Return the topics that were found: those published, and those read, with their types."""
        from echelon_flight.links.ros2_messages import ros_type

        for finder, found in zip(self._finders, self._found, strict=True):
            for sample in finder.take(1000):
                name = getattr(sample, "topic_name", "")
                own = str(getattr(sample, "participant_key", "")) == str(self._participant.guid)
                if name.startswith("rt/") and not own:
                    found.setdefault(name[2:], set()).add(ros_type(sample.type_name))
        return self._found

    def wait_for(self, address: Ros2Address, source: str, target: str, patience: float) -> None:
        """Wait until a vehicle's state is published, and its inputs are read, some time (s).

        Raises:
            FlightError: a topic is missing or has another type.
        """
        until = time.monotonic() + patience
        while True:
            published, read = self.topics()
            wrong = self._wrong(address.source, source, published, "publishes", "from")
            wrong = wrong or self._wrong(address.target, target, read, "reads", "to")
            if not wrong:
                return
            if time.monotonic() > until:
                raise FlightError(wrong)
            time.sleep(0.02)

    def _wrong(
        self, topic: str, kind: str, found: Mapping[str, set[str]], verb: str, option: str
    ) -> str:
        """Return what is wrong with a topic, as a sentence; empty if nothing is."""
        from echelon_flight.links import ros2_messages

        types = found.get("/" + topic.lstrip("/"), set())
        wanted = getattr(ros2_messages, kind).__idl__.idl_transformed_typename
        wanted = ros2_messages.ros_type(wanted)
        if wanted in types:
            return ""
        if types:
            has = listing(sorted(types))
            return f"a node {verb} `{topic}` as {has}, and the link needs `{wanted}`."
        names = sorted(found)
        more = f" and {len(names) - 6} more" if len(names) > 6 else ""
        seen = f"it has {listing(names[:6])}{more}" if names else "it has none such"
        return (
            f"no node {verb} `{topic}` in ROS domain {self.domain}; {seen}. Start the node, or "
            f"name its topic by `?{option}=`."
        )


@final
class Reader:
    """The newest message of a topic."""

    def __init__(self, participant: Any, topic: Any) -> None:
        """Read with best effort, which publishers of both kinds serve."""
        from cyclonedds.core import InstanceState, ReadCondition, SampleState, ViewState, WaitSet
        from cyclonedds.sub import DataReader

        self._reader: Any = DataReader(participant, topic, qos=_quality(reliable=False))
        self._kind = topic.data_type
        any_state = SampleState.Any | ViewState.Any | InstanceState.Any
        self._arrival: Any = WaitSet(participant)
        self._arrival.attach(ReadCondition(self._reader, any_state))

    def close(self) -> None:
        """Read no more."""
        self._arrival = self._reader = None

    def newest(self, wait: float) -> Any:
        """Return the newest message that was not yet returned, after at most `wait` s; or None."""
        message = self._take()
        if message is None and wait > 0.0:
            self._arrival.wait(int(1e9 * wait))
            message = self._take()
        return message

    def _take(self) -> Any:
        # A publisher that ends leaves a sample without a message.
        samples = [each for each in self._reader.take(10) if isinstance(each, self._kind)]
        return samples[-1] if samples else None


@final
class Writer:
    """Writes messages of a topic."""

    def __init__(self, participant: Any, topic: Any) -> None:
        """Write reliably, since most subscriptions of ROS ask for it; the last message counts."""
        from cyclonedds.pub import DataWriter

        self._writer: Any = DataWriter(participant, topic, qos=_quality(reliable=True))

    def close(self) -> None:
        """Write no more."""
        self._writer = None

    def write(self, message: Any) -> None:
        """Write a message.

        Raises:
            FlightError: it could not be written.
        """
        from cyclonedds.core import DDSException

        try:
            self._writer.write(message)
        except DDSException as error:
            raise FlightError(f"DDS did not write a message: {error.msg}.") from None


def _quality(reliable: bool) -> Any:
    from cyclonedds.core import Policy, Qos

    # No wait for a subscriber that does not answer: it gets the next message.
    kind = Policy.Reliability.Reliable(0) if reliable else Policy.Reliability.BestEffort
    plain = Policy.DataRepresentation(use_cdrv0_representation=True)
    return Qos(kind, Policy.History.KeepLast(1), Policy.Durability.Volatile, plain)
