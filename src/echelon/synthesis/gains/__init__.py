"""Gains: what a synthesis returns, the interface `Method`, and the bundled methods."""

from echelon.synthesis.gains.domain_methods import Contraction, Monotone, RobustLQR
from echelon.synthesis.gains.gain import Feedback, FixedGain, Gain, Method
from echelon.synthesis.gains.printed_lmi import PrintedLMI
from echelon.synthesis.gains.riccati import InnerLoop, Riccati

__all__ = [
    "Contraction",
    "Feedback",
    "FixedGain",
    "Gain",
    "InnerLoop",
    "Method",
    "Monotone",
    "PrintedLMI",
    "Riccati",
    "RobustLQR",
]
