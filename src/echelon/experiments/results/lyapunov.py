"""The paper's Lyapunov function V = 1/2 z'(M kron P) z along a run, and why it falls or rises."""

from collections.abc import Callable
from typing import NamedTuple, TypeAlias, final

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla

from echelon.agents.models.heading_symmetry import state_turn
from echelon.agents.models.model import ControlAffine
from echelon.agents.network.graph import Graph
from echelon.agents.world.disturbance import disturbed, draw
from echelon.core.compiled import cached_jit
from echelon.core.numerics import precision
from echelon.core.types import Array
from echelon.simulation.engine.result import Result
from echelon.simulation.step.drive import Drive
from echelon.simulation.step.motion import Motion

# Below this fraction of its largest value V is made of rounding and its rises mean nothing.
_ROUNDING = 1e-20
_ULPS = 8.0 * np.finfo(float).eps
"""Of the largest states and offsets: what the differences between neighbours are off by."""


class Lyapunov(NamedTuple):
    """V, its derivative, and the derivative's part that the drift makes, at each frame: (T,) each.

    `rate` is exact along the closed loop at the frame, leader's motion included. `drift` is the sum
    over edges of A_ij (y_i - y_j)'P (f(x_i) - f(x_j)) about the trim: the paper's Assumption 5, as
    met on this run, says that it is not positive. `after` and `drift_after` are V and that part one
    step of the run later. Below `rounding` V is nothing but that.
    """

    value: Array
    rate: Array
    drift: Array
    after: Array
    drift_after: Array
    rounding: float

    def rises(self) -> Array:
        """Return (T - 1,) booleans: where V rises to the next frame by more than rounding."""
        return np.diff(self.value) > 1e-9 * self.value[:-1] + self.rounding

    def forbidden(self) -> Array:
        """Return (T,) booleans: where V rises over a step although theory says that it may not.

        The law's own part of V' is a square with a minus. Where that and the drift's part push V
        down as a step begins, the drift still does as it ends, and V is larger there, it is the
        work of the held input, not of the law. Between frames that are stored less often, more may
        happen than derivatives at both ends know.
        """
        slack = 1e-9 * np.maximum(np.abs(self.rate), np.abs(self.drift))
        falls = (self.drift <= slack) & (self.rate - self.drift <= slack)
        rises = self.after - self.value > 1e-9 * self.value + self.rounding
        return falls & (self.drift_after <= slack) & rises


def goes_both_ways(graph: Graph) -> bool:
    """Tell whether V is known of a graph: each edge is heard both ways, and all the time."""
    return not graph.directed and graph.schedule is None


def lyapunov(result: Result) -> Lyapunov | None:
    """Return V along a run, in float64.

    None where the followers' law has no P or nothing was stored, and on graphs that are directed or
    switch, where V is no sum over edges and need not fall (theory page, T7).
    """
    P, graph, offsets = result.drive.metric(result.model), result.graph, result.formation.offsets
    if P is None or not len(result.times) or not goes_both_ways(graph):
        return None
    with precision("float64"), np.errstate(over="ignore", invalid="ignore"):
        x, u = result.states, result.inputs
        steps = np.rint(result.times / result.settings.dt).astype(np.int32)
        fields = _fields(result.drive, result.model, _motion(result), graph.leaders[0], x, u, steps)
        now, after = (
            _seen(result.model, each, np.asarray(each.states) - offsets) for each in fields
        )
        y, f, xdot = now
        later, f_after, _ = after
        difference = _difference(result.model)
        deviations = Deviations(graph, difference)
        z, delta = deviations(y)
        z_later, delta_later = deviations(later)
        value = 0.5 * _form(delta, P, z)
        return Lyapunov(
            value=value,
            rate=_form(delta, P, Deviations(graph, np.subtract).disagreement(xdot)),
            drift=_drift(graph, P, y, f, difference),
            after=0.5 * _form(delta_later, P, z_later),
            drift_after=_drift(graph, P, later, f_after, difference),
            rounding=_rounding(result, P, value),
        )


def _form(a: Array, P: Array, b: Array) -> Array:
    """Return sum_i a_i'P b_i for each frame, (T,), of a, b (T, N_f, n)."""
    return np.einsum("tia,ab,tib->t", a, P, b)


_Difference: TypeAlias = Callable[[Array, Array], Array]


def _difference(model: ControlAffine) -> _Difference:
    """Return the difference of states (T, E, n) that the laws take: angles may wind."""
    return lambda x, y: np.asarray(_differences(model, x, y))


@cached_jit
def _differences(model: ControlAffine, x: jax.Array, y: jax.Array) -> jax.Array:
    return jax.vmap(jax.vmap(model.difference))(x, y)


def _drift(graph: Graph, P: Array, y: Array, f: Array, difference: _Difference) -> Array:
    """Return the drift's part of V' at states less their offsets y with drifts f, (T, N, n)."""
    i, j = graph.edges.T
    apart = difference(y[:, i], y[:, j])
    return np.einsum("e,tea,ab,teb->t", graph.weights, apart, P, f[:, i] - f[:, j])


def _rounding(result: Result, P: Array, value: Array) -> float:
    """Return below what V is made of rounding: of its own sum, or of the states'."""
    size = np.abs(result.states).max(axis=(0, 1)) + np.abs(result.formation.offsets).max(axis=0)
    ulp = _ULPS * size
    states = 0.5 * float(result.graph.weights.sum()) * float(ulp @ np.abs(P) @ ulp)
    return max(_ROUNDING * float(value.max(initial=0.0)), states)


def _motion(result: Result) -> Motion:
    return Motion.of(result.model, result.world, result.settings)


class _Fields(NamedTuple):
    """States (T, N, n), the drift under the drive and xdot there, and the headings (T,).

    Beside the headings, in whose axes the metric stands, are their rates, rad/s; both are None
    where it does not turn.
    """

    states: jax.Array
    drift: jax.Array
    xdot: jax.Array
    headings: jax.Array | None
    rates: jax.Array | None


@cached_jit
def _fields(
    drive: Drive,
    model: ControlAffine,
    motion: Motion,
    leader: int,
    x: jax.Array,
    u: jax.Array,
    steps: jax.Array,
) -> tuple[_Fields, _Fields]:
    """Return the fields at states x (T, N, n) under inputs u (T, N, m) at steps (T,), and after it.

    What moves is taken for the same a step later.
    """

    def velocity(x: jax.Array, u: jax.Array, agent: jax.Array, step: jax.Array) -> jax.Array:
        return disturbed(motion.plant, *draw(motion.wind, step, agent))(x, u)

    moving = jax.vmap(jax.vmap(velocity, in_axes=(0, 0, 0, None)), in_axes=(0, 0, None, 0))
    later, xdot = jax.vmap(motion.advance)(x, u, steps), moving(x, u, jnp.arange(x.shape[1]), steps)

    def told(t: jax.Array, x: jax.Array) -> jax.Array | None:
        return drive.heading(model, t, x)

    def fields(x: jax.Array, steps: jax.Array) -> _Fields:
        times, first = steps.astype(x.dtype) * motion.dt, x[:, leader]
        if told(times[0], first[0]) is None:
            drift = jax.vmap(jax.vmap(lambda x: drive.drift(motion.plant, x)))(x)
            return _Fields(x, drift, xdot, None, None)
        along = (jnp.ones_like(times), xdot[:, leader])
        turn = jax.vmap(lambda *at: jax.jvp(told, at[:2], at[2:]))
        headings, rates = turn(times, first, *along)
        drift = jax.vmap(jax.vmap(lambda x, psi: drive.drift(motion.plant, x, psi), (0, None)))(
            x, headings
        )
        return _Fields(x, drift, xdot, headings, rates)

    return fields(x, steps), fields(later, steps + 1)


def _seen(model: ControlAffine, fields: _Fields, y: Array) -> tuple[Array, Array, Array]:
    """Return y, the drift and xdot, (T, N, n) each, in the axes in which the metric stands."""
    f, xdot = np.asarray(fields.drift), np.asarray(fields.xdot)
    if fields.headings is None or fields.rates is None:
        return y, f, xdot
    y, f, xdot = (
        np.asarray(_turned_back(model, jnp.asarray(part), fields.headings)) for part in (y, f, xdot)
    )
    # What rests in the world turns the other way in axes that turn.
    turning = np.asarray(fields.rates)[:, None, None] * (y @ state_turn(model).slope.T)
    return y, f - turning, xdot - turning


@cached_jit
def _turned_back(model: ControlAffine, values: jax.Array, angles: jax.Array) -> jax.Array:
    """Return values (T, N, n) in axes that are turned by angles (T,)."""
    return jax.vmap(jax.vmap(state_turn(model), (0, None)))(values, -angles)


@final
class Deviations:
    """z and delta of a graph, its Laplacian factored once.

    Args:
        graph: who hears whom.
        difference: of states (T, E, n).
    """

    def __init__(self, graph: Graph, difference: _Difference) -> None:
        """Factor the followers' Laplacian."""
        i, j = graph.edges.T
        edge = np.arange(len(i))
        signs = np.concatenate([graph.weights, -graph.weights])
        places = (np.concatenate([i, j]), np.concatenate([edge, edge]))
        self._gather = sp.csr_array(sp.coo_array((signs, places), shape=(graph.agents, len(i))))
        self._graph, self._difference = graph, difference
        self._solve = spla.splu(sp.csc_array(graph.grounded_laplacian())).solve

    def __call__(self, y: Array) -> tuple[Array, Array]:
        """Return z and delta, (T, N_f, n) each, of states less their offsets y (T, N, n)."""
        z = self.disagreement(y)
        frames, followers, n = z.shape
        # delta with (L_g kron I) delta = z.
        columns = np.moveaxis(z, 1, 0).reshape(followers, -1)
        solved = self._solve(columns)
        return z, np.moveaxis(solved.reshape(followers, frames, n), 0, 1)

    def disagreement(self, values: Array) -> Array:
        """Return the followers' z (T, N_f, n) of values (T, N, n)."""
        frames, agents, n = values.shape
        i, j = self._graph.edges.T
        # Differences first, as in the closed loop: at consensus they vanish exactly.
        apart = self._difference(values[:, i], values[:, j])
        differences = np.moveaxis(apart, 1, 0).reshape(len(i), -1)
        z = np.moveaxis((self._gather @ differences).reshape(agents, frames, n), 0, 1)
        return z[:, list(self._graph.followers)]


def potential(model: ControlAffine, graph: Graph, P: Array) -> Callable[[Array], Array]:
    """Return V (T,) as a function of states less their offsets (T, N, n), in float64."""
    deviations = Deviations(graph, _difference(model))

    def value(y: Array) -> Array:
        with precision("float64"), np.errstate(over="ignore", invalid="ignore"):
            z, delta = deviations(y)
            return 0.5 * _form(delta, P, z)

    return value
