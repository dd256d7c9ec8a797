"""The eigenvalues by which a network's disagreement splits, all that gains and proofs need."""

from typing import NamedTuple

from echelon.core.types import Array


class Spectrum(NamedTuple):
    """Eigenvalues lambda of the matrix that weighs errors into disagreements.

    Attributes:
        eigenvalues: (K,), positive, ascending and read-only: all of them, or of a large graph the
            extreme two.
        total: how many there are in truth, K or more.
        proved: a bound that the smallest is not below, whatever was rounded.
    """

    eigenvalues: Array
    total: int
    proved: float

    @property
    def low(self) -> float:
        """The smallest, lambda_min: the slowest disagreement, which couplings are chosen for."""
        return float(self.eigenvalues[0])

    @property
    def high(self) -> float:
        """The largest, lambda_max: the fastest disagreement, which a step must follow."""
        return float(self.eigenvalues[-1])
