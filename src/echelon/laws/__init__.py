"""Control laws: the interface `Law` and the bundled members."""

from echelon.laws.agreement import Agreement
from echelon.laws.consensus import Consensus
from echelon.laws.law import Law, LocalView
from echelon.laws.passive import Passive
from echelon.laws.tracking import Tracking
from echelon.optimal.leader import OptimalTracking

__all__ = ["Agreement", "Consensus", "Law", "LocalView", "OptimalTracking", "Passive", "Tracking"]
