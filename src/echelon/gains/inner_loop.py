"""An inner loop that makes the paper's Assumption 5 hold, and the monotone P that comes with it."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg

from echelon.certificates.certificate import certify
from echelon.core.errors import GainError, listing
from echelon.core.linear import as_matrix, riccati
from echelon.core.types import Array
from echelon.gains.gain import Gain, Method, check_coupling
from echelon.gains.riccati import Riccati
from echelon.models.linearization import Linearization, linearize
from echelon.models.model import ControlAffine
from echelon.network.graph import Graph

_SAMPLES = 16


class InnerLoop(Method):
    """Close a loop that ignores the symmetric states, u = kappa(x) + u~, then use the paper's law.

    The symmetric states (a vehicle's position) are those on which f and g do not depend. The loop
    shifts all other modes to the left, so that A - B K has semisimple zeros and is Hurwitz
    otherwise. Then a P > 0 with P (A - B K) + (A - B K)'P <= 0 exists; with linear f the
    disagreement goes to zero for every coupling c > 0 and every connected graph.

    Args:
        base: whose weights shape the inner loop, by the Riccati equation of the other states; the
            model's own `damping` when left out, or its weights where it has none.
        coupling: c; any positive number is stable, and it sets the rate.
        symmetry_weight: weight of the symmetric states in P, one number each or one for all; the
            model's own when left out.
    """

    base: Riccati | None = None
    coupling: float = 3.0
    symmetry_weight: tuple[float, ...] | float | None = None

    def solve(self, model: ControlAffine, graph: Graph) -> Gain:
        """Return the gain.

        Raises:
            GainError: no state is symmetric, or the other states cannot be stabilized.
        """
        check_coupling(self.coupling)
        linear = linearize(model)
        fixed = symmetric_states(model)
        if not fixed:
            raise GainError(
                f"`{type(model).__name__}` has no state that its dynamics ignore, so an inner loop "
                "has nothing to leave alone; use `monotone` or `riccati`."
            )
        K = self._feedback(model, linear, fixed)
        closed = linear.with_inner(K)
        P = _monotone(model, closed.A, fixed, self._weights(model, len(fixed)))
        R = np.eye(len(model.input_names))
        certificate = certify(closed, graph, P, R, self.coupling, edge=0.0)
        return Gain(P, R, self.coupling, "inner-loop", certificate, inner=K)

    def _feedback(self, model: ControlAffine, linear: Linearization, fixed: list[int]) -> Array:
        """Return K (m, n), zero in the columns of the symmetric states."""
        if self.base is None and model.damping is not None:
            return np.asarray(model.damping, float)
        free = _others(model, fixed)
        Q, R = self._base_weights(model)
        A, B = linear.A[np.ix_(free, free)], linear.B[free]
        K = np.zeros((len(model.input_names), len(model.state_names)))
        K[:, free] = np.linalg.solve(R, B.T @ riccati(A, B, Q[np.ix_(free, free)], R))
        return K

    def _base_weights(self, model: ControlAffine) -> tuple[Array, Array]:
        base = Riccati() if self.base is None else self.base
        Q = model.weights[0] if base.Q is None else base.Q
        R = model.weights[1] if base.R is None else base.R
        return (
            as_matrix("Q", Q, len(model.state_names)),
            as_matrix("R", R, len(model.input_names)),
        )

    def _weights(self, model: ControlAffine, count: int) -> Array:
        """Return the weights of the symmetric states, (count,)."""
        given = model.symmetry_weights if self.symmetry_weight is None else self.symmetry_weight
        weights = np.broadcast_to(np.asarray(1.0 if given is None else given, float), (count,))
        if not (weights > 0.0).all():
            raise GainError(f"`symmetry_weight` is {weights.tolist()}, and must be positive.")
        return weights


def symmetric_states(model: ControlAffine) -> list[int]:
    """Return the indices of states on which neither f nor g depends (tested at random states)."""
    base = np.asarray(model.trim[0], float)
    states = base + np.random.default_rng(0).uniform(-0.5, 0.5, (_SAMPLES, len(base)))
    slopes = np.asarray(_sensitivity(model, jnp.asarray(states)))
    return [k for k in range(len(base)) if slopes[k] == 0.0]


@eqx.filter_jit
def _sensitivity(model: ControlAffine, states: jax.Array) -> jax.Array:
    """Return for each state the largest derivative of f and g along it, (n,)."""

    def one(x: jax.Array) -> jax.Array:
        f, g = jax.jacfwd(model.drift)(x), jax.jacfwd(model.input_map)(x)
        return jnp.maximum(jnp.abs(f).max(axis=0), jnp.abs(g).max(axis=(0, 1)))

    return jax.vmap(one)(states).max(axis=0)


def _others(model: ControlAffine, fixed: list[int]) -> list[int]:
    return [k for k in range(len(model.state_names)) if k not in fixed]


def _monotone(model: ControlAffine, A: Array, fixed: list[int], weights: Array) -> Array:
    """Return P = T^-T diag(weights, P_s) T^-1, with P_s from a Lyapunov equation.

    T^-1 takes the symmetric states to coordinates that stand still when the rest decays.
    """
    free = _others(model, fixed)
    inner = A[np.ix_(free, free)]
    slow = np.linalg.eigvals(inner).real.max() if free else -1.0
    if slow >= 0.0:
        names = listing(model.state_names[k] for k in free)
        raise GainError(
            f"the inner loop leaves a mode at {slow:.3g} 1/s among {names}, and must damp them all."
        )
    T_inverse = np.eye(len(A))
    T_inverse[np.ix_(fixed, free)] = -A[np.ix_(fixed, free)] @ np.linalg.inv(inner)
    core = np.zeros_like(A)
    core[fixed, fixed] = weights
    core[np.ix_(free, free)] = scipy.linalg.solve_continuous_lyapunov(inner.T, -np.eye(len(free)))
    P = T_inverse.T @ core @ T_inverse
    return 0.5 * (P + P.T)
