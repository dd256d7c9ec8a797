"""Gains: what a synthesis returns, the interface `Method`, and the bundled methods."""

from echelon.gains.contraction import Contraction
from echelon.gains.fixed import FixedGain
from echelon.gains.gain import Feedback, Gain, Method
from echelon.gains.inner_loop import InnerLoop
from echelon.gains.monotone import Monotone
from echelon.gains.riccati import Riccati
from echelon.gains.robust_lqr import RobustLQR

__all__ = [
    "Contraction",
    "Feedback",
    "FixedGain",
    "Gain",
    "InnerLoop",
    "Method",
    "Monotone",
    "Riccati",
    "RobustLQR",
]
