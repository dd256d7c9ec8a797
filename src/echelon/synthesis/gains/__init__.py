"""Gains: what a synthesis returns, the interface `Method`, and the bundled methods."""

from echelon.synthesis.gains.contraction import Contraction
from echelon.synthesis.gains.fixed import FixedGain
from echelon.synthesis.gains.gain import Feedback, Gain, Method
from echelon.synthesis.gains.inner_loop import InnerLoop
from echelon.synthesis.gains.monotone import Monotone
from echelon.synthesis.gains.riccati import Riccati
from echelon.synthesis.gains.robust_lqr import RobustLQR

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
