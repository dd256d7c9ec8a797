"""Control laws: the interface `Law` and the bundled members."""

from echelon.laws.consensus import Agreement, Consensus
from echelon.laws.law import (
    Checks,
    Faces,
    Feeds,
    KeepsApart,
    Law,
    LocalView,
    Proves,
    Speaks,
    Travels,
    TrimInput,
)
from echelon.laws.path_leader import PathLQR, Tracking
from echelon.laws.stopping_point import StoppingLeader, StoppingPoint

__all__ = [
    "Agreement",
    "Checks",
    "Consensus",
    "Faces",
    "Feeds",
    "KeepsApart",
    "Law",
    "LocalView",
    "PathLQR",
    "Proves",
    "Speaks",
    "StoppingLeader",
    "StoppingPoint",
    "Tracking",
    "Travels",
    "TrimInput",
]
