"""The leader's law along any feasible path: linear-quadratic feedback that varies with time.

The gain is swept backward along the path, about which the model is linearized; so it also leads
models that no feedback stabilizes at their trim, such as a unicycle, and models without flat
outputs.
"""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg

from echelon.agents.models.model import ControlAffine
from echelon.agents.network.graph import Graph
from echelon.agents.references.reference import Guide, check_reference
from echelon.core.compiled import cached_jit
from echelon.core.errors import LawError
from echelon.core.identity import process_key
from echelon.core.linear import symmetric_part
from echelon.core.memoize import BoundedCache
from echelon.core.types import Array, Input
from echelon.laws.law import LocalView, Memory
from echelon.laws.path_leader import PathLeader

_SPAN = 0.02
"""Between two gains, s; A and B are taken in the middle, an error of second order in it."""
_MOST = 50_000
"""Gains of a path; a longer one has them farther apart, so that a quadrotor's take 20 MB."""

_HELD = 1500
"""Intervals (of 0.02 s: 30 s) for which the end is held at least, so that a short path has the gain
of a long one: what the beginning leaves of P falls at twice the slowest mode."""
_SWEEPS = BoundedCache[tuple[Array, Array]](4, lambda swept: swept[0].nbytes, 2**26)
"""Gains that were swept last, and their slowest decay."""


class PathLQR(PathLeader):
    """u_L = u_r(t) - S K(t) (x - x_r(t)), with K = R^-1 B'P of the Riccati differential equation.

    -Pdot = A'P + P A - P B R^-1 B'P + Q along the reference (x_r, u_r), where A is the slope of
    f + g u_r and B = g S; Q and R are the model's weights. P is swept backward from zero, a
    time after the end that is as long as the path, and 30 s at least. For that time the end is
    held, and P comes to the steady solution there, if there is one.

    Args:
        reference: a path by the model's flatness map, or given as states and inputs (`StatePath`).
        horizon: how long it is followed, s; afterwards the last gain holds.
    """

    horizon: float = eqx.field(default=10.0, static=True)
    gains: Array | None = None
    decay: Array | None = None

    @property
    def information(self) -> tuple[str, ...]:
        """The whole reference, along which the gain is swept backward."""
        return ("the reference, all of it before the start",)

    def prepared(self, model: ControlAffine, graph: Graph) -> "PathLQR":
        """Sweep the gain, once for a model and a path.

        Raises:
            LawError: the model cannot follow the reference, or no feedback stabilizes it there.
        """
        check_reference(self.reference)
        self.reference.fit(model)
        about = model, self.reference, self.horizon
        gains, decay = _SWEEPS.get_or_make(process_key(about), lambda: sweep(*about))
        return PathLQR(self.reference, self.horizon, gains, decay)

    def own_mode(self, model: ControlAffine) -> float | None:
        """Return the slowest rate (1/s, below 0) at which errors shrink, by e'P e."""
        return None if self.decay is None else float(self.decay)

    def update(self, model: ControlAffine, view: LocalView, memory: Memory) -> tuple[Input, Memory]:
        """Return the leader's input."""
        if self.gains is None:
            raise LawError("`PathLQR` has no gain yet; call `prepared(model, graph)` first.")
        state, u = self.reference.follow(model, view.t)
        gains = jnp.asarray(self.gains, view.x.dtype)
        last = len(gains) - 1
        place = jnp.clip(view.t * (last / self.horizon), 0.0, last)
        k = jnp.minimum(jnp.floor(place).astype(jnp.int32), last - 1)
        K = gains[k] + (place - k) * (gains[k + 1] - gains[k])
        # With several leaders each follows the reference at an offset of its own.
        v = K @ model.difference(view.x, state + view.offset)
        return u - model.physical(v, trim=False), memory


def sweep(model: ControlAffine, reference: Guide, horizon: float) -> tuple[Array, Array]:
    """Return the gains K (N + 1, m, n) at equal times over a horizon (s), and the slowest decay.

    Along the linearization V = e'P e falls as V' = -e'(Q + K'R K) e, so that errors shrink at
    half the least eigenvalue of P^-1 (Q + K'R K) or faster, in the metric P.

    Raises:
        LawError: P grows beyond all numbers, as where an unstable mode is out of the inputs' reach.
    """
    Q, R = (np.diag(np.asarray(part, float)) for part in model.weights)
    count = min(max(1, math.ceil(horizon / _SPAN)), _MOST)
    # Ends and middles of the intervals, and the end once more, where it is held.
    times = jnp.linspace(0.0, horizon, 2 * count + 1)
    A, B = (np.asarray(part, np.float64) for part in _slopes(model, reference, times))
    name, path = type(model).__name__, type(reference).__name__
    if not (np.isfinite(A).all() and np.isfinite(B).all()):
        raise LawError(
            f"the reference `{path}` cannot be followed by `{name}`: its states, inputs or slopes "
            "are not finite."
        )
    held = np.append(np.arange(1, 2 * count, 2), 2 * count)
    push = B[held] @ np.linalg.solve(R, B[held].swapaxes(1, 2))
    P = _backward(_flows(A[held], push, Q, horizon / count))
    if not np.isfinite(P).all():
        raise LawError(
            f"`lqr` cannot hold `{name}` on the reference `{path}`: no feedback keeps its "
            "linearization there bounded."
        )
    K = np.linalg.solve(R, B[::2].swapaxes(1, 2) @ P)
    return K, _decay(P, Q + K.swapaxes(1, 2) @ R @ K)


def _backward(flows: Array) -> Array:
    """Return P (N + 1, n, n) at the ends of N intervals, from their flows and that of the end."""
    n = flows.shape[-1] // 2
    P = [np.zeros((n, n))]
    # What overflows is rejected afterwards, by its NaN.
    with np.errstate(all="ignore"):
        for _ in range(max(len(flows) - 1, _HELD)):
            P[0] = _before(P[0], flows[-1])
        for flow in flows[-2::-1]:
            P.append(_before(P[-1], flow))
    return np.array(P[::-1])


def _flows(A: Array, G: Array, Q: Array, span: float) -> Array:
    """Return exp(-H span) for each Hamiltonian matrix H = [[A, -G], [-Q, -A']], (N, 2n, 2n).

    [X; Y] with [X; Y]' = H [X; Y] has P = Y X^-1 for the Riccati equation's solution. With A and
    G held this is exact at any length of a step, where a Runge-Kutta step of fast modes is not
    stable.
    """
    H = np.block([[A, -G], [np.broadcast_to(-Q, A.shape), -A.swapaxes(1, 2)]])
    return scipy.linalg.expm(-span * H)


def _before(P: Array, flow: Array) -> Array:
    """Return P one interval earlier."""
    n = len(P)
    X, Y = flow[:n, :n] + flow[:n, n:] @ P, flow[n:, :n] + flow[n:, n:] @ P
    # Rounding alone makes it asymmetric, and would grow with every interval.
    return symmetric_part(np.linalg.solve(X.T, Y.T).T)


def _decay(P: Array, W: Array) -> Array:
    """Return minus half the least eigenvalue of P^-1 W over P (N, n, n) and W (N, n, n)."""
    root = np.linalg.inv(np.linalg.cholesky(P))
    # An array, since a float would be a constant of the compiled step, and another one of another.
    return np.asarray(-0.5 * np.linalg.eigvalsh(root @ W @ root.swapaxes(1, 2)).min())


@cached_jit
def _slopes(
    model: ControlAffine, reference: Guide, times: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Return A (T, n, n) and B (T, n, m) of the deviation from a reference at times (T,)."""

    def one(t: jax.Array) -> tuple[jax.Array, jax.Array]:
        x, u = reference.follow(model, t)
        slope = jax.jacfwd(lambda x: model.velocity(x, u))(x)
        return slope, model.normalized_input_map(x)

    return jax.vmap(one)(times)
