"""The paper's Lyapunov function V = 1/2 z'(M kron P) z along a run, and why it falls or rises."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla

from echelon.core.numerics import precision
from echelon.core.types import Array
from echelon.engine.drive import Drive
from echelon.engine.motion import Motion
from echelon.engine.result import Result
from echelon.network.graph import Graph
from echelon.world.disturbance import disturb

# Below this fraction of its largest value V is made of rounding and its rises mean nothing.
_ROUNDING = 1e-20


class Lyapunov(NamedTuple):
    """V, its derivative, and the derivative's part that the drift makes, at each frame: (T,) each.

    `rate` is exact along the closed loop at the frame, leader's motion included. `drift` is the sum
    over edges of A_ij (y_i - y_j)'P (f(x_i) - f(x_j)) about the trim: the paper's Assumption 5, as
    met on this run, says that it is not positive.
    """

    value: Array
    rate: Array
    drift: Array

    def rises(self) -> Array:
        """Return (T - 1,) booleans: where V rises to the next frame by more than rounding."""
        return np.diff(self.value) > 1e-9 * self.value[:-1] + _ROUNDING * self.value.max(
            initial=0.0
        )

    def forbidden(self) -> Array:
        """Return (T - 1,) booleans: where V rises although theory says that it may not.

        Where drift and input both push V down at two successive frames, a rise in between is the
        work of the step, not of the law.
        """
        slack = 1e-9 * np.abs(self.rate).max(initial=0.0)
        falls = (self.drift <= slack) & (self.rate - self.drift <= slack)
        return self.rises() & falls[:-1] & falls[1:]


def lyapunov(result: Result) -> Lyapunov | None:
    """Return V along a run, in float64.

    None where the followers' law has no P or nothing was stored.
    """
    P = result.drive.metric(result.model)
    if P is None or not len(result.times):
        return None
    with precision("float64"), np.errstate(over="ignore", invalid="ignore"):
        x, u = jnp.asarray(result.states), jnp.asarray(result.inputs)
        steps = jnp.asarray(np.rint(result.times / result.settings.dt).astype(np.int32))
        fields = _fields(result.drive, _motion(result), x, u, steps)
        f, xdot = (np.asarray(part) for part in fields)
        y = result.states - result.formation.offsets
        z, zdot = (_disagreement(result.graph, part) for part in (y, xdot))
        delta = _grounded_inverse(result.graph, z)
        i, j = result.graph.edges.T
        drift = np.einsum(
            "e,tea,ab,teb->t", result.graph.weights, y[:, i] - y[:, j], P, f[:, i] - f[:, j]
        )
        value = 0.5 * np.einsum("tia,ab,tib->t", delta, P, z)
        return Lyapunov(value, np.einsum("tia,ab,tib->t", delta, P, zdot), drift)


def _motion(result: Result) -> Motion:
    return Motion.of(result.model, result.world, result.settings)


@eqx.filter_jit
def _fields(
    drive: Drive,
    motion: Motion,
    x: jax.Array,
    u: jax.Array,
    steps: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """Return the drift under the drive and xdot for x (T, N, n), u (T, N, m) at steps (T,)."""

    def one(x: jax.Array, u: jax.Array, agent: jax.Array, step: jax.Array) -> tuple[Any, Any]:
        return drive.drift(motion.plant, x), disturb(motion.plant, motion.wind, step, agent)(x, u)

    over = jax.vmap(jax.vmap(one, in_axes=(0, 0, 0, None)), in_axes=(0, 0, None, 0))
    return over(x, u, jnp.arange(x.shape[1]), steps)


def _disagreement(graph: Graph, values: Array) -> Array:
    """Return the followers' z (T, N_f, n) of values (T, N, n)."""
    frames, agents, n = values.shape
    i, j = graph.edges.T
    edge = np.arange(len(i))
    signs = np.concatenate([graph.weights, -graph.weights])
    places = (np.concatenate([i, j]), np.concatenate([edge, edge]))
    gather = sp.csr_array(sp.coo_array((signs, places), shape=(agents, len(i))))
    # Differences first, as in the closed loop: at consensus they vanish exactly.
    differences = np.moveaxis(values[:, i] - values[:, j], 1, 0).reshape(len(i), -1)
    z = np.moveaxis((gather @ differences).reshape(agents, frames, n), 0, 1)
    return z[:, list(graph.followers)]


def _grounded_inverse(graph: Graph, z: Array) -> Array:
    """Return delta with (L_g kron I) delta = z, for z (T, N_f, n)."""
    frames, followers, n = z.shape
    columns = np.moveaxis(z, 1, 0).reshape(followers, -1)
    solved = spla.splu(sp.csc_array(graph.grounded_laplacian())).solve(columns)
    return np.moveaxis(solved.reshape(followers, frames, n), 0, 1)
