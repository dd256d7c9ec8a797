"""Stopping-point consensus: agents tell each other where they would come to rest (T5).

Each output of each agent is then one integrator, whatever the agent, so that the formation converges
from anywhere, over any graph in which the leader reaches everybody, and what an agent goes through
depends on its own start and on a speed alone.
"""

import math
from collections.abc import Sequence
from typing import final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from echelon.core.errors import LawError, ModelError, listing
from echelon.core.types import Array, Input, Scalar, State
from echelon.core.words import Feedforward, Hears
from echelon.laws.flat_loop import FlatLoop, Held
from echelon.laws.law import Law, LocalView
from echelon.models.chains import chains_of, switch_on
from echelon.models.model import ControlAffine
from echelon.network.graph import Graph
from echelon.references.flatness import follow_at
from echelon.references.guide import Guide
from echelon.references.reference import Reference, check_reference

RATE = 4.0
"""Of the slowest root, 1/s, unless it is given."""
SPEED = 2.5
"""m/s and rad/s, unless it is given."""
_SPREAD = 0.125
"""Roots of a rate r are r, 1.125 r, 1.25 r, ..: apart, as the certificate wants them."""


def _speeds(given: float | Sequence[float]) -> float | tuple[float, ...]:
    """Return speeds as plain numbers, which a compiled step takes for constants."""
    return tuple(map(float, given)) if isinstance(given, Sequence | np.ndarray) else given


@final
class StoppingPoint(Law):
    """zeta_i' = zeta_0' - sigma(c z_i), z_i = sum_j A_ij ((zeta_i - xi_i) - (zeta_j - xi_j)).

    zeta = q(D) y / q(0) is where an agent's flat outputs y would come to rest if nobody spoke, and
    sigma(x) = x / sqrt(1 + (x/s)^2) bounds the speed that agreement asks for.

    Args:
        roots: of q, 1/s, distinct and positive; one fewer than the longest chain of the model.
        rate: the slowest root, from which the others are made, in place of `roots`.
        coupling: c > 0; when left out twice the slowest root over lambda_min, or what the step
            holds, 1 / (d_max dt), where that is less.
        speed: s, of all outputs or one each, in their units per second; infinite is linear.
        observer: whether what the model lacks is estimated and opposed.
        feedforward: `relay`, the leader's zeta' forwarded to all; `parent`, that of the one agent
            that each hears.
        hears: `all` neighbours, or `leaderward` those alone that are nearer to the leader; with
            `parent` it is that one.
    """

    roots: tuple[float, ...] | None = eqx.field(default=None, static=True)
    rate: float | None = eqx.field(default=None, static=True)
    coupling: float | None = None
    speed: float | tuple[float, ...] = eqx.field(default=SPEED, converter=_speeds)
    observer: bool = eqx.field(default=True, static=True)
    feedforward: Feedforward = eqx.field(
        default=Feedforward.RELAY, static=True, converter=Feedforward.named
    )
    hears: Hears = eqx.field(default=Hears.ALL, static=True, converter=Hears.named)
    loop: FlatLoop | None = None
    reach: "Reach | None" = None
    ahead: Array | None = None

    def __check_init__(self) -> None:
        """Refuse what makes no loop."""
        check_loop(self)
        allowed = (Feedforward.RELAY, Feedforward.PARENT)
        if self.feedforward not in allowed:
            raise LawError(
                f"`feedforward` is `{self.feedforward}`, and the law `stopping-point` is sent "
                f"zeta' by {listing(map(str, allowed))}: without it a leader that moves is lost."
            )

    @property
    def leaderward(self) -> bool:
        """Whether only neighbours nearer to the leader are heard."""
        return self.hears is Hears.LEADERWARD or self.feedforward is Feedforward.PARENT

    @property
    def information(self) -> tuple[str, ...]:
        """Neighbours' stopping points, and whose rate is told."""
        parent = self.feedforward is Feedforward.PARENT
        whose = "its parent's" if parent else "the leader's, forwarded to everybody"
        return ("neighbours' stopping points zeta", f"zeta' of the same step, {whose}")

    def prepared(self, model: ControlAffine, graph: Graph) -> "StoppingPoint":
        """Find the model's chains, and what the graph asks of the coupling."""
        if self.loop is not None:
            return self
        if self.feedforward is Feedforward.PARENT:
            graph.parents()
        loop, reach = loop_for(self, model), Reach.of(graph, self.leaderward)
        parts = (self.roots, self.rate, self.coupling, self.speed, self.observer)
        told = (self.feedforward, self.hears)
        return StoppingPoint(*parts, *told, loop, reach, np.zeros_like(loop.weights))

    def following(self, leader: Law, model: ControlAffine) -> "StoppingPoint":
        """Take over how the leader begins, which tells how high a thrust is level."""
        if not isinstance(leader, StoppingLeader) or leader.loop is None or self.loop is None:
            raise LawError(
                "followers under `stopping-point` are sent the leader's zeta', which the law "
                f"`{type(leader).__name__}` does not have; give the leader the law "
                "`stopping-point` too."
            )
        if not np.array_equal(leader.loop.weights, self.loop.weights):
            raise LawError(
                "the leader and the followers have different `roots`, and would come to rest "
                "differently; give both the same."
            )
        ahead = np.asarray(leader.begins(model))
        same = self.ahead is not None and np.array_equal(self.ahead, ahead)
        return self if same else eqx.tree_at(lambda law: law.ahead, self, ahead)

    def init(self) -> Held:
        """Return a memory in its form."""
        return the_loop(self).nothing()

    def begin(self, model: ControlAffine, x: State) -> Held:
        """Return the memory of an agent that begins at x, with its integrators level."""
        return begun(self, model, x, jnp.asarray(self.ahead, x.dtype))

    def signal(self, model: ControlAffine, x: State, offset: State, memory: Held) -> jax.Array:
        """Return zeta less the offset, (m,)."""
        return the_loop(self).place(model, x, offset, memory)

    def message(self, model: ControlAffine, x: State, v: Input, memory: Held) -> jax.Array:
        """Return zeta', (m,)."""
        return memory.rate

    def update(self, model: ControlAffine, view: LocalView, memory: Held) -> tuple[Input, Held]:
        """Return the input of one agent."""
        assert self.reach is not None
        c = self.reach.coupling(self, view.period)
        rate = view.feedforward - bounded(c * view.disagreement, self.speed)
        return the_loop(self).obey(model, view.x, rate, memory, view.period)

    def settle(
        self, model: ControlAffine, view: LocalView, wanted: Input, got: Input, memory: Held
    ) -> Held:
        """Return the memory with what the actuators made of the input."""
        return the_loop(self).settle(model, view.x, wanted, got, memory, view.period)


@final
class StoppingLeader(Law):
    """The same law with the reference as its leader: zeta_0' = zeta_r' - sigma(c (zeta_0 - zeta_r)).

    Args:
        reference: the path to follow; without one the trim's flat outputs are held.
        roots: as the followers'.
        rate: as the followers'.
        coupling: c > 0, 1/s; the slowest root doubled when left out, or what the step holds.
        speed: s_0, of all outputs or one each.
        observer: whether what the model lacks is estimated and opposed.
    """

    reference: Guide | None = None
    roots: tuple[float, ...] | None = eqx.field(default=None, static=True)
    rate: float | None = eqx.field(default=None, static=True)
    coupling: float | None = None
    speed: float | tuple[float, ...] = eqx.field(default=SPEED, converter=_speeds)
    observer: bool = eqx.field(default=True, static=True)
    loop: FlatLoop | None = None

    def __check_init__(self) -> None:
        """Refuse what makes no loop."""
        check_loop(self)

    @property
    def information(self) -> tuple[str, ...]:
        """The reference."""
        return ("the reference and its derivatives",)

    def prepared(self, model: ControlAffine, graph: Graph) -> "StoppingLeader":
        """Find the model's chains, and check that the reference can be led along."""
        if self.loop is not None:
            return self
        loop = loop_for(self, model)
        if self.reference is not None:
            check_reference(self.reference)
            if not isinstance(self.reference, Reference):
                raise LawError(
                    "the law `stopping-point` follows a path in space, of which it needs "
                    "derivatives, and the reference `states` gives states; use `lqr` for the "
                    "leader and `consensus` for the followers."
                )
            self.reference.fit(model)
        parts = (self.reference, self.roots, self.rate, self.coupling, self.speed, self.observer)
        return StoppingLeader(*parts, loop)

    def path(self, model: ControlAffine, t: Scalar) -> jax.Array:
        """Return the flat outputs to follow with their derivatives, (r + 1, m)."""
        loop = the_loop(self)
        if isinstance(self.reference, Reference):
            return self.reference.derivatives(t, len(loop.weights), loop.chains.outputs)
        trim = jnp.asarray(np.asarray(model.trim[0], float), t.dtype)
        there = model.output(trim)
        place = jnp.stack([there[model.output_names.index(name)] for name in loop.chains.outputs])
        return jnp.pad(place[None], ((0, len(loop.weights)), (0, 0)))

    def begins(self, model: ControlAffine) -> jax.Array:
        """Return the flat outputs at t = 0 with their derivatives, (r, m)."""
        return self.path(model, jnp.zeros(()))[:-1]

    def start(self, model: ControlAffine) -> State:
        """Return the reference's state at time zero, or the trim."""
        if self.reference is None:
            return jnp.asarray(np.asarray(model.trim[0], float))
        return follow_at(model, self.reference, jnp.zeros(1))[0][0]

    def reference_states(self, model: ControlAffine, times: jax.Array) -> jax.Array | None:
        """Return x_r at each of `times`, (T, n)."""
        if self.reference is None:
            return None
        return follow_at(model, self.reference, times)[0]

    def own_mode(self, model: ControlAffine) -> float:
        """Return the slowest mode of the leader about its reference, 1/s."""
        slow = slowest_root(self)
        return -min(slow, self.coupling or 2.0 * slow)

    def init(self) -> Held:
        """Return a memory in its form."""
        return the_loop(self).nothing()

    def begin(self, model: ControlAffine, x: State) -> Held:
        """Return the memory of a leader that begins at x, as level as the reference."""
        return begun(self, model, x, self.begins(model).astype(x.dtype))

    def signal(self, model: ControlAffine, x: State, offset: State, memory: Held) -> jax.Array:
        """Return zeta less the offset, (m,)."""
        return the_loop(self).place(model, x, offset, memory)

    def message(self, model: ControlAffine, x: State, v: Input, memory: Held) -> jax.Array:
        """Return zeta', (m,)."""
        return memory.rate

    def update(self, model: ControlAffine, view: LocalView, memory: Held) -> tuple[Input, Held]:
        """Return the leader's input."""
        loop, path = the_loop(self), self.path(model, view.t)
        away = loop.place(model, view.x, view.offset, memory) - loop.stop(path[:-1])
        c = 2.0 * slowest_root(self) if self.coupling is None else self.coupling
        c = jnp.minimum(c, 1.0 / jnp.maximum(view.period, 1e-9))
        rate = loop.stop(path[1:]) - bounded(c * away, self.speed)
        return loop.obey(model, view.x, rate, memory, view.period)

    def settle(
        self, model: ControlAffine, view: LocalView, wanted: Input, got: Input, memory: Held
    ) -> Held:
        """Return the memory with what the actuators made of the input."""
        return the_loop(self).settle(model, view.x, wanted, got, memory, view.period)


@final
class Reach(eqx.Module):
    """What the graph asks of the coupling.

    Attributes:
        slowest: the smallest eigenvalue of the followers' Laplacian.
        heaviest: d_max, the largest sum of weights that one follower hears.
    """

    slowest: float
    heaviest: float

    @classmethod
    def of(cls, graph: Graph, leaderward: bool) -> "Reach":
        """Return it of a graph."""
        heard = graph.exchange(leaderward)
        sums = np.zeros(graph.agents)
        np.add.at(sums, heard.receivers, heard.weights)
        own = sums[list(graph.followers)]
        # Heard one way the Laplacian is triangular, and its eigenvalues are on its diagonal.
        slowest = float(own.min()) if leaderward else graph.spectrum().low
        return cls(slowest, float(own.max()))

    def coupling(self, law: StoppingPoint, period: Scalar | float) -> Scalar | float:
        """Return c of a law whose inputs are held for a period (s)."""
        if law.coupling is not None:
            return law.coupling
        return jnp.minimum(
            2.0 * slowest_root(law) / self.slowest,
            1.0 / (self.heaviest * jnp.maximum(period, 1e-9)),
        )


# ---- shared by both ------------------------------------------------------------------------------


def check_loop(law: StoppingPoint | StoppingLeader) -> None:
    """Check what both laws are made with.

    Raises:
        LawError: roots are not distinct and positive, or another number is not positive.
    """
    if law.roots is not None and law.rate is not None:
        raise LawError("got `roots` and `rate`, allowed is one of them.")
    for name in ("rate", "coupling"):
        value = getattr(law, name)
        if isinstance(value, int | float) and not 0.0 < value < math.inf:
            raise LawError(f"`{name}` is {value}, and must be a positive finite number.")
    roots = (1.0,) if law.roots is None else law.roots
    if not isinstance(roots, Sequence) or not all(_positive(root) for root in roots):
        raise LawError(f"`roots` are {law.roots}, and must be a list of positive numbers, 1/s.")
    if len(set(roots)) < len(roots):
        raise LawError(f"`roots` are {list(roots)}, and must be different from each other.")
    speeds = law.speed if isinstance(law.speed, Sequence) else (law.speed,)
    if not all(isinstance(s, int | float) and s > 0.0 for s in speeds):
        raise LawError(f"`speed` is {law.speed}, and must be positive, or a list of such numbers.")


def _positive(root: object) -> bool:
    return isinstance(root, int | float) and 0.0 < root < math.inf


def loop_for(law: StoppingPoint | StoppingLeader, model: ControlAffine) -> FlatLoop:
    """Return the inner loop of a law for a model.

    Raises:
        LawError: the model has no flat coordinates, or roots or speeds are not as many as it needs.
    """
    try:
        chains = chains_of(model)
    except ModelError as error:
        raise LawError(str(error)) from None
    needed, m = max(chains.degrees) - 1, len(chains.outputs)
    if law.roots is not None and len(law.roots) != needed:
        raise LawError(
            f"`roots` are {list(law.roots)}, and `{type(model).__name__}` needs {needed}: its "
            f"longest chain is of {needed + 1} integrators."
        )
    if isinstance(law.speed, Sequence) and len(law.speed) != m:
        raise LawError(
            f"`speed` has {len(law.speed)} numbers, and must be one, or one for each of "
            f"{listing(chains.outputs)}."
        )
    return FlatLoop.of(chains, roots_of(law, needed), law.observer)


def roots_of(law: StoppingPoint | StoppingLeader, count: int) -> tuple[float, ...]:
    """Return the roots of q, the slowest first."""
    if law.roots is not None:
        return tuple(sorted(law.roots))
    rate = RATE if law.rate is None else law.rate
    return tuple(rate * (1.0 + _SPREAD * k) for k in range(count))


def slowest_root(law: StoppingPoint | StoppingLeader) -> float:
    """Return the slowest root, 1/s; the rate where an agent has none."""
    return (*roots_of(law, 1), RATE)[0]


def the_loop(law: StoppingPoint | StoppingLeader) -> FlatLoop:
    """Return the loop of a prepared law.

    Raises:
        LawError: it is not prepared.
    """
    if law.loop is None:
        raise LawError(
            f"`{type(law).__name__}` has no loop yet; call `prepared(model, graph)` first."
        )
    return law.loop


def begun(
    law: StoppingPoint | StoppingLeader, model: ControlAffine, x: State, ahead: jax.Array
) -> Held:
    """Return the memory of an agent that begins at x and follows what has these derivatives."""
    loop = the_loop(law)
    return loop.begun(model, x, switch_on(model, loop.chains, x, ahead))


def bounded(x: jax.Array, speed: float | tuple[float, ...]) -> jax.Array:
    """Return sigma(x) = x / sqrt(1 + (x/s)^2): odd, increasing, of slope 1 at 0, below s."""
    # By the inverse, which is 0 where s is infinite and sigma is linear.
    inverse = 1.0 / jnp.asarray(speed, x.dtype)
    return x / jnp.sqrt(1.0 + (x * inverse) ** 2)
