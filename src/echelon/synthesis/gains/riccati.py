"""Gains by a Riccati equation at the trim, with an inner loop or without."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg

from echelon.agents.models.linearization import Linearization, own_damping
from echelon.agents.models.model import ControlAffine
from echelon.core.compiled import cached_jit
from echelon.core.errors import GainError, listing
from echelon.core.linear import (
    Weight,
    as_matrix,
    check_definite,
    check_eigenvalues,
    eigenvalue_text,
    riccati,
    symmetric_part,
    uncontrollable_modes,
    without_warnings,
)
from echelon.core.types import Array
from echelon.synthesis.gains.gain import Feedback, Method

# ---- weights -------------------------------------------------------------------------------------


def weights_of(
    model: ControlAffine, Q: Weight | None = None, R: Weight | None = None
) -> tuple[Array, Array]:
    """Return Q (n, n) of the states and R (m, m) of the normalized inputs.

    Args:
        model: its weights are the defaults.
        Q: n numbers (a diagonal) or (n, n).
        R: m numbers (a diagonal) or (m, m).

    Raises:
        GainError: one has another size, Q is not symmetric positive semidefinite, or R is not
            symmetric positive definite.
    """
    default_Q, default_R = model.weights
    Q = as_matrix("Q", default_Q if Q is None else Q, len(model.state_names))
    R = as_matrix("R", default_R if R is None else R, len(model.input_names))
    check_definite("R", R)
    # R is inverted, so it must be definite; Q may have zero weights for states that decay.
    _check_semidefinite(Q)
    return Q, R


def _check_semidefinite(Q: Array) -> None:
    if not np.isfinite(Q).all() or not np.allclose(Q, Q.T, rtol=1e-9, atol=0.0):
        raise GainError("`Q` must be a symmetric matrix of finite numbers.")
    # Rounding makes zero eigenvalues of a Q of lower rank, such as C'C, slightly negative.
    check_eigenvalues("Q", "positive semidefinite", Q, -1e-12 * len(Q))


# ---- Riccati -------------------------------------------------------------------------------------


class Riccati(Method):
    """P from A'P + P A + Q - P B R^-1 B'P = 0 at the trim, in normalized inputs.

    Args:
        Q: state weight, n numbers or (n, n); by default the model's.
        R: weight of the normalized input, m numbers or (m, m); by default the model's.
        coupling: c > 0; by default 1/lambda_min, twice the smallest 1/(2 lambda_min) of the
            guarantee for linear agents.
    """

    name = "riccati"

    Q: Weight | None = None
    R: Weight | None = None

    def feedback(self, model: ControlAffine, linear: Linearization) -> Feedback:
        """Return P, whose equation leaves -Q at strength 1.

        Raises:
            GainError: a weight is not positive (semi)definite, or a mode cannot be stabilized
                (named).
        """
        Q, R = weights_of(model, self.Q, self.R)
        _check_stabilizable(model, linear)
        # P A + A'P - s P B R^-1 B'P = -Q - (s - 1) P B R^-1 B'P, never positive for s >= rho = 1.
        return Feedback(riccati(*linear, Q, R), R, rho=1.0)


def _check_stabilizable(model: ControlAffine, linear: Linearization) -> None:
    """Name the first mode that no input can move and that does not decay by itself."""
    for eigenvalue, direction in uncontrollable_modes(*linear):
        # A mode that decays needs no input: (A, B) need not be controllable.
        if eigenvalue.real >= 0.0:
            # The mode is a combination w'x; entries of the size of rounding are left out.
            used = np.abs(direction) > 0.1 * np.abs(direction).max()
            states = listing(itertools.compress(model.state_names, used))
            raise GainError(
                f"the linearization of `{type(model).__name__}` at its trim cannot be stabilized: "
                f"no input moves the mode at {eigenvalue_text(eigenvalue)} 1/s, which lies along "
                f"{states}; give the gain yourself (method `given`)."
            )


# ---- an inner loop with which the paper's Assumption 5 holds -------------------------------------

_SAMPLES = 16
"""Random states; several, since a drift may be constant on one side of a threshold."""


class InnerLoop(Method):
    """Close a loop that ignores the symmetric states, u = kappa(x) + u~, then use the paper's law.

    The symmetric states (a vehicle's position) are those on which f and g do not depend. The loop
    shifts all other modes to the left, so that A - B K has semisimple zeros and is Hurwitz
    otherwise. Then a P > 0 with P (A - B K) + (A - B K)'P <= 0 exists; with linear f the
    disagreement goes to zero for every coupling c > 0 and every connected graph.

    Args:
        Q, R: weights of states and normalized inputs that shape the inner loop, by the Riccati
            equation of the other states. With neither it is the model's `damping`, if it has one;
            a weight left out is the model's.
        coupling: c > 0; any is stable, and it sets the rate; 3 by default.
        symmetry_weight: weight of the symmetric states in P, one number each or one for all; by
            default the model's.
    """

    name = "inner-loop"
    free_coupling = 3.0

    Q: Weight | None = None
    R: Weight | None = None
    symmetry_weight: tuple[float, ...] | float | None = None

    def feedback(self, model: ControlAffine, linear: Linearization) -> Feedback:
        """Return the inner loop, and a P that the drift with this loop does not expand.

        Raises:
            GainError: no state is symmetric, the other states cannot be stabilized, or a weight is
                not positive.
        """
        fixed = symmetric_states(model)
        if not fixed:
            raise GainError(
                f"`{type(model).__name__}` has no symmetric state, one that does not enter its "
                "dynamics, which the method `inner-loop` needs; use `monotone` or `riccati`."
            )
        K = self._feedback(model, linear, fixed)
        P = _monotone(model, linear.with_inner(K).A, fixed, self._weights(model, len(fixed)))
        # P A + A'P <= 0 without any feedback, so it holds with every coupling: rho is 0. It holds
        # with any R too, which limits how fast an input responds where the agent is tilted.
        declared = model.symmetry_inputs
        inputs = np.ones(len(model.input_names)) if declared is None else declared
        R = np.diag(np.atleast_1d(np.asarray(inputs, float)))
        return Feedback(P, R, rho=0.0, inner=K)

    def _feedback(self, model: ControlAffine, linear: Linearization, fixed: list[int]) -> Array:
        """Return K (m, n), zero in the columns of the symmetric states."""
        # A Riccati equation ignores actuator limits; the damping of a model respects them.
        declared = own_damping(model) if self.Q is None and self.R is None else None
        if declared is not None:
            return declared
        free = _others(model, fixed)
        Q, R = weights_of(model, self.Q, self.R)
        A, B = linear.A[np.ix_(free, free)], linear.B[free]
        # Zero columns: with position feedback the offsets were no symmetries (Lemma 4).
        K = np.zeros((len(model.input_names), len(model.state_names)))
        K[:, free] = np.linalg.solve(R, B.T @ riccati(A, B, Q[np.ix_(free, free)], R))
        return K

    def _weights(self, model: ControlAffine, count: int) -> Array:
        chosen = model.symmetry_weights if self.symmetry_weight is None else self.symmetry_weight
        try:
            weights = np.asarray(1.0 if chosen is None else chosen, float)
        except (TypeError, ValueError):
            weights = np.array(np.nan)
        if weights.shape not in ((), (count,)) or not ((weights > 0.0) & (weights < np.inf)).all():
            raise GainError(
                f"`symmetry_weight` is {chosen}, and must be one positive number, or {count}, one "
                "for each symmetric state."
            )
        return np.broadcast_to(weights, (count,))


def symmetric_states(model: ControlAffine) -> list[int]:
    """Return the indices of states on which neither f nor g depends (tested at random states)."""
    base = np.asarray(model.trim[0], float)
    # Half a unit about the trim stays inside the charts of angles; a fixed seed for one answer.
    states = base + np.random.default_rng(0).uniform(-0.5, 0.5, (_SAMPLES, len(base)))
    slopes = np.asarray(_sensitivity(model, jnp.asarray(states)))
    # Exactly zero: the derivative in a state that the code does not use has no rounding.
    return [k for k in range(len(base)) if slopes[k] == 0.0]


@cached_jit
def _sensitivity(model: ControlAffine, states: jax.Array) -> jax.Array:
    """Return for each state the largest derivative of f and g along it, (n,)."""

    def one(x: jax.Array) -> jax.Array:
        f, g = jax.jacfwd(model.drift)(x), jax.jacfwd(model.input_map)(x)
        return jnp.maximum(jnp.abs(f).max(axis=0), jnp.abs(g).max(axis=(0, 1)))

    return jax.vmap(one)(states).max(axis=0)


def _others(model: ControlAffine, fixed: list[int]) -> list[int]:
    return [k for k in range(len(model.state_names)) if k not in fixed]


def _monotone(model: ControlAffine, A: Array, fixed: list[int], weights: Array) -> Array:
    """Return P = T^-T diag(weights, P_s) T^-1, with P_s from a Lyapunov equation."""
    free = _others(model, fixed)
    inner = A[np.ix_(free, free)]
    # Without other states nothing needs to decay; -1 stands for a mode that does.
    slow = np.linalg.eigvals(inner).real.max() if free else -1.0
    one = np.eye(len(free))
    with without_warnings():
        # With any positive weights V does not rise, since y is constant; they only set rates.
        decaying = scipy.linalg.solve_continuous_lyapunov(inner.T, -one)
        exact = np.allclose(inner.T @ decaying + decaying @ inner, -one, atol=1e-6)
    # SciPy moves a mode that is nearly on the axis, and solves another equation.
    if slow >= 0.0 or not exact:
        names = listing(model.state_names[k] for k in free)
        raise GainError(
            f"the inner loop leaves a mode at {slow:.3g} 1/s among {names}, and must damp them all."
        )
    T_inverse = np.eye(len(A))
    # The columns of the symmetric states are zero in A, so y = x_f - A_fs A_ss^-1 x_s has ydot = 0.
    T_inverse[np.ix_(fixed, free)] = -A[np.ix_(fixed, free)] @ np.linalg.inv(inner)
    core = np.zeros_like(A)
    core[fixed, fixed] = weights
    core[np.ix_(free, free)] = decaying
    # P A + A'P = T^-T diag(0, -I) T^-1 <= 0. Rounding leaves it a little off symmetry.
    return symmetric_part(T_inverse.T @ core @ T_inverse)
