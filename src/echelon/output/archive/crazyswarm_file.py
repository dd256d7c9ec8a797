"""The file crazyflies.yaml of Crazyswarm2: which vehicles there are, and where they stand."""

from collections.abc import Sequence

_HEAD = """# For Crazyswarm2, by echelon. Edit the addresses. Before the start each vehicle
# stands at its `initial_position`, below the first point of its CSV file.
robots:
"""
_TAIL = """robot_types:
  crazyflie:
    motion_capture:
      enabled: true
      tracking: librigidbodytracker
      marker: default_single_marker
      dynamics: default
    big_quad: false
    battery:
      voltage_warning: 3.8 # V
      voltage_critical: 3.7 # V
all:
  firmware_params:
    stabilizer:
      estimator: 2 # Kalman
      controller: 2 # Mellinger
"""


def swarm_text(begins: Sequence[Sequence[float]]) -> str:
    """Return the file for agents whose paths begin at points (x, y, z, ...), m."""
    robots = [
        f"  agent{k}:\n    enabled: true\n    uri: radio://0/80/2M/E7E7E7E7{k + 1:02X}\n"
        f"    initial_position: [{x:.4f}, {y:.4f}, 0.0]\n    type: crazyflie\n"
        for k, (x, y, *_) in enumerate(begins)
    ]
    return _HEAD + "".join(robots) + _TAIL
