"""Control laws: the interface `Law` and the bundled members."""

from echelon.laws.consensus import Agreement, Consensus
from echelon.laws.law import Law, LocalView, TrimInput
from echelon.laws.path_leader import PathLQR, Tracking
from echelon.laws.stopping_point import StoppingLeader, StoppingPoint

__all__ = [
    "Agreement",
    "Consensus",
    "Law",
    "LocalView",
    "PathLQR",
    "StoppingLeader",
    "StoppingPoint",
    "Tracking",
    "TrimInput",
]
