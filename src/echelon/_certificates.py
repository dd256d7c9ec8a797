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
