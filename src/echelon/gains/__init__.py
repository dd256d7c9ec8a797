"""Gains: what a synthesis returns, the interface `Method`, and the bundled methods."""

from echelon.certificates.certificate import Certificate, Region
from echelon.gains.contraction import Contraction
from echelon.gains.gain import Gain, Method
from echelon.gains.given import Given
from echelon.gains.inner_loop import InnerLoop
from echelon.gains.monotone import Monotone
from echelon.gains.riccati import Riccati
from echelon.gains.robust_lqr import RobustLQR

__all__ = [
    "Certificate",
    "Contraction",
    "Gain",
    "Given",
    "InnerLoop",
    "Method",
    "Monotone",
    "Region",
    "Riccati",
    "RobustLQR",
]
