"""What the ground station hears, as topics of ROS 2 that RViz, Foxglove and `ros2 topic` show."""

# The library's sequences are lists in Python.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false

import contextlib
import math
from collections.abc import Mapping
from typing import Any, Final, final

from echelon_flight import FlightError
from echelon_flight.links.ros2 import Node
from echelon_flight.local_flight import offsets_at
from echelon_flight.wire import Report

_SPHERE, _LINE = 2, 4
_SIZE: Final = 0.1
"""m, of a drawn agent."""


@final
class Ros2View:
    """Publishes `/echelon/agentK/pose`, `/echelon/agentK/goal` and `/echelon/markers`.

    All are in the frame `world`, at the rate of reports, 10 a second. A goal is the leader's last
    reported place plus the offset; a leader's goal is its own place. Reports have no attitude.

    Args:
        facts: the content of flight.json.

    Raises:
        FlightError: the domain cannot be joined.
        MissingLibraryError: cyclonedds is not installed.
    """

    def __init__(self, facts: Mapping[str, Any]) -> None:
        """Join the domain."""
        self._facts, self._node = facts, Node()
        self._topics = {
            (k, what): self._node.writer(f"/echelon/agent{k}/{what}", "PoseStamped")
            for k in range(facts["agents"])
            for what in ("pose", "goal")
        }
        self._markers = self._node.writer("/echelon/markers", "MarkerArray")
        self._places, self._goals = dict[int, list[float]](), dict[int, list[float]]()

    def report(self, number: int, report: Report) -> None:
        """Publish an agent's report."""
        place = [report.x, report.y, report.z][: len(self._facts["position"])]
        if not all(map(math.isfinite, place)):
            return
        self._places[number] = place
        leader = report.leader if report.leader in self._places else self._facts["leader"]
        if leader in self._places:
            offsets = offsets_at(self._facts["offsets"], max(0.0, report.time))
            parts = zip(self._places[leader], offsets[number], offsets[leader], strict=True)
            self._goals[number] = [x + b - a for x, b, a in parts]
        # What cannot be shown stops no ground station.
        with contextlib.suppress(FlightError):
            self._publish(number)

    def _publish(self, number: int) -> None:
        from echelon_flight.links import ros2_messages as ros

        header = ros.Header()
        for what, points in (("pose", self._places), ("goal", self._goals)):
            if number in points:
                pose = ros.PoseStamped(header, ros.Pose(ros.Point(*points[number])))
                self._topics[number, what].write(pose)
        # All at once: a subscriber keeps the last message.
        shapes = [shape for k in self._places for shape in self._shapes(header, k)]
        self._markers.write(ros.MarkerArray(shapes))

    def _shapes(self, header: Any, number: int) -> list[Any]:
        """Return an agent, and a line to its goal, whose length is its error."""
        from echelon_flight.links import ros2_messages as ros

        place = ros.Point(*self._places[number])
        agent = ros.Marker(header, "agents", number, _SPHERE, pose=ros.Pose(place))
        agent.scale, agent.color = ros.Vector3(_SIZE, _SIZE, _SIZE), ros.ColorRGBA(0.1, 0.4, 0.8)
        if number not in self._goals:
            return [agent]
        line = ros.Marker(header, "errors", number, _LINE, scale=ros.Vector3(0.2 * _SIZE))
        line.color, line.points = ros.ColorRGBA(0.7), [place, ros.Point(*self._goals[number])]
        return [agent, line]

    def close(self) -> None:
        """Leave the domain."""
        self._node.close()
