"""The spectrum of a network: the eigenvalues that gains and proofs need."""

from typing import NamedTuple

import numpy as np

from echelon.core.types import Array


class Spectrum(NamedTuple):
    """Eigenvalues lambda of the matrix L that weighs errors into disagreements.

    Attributes:
        eigenvalues: (K,), of positive real part, ascending by it and read-only: all of them, or of
            a large graph the extreme two. Complex where a directed graph makes them so.
        total: the number of all eigenvalues, K or more.
        proved: a number with W L + L'W >= 2 proved W, W = diag(sums), rounding included; 0 where
            none is known. For a symmetric L it is a lower bound of the smallest eigenvalue.
        sums: (n,) positive, the weights w of followers in sum_i w_i delta_i'P delta_i (theory page,
            T7); None where all are 1.
        weakest: replaces lambda_min where several graphs take turns: for each of them
            L + L' >= 2 weakest; None for one graph.
    """

    eigenvalues: Array
    total: int
    proved: float
    sums: Array | None = None
    weakest: float | None = None

    @property
    def low(self) -> float:
        """The smallest real part, lambda_min: the slowest disagreement, which sets the coupling.

        It is itself an eigenvalue, also of a directed graph (Perron and Frobenius).
        """
        return float(self.eigenvalues[0].real) if self.weakest is None else self.weakest

    @property
    def high(self) -> float:
        """The largest modulus, lambda_max: the fastest disagreement, which limits the time step."""
        if np.iscomplexobj(self.eigenvalues):
            return float(np.abs(self.eigenvalues).max())
        return float(self.eigenvalues[-1])

    @property
    def symmetric(self) -> bool:
        """Whether L is one symmetric matrix, so that V = delta'(L kron P) delta can decrease."""
        return self.weakest is None and self.sums is None and self.proved > 0.0

    @property
    def skew(self) -> float:
        """Ratio of the largest and the smallest weight in `sums`, 1 or more."""
        return 1.0 if self.sums is None else float(self.sums.max() / self.sums.min())
