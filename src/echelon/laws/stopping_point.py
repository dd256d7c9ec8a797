"""Stopping-point consensus: agents send each other where they would come to rest (T5)."""

import dataclasses
import functools
import math
from typing import final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from echelon.agents.models.model import ControlAffine, FlatBound, wrap_angles
from echelon.agents.network.exchange import Near
from echelon.agents.network.graph import Graph
from echelon.agents.references.flatness import first_state, followed_states
from echelon.agents.references.reference import LeaderPath, Reference, check_reference
from echelon.core.cache import memoize
from echelon.core.errors import LawError, check_kind, listing
from echelon.core.numerics import greater, lesser, precision
from echelon.core.types import Array, Input, Scalar, State
from echelon.core.words import Feedforward, NeighbourChoice
from echelon.laws.flat_law import CHAIN_SHARE, LEAD_SHARE, LEAD_SPEED, SHARE, SPEED, FlatLaw
from echelon.laws.flat_loop import FlatMemory
from echelon.laws.law import Expected, Law, LocalView, Proves, Travels
from echelon.laws.safety import Safety
from echelon.laws.unlike_loop import UnlikeLoop

# ---- the decay of a stopping point whose speed is bounded ----------------------------------------

_LINEAR = 1e-8
"""Of c |x| / s; below it sigma is linear to rounding."""
_NEARLY_ONE = -0.3
"""Of coth a - a; below it coth a is between 1 and 1.2, and a guess of a may take it for 1.09."""


def saturated_decay(
    start: jax.Array, coupling: Scalar | float, inverse: jax.Array, age: Scalar
) -> jax.Array:
    """Return x after a time (s) of x' = -sigma(c x), sigma(x) = x / sqrt(1 + (x/s)^2), entrywise.

    With sinh a = s / (c |x|) the function coth a - a falls by c per second.

    `inverse` is 1/s of each entry, 0 where sigma is linear; `age` is in s.
    """
    v = coupling * jnp.abs(start) * inverse
    linear = v < _LINEAR
    v = jnp.where(linear, 1.0, v)
    coth, per_v = jnp.sqrt(1.0 + v * v), 1.0 / v
    target = coth - jnp.log((1.0 + coth) * per_v) - coupling * age
    # coth a is 1/a + a/3 or so, and 1.09 of a large a: within a tenth. Halley's method makes of
    # that 2e-5, then 4e-16. Divisions take longest: with coth a = p / b there is one a round.
    near = 2.0 / (target + jnp.sqrt(target * target + 8.0 / 3.0))
    a = jnp.where(target > _NEARLY_ONE, near, 1.09 - target)
    for _ in range(2):
        b = -jnp.expm1(-2.0 * a)
        p = 2.0 - b
        off = p - b * (a + target)
        a = a + off * p * b / (p**3 - off * (p * p - b * b))
    # Nothing is left of a start long before e^a is infinite, and slopes are no numbers.
    grown = jnp.expm1(jnp.minimum(a, math.log(float(jnp.finfo(start.dtype).max)) - 1.0))
    left = per_v * (1.0 / grown + 1.0 / (2.0 + grown))
    return start * jnp.where(linear, jnp.exp(-coupling * age), left)


# ---- the law -------------------------------------------------------------------------------------
# Each output of each agent is then one integrator, whatever the agent. So the formation converges
# from anywhere, over any graph in which the leader reaches everybody, and an agent's motion depends
# on its own start and on a speed alone.

_INSTANT = 1e-9
"""s; a shorter period is none."""
_SEEN = 60.0
"""s of the leader's path, for default speeds; guarantees use the whole run."""


def _share(links: int) -> float:
    """Return what part of what leads to a border followers may have, of all links together."""
    return SHARE if links == 1 else CHAIN_SHARE


@final
class GraphDemand(eqx.Module):
    """The properties of the graph that determine the coupling.

    Attributes:
        slowest: the smallest eigenvalue of the followers' Laplacian; of a graph that switches, of
            the mean over a period, or of the last one.
        heaviest: d_max, the largest sum of a follower's weights.
        links: how many speeds add up on the path from a leader.
    """

    slowest: float
    heaviest: float
    links: int = 1

    @classmethod
    def of(cls, graph: Graph, leaderward: bool, links: int) -> "GraphDemand":
        """Return it of a graph.

        Raises:
            LawError: with leaderward messages, the leader does not reach somebody after the last
                switch.
        """
        whole, schedule = graph.stretches(leaderward), graph.schedule
        own = np.stack([L.diagonal() for L in whole])
        if schedule is None:
            # With one-way edges the Laplacian is triangular: its eigenvalues are its diagonal.
            slowest = float(own.min()) if leaderward else graph.spectrum().low
            return cls(slowest, float(own.max()), links)
        share = np.eye(len(own))[-1]
        if schedule.period is not None:
            share = np.diff(schedule.starts, append=schedule.period) / schedule.period
        mean = sum(part * L.toarray() for part, L in zip(share, whole, strict=True))
        slowest = float(np.linalg.eigvals(np.asarray(mean)).real.min())
        if not slowest > 0.0:
            raise LawError(
                f"the leader does not reach everybody from {schedule.starts[-1]:g} s on where "
                "neighbours nearer to it alone are heard; set `hears: all`, or add edges there."
            )
        return cls(slowest, float(own.max()), links)


@final
class StoppingPoint(FlatLaw, Proves):
    """zeta_i' = zeta_0' - sigma(c z_i), z_i = sum_j A_ij ((zeta_i - xi_i) - (zeta_j - xi_j)).

    zeta = q(D) y / q(0) is where an agent's flat outputs y would come to rest without messages, and
    sigma(x) = x / sqrt(1 + (x/s)^2) bounds the speed that agreement asks for. Where `coupling` is
    left out, c is twice the slowest root over lambda_min, or what the step holds, a little below
    1 / (d_max dt), where that is less.

    Args:
        feedforward: `relay`, the leader's zeta' forwarded to all; `parent`, that of the one agent
            that each hears.
        hears: `all` neighbours, or `leaderward` those alone that are nearer to the leader; with
            `parent` it is that one.
        safety: keeps away from all others, whatever the graph; None for not.
        reach: of the graph; computed by `prepared`.
        ahead: (r, m) the beginning of the leader's path; set by `following`.
    """

    feedforward: Feedforward = eqx.field(
        default=Feedforward.RELAY, static=True, converter=Feedforward.named
    )
    hears: NeighbourChoice = eqx.field(
        default=NeighbourChoice.ALL, static=True, converter=NeighbourChoice.named
    )
    safety: Safety | None = eqx.field(default=None, static=True)
    reach: GraphDemand | None = None
    ahead: Array | None = None

    def __check_init__(self) -> None:
        allowed = (Feedforward.RELAY, Feedforward.PARENT)
        if self.feedforward not in allowed:
            raise LawError(
                f"`feedforward` is `{self.feedforward}`, and the law `stopping-point` is sent "
                f"zeta' by {listing(map(str, allowed))}: without it a leader that moves is lost."
            )
        if self.safety is not None:
            check_kind("safety", self.safety, Safety, LawError)
            if self.feedforward is Feedforward.PARENT:
                raise LawError("`safety` needs `feedforward: relay`, one zeta' for all agents.")

    @property
    def prover(self) -> str:  # pyright: ignore
        """The theorem of this law; of unlike agents, what the running step shows."""
        if isinstance(self.loop, UnlikeLoop):
            return Law.prover
        return "echelon.guarantees.stopping.stopping_promise:StoppingPromise"

    @property
    def leaderward(self) -> bool:
        """Whether followers use messages of neighbours nearer to the leader alone."""
        return self.hears is NeighbourChoice.LEADERWARD or self.feedforward is Feedforward.PARENT

    @property
    def information(self) -> tuple[str, ...]:
        """Neighbours' stopping points, and the rate of the leader or the parent."""
        parent = self.feedforward is Feedforward.PARENT
        whose = "its parent's" if parent else "the leader's, forwarded to everybody"
        words = "neighbours' stopping points zeta", f"zeta' of the same step, {whose}"
        near = "positions and their derivatives of all within reach"
        return words if self.safety is None else (*words, near)

    def prepared(self, model: ControlAffine, graph: Graph) -> "StoppingPoint":
        """Find the model's chains, and the graph's properties for the coupling."""
        links = 1
        if self.feedforward is Feedforward.PARENT:
            # Raises where the graph is no tree.
            graph.parents()
            links = int(graph.depths().max())
        # A leader that hands over follows like all others.
        loop = self.build_loop(model, range(graph.agents) if graph.backups else graph.followers)
        reach = GraphDemand.of(graph, self.leaderward, links)
        speeds = self.speeds_within(model, loop, SPEED, _share(links), links)
        # All of it anew, since a law may come from a run of another model or graph.
        law = eqx.tree_at(
            lambda law: (law.loop, law.reach, law.ahead, law.speeds),
            self,
            (loop, reach, np.zeros_like(loop.weights), speeds),
            is_leaf=lambda part: part is None,
        )
        if self.safety is None:
            return law
        law = dataclasses.replace(law, safety=self.safety.prepared(model))
        law.places(model)
        return law

    def following(self, leader: Law, model: ControlAffine) -> "StoppingPoint":
        """Take over the beginning of the leader's path, which sets the level thrust."""
        if not isinstance(leader, StoppingLeader) or self.loop is None:
            raise LawError(
                "followers under `stopping-point` are sent the leader's zeta', which the law "
                f"`{type(leader).__name__}` does not have; give the leader the law "
                "`stopping-point` too."
            )
        if not np.array_equal(leader.ready.weights, self.loop.weights):
            raise LawError(
                "the leader and the followers have different `roots`, and would come to rest "
                "differently; give both the same."
            )
        ahead = beginning_of(leader, model)
        assert self.reach is not None
        links, slowest = self.reach.links, functools.partial(leader.slowest_along, model)
        # A bound of several outputs leaves more speed where the path keeps away from it.
        speeds = self.speeds_within(model, self.loop, SPEED, _share(links), links, slowest)
        return eqx.tree_at(lambda law: (law.ahead, law.speeds), self, (ahead, speeds))

    def check_late(self, graph: Graph, period: float) -> None:
        """Check that no stopping point passes its neighbours' within a step: c d_max dt <= 1."""
        assert self.reach is not None
        share = float(self.strength(period)) * self.reach.heaviest * period
        if share > 1.0:
            raise LawError(
                f"`coupling` {self.coupling:g} 1/s times the largest sum of a follower's weights, "
                f"{self.reach.heaviest:g}, times the step, {period:g} s, is {share:.3g}, and must "
                "be at most 1 where messages are late; lower `coupling` or `dt`."
            )

    def begin(self, model: ControlAffine, x: State) -> FlatMemory:
        """Return the memory of an agent that begins at x, with its integrators level."""
        return self.initial_memory(model, x, jnp.asarray(self.ahead, x.dtype))

    def strength(self, period: Scalar | float) -> Scalar | float:
        """Return c where inputs are held for a period (s)."""
        assert self.reach is not None
        if self.coupling is not None:
            return self.coupling
        period = greater(period, _INSTANT)
        # While the highest derivatives are held the inner loop goes on, and zeta moves farther than
        # Euler's step by half the sum of the roots times the period; twice that is kept free.
        most = 1.0 / (self.reach.heaviest * period * (1.0 + period * self.fastest))
        return lesser(2.0 * self.slowest_root / self.reach.slowest, most)

    def update(
        self, model: ControlAffine, view: LocalView, memory: FlatMemory
    ) -> tuple[Input, FlatMemory]:
        """Return the input of one agent."""
        pull = self.bounded(self.strength(view.period) * view.disagreement)
        moving = view.offset_rate
        if self.safety is not None and view.near is not None:
            pull, active = self._held_apart(model, view, view.near, pull)
            # What the filter lets through has the offset's rate in it.
            memory, moving = memory._replace(active=active), None
        return self.ready.obey(model, view, view.feedforward - pull, memory, moving)

    def _held_apart(
        self, model: ControlAffine, view: LocalView, near: Near, pull: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Return the pull (m,), less the offset's rate, that keeps away, and how many act on it."""
        assert self.safety is not None
        places = np.array(self.places(model))
        speeds = jnp.broadcast_to(jnp.asarray(self.speeds, view.x.dtype), pull.shape)[places]
        scales = jnp.asarray(self.safety.scales(model), view.x.dtype)
        rate = -pull[places]
        if view.offset_rate is not None:
            rate = rate + self.ready.shift(model, view.offset_rate)[places]
            rate = rate * (speeds / jnp.maximum(jnp.abs(rate), speeds)).min()
        rate, active = self.safety.filtered(rate, near, scales, speeds)
        # Where no row acts it is the same to the bit.
        return pull.at[places].set(-rate), active


@final
class StoppingLeader(FlatLaw, Travels, Proves):
    """The same law led by the reference: zeta_0' = zeta_r' - sigma(c (zeta_0 - zeta_r)).

    Where `coupling` is left out, c is the slowest root doubled, or what the step holds.

    Args:
        reference: the path to follow; without one the trim's flat outputs are held.
    """

    reference: LeaderPath | None = None

    @property
    def information(self) -> tuple[str, ...]:
        """The reference."""
        return ("the reference and its derivatives",)

    def prepared(self, model: ControlAffine, graph: Graph) -> "StoppingLeader":
        """Find the model's chains, and check that it can be led along the reference."""
        loop = self.build_loop(model, (*graph.leaders, *graph.backups))
        if self.reference is not None:
            check_reference(self.reference)
            if not isinstance(self.reference, Reference):
                raise LawError(
                    "the law `stopping-point` follows a path in space, of which it needs "
                    "derivatives, and the reference `states` gives states; use `lqr` for the "
                    "leader and `consensus` for the followers."
                )
            self.reference.fit(model)
        none = {"is_leaf": lambda part: part is None}
        law = eqx.tree_at(lambda law: law.loop, self, loop, **none)
        speeds = self.speeds_within(
            model,
            loop,
            LEAD_SPEED,
            LEAD_SHARE,
            slowest=functools.partial(law.slowest_along, model),
        )
        return eqx.tree_at(lambda law: law.speeds, law, speeds, **none)

    def path(self, model: ControlAffine, t: Scalar) -> jax.Array:
        """Return the flat outputs to follow with their derivatives, (r + 1, m)."""
        loop = self.ready
        if isinstance(self.reference, Reference):
            path = self.reference.derivatives(t, len(loop.weights), loop.chains.outputs)
            return loop.of_leader(path)
        there = model.output(jnp.asarray(np.asarray(model.trim[0], float), t.dtype))
        place = jnp.stack([there[model.output_names.index(name)] for name in loop.chains.outputs])
        return jnp.pad(place[None], ((0, len(loop.weights)), (0, 0)))

    def slowest_along(self, model: ControlAffine, bound: FlatBound) -> float:
        """Return the least value of a bounded length on the beginning of the path."""
        if len(bound.outputs) == 1:
            return 0.0
        places = np.array([self.ready.chains.outputs.index(name) for name in bound.outputs])
        times = jnp.linspace(0.0, _SEEN, 20 * int(_SEEN) + 1)
        path = np.asarray(jax.vmap(lambda t: self.path(model, t))(times))
        return float(np.linalg.norm(path[:, bound.derivative, places], axis=1).min())

    def begins(self, model: ControlAffine) -> jax.Array:
        """Return the flat outputs at t = 0 with their derivatives, (r, m)."""
        return self.path(model, jnp.zeros(()))[:-1]

    def start(self, model: ControlAffine) -> State:
        """Return the reference's state at time zero, or the trim."""
        if self.reference is None:
            return jnp.asarray(np.asarray(model.trim[0], float))
        return first_state(model, self.reference)

    def reference_states(self, model: ControlAffine, times: jax.Array) -> jax.Array | None:
        """Return x_r at each of `times`, (T, n)."""
        if self.reference is None:
            return None
        return followed_states(model, self.reference, times)

    def own_mode(self, model: ControlAffine) -> float:
        """Return the slowest mode of the leader about its reference, 1/s."""
        return -min(self.slowest_root, float(self.strength(0.0)))

    def begin(self, model: ControlAffine, x: State) -> FlatMemory:
        """Return the memory of a leader that begins at x, as level as its path."""
        return self.initial_memory(model, x, self.begins(model).astype(x.dtype), moves=True)

    def strength(self, period: Scalar | float) -> Scalar | float:
        """Return c where inputs are held for a period (s)."""
        if self.coupling is not None:
            return self.coupling
        return lesser(2.0 * self.slowest_root, 1.0 / greater(period, _INSTANT))

    def update(
        self, model: ControlAffine, view: LocalView, memory: FlatMemory
    ) -> tuple[Input, FlatMemory]:
        """Return the leader's input."""
        if memory.active is not None:
            # A backup leader that was held back when it took the lead gives way to nobody now.
            memory = memory._replace(active=0.0 * memory.half)
        away = self.deviation(model, view.t, view.x, view.offset, memory)
        rate = self._rate(model, view.t, away, view.period)
        return self.ready.obey(model, view, rate, memory, view.offset_rate)

    def _rate(
        self, model: ControlAffine, t: Scalar, away: jax.Array, period: Scalar | float
    ) -> jax.Array:
        """Return zeta' (m,) that the leader commands at a deviation (m,) from its path."""
        ahead = self.ready.stop(self.path(model, t)[1:])
        return ahead - self.bounded(self.strength(period) * away)

    @property
    def plans(self) -> bool:
        """Whether others can predict it: always, by its path or its trim."""
        return True

    def deviation(
        self, model: ControlAffine, t: Scalar, x: State, offset: State, memory: FlatMemory
    ) -> jax.Array:
        """Return zeta_0 - zeta_r, (m,)."""
        loop = self.ready
        away = loop.place(model, x, offset, memory) - loop.stop(self.path(model, t)[:-1])
        return wrap_angles(away, *loop.angles) if loop.angles else away

    def expected(
        self,
        model: ControlAffine,
        t: Scalar,
        deviation: jax.Array,
        age: Scalar,
        period: Scalar | float,
    ) -> Expected:
        """Return zeta_r + D and zeta_r' - sigma(c D), with D' = -sigma(c D) from the deviation."""
        inverse = 1.0 / jnp.asarray(self.speeds, deviation.dtype)
        away = saturated_decay(deviation, self.strength(period), inverse, age)
        there = self.ready.stop(self.path(model, t)[:-1])
        return Expected(there + away, self._rate(model, t, away, period))

    def expected_hull(self, model: ControlAffine, t: Scalar, signal: jax.Array) -> jax.Array:
        """Return the hull of the path, moved so that it ends at the signal."""
        hull = self.hull_of(model, self.path(model, t)[:-1])
        return hull - hull[-1:] + signal[None, np.array(self.places(model))]


@memoize
def beginning_of(leader: StoppingLeader, model: ControlAffine) -> Array:
    """Return the beginning of a leader's path, as `begins` does, read-only."""
    with precision("float64"):
        beginning = np.array(leader.begins(model))
    beginning.setflags(write=False)
    return beginning
