"""The formation law for single integrators of Mesbahi and Egerstedt (paper, Theorem 1)."""

import numpy as np

from echelon.agents.models.integrator import SingleIntegrator
from echelon.agents.models.model import ControlAffine
from echelon.agents.network.graph import Graph
from echelon.core.errors import LawError
from echelon.core.types import Array, Input
from echelon.laws.law import Law, LocalView, Memory


class Agreement(Law):
    """u_i = -sum_j A_ij ((x_i - x_j) - (xi_i - xi_j)).

    Run by all agents alike, it drives every x_i - xi_i to one common constant, the mean of their
    starts.
    """

    @property
    def information(self) -> tuple[str, ...]:
        """Neighbours' states."""
        return ("neighbours' states",)

    def metric(self, model: ControlAffine) -> Array:
        """Return the identity."""
        return np.eye(len(model.state_names))

    def prepared(self, model: ControlAffine, graph: Graph) -> "Agreement":
        """Check that the model is a single integrator."""
        # u = -z gives differences of states as velocities, which suits xdot = u and no other.
        if not isinstance(model, SingleIntegrator):
            raise LawError(
                f"the law `agreement` is made for `SingleIntegrator`, and the model is "
                f"`{type(model).__name__}`; use `consensus`."
            )
        return self

    def update(self, model: ControlAffine, view: LocalView, memory: Memory) -> tuple[Input, Memory]:
        """Return the velocity of one agent."""
        # The consensus law at f = 0, g = P = R = I and c = 1: z has the brackets.
        return -view.disagreement, memory
