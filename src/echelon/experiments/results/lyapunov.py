"""The paper's Lyapunov function V = 1/2 z'(M kron P) z along a run, and the terms of V'."""

import functools
from collections.abc import Callable
from typing import NamedTuple, TypeAlias, final
from weakref import WeakKeyDictionary

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla
from jaxtyping import Bool, Float

from echelon.agents.models.heading_symmetry import state_turn
from echelon.agents.models.model import ControlAffine
from echelon.agents.network.graph import Graph
from echelon.core.compiled import cached_jit
from echelon.core.numerics import precision
from echelon.core.types import Array
from echelon.simulation.engine.parts import Parts
from echelon.simulation.engine.result import Result
from echelon.simulation.step.drive import Controller
from echelon.simulation.step.motion import PlantStep

# Below this fraction of its largest value V is rounding, and an increase means nothing.
_ROUNDING = 1e-20
_ULPS = 8.0 * np.finfo(float).eps
"""Relative rounding of differences between neighbours, of the largest states and offsets."""


class Lyapunov(NamedTuple):
    """V, its derivative, and the drift's part of the derivative, at each frame.

    `rate` is exact along the closed loop at the frame, leader's motion included. `drift` is the sum
    over edges of A_ij (y_i - y_j)'P (f(x_i) - f(x_j)) about the trim: the paper's Assumption 5
    means that it is not positive. `after` and `drift_after` are V and that part one step of the run
    later. Below `rounding` V is rounding only.
    """

    value: Float[Array, " T"]
    rate: Float[Array, " T"]
    drift: Float[Array, " T"]
    after: Float[Array, " T"]
    drift_after: Float[Array, " T"]
    rounding: float

    def rises(self) -> Bool[Array, " T-1"]:
        """Return where V increases to the next frame by more than rounding."""
        return rises(self.value[:-1], self.value[1:], self.rounding)

    @np.errstate(over="ignore", invalid="ignore")
    def forbidden(self) -> Array:
        """Return (T,) booleans: where V increases over a step although theory excludes it.

        The law's part of V' is minus a square. If that and the drift's part are negative at the
        start of a step, the drift's part also at its end, and V is larger there, the cause is the
        input held over the step, not the law. Between frames that are stored less often this cannot
        be decided from derivatives at both ends.
        """
        slack = 1e-9 * np.maximum(np.abs(self.rate), np.abs(self.drift))
        falls = (self.drift <= slack) & (self.rate - self.drift <= slack)
        increases = rises(self.value, self.after, self.rounding)
        return falls & (self.drift_after <= slack) & increases


@np.errstate(over="ignore", invalid="ignore")
def rises(
    before: Float[Array, " T"], after: Float[Array, " T"], rounding: float | None = None
) -> Bool[Array, " T"]:
    """Return where V increases by more than rounding, by default that of its sum."""
    rounding = _ROUNDING * float(before.max(initial=0.0)) if rounding is None else rounding
    return after - before > 1e-9 * before + rounding


def goes_both_ways(graph: Graph) -> bool:
    """Return whether V is defined for a graph: undirected, and without switching."""
    return not graph.directed and graph.schedule is None


def fixed_metric(parts: Parts) -> Float[Array, "n n"] | None:
    """Return the P of V, if V is a function of the states alone: P does not turn with a heading."""
    turning = getattr(getattr(parts.drive, "follower", None), "turning", False)
    if turning or not goes_both_ways(parts.graph):
        return None
    return parts.drive.metric(parts.model)


_COMPUTED: "WeakKeyDictionary[Result, Lyapunov | None]" = WeakKeyDictionary()


def lyapunov(result: Result) -> Lyapunov | None:
    """Return V along a run, in float64, computed once.

    None where the followers' law has no P or no frame was stored, where offsets change with time,
    and on directed or switching graphs, where V is not a sum over edges and need not decrease
    (theory page, T7).
    """
    if result not in _COMPUTED:
        _COMPUTED[result] = _lyapunov(result)
    return _COMPUTED[result]


def _lyapunov(result: Result) -> Lyapunov | None:
    P, graph, offsets = result.drive.metric(result.model), result.graph, result.formation.offsets
    if P is None or not len(result.times) or not goes_both_ways(graph):
        return None
    if result.formation.motion is not None:
        return None
    with precision("float64"), np.errstate(over="ignore", invalid="ignore"):
        x, u = result.states, result.inputs
        steps = np.rint(result.times / result.settings.dt).astype(np.int32)
        motion = PlantStep.of(result.model, result.world, result.settings, graph.agents)
        motion = motion.memoryless
        fields = _fields(result.drive, result.model, motion, graph.leaders[0], x, u, steps)
        now, after = (
            _in_metric_axes(result.model, field, np.asarray(field.states) - offsets)
            for field in fields
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


def _form(
    a: Float[Array, "T F n"], P: Float[Array, "n n"], b: Float[Array, "T F n"]
) -> Float[Array, " T"]:
    """Return sum_i a_i'P b_i for each frame."""
    return np.einsum("tia,ab,tib->t", a, P, b)


_Difference: TypeAlias = Callable[[Array, Array], Array]


def _difference(model: ControlAffine) -> _Difference:
    """Return the difference of states (T, E, n) that the laws use, with angles modulo 2 pi."""
    return lambda x, y: np.asarray(_differences(model, x, y))


@cached_jit
def _differences(model: ControlAffine, x: jax.Array, y: jax.Array) -> jax.Array:
    return jax.vmap(jax.vmap(model.difference))(x, y)


def _drift(graph: Graph, P: Array, y: Array, f: Array, difference: _Difference) -> Array:
    """Return the drift's part of V' at states minus offsets y with drifts f, (T, N, n)."""
    i, j = graph.edges.T
    differences = difference(y[:, i], y[:, j])
    return np.einsum("e,tea,ab,teb->t", graph.weights, differences, P, f[:, i] - f[:, j])


def _rounding(result: Result, P: Array, value: Array) -> float:
    """Return the value below which V is rounding, of its sum or of the states."""
    size = np.abs(result.states).max(axis=(0, 1)) + np.abs(result.formation.offsets).max(axis=0)
    ulp = _ULPS * size
    states = 0.5 * float(result.graph.weights.sum()) * float(ulp @ np.abs(P) @ ulp)
    return max(_ROUNDING * float(value.max(initial=0.0)), states)


class _Fields(NamedTuple):
    """States, drift, xdot (T, N, n); headings (T,) and rates (rad/s), None if axes do not turn."""

    states: jax.Array
    drift: jax.Array
    xdot: jax.Array
    headings: jax.Array | None
    rates: jax.Array | None


@cached_jit
def _fields(
    drive: Controller,
    model: ControlAffine,
    motion: PlantStep,
    leader: int,
    x: jax.Array,
    u: jax.Array,
    steps: jax.Array,
) -> tuple[_Fields, _Fields]:
    """The velocity is taken to be the same one step later."""

    def velocity(x: jax.Array, u: jax.Array, agent: jax.Array, step: jax.Array) -> jax.Array:
        return motion.field(((),) * len(motion.weather), step, agent)[0](x, u)

    moving = jax.vmap(jax.vmap(velocity, in_axes=(0, 0, 0, None)), in_axes=(0, 0, None, 0))
    agents = jnp.arange(x.shape[1])
    memory = jax.vmap(motion.begin)(x[0])

    def moved(x: jax.Array, u: jax.Array, step: jax.Array) -> jax.Array:
        return motion.advance(memory, x, u, step, agents)[0]

    later = jax.vmap(moved)(x, u, steps)
    xdot = moving(x, u, agents, steps)

    def heading(t: jax.Array, x: jax.Array) -> jax.Array | None:
        return drive.heading(model, t, x)

    def fields(x: jax.Array, steps: jax.Array) -> _Fields:
        times, first = steps.astype(x.dtype) * motion.dt, x[:, leader]
        if heading(times[0], first[0]) is None:
            drift = jax.vmap(jax.vmap(lambda x: drive.drift(motion.plant, x)))(x)
            return _Fields(x, drift, xdot, None, None)
        along = (jnp.ones_like(times), xdot[:, leader])
        turn = jax.vmap(lambda *at: jax.jvp(heading, at[:2], at[2:]))
        headings, rates = turn(times, first, *along)
        drift = jax.vmap(jax.vmap(lambda x, psi: drive.drift(motion.plant, x, psi), (0, None)))(
            x, headings
        )
        return _Fields(x, drift, xdot, headings, rates)

    return fields(x, steps), fields(later, steps + 1)


def _in_metric_axes(
    model: ControlAffine, fields: _Fields, y: Float[Array, "T N n"]
) -> tuple[Float[Array, "T N n"], Float[Array, "T N n"], Float[Array, "T N n"]]:
    f, xdot = np.asarray(fields.drift), np.asarray(fields.xdot)
    if fields.headings is None or fields.rates is None:
        return y, f, xdot
    y, f, xdot = (
        np.asarray(_rotate_back(model, jnp.asarray(part), fields.headings)) for part in (y, f, xdot)
    )
    # A vector that is constant in the world turns backward in turning axes.
    turning = np.asarray(fields.rates)[:, None, None] * (y @ state_turn(model).slope.T)
    return y, f - turning, xdot - turning


@cached_jit
def _rotate_back(model: ControlAffine, values: jax.Array, angles: jax.Array) -> jax.Array:
    """Return values (T, N, n) in axes rotated by angles (T,)."""
    return jax.vmap(jax.vmap(state_turn(model), (0, None)))(values, -angles)


@final
class Deviations:
    """Computes z and delta for a graph, whose Laplacian is factored once."""

    def __init__(self, graph: Graph, difference: _Difference) -> None:
        i, j = graph.edges.T
        edge = np.arange(len(i))
        signs = np.concatenate([graph.weights, -graph.weights])
        places = (np.concatenate([i, j]), np.concatenate([edge, edge]))
        self._gather = sp.csr_array(sp.coo_array((signs, places), shape=(graph.agents, len(i))))
        self._graph, self._difference = graph, difference

    @functools.cached_property
    def _solve(self) -> Callable[[Array], Array]:
        return spla.splu(sp.csc_array(self._graph.grounded_laplacian())).solve

    def __call__(
        self, y: Float[Array, "T N n"]
    ) -> tuple[Float[Array, "T F n"], Float[Array, "T F n"]]:
        """Return z and delta of the followers for states minus offsets y."""
        z = self.disagreement(y)
        frames, followers, n = z.shape
        # delta with (L_g kron I) delta = z.
        columns = np.moveaxis(z, 1, 0).reshape(followers, -1)
        delta = self._solve(columns).reshape(followers, frames, n)
        return z, np.moveaxis(delta, 0, 1)

    def disagreement(self, values: Float[Array, "T N n"]) -> Float[Array, "T F n"]:
        """Return the followers' z of values."""
        frames, agents, n = values.shape
        i, j = self._graph.edges.T
        # Differences first, as in the closed loop: at consensus they vanish exactly.
        differences = self._difference(values[:, i], values[:, j])
        differences = np.moveaxis(differences, 1, 0).reshape(len(i), -1)
        z = np.moveaxis((self._gather @ differences).reshape(agents, frames, n), 0, 1)
        return z[:, list(self._graph.followers)]


def potential(model: ControlAffine, graph: Graph, P: Array) -> Callable[[Array], Array]:
    """Return V (T,) as a function of states minus offsets (T, N, n), in float64."""
    deviations = Deviations(graph, _difference(model))

    def value(y: Array) -> Array:
        with precision("float64"), np.errstate(over="ignore", invalid="ignore"):
            z, delta = deviations(y)
            return 0.5 * _form(delta, P, z)

    return value
