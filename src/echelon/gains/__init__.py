"""Gains: what a synthesis returns, the interface `Method`, and the bundled methods."""

from echelon._certificates import Certificate
from echelon.gains.gain import Gain, Method
from echelon.gains.given import Given
from echelon.gains.inner_loop import InnerLoop
from echelon.gains.riccati import Riccati

__all__ = ["Certificate", "Gain", "Given", "InnerLoop", "Method", "Riccati"]
