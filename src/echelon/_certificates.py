"""What can be said of a gain on a graph: spectrum, modal abscissas and observability at the trim."""

import numpy as np

from echelon._graph import Graph
from echelon._linearization import Linearization
from echelon._numerics import observability_rank
from echelon._types import Matrix
from echelon.gains.gain import Certificate


def certify(
    linear: Linearization, graph: Graph, P: Matrix, R: Matrix, coupling: float, edge: float | None
) -> Certificate:
    """Return the certificate of the law with gain P, R and coupling c, by linearization at the trim.

    With constant g the disagreement splits over the eigenvectors of the grounded Laplacian into modes
    A - c lambda B R^-1 B'P (theory page, T2).
    """
    low, high = graph.grounded_spectrum()
    feedback = linear.B @ np.linalg.solve(R, linear.B.T @ P)
    return Certificate(
        kind="linearization",
        lambda_min=low,
        lambda_max=high,
        abscissas=(
            _abscissa(linear.A - coupling * low * feedback),
            _abscissa(linear.A - coupling * high * feedback),
        ),
        edge=edge,
        observable=observability_rank(linear.A, linear.B.T @ P),
    )


def _abscissa(matrix: Matrix) -> float:
    """Return the largest real part of an eigenvalue."""
    return float(np.linalg.eigvals(matrix).real.max())
