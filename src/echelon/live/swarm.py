"""The closed loop as it runs live: one compiled call a picture, and knobs that compile nothing."""

from typing import Any, NamedTuple, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from echelon.core.errors import SimulationError
from echelon.core.numerics import precision
from echelon.core.types import Array, Input, Scalar, State
from echelon.core.words import Feedforward
from echelon.engine.laws import Laws
from echelon.engine.loop import Loop, Moment, assemble, begin, control, step
from echelon.engine.parts import Parts
from echelon.engine.prepare import prepare
from echelon.engine.settings import Settings
from echelon.gains.gain import Gain
from echelon.laws.law import Law, LocalView, Memory
from echelon.live.knobs import Knobs, Panel
from echelon.models.model import ControlAffine
from echelon.network.exchange import Exchange
from echelon.network.graph import Graph
from echelon.world.disturbance import Disturbance
from echelon.world.world import World

PICTURE = 0.04
"""Seconds of a picture."""
_MANY = 200
"""With more agents than this the loop is stepped in float32, which takes half the time."""


@final
class Dimmed(Law):
    """A follower's law that is sent a share of the feed-forward: all at 1, nothing at 0."""

    law: Law
    share: Any
    feedforward: Feedforward = eqx.field(static=True)
    turning: bool = eqx.field(static=True)

    def facing(self, heading: Scalar) -> Law:
        """Return the law in the axes of a heading."""
        return eqx.tree_at(lambda each: each.law, self, self.law.facing(heading))

    def init(self) -> Memory:
        """Return what the law begins with."""
        return self.law.init()

    def update(self, model: ControlAffine, view: LocalView, memory: Memory) -> tuple[Input, Memory]:
        """Return the input of one agent."""
        dimmed = eqx.tree_at(
            lambda v: v.feedforward,
            view,
            jnp.asarray(self.share, view.x.dtype) * view.feedforward,
        )
        return self.law.update(model, dimmed, memory)

    def begin(self, model: ControlAffine, x: State) -> Memory:
        """Return what the law begins with at x."""
        return self.law.begin(model, x)

    def signal(self, model: ControlAffine, x: State, offset: State, memory: Memory) -> Any:
        """Return what neighbours hear."""
        return self.law.signal(model, x, offset, memory)

    def settle(
        self, model: ControlAffine, view: LocalView, wanted: Input, got: Input, memory: Memory
    ) -> Memory:
        """Return the memory once the actuators have acted."""
        return self.law.settle(model, view, wanted, got, memory)

    def message(self, model: ControlAffine, x: State, v: Input, memory: Memory) -> Any:
        """Return what the law sends."""
        return self.law.message(model, x, v, memory)


class Picture(NamedTuple):
    """What is seen at a time (s): states (N, n), inputs (N, m), errors (N,), offsets (N, n)."""

    time: float
    states: Array
    inputs: Array
    errors: Array
    offsets: Array

    @property
    def finite(self) -> bool:
        """Whether all numbers are."""
        return bool(np.isfinite(self.states).all() and np.isfinite(self.inputs).all())


@final
class Swarm:
    """Agents under laws that go on for as long as someone watches.

    Args:
        parts: of a scenario.
        settings: of it.
        panel: of its knobs.

    Raises:
        EchelonError: a part is malformed or does not fit the others.
    """

    def __init__(self, parts: Parts, settings: Settings, panel: Panel) -> None:
        """Prepare what the steps need.

        Raises:
            SimulationError: the graph switches at times of its own.
        """
        if parts.graph.schedule is not None:
            raise SimulationError(
                "the graph has a `schedule`, and a live run has links cut by hand; use `echelon "
                "run`, or leave the schedule out."
            )
        world = World(parts.world.plant, parts.world.disturbance or Disturbance())
        self.many = parts.graph.agents > _MANY
        self.kind: Any = "float32" if self.many else settings.precision
        prepared = prepare(parts.replace(world=world), settings)
        problem, drive = prepared.problem, prepared.parts.drive
        assert isinstance(drive, Laws)
        loop = assemble(problem, drive.leader, drive.follower)
        law = loop.follower
        if panel.start.coupling is not None:
            law = eqx.tree_at(_inner, law, self._inner(panel.gain(panel.start)), is_leaf=_is_none)
        dimmed = Dimmed(law, np.asarray(1.0), law.feedforward, law.turning)
        self.loop: Loop = eqx.tree_at(lambda each: each.follower, loop, dimmed)
        self.panel, self.settings, self.parts = panel, settings, prepared.parts
        self.states, self.measured = problem.states, list(problem.meter.measured)
        self.nearest = np.array(parts.graph.nearest_leader())
        self.weights = np.asarray(loop.exchange.weights, np.float64)
        self.edge = _edges_of(loop.exchange, parts.graph)
        self.count = max(1, round(PICTURE / settings.dt))
        self.offsets = panel.offsets(panel.start)
        self.restart()

    @property
    def span(self) -> float:
        """Seconds from a picture to the next."""
        return self.count * self.settings.dt

    def restart(self) -> None:
        """Begin again, the knobs as they are."""
        with precision(self.kind):
            self.now: Moment = begin(self.loop, jnp.asarray(self.states))

    @property
    def steps(self) -> int:
        """How many steps were taken."""
        return int(self.now.step)

    def turn(self, knobs: Knobs) -> None:
        """Let the loop run with the knobs so."""
        self.offsets = self.panel.offsets(knobs)
        weights = self.weights.copy()
        weights[..., np.isin(self.edge, list(knobs.cut))] = 0.0
        loop = eqx.tree_at(
            lambda each: (each.offsets, each.exchange.weights, each.follower.share),
            self.loop,
            (self.offsets, weights, np.asarray(float(knobs.feedforward))),
        )
        wind = self.panel.wind(knobs)
        loop = eqx.tree_at(lambda each: each.motion.wind.constant, loop, wind)
        if knobs.coupling is not None:
            loop = self._with_gain(loop, knobs)
        self.loop = loop

    def _with_gain(self, loop: Loop, knobs: Knobs) -> Loop:
        """Return the loop with the gain of the knobs."""
        gain = self.panel.gain(knobs)
        assert gain is not None

        def places(each: Any) -> tuple[Any, ...]:
            own = each.follower.law.gain
            return own.P, own.R, own.R_inverse, own.inner, own.coupling

        numbers = (gain.P, gain.R, gain.R_inverse, self._inner(gain), np.asarray(knobs.coupling))
        return eqx.tree_at(places, loop, numbers)

    @staticmethod
    def _inner(gain: Gain | None) -> Array:
        """Return the inner loop of a gain, zero without one, so that either compiles to one."""
        assert gain is not None
        if gain.inner is not None:
            return gain.inner
        return np.zeros((len(gain.R), len(gain.P)))

    def kick(self, agent: int, by: Array) -> None:
        """Change the state of an agent by (n,), all at once."""
        with precision(self.kind):
            moved = self.now.states.at[agent].add(jnp.asarray(by, self.now.states.dtype))
            self.now = self.now._replace(states=moved)

    def advance(self, still: bool = False) -> Picture:
        """Go on to the next picture, or look at the present one, and return it."""
        count = np.asarray(0 if still else self.count, np.int32)
        with precision(self.kind):
            self.now, inputs = _advance(self.loop, self.now, count)
            states = np.asarray(self.now.states, np.float64)
        y = states - self.offsets
        with np.errstate(over="ignore", invalid="ignore"):
            away = (y - y[self.nearest])[:, self.measured]
            errors = np.linalg.norm(away, axis=1)
        time = self.steps * self.settings.dt
        return Picture(time, states, np.asarray(inputs, np.float64), errors, self.offsets)


def _edges_of(heard: Exchange, graph: Graph) -> Array:
    """Return which edge each of the ways goes along on which agents hear each other."""
    places = {tuple(pair): k for k, pair in enumerate(graph.edges.tolist())}
    # A directed edge (i, j) is heard by j, and an undirected one stands once.
    pairs = zip(np.asarray(heard.senders).tolist(), np.asarray(heard.receivers).tolist())
    return np.array([places[p] if p in places else places[p[::-1]] for p in pairs])


def _inner(law: Any) -> Any:
    return law.gain.inner


def _is_none(node: object) -> bool:
    return node is None


@eqx.filter_jit
def _advance(loop: Loop, now: Moment, count: Array) -> tuple[Moment, jax.Array]:
    """Take steps, and return the moment with the inputs (N, m) there."""

    def one(_: jax.Array, now: Moment) -> Moment:
        return step(loop, now, control(loop, now))

    now = jax.lax.fori_loop(0, count, one, now)
    return now, control(loop, now).inputs
