"""Integral action of a law: the sums of its outputs' errors are states of its Riccati equation.

With s' = C z, where C picks the outputs, (z, s) obeys A_a = [[A, 0], [C, 0]] and B_a = [B; 0].
P_a solves their Riccati equation, and u = -c R^-1 B_a'P_a (z, s) has the modes A_a - c lambda B_a
R^-1 B_a'P_a, which decay for 2 c lambda_min >= 1 as those without a sum do. With P_a = [[P, N],
[N', M]] the law is u = -c R^-1 B'P (z + L s), L = P^-1 N: that of a gain P.
"""

from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Float

from echelon.agents.models.heading_symmetry import heading_index, state_turn
from echelon.agents.models.linearization import Linearization, linearize
from echelon.agents.models.model import ControlAffine
from echelon.agents.network.spectrum import Spectrum
from echelon.core.cache import memoize
from echelon.core.digits import about
from echelon.core.errors import GainError, listing
from echelon.core.linear import equilibrated_rank, riccati, symmetric_part
from echelon.core.types import Array, Input, Scalar, State
from echelon.core.words import amount
from echelon.synthesis.gains.gain import Gain

Weights: TypeAlias = bool | float | Sequence[float] | None
"""True for the default, a number for all outputs, or one for each; None or False for no sums."""
Sum: TypeAlias = Float[jax.Array, " q"]
"""The sum of each output's error, times s."""

_TRIED = tuple(float(f"{digit}e{power}") for power in range(-3, 4) for digit in (1, 2, 5))
_LOST = 0.25
"""Of the rate of the slowest mode: what a default weight may cost."""
_MODES = 16
"""Eigenvalues of a graph at which weights are tried."""
_ROUNDING = 1e-9
_SHORT = 0.01
"""Of the input that weighs as much as a state of 1: a shortfall that nearly stops the sums."""


class Integral(eqx.Module):
    """The sums of outputs' errors, and how a law acts on them.

    Attributes:
        weights: of the sums, as the user gave them; None for the default.
        outputs: the states that are summed, q of them.
        used: (q,) the weights in use.
        gain: P, R and c of the law that acts on z + L s.
        lift: L (n, q).

    Raises:
        GainError: a weight is negative or not finite.
    """

    weights: tuple[float, ...] | None = eqx.field(static=True)
    outputs: tuple[int, ...] = eqx.field(default=(), static=True)
    used: tuple[float, ...] = eqx.field(default=(), static=True)
    gain: Gain | None = None
    lift: Array | None = None

    @classmethod
    def of(cls, given: "Integral | Weights") -> "Integral | None":
        """Return the action that a user asks for by weights; None for none."""
        if isinstance(given, Integral) or given is None or given is False:
            return given or None
        if given is True:
            return cls(None)
        weights = tuple(np.atleast_1d(np.asarray(given, float)).tolist())
        if not all(0.0 <= weight < np.inf for weight in weights) or not any(weights):
            raise GainError(
                f"`integral` is {given}, and must be true, or weights that are not negative, one "
                "for each output or one for all, with at least one above 0."
            )
        return cls(weights)

    def prepared(self, model: ControlAffine, gain: Gain, spectrum: Spectrum) -> "Integral":
        """Return the action that goes with a gain, for a graph's eigenvalues.

        Raises:
            GainError: the inputs cannot hold all outputs, or P of the gain solves no Riccati
                inequality.
        """
        few = np.linspace(0, len(spectrum.eigenvalues) - 1, _MODES).round().astype(int)
        strengths = gain.coupling * np.append(spectrum.low, spectrum.eigenvalues[np.unique(few)])
        one = gain.P, gain.R, gain.inner
        outputs, used, P, lift = _solved(model, one, self.weights, strengths)
        return Integral(self.weights, outputs, used, eqx.tree_at(lambda g: g.P, gain, P), lift)

    def begin(self) -> Sum:
        """Return the sums of an agent that begins, (q,)."""
        return jnp.zeros(len(self.outputs))

    def feedback(
        self, model: ControlAffine, x: State, error: State, total: Sum, heading: Scalar | None
    ) -> Input:
        """Return c R^-1 (g(x) S)'P (error + L total), a normalized input (m,)."""
        assert self.gain is not None and self.lift is not None
        full = jnp.zeros_like(x).at[jnp.array(self.outputs)].set(total)
        L, turn = jnp.asarray(self.lift, x.dtype), state_turn(model)
        # The sums stay in the world's axes, and L acts in those of the heading.
        lifted = L @ full if heading is None else turn(L @ turn(full, -heading), heading)
        return self.gain.feedback(model, x, error + lifted, heading)

    def settle(
        self,
        model: ControlAffine,
        view: tuple[State, State, Scalar | float],
        total: Sum,
        inputs: tuple[Input, Input],
        heading: Scalar | None,
    ) -> Sum:
        """Return the sums (q,) after a step.

        Where an actuator cannot deliver what is desired, sums that would ask for more slow down.

        Args:
            model: the agent.
            view: its state (n,), its error (n,), and how long the input is held, s.
            total: (q,) before.
            inputs: desired and delivered, (m,) each.
            heading: in whose axes the gain is, rad; None for the world's.
        """
        assert self.gain is not None
        x, error, period = view
        step = period * error[jnp.array(self.outputs)]
        beyond = model.normalized(inputs[0]) - model.normalized(inputs[1])
        more = -self.feedback(model, x, jnp.zeros_like(x), step, heading)
        size = beyond @ (jnp.asarray(self.gain.R, x.dtype) @ beyond) / _SHORT**2
        # Near rest it is 1 to second order, so that the sums there are plain ones.
        share = jnp.where(beyond @ more > 0.0, 1.0 / (1.0 + size), 1.0)
        return total + share * step

    # ---- what is known of it ----

    def loops(self, model: ControlAffine, strengths: Array) -> Array:
        """Return A_a - s B_a R^-1 B_a'P_a at the trim for strengths s = c lambda (K,)."""
        assert self.gain is not None and self.lift is not None
        one, rows = linearize(model).with_inner(self.gain.inner), list(self.outputs)
        A, B = augmented(one, rows)
        K = self.gain.R_inverse @ one.B.T @ self.gain.P
        K = np.hstack([K, K @ self.lift[:, rows]])
        return A - strengths[:, None, None] * (B @ K)

    def slowest(self, model: ControlAffine, strengths: Array) -> float:
        """Return the slowest mode (1/s) of a loop in continuous time, likewise."""
        return float(np.linalg.eigvals(self.loops(model, strengths)).real.max())


# ---- the augmented Riccati equation --------------------------------------------------------------


def augmented(linear: Linearization, outputs: Sequence[int]) -> Linearization:
    """Return A_a (n + q, n + q) and B_a (n + q, m), with the sums of some states."""
    (A, B), q = linear, len(outputs)
    C = np.eye(len(A))[list(outputs)]
    top, bottom = np.hstack([A, np.zeros((len(A), q))]), np.hstack([C, np.zeros((q, q))])
    return Linearization(np.vstack([top, bottom]), np.vstack([B, np.zeros((q, B.shape[1]))]))


def summed_states(model: ControlAffine) -> tuple[int, ...]:
    """Return the states that are outputs: coordinates of the position, then the heading."""
    heading = () if model.heading is None else (heading_index(model),)
    return model.position_indices() + heading


class _Solution(NamedTuple):
    """Outputs (q), their weights, P (n, n) and L (n, n), as in `Integral`."""

    outputs: tuple[int, ...]
    used: tuple[float, ...]
    P: Array
    lift: Array


@memoize
def _solved(
    model: ControlAffine,
    gain: tuple[Array, Array, Array | None],
    weights: tuple[float, ...] | None,
    strengths: Array,
) -> _Solution:
    """Return the action for P, R and an inner loop, by given weights or by those that are found."""
    P, R, inner = gain
    linear = linearize(model).with_inner(inner)
    outputs, given = _outputs(model, linear, weights)
    _check_outputs(model, linear, outputs)
    whole, Q = augmented(linear, outputs), _implied_weight(linear, P, R)
    enough = (1.0 - _LOST) * _slowest(linear, P, R, strengths)
    # Six digits, so that rounding of Q changes no weight.
    sizes = [[float(f"{x * (Q[k, k] or 1.0):.6g}") for k in outputs] for x in _TRIED]
    tried = list[tuple[float, _Solution]]()
    for used in sizes if given is None else [given]:
        P = riccati(*whole, np.asarray(scipy.linalg.block_diag(Q, np.diag(used))), R)
        tried.append((_slowest(whole, P, R, strengths), _split(outputs, (*used,), P)))
        if tried[-1][0] <= enough:
            break
    return min(tried, key=lambda one: one[0])[1]


def _slowest(linear: Linearization, P: Array, R: Array, strengths: Array) -> float:
    A, B = linear
    loops = A - strengths[:, None, None] * (B @ np.linalg.solve(R, B.T @ P))
    return float(np.linalg.eigvals(loops).real.max())


def _split(outputs: tuple[int, ...], used: tuple[float, ...], whole: Array) -> _Solution:
    n = len(whole) - len(outputs)
    lift = np.zeros((n, n))
    lift[:, list(outputs)] = np.linalg.solve(whole[:n, :n], whole[:n, n:])
    return _Solution(outputs, used, whole[:n, :n], lift)


def _outputs(
    model: ControlAffine, linear: Linearization, weights: tuple[float, ...] | None
) -> tuple[tuple[int, ...], tuple[float, ...] | None]:
    """Return the states that are summed, and their weights if the user gave some."""
    every, place = summed_states(model), model.position_indices()
    if weights is None:
        # Of a vehicle whose inputs cannot hold its heading too, its position alone.
        return (every if _held(linear, every) or not place else place), None
    full = weights * len(every) if len(weights) == 1 else weights
    if len(full) != len(every):
        names = listing(model.state_names[k] for k in every)
        raise GainError(
            f"`integral` has {amount(len(full), 'weight')}, and `{type(model).__name__}` needs one "
            f"for all, or one for each of {names}."
        )
    outputs = tuple(k for k, weight in zip(every, full, strict=True) if weight)
    return outputs, tuple(weight for weight in full if weight)


def _check_outputs(model: ControlAffine, linear: Linearization, outputs: tuple[int, ...]) -> None:
    """Check that constant inputs hold outputs, and that the heading turns them into each other."""
    name, m = f"`{type(model).__name__}`", len(model.input_names)
    names = listing(model.state_names[k] for k in outputs)
    alone = [k for k in outputs if state_turn(model).partners[k] not in outputs]
    text = ""
    if not outputs:
        text = f"positions and headings, and {name} has none"
    elif len(outputs) > m:
        text = f"{names} of {name}, and its inputs can hold {m} at most; give the others weight 0"
    elif not _held(linear, outputs):
        text = f"{names} of {name}, whose inputs cannot hold them all ([[A, B], [C, 0]] has not "
        text += "full rank); give some of them weight 0"
    elif alone:
        pair = (alone[0], state_turn(model).partners[alone[0]])
        text = f"one of {listing(model.state_names[k] for k in pair)}, which turn into each other "
        text += "with the heading; give both a weight, or none"
    if text:
        raise GainError(f"`integral` sums {text}.")


def _held(linear: Linearization, outputs: Sequence[int]) -> bool:
    """Tell whether [[A, B], [C, 0]] has rank n + q: constant inputs hold any outputs."""
    whole = np.hstack(augmented(linear, outputs))
    return len(outputs) <= linear.B.shape[1] and equilibrated_rank(whole) == len(whole)


def _implied_weight(linear: Linearization, P: Array, R: Array) -> Array:
    """Return Q (n, n) for which P solves the Riccati equation: the weight of a gain by `riccati`.

    Raises:
        GainError: it is not positive semidefinite.
    """
    A, push = linear.A, linear.B @ np.linalg.solve(R, linear.B.T)
    Q = P @ push @ P - A.T @ P - P @ A
    size = abs(P) @ abs(push) @ abs(P) + abs(A.T) @ abs(P) + abs(P) @ abs(A)
    Q: Array = symmetric_part(np.where(abs(Q) > _ROUNDING * size, Q, 0.0))
    values, vectors = np.linalg.eigh(Q)
    if values.min() < -_ROUNDING * size.max():
        raise GainError(
            "`integral` needs a gain whose P satisfies A'P + P A <= P B R^-1 B'P, as one by the "
            f"method `riccati` does; here an eigenvalue is {about(values.min())} too low."
        )
    return Q if values.min() >= 0.0 else symmetric_part((vectors * values.clip(0.0)) @ vectors.T)
