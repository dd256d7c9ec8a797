"""The eigenvalues by which a network's disagreement splits, all that gains and proofs need."""

from typing import NamedTuple

import numpy as np

from echelon.core.types import Array


class Spectrum(NamedTuple):
    """Eigenvalues lambda of the matrix L that weighs errors into disagreements.

    Attributes:
        eigenvalues: (K,), of positive real part, ascending by it and read-only: all of them, or of
            a large graph the extreme two. Complex where a directed graph makes them so.
        total: how many there are in truth, K or more.
        proved: a number that W L + L'W >= 2 proved W holds with, W = diag(sums), whatever was
            rounded; 0 where none is known. Of a symmetric L it is a bound of the smallest.
        sums: (n,) positive, the weights w of followers in sum_i w_i delta_i'P delta_i (theory page,
            T7); None where all are 1.
        weakest: what takes the place of lambda_min where several graphs take turns: for each of
            them L + L' >= 2 weakest; None of one graph.
    """

    eigenvalues: Array
    total: int
    proved: float
    sums: Array | None = None
    weakest: float | None = None

    @property
    def low(self) -> float:
        """The smallest real part, lambda_min: the slowest disagreement, which couplings are for.

        It is an eigenvalue itself, of a directed graph too (Perron and Frobenius).
        """
        return float(self.eigenvalues[0].real) if self.weakest is None else self.weakest

    @property
    def high(self) -> float:
        """The largest size, lambda_max: the fastest disagreement, which a step must follow."""
        if np.iscomplexobj(self.eigenvalues):
            return float(np.abs(self.eigenvalues).max())
        return float(self.eigenvalues[-1])

    @property
    def symmetric(self) -> bool:
        """Whether they are of one symmetric matrix, so that V = delta'(L kron P) delta may fall."""
        return self.weakest is None and self.sums is None and self.proved > 0.0

    @property
    def skew(self) -> float:
        """The largest of the sums' weights by the smallest, 1 or more."""
        return 1.0 if self.sums is None else float(self.sums.max() / self.sums.min())
