"""Control laws: the interface `Law` and the bundled members."""

from echelon.laws.agreement import Agreement
from echelon.laws.consensus import Consensus
from echelon.laws.law import Law, LocalView
from echelon.laws.lqr import PathLQR
from echelon.laws.stopping_point import StoppingLeader, StoppingPoint
from echelon.laws.tracking import Tracking
from echelon.laws.trim_input import TrimInput

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
