"""How a cost of a run changes with its gain and its starts: the closed loop differentiated."""

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
"""What is to be small, a number made of the sums over all steps of a run, in JAX."""

_WORTH = 10_000
"""Steps of one agent from which on native code saves more than it takes to make."""

VARIABLES = ("P", "R", "coupling", "initial", "offsets")
"""What a cost can be differentiated by.

P, R and the coupling of the followers' gain; the starts (N, n); the goals' offsets (N, n), where
the starts are held.
"""


class Gradient(NamedTuple):
    """A cost, its slope along each of the variables that were asked for, and the sums of the run.

    The slope along P or R is symmetric, that of a change that is. `engine` says what took the run
    back, and a warning why it was not native code where that would have paid.
    """

    value: float
    slopes: Mapping[str, Array]
    sums: Sums
    engine: str = "jax"
    warnings: tuple[str, ...] = ()


def gradient(parts: Parts, settings: Settings, cost: Cost, wrt: Sequence[str]) -> Gradient:
    """Return a cost of a run and how it changes with some of what the run is made of.

    The steps are differentiated backwards, in float64, by native code where `settings.engine` has
    it so and else by JAX; both to rounding alike. Of every some of them the states are kept and the
    steps between computed again, so that memory grows with the root of their number.

    Args:
        parts: agents, graph, formation, laws, starts and world.
        settings: horizon, step and the like.
        cost: of the sums over the run's steps, such as `lambda sums: sums.errors[0].sum()`. As by
            `jax.jit` a function is traced once: what else it reads, of its closure or its module,
            stays as it was then, and another value wants another function.
        wrt: of `VARIABLES`.

    Raises:
        EchelonError: a part is malformed or does not fit the others; what drives the agents are no
            laws, or have no gain; a variable is unknown; `settings.engine` is `native`, and there
            is no such code.
    """
    with precision("float64"):
        ready = _taken(parts, settings, tuple(wrt))
        found = choose_engine(
            settings,
            len(ready.run.states),
            lambda: ready.natively(cost),
            lambda why: by_jax(ready.run, settings.steps, cost, why),
            _WORTH,
        )
    _give(ready)
    return found


class DifferentiableRun(NamedTuple):
    """A loop, what the cost is differentiated by, the starts (N, n), what the leaders follow."""

    loop: Loop
    values: dict[str, Array]
    states: Array
    reference: Array | None


# ---- what is ready to be run again ---------------------------------------------------------------


_READY, _ROOM = 4, 128 * 2**20
"""Runs that are kept for other calls, and the bytes of all of them together."""
_ready = BoundedCache["_Ready"](_READY, lambda ready: ready.size, _ROOM)


def _taken(parts: Parts, settings: Settings, wrt: tuple[str, ...]) -> "_Ready":
    """Return a run for a caller's own use, made ready unless it was before."""
    key = content_of(parts, settings, wrt)
    ready = _ready.pop(key)
    if ready is None or not ready.turn(parts):
        ready = _Ready(parts, settings, wrt, key)
    return ready


def _give(ready: "_Ready") -> None:
    """Keep a run for the next caller."""
    if ready.key is not None:
        _ready.put(ready.key, ready)


@final
class _Ready:
    """A run that is checked and made ready, and is differentiated one time after the other."""

    def __init__(
        self, parts: Parts, settings: Settings, wrt: tuple[str, ...], key: Hashable | None
    ) -> None:
        self.key, self.wrt, prepared = key, wrt, prepare(parts, settings)
        self.problem, self.drive = copied((prepared.problem, prepared.parts.drive))
        values = _values(self.problem, self.drive, wrt)
        loop = assemble(self.problem, self.drive.leader, self.drive.follower)
        reference = sample_reference(prepared, 0, settings.steps)
        self.run = DifferentiableRun(loop, values, self.problem.states, reference)
        self.gain, self._native = digest(parts.drive.gain), None

    def turn(self, parts: Parts) -> bool:
        """Take the same parts with another gain; tell whether that is all that changes.

        What a law of the same form does is as it was when that was checked.
        """
        gain = digest(parts.drive.gain)
        if gain is not None and gain == self.gain:
            return True
        problem, leader, given = self.problem, self.drive.leader, copied(parts.drive)
        follower = given.follower.prepared(problem.model, problem.graph)
        drive = Laws(leader, follower.following(leader, problem.model))
        loop = assemble(problem, drive.leader, drive.follower)
        if not alike(loop, self.run.loop):
            return False
        drive.accept(problem)
        values = _values(problem, drive, self.wrt)
        self.run, self.gain = self.run._replace(loop=loop, values=values), gain
        if self._native is not None and not self._native.turn(self.run):
            self._native = None
        return True

    def natively(self, cost: Cost) -> Gradient:
        """Return the gradient of a cost by native code."""
        if self._native is None:
            self._native = Native(self.run, self.problem.settings.steps)
        return self._native.gradient(cost)

    @property
    def size(self) -> int:
        """Bytes of what is held from one call to the next."""
        arrays = jax.tree.leaves((self.run, self.problem.graph.edges, self.problem.graph.weights))
        held = sum(np.asarray(array).nbytes for array in arrays)
        return held + (0 if self._native is None else self._native.size)


# ---- by native code ------------------------------------------------------------------------------


_PARTS = {"P": ("P",), "R": ("R", "R_inverse"), "coupling": ("coupling",)}
"""What of a gain changes with a variable."""


@final
class Native:
    """A run that native code takes back, for one cost after the other.

    Args:
        run: what is run.
        steps: how many.
    """

    def __init__(self, run: DifferentiableRun, steps: int) -> None:
        """Find the numbers of the gain along which there are slopes."""
        self.run, self.steps = run, steps
        names = [part for name in run.values for part in _PARTS.get(name, ())]
        self._own, self._order = _own(run.loop, names)
        self._sums = tuple(np.shape(part) for part in run.loop.meter.nothing())
        self._ways = dict[bool, Backward | Unsupported]()

    def turn(self, run: DifferentiableRun) -> bool:
        """Take another gain; tell whether its numbers alone are others."""
        if not self._own.covers(run.loop):
            return False
        self.run = run
        for way in self._ways.values():
            if isinstance(way, Backward):
                way.turn(run.loop)
        return True

    @property
    def size(self) -> int:
        """Bytes of what is held from one cost to the next."""
        return sum(way.size for way in self._ways.values() if isinstance(way, Backward))

    def gradient(self, cost: Cost) -> Gradient:
        """Return the gradient of a cost.

        Raises:
            Unsupported: there is no such code.
            MissingExtraError: llvmlite is not installed.
        """
        way = self._way(_is_spaced(cost, self._sums))
        sums = way.run()
        if sums is None:
            raise Unsupported("states beyond the range of its sines")
        value, along = _slopes_of(cost, sums)
        found = way.slopes(along)
        parts = dict(zip(self._order, found.leaves, strict=True))
        parts |= {"initial": found.states, "offsets": found.offsets}
        if "R" in parts:
            inverse = self.run.loop.follower.gain.R_inverse  # type: ignore[attr-defined]
            parts["R"] = parts["R"] - inverse.T @ parts["R_inverse"] @ inverse.T
        slopes = {name: _symmetric(name, parts[name]) for name in self.run.values}
        return Gradient(float(value), slopes, sums, "native")

    def _way(self, spaced: bool) -> Backward:
        """Return the way back of costs, whether they rest on distances or not."""
        if spaced not in self._ways:
            run, needs = self.run, SlopeNeeds(spaced, "offsets" in self.run.values)
            given = self._own, run.states, run.reference, self.steps, needs
            try:
                self._ways[spaced] = Backward(*given)
            except Unsupported as reason:
                self._ways[spaced] = reason
        way = self._ways[spaced]
        if isinstance(way, Unsupported):
            raise way
        return way


@memoize
def _is_spaced(cost: Cost, shapes: tuple[tuple[int, ...], ...]) -> bool:
    """Tell whether a cost rests on distances."""
    return Sums(*used_leaves(cost, Sums(*map(np.zeros, shapes)))).spacing


def _own(loop: Loop, names: Sequence[str]) -> tuple[VaryingNumbers, list[str]]:
    """Return the numbers of the followers' gain under some names, and those in their order."""

    def places(loop: Loop) -> list[Any]:
        law: Any = loop.follower
        return [getattr(law.gain, name) for name in names]

    if not names:
        return VaryingNumbers([loop]), []
    # Twice as much is another number wherever there is one; zeros stay, and fold.
    unlike = eqx.tree_at(places, loop, [2.0 * np.asarray(part) for part in places(loop)])
    marked = jax.tree.leaves(eqx.tree_at(places, bare(loop), list(names)))
    return VaryingNumbers([loop], unlike), [leaf for leaf in marked if isinstance(leaf, str)]


@cached_jit
def _slopes_of(cost: Cost, sums: Sums) -> tuple[jax.Array, Sums]:
    """Return a cost of sums, and its slopes along those that have some."""
    names = ("errors", "tracking", "outputs", "effort", "spacing")
    smooth = {name: getattr(sums, name) for name in names}
    value, slopes = jax.value_and_grad(lambda part: cost(sums._replace(**part)))(smooth)
    return value, sums._replace(**slopes)


# ---- by JAX --------------------------------------------------------------------------------------


def by_jax(run: DifferentiableRun, steps: int, cost: Cost, instead: str = "") -> Gradient:
    """Return the gradient by JAX's reverse mode over steps of JAX, `instead` of native code."""
    (value, sums), slopes = _differentiate(*run, steps, cost)
    found = {name: _symmetric(name, np.asarray(slope)) for name, slope in slopes.items()}
    told = (f"JAX takes the steps back, since {instead}.",) * bool(instead)
    return Gradient(float(value), found, jax.tree.map(np.asarray, sums), warnings=told)


def _values(problem: Problem, drive: Drive, wrt: Sequence[str]) -> dict[str, Array]:
    """Return what a cost is differentiated by, by name."""
    gain = drive.gain
    if not isinstance(drive, Laws):
        raise SimulationError(
            f"a run driven by `{type(drive).__name__}` cannot be differentiated, one by `Laws` can."
        )
    known = {"initial": np.asarray(problem.states), "offsets": problem.formation.offsets}
    if gain is not None:
        known |= {"P": gain.P, "R": gain.R, "coupling": np.asarray(gain.coupling)}
    for name in wrt:
        if name in VARIABLES and name not in known:
            law = type(drive.follower).__name__
            raise SimulationError(f"the followers' law `{law}` has no gain, and so no `{name}`.")
        if name not in known:
            raise SimulationError(
                f"`wrt` names `{name}`, allowed are {listing(VARIABLES)}"
                f"{did_you_mean(name, VARIABLES)}."
            )
    return {name: known[name] for name in wrt}


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
) -> Any:
    """Return the cost, the sums of the run, and the slopes."""

    def whole(values: dict[str, Any]) -> tuple[jax.Array, Sums]:
        start = jnp.asarray(values.get("initial", states))
        changed = _with_offsets(_with_gain(loop, values), values)
        sums = _sums(changed, start, reference, steps)
        return cost(sums), sums

    return jax.value_and_grad(whole, has_aux=True)(jax.tree.map(jnp.asarray, values))


def _with_gain(loop: Loop, values: Mapping[str, Any]) -> Loop:
    """Return the loop with other numbers in the followers' gain."""
    given = {name: values[name] for name in ("P", "R", "coupling") if name in values}
    if "R" in given:
        given["R_inverse"] = jnp.linalg.inv(given["R"])

    def places(loop: Loop) -> list[Any]:
        gain: Any = loop.follower
        return [getattr(gain.gain, name) for name in given]

    return eqx.tree_at(places, loop, [*given.values()]) if given else loop


def _with_offsets(loop: Loop, values: Mapping[str, Any]) -> Loop:
    """Return the loop with other offsets of the goals."""
    if "offsets" not in values:
        return loop
    offsets, meter = values["offsets"], loop.meter
    i, j = (offsets[ends][:, np.array(meter.measured)] for ends in meter.edges.T)
    wanted = distance_of(((i - j) ** 2).sum(axis=1))

    def places(loop: Loop) -> list[Any]:
        return [loop.offsets, loop.meter.offsets, loop.meter.spacings]

    return eqx.tree_at(places, loop, [offsets, offsets, wanted])


def _sums(loop: Loop, states: jax.Array, reference: Array | None, steps: int) -> Sums:
    """Return the sums over the steps of a run."""

    def one(done: tuple[Moment, Sums], _: None) -> tuple[tuple[Moment, Sums], None]:
        now, sums = measured_step(loop, done[0], reference, 0)
        return (now, done[1].plus(sums)), None

    @jax.checkpoint
    def several(done: tuple[Moment, Sums], _: None) -> tuple[tuple[Moment, Sums], None]:
        return jax.lax.scan(one, done, None, length=few)

    few = max(1, math.isqrt(steps))
    done = begin(loop, states), loop.meter.nothing()
    done, _ = jax.lax.scan(several, done, None, length=steps // few)
    return jax.lax.scan(one, done, None, length=steps % few)[0][1]
