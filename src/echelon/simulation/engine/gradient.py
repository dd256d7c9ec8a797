"""Gradients of a cost of a run by reverse-mode differentiation of the closed loop."""

import math
from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import Any, NamedTuple, TypeAlias, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from echelon.core.compiled import cached_jit
from echelon.core.errors import SimulationError, did_you_mean, listing
from echelon.core.identity import digest
from echelon.core.jaxpr import used_leaves
from echelon.core.memoize import BoundedCache, memoize
from echelon.core.numerics import precision
from echelon.core.types import Array
from echelon.simulation.engine.content import content_of, copied
from echelon.simulation.engine.law_drive import Laws, choose_engine
from echelon.simulation.engine.parts import Parts
from echelon.simulation.engine.prepare import prepare
from echelon.simulation.engine.simulate import sample_reference
from echelon.simulation.native.backward import Backward, SlopeNeeds
from echelon.simulation.native.varying import VaryingNumbers, alike, bare
from echelon.simulation.scalars import Unsupported
from echelon.simulation.step.drive import Drive, Problem
from echelon.simulation.step.loop import Loop, Moment, assemble
from echelon.simulation.step.meter import Sums, distance_of
from echelon.simulation.step.sequence import begin, measured_step
from echelon.simulation.step.settings import Settings

Cost: TypeAlias = Callable[[Sums], jax.Array]
"""A scalar cost of the sums over all steps of a run, written with `jax.numpy`."""

_WORTH = 10_000
"""Agent steps above which native code saves more time than generating it takes."""

VARIABLES = ("P", "R", "coupling", "initial", "offsets")
"""What a cost can be differentiated by.

P, R and the coupling of the followers' gain; the initial states (N, n); the goals' offsets (N, n),
at fixed initial states.
"""


class Gradient(NamedTuple):
    """A cost, its derivative by each requested variable, and the sums of the run.

    The derivatives by P and R are symmetric, for symmetric changes. `engine` is what differentiated
    the run; a warning gives the reason if native code would have been faster but is unavailable.
    """

    value: float
    slopes: Mapping[str, Array]
    sums: Sums
    engine: str = "jax"
    warnings: tuple[str, ...] = ()


def gradient(parts: Parts, settings: Settings, cost: Cost, wrt: Sequence[str]) -> Gradient:
    """Return a cost of a run and its derivatives by some of the run's parameters.

    The steps are differentiated backwards in float64, by native code or JAX as `settings.engine`
    says; both agree to rounding. States are stored at checkpoints and the steps between are
    computed again, so that memory grows with the square root of the number of steps.

    Args:
        parts: agents, graph, formation, laws, starts and world.
        settings: horizon, step and the like.
        cost: of the sums over the run's steps, such as `lambda sums: sums.errors[0].sum()`. It is
            traced once, as by `jax.jit`: values that it reads from its closure or module stay as
            they were then; pass a new function for other values.
        wrt: of `VARIABLES`.

    Raises:
        EchelonError: a part is malformed or does not fit the others; the agents are not driven by
            laws, or these have no gain; messages are late; a variable is unknown; the cost is not
            one number;
            `settings.engine` is `native`, and native code is unavailable.
    """
    if parts.world.network is not None:
        raise SimulationError("got a network, but derivatives are of messages that are never late.")
    if parts.drive.safety is not None:
        raise SimulationError("got `safety`, but derivatives are of agents that do not keep apart.")
    with precision("float64"):
        prepared = _take(parts, settings, tuple(wrt))
        result = choose_engine(
            settings,
            len(prepared.run.states),
            lambda: prepared.native_gradient(cost),
            lambda reason: by_jax(prepared.run, settings.steps, cost, reason),
            _WORTH,
        )
    _give_back(prepared)
    return result


class DifferentiableRun(NamedTuple):
    """A loop, the variables' values, the initial states (N, n) and the leaders' reference."""

    loop: Loop
    values: dict[str, Array]
    states: Array
    reference: Array | None


# ---- runs prepared for later calls ---------------------------------------------------------------


_MOST_RUNS, _MOST_BYTES = 4, 128 * 2**20
"""Most runs cached for later calls, and the most bytes of them together."""
_cache = BoundedCache["_PreparedRun"](_MOST_RUNS, lambda run: run.size, _MOST_BYTES)


def _take(parts: Parts, settings: Settings, wrt: tuple[str, ...]) -> "_PreparedRun":
    """Return a prepared run, taken from the cache if it is there."""
    key = content_of(parts, settings, wrt)
    # Out of the cache while in use: another thread must not change its gain meanwhile.
    cached = _cache.pop(key)
    if cached is None or not cached.update(parts):
        return _PreparedRun(parts, settings, wrt, key)
    return cached


def _give_back(run: "_PreparedRun") -> None:
    """Put a run into the cache for the next call."""
    if run.key is not None:
        _cache.put(run.key, run)


@final
class _PreparedRun:
    """A checked run that can be differentiated many times, also with another gain."""

    def __init__(
        self, parts: Parts, settings: Settings, wrt: tuple[str, ...], key: Hashable | None
    ) -> None:
        self.key, self.wrt, prepared = key, wrt, prepare(parts, settings)
        self.problem, drive = copied((prepared.problem, prepared.parts.drive))
        values = _values(self.problem, drive, wrt)
        assert isinstance(drive, Laws)  # `_values` rejects all others
        self.drive = drive
        loop = assemble(self.problem, self.drive.leader, self.drive.follower)
        reference = sample_reference(prepared, 0, settings.steps)
        self.run = DifferentiableRun(loop, values, self.problem.states, reference)
        self.gain, self._native = digest(parts.drive.gain), None

    def update(self, parts: Parts) -> bool:
        """Replace the gain; return False if the parts differ in more than its numbers.

        A law of the same form is not checked again.
        """
        gain = digest(parts.drive.gain)
        if gain is not None and gain == self.gain:
            return True
        problem, leader, new = self.problem, self.drive.leader, copied(parts.drive)
        assert isinstance(new, Laws)  # the key of the cache contains the type
        follower = new.follower.prepared(problem.model, problem.graph)
        drive = Laws(leader, follower.following(leader, problem.model))
        loop = assemble(problem, drive.leader, drive.follower)
        if not alike(loop, self.run.loop):
            return False
        drive.accept(problem)
        values = _values(problem, drive, self.wrt)
        self.run, self.gain = self.run._replace(loop=loop, values=values), gain
        if self._native is not None and not self._native.update(self.run):
            self._native = None
        return True

    def native_gradient(self, cost: Cost) -> Gradient:
        """Return the gradient of a cost by native code."""
        if self._native is None:
            self._native = Native(self.run, self.problem.settings.steps)
        return self._native.gradient(cost)

    @property
    def size(self) -> int:
        """Bytes stored from one call to the next."""
        arrays = jax.tree.leaves((self.run, self.problem.graph.edges, self.problem.graph.weights))
        size = sum(np.asarray(array).nbytes for array in arrays)
        return size + (0 if self._native is None else self._native.size)


# ---- by native code ------------------------------------------------------------------------------


_PARTS = {"P": ("P",), "R": ("R", "R_inverse"), "coupling": ("coupling",)}
"""The fields of a gain that change with each variable."""


@final
class Native:
    """A run that native code differentiates, for any number of costs.

    Args:
        run: the run.
        steps: its number of steps.
    """

    def __init__(self, run: DifferentiableRun, steps: int) -> None:
        """Find the numbers of the gain that have derivatives."""
        self.run, self.steps = run, steps
        names = [part for name in run.values for part in _PARTS.get(name, ())]
        self._varying, self._order = _gain_numbers(run.loop, names)
        self._shapes = tuple(np.shape(part) for part in run.loop.meter.zero_sums())
        self._passes = dict[bool, Backward | Unsupported]()

    def update(self, run: DifferentiableRun) -> bool:
        """Replace the gain; return False if the runs differ in more than its numbers."""
        if not self._varying.covers(run.loop):
            return False
        self.run = run
        for backward in self._passes.values():
            if isinstance(backward, Backward):
                backward.update(run.loop)
        return True

    @property
    def size(self) -> int:
        """Bytes stored from one cost to the next."""
        return sum(each.size for each in self._passes.values() if isinstance(each, Backward))

    def gradient(self, cost: Cost) -> Gradient:
        """Return the gradient of a cost.

        Raises:
            Unsupported: native code is unavailable for this run.
            MissingExtraError: llvmlite is not installed.
        """
        backward = self._backward(_uses_distances(cost, self._shapes))
        sums = backward.run()
        if sums is None:
            raise Unsupported("angles or whole numbers as large as these")
        value, by_sums = _cost_slopes(cost, sums)
        slopes = backward.slopes(by_sums)
        parts = dict(zip(self._order, slopes.leaves, strict=True))
        parts |= {"initial": slopes.states, "offsets": slopes.offsets}
        if "R" in parts:
            inverse = self.run.loop.follower.gain.R_inverse  # type: ignore[attr-defined]
            parts["R"] = parts["R"] - inverse.T @ parts["R_inverse"] @ inverse.T
        symmetric = {name: _symmetric(name, parts[name]) for name in self.run.values}
        return Gradient(float(value), symmetric, sums, "native")

    def _backward(self, distances: bool) -> Backward:
        """Return the backward pass of costs that depend on distances, or do not."""
        if distances not in self._passes:
            run, needs = self.run, SlopeNeeds(distances, "offsets" in self.run.values)
            data = self._varying, run.states, run.reference, self.steps, needs
            try:
                self._passes[distances] = Backward(*data)
            except Unsupported as reason:
                # Stored, so that the next call does not trace the run again to fail again.
                self._passes[distances] = reason
        backward = self._passes[distances]
        if isinstance(backward, Unsupported):
            raise backward
        return backward


@memoize
def _uses_distances(cost: Cost, shapes: tuple[tuple[int, ...], ...]) -> bool:
    """Tell whether a cost depends on the distances between agents."""
    return Sums(*used_leaves(cost, Sums(*map(np.zeros, shapes)))).spacing


def _gain_numbers(loop: Loop, names: Sequence[str]) -> tuple[VaryingNumbers, list[str]]:
    """Return the numbers of some fields of the followers' gain, and the fields in their order."""

    def places(loop: Loop) -> list[Array]:
        law: Any = loop.follower
        return [getattr(law.gain, name) for name in names]

    if not names:
        return VaryingNumbers([loop]), []
    # Doubled, each number differs from its original, except for zeros, which then fold.
    variant = eqx.tree_at(places, loop, [2.0 * np.asarray(part) for part in places(loop)])
    marked = jax.tree.leaves(eqx.tree_at(places, bare(loop), list(names)))
    return VaryingNumbers([loop], variant), [leaf for leaf in marked if isinstance(leaf, str)]


@cached_jit
def _cost_slopes(cost: Cost, sums: Sums) -> tuple[jax.Array, Sums]:
    """Return a cost of sums, and its derivatives by those that are differentiable."""
    names = ("errors", "tracking", "outputs", "effort", "spacing")
    smooth = {name: getattr(sums, name) for name in names}
    value, slopes = jax.value_and_grad(lambda part: _number(cost, sums._replace(**part)))(smooth)
    return value, sums._replace(**slopes)


def _number(cost: Cost, sums: Sums) -> jax.Array:
    """Return the cost of sums, which must be one number."""
    value = cost(sums)
    if (shape := jnp.shape(value)) != ():
        raise SimulationError(
            f"the cost of a run has shape {shape}, and must be one number, such as a sum of it."
        )
    return value


# ---- by JAX --------------------------------------------------------------------------------------


def by_jax(run: DifferentiableRun, steps: int, cost: Cost, reason: str = "") -> Gradient:
    """Return the gradient by JAX's reverse mode; `reason` says why not by native code."""
    (value, sums), slopes = _differentiate(*run, steps, cost)
    symmetric = {name: _symmetric(name, np.asarray(slope)) for name, slope in slopes.items()}
    warnings = (f"JAX differentiates the steps, since {reason}.",) * bool(reason)
    return Gradient(float(value), symmetric, jax.tree.map(np.asarray, sums), warnings=warnings)


def _values(problem: Problem, drive: Drive, wrt: Sequence[str]) -> dict[str, Array]:
    """Return the values of the variables by name."""
    gain = drive.gain
    if not isinstance(drive, Laws):
        raise SimulationError(
            f"a run driven by `{type(drive).__name__}` cannot be differentiated; use `Laws`."
        )
    available = {"initial": np.asarray(problem.states), "offsets": problem.formation.offsets}
    if gain is not None:
        available |= {"P": gain.P, "R": gain.R, "coupling": np.asarray(gain.coupling)}
    for name in wrt:
        if name in VARIABLES and name not in available:
            law = type(drive.follower).__name__
            raise SimulationError(f"the followers' law `{law}` has no gain, and so no `{name}`.")
        if name not in available:
            raise SimulationError(
                f"`wrt` names `{name}`, allowed are {listing(VARIABLES)}"
                f"{did_you_mean(name, VARIABLES)}."
            )
    return {name: available[name] for name in wrt}


def _symmetric(name: str, slope: Array) -> Array:
    return 0.5 * (slope + slope.T) if name in ("P", "R") else slope


@cached_jit
def _differentiate(
    loop: Loop,
    values: dict[str, Array],
    states: Array,
    reference: Array | None,
    steps: int,
    cost: Cost,
) -> tuple[tuple[jax.Array, Sums], dict[str, jax.Array]]:
    """Return the cost, the sums of the run, and the slopes."""

    def whole(values: dict[str, jax.Array]) -> tuple[jax.Array, Sums]:
        start = jnp.asarray(values.get("initial", states))
        changed = _with_offsets(_with_gain(loop, values), values)
        sums = _sums(changed, start, reference, steps)
        return _number(cost, sums), sums

    return jax.value_and_grad(whole, has_aux=True)(jax.tree.map(jnp.asarray, values))


def _with_gain(loop: Loop, values: Mapping[str, jax.Array]) -> Loop:
    """Return the loop with other numbers in the followers' gain."""
    numbers = {name: values[name] for name in ("P", "R", "coupling") if name in values}
    if "R" in numbers:
        numbers["R_inverse"] = jnp.linalg.inv(numbers["R"])

    def places(loop: Loop) -> list[Array]:
        law: Any = loop.follower
        return [getattr(law.gain, name) for name in numbers]

    return eqx.tree_at(places, loop, [*numbers.values()]) if numbers else loop


def _with_offsets(loop: Loop, values: Mapping[str, jax.Array]) -> Loop:
    """Return the loop with other offsets of the goals."""
    if "offsets" not in values:
        return loop
    offsets, meter = values["offsets"], loop.meter
    i, j = (offsets[ends][:, np.array(meter.measured)] for ends in meter.edges.T)
    spacings = distance_of(((i - j) ** 2).sum(axis=1))

    def places(loop: Loop) -> list[Array]:
        return [loop.offsets, loop.meter.offsets, loop.meter.spacings]

    return eqx.tree_at(places, loop, [offsets, offsets, spacings])


def _sums(loop: Loop, states: jax.Array, reference: Array | None, steps: int) -> Sums:
    """Return the sums over the steps of a run."""

    def one(carry: tuple[Moment, Sums], _: None) -> tuple[tuple[Moment, Sums], None]:
        now, sums = measured_step(loop, carry[0], reference, 0)
        return (now, carry[1].plus(sums)), None

    @jax.checkpoint
    def several(carry: tuple[Moment, Sums], _: None) -> tuple[tuple[Moment, Sums], None]:
        return jax.lax.scan(one, carry, None, length=few)

    # Checkpoints and the steps after each are then equally many: the least memory.
    few = max(1, math.isqrt(steps))
    carry = begin(loop, states), loop.meter.zero_sums()
    carry, _ = jax.lax.scan(several, carry, None, length=steps // few)
    return jax.lax.scan(one, carry, None, length=steps % few)[0][1]
