"""What can be said of a gain on a graph: spectrum, abscissa and observability at the trim."""

from typing import Literal, TypeAlias

import equinox as eqx
import numpy as np

from echelon._graph import Graph
from echelon._linearization import Linearization
from echelon._numerics import observability_rank
from echelon._types import Matrix

Kind: TypeAlias = Literal["proof", "vertices", "samples", "linearization"]


class Certificate(eqx.Module):
    """What is known of a gain on a graph by linearization at the trim; no region is proved.

    Attributes:
        kind: the kind of argument behind the abscissa.
        lambda_min, lambda_max: extreme eigenvalues of the grounded Laplacian.
        abscissa: largest real part of an eigenvalue of A - c lambda B R^-1 B'P, 1/s, over the
            eigenvalues lambda that were looked at.
        modes: how many eigenvalues lambda that were: all, or on large graphs the extreme two.
        edge: smallest coupling for which the linearization is proved stable, or None where no bound
            is known.
        observable: rank of the observability matrix of (A, g'P), out of n; below n, disagreements
            exist that never enter the input.
    """

    kind: Kind = eqx.field(static=True)
    lambda_min: float
    lambda_max: float
    abscissa: float
    modes: int = eqx.field(static=True)
    edge: float | None
    observable: int = eqx.field(static=True)

    @property
    def stable(self) -> bool:
        """Whether the linearized disagreement decays in every mode that was looked at."""
        return self.abscissa < 0.0


def certify(
    linear: Linearization, graph: Graph, P: Matrix, R: Matrix, coupling: float, edge: float | None
) -> Certificate:
    """Return what linearization at the trim says of the law with gain P, R and coupling c.

    With constant g the disagreement splits over the eigenvectors of the grounded Laplacian into
    modes A - c lambda B R^-1 B'P (theory page, T2).
    """
    eigenvalues = graph.grounded_spectrum()
    feedback = linear.B @ np.linalg.solve(R, linear.B.T @ P)
    return Certificate(
        kind="linearization",
        lambda_min=float(eigenvalues[0]),
        lambda_max=float(eigenvalues[-1]),
        abscissa=_abscissa(linear.A - coupling * eigenvalues[:, None, None] * feedback),
        modes=len(eigenvalues),
        edge=edge,
        observable=observability_rank(linear.A, linear.B.T @ P),
    )


def _abscissa(matrices: Matrix) -> float:
    """Return the largest real part of an eigenvalue of any of the matrices."""
    return float(np.linalg.eigvals(matrices).real.max())
