"""What one agent computes on board, as functions on graphs of scalars.

They are traced from what `Agent` runs, as native code is. Rules about messages, such as which one
is the newest, are no arithmetic, and are left to the program that receives them.
"""

import dataclasses
import functools
import math
import operator
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple, final

import jax
import jax.numpy as jnp
import numpy as np

from echelon.agents.models.model import ControlAffine
from echelon.agents.world.sensing import Estimate, EstimatingSensor, Estimator
from echelon.core.numerics import rk4
from echelon.core.types import PyTree
from echelon.core.words import Feedforward
from echelon.laws.consensus import Consensus
from echelon.laws.flat_law import FlatLaw
from echelon.laws.law import Feeds, Law
from echelon.simulation.engine.agent import OwnLaw
from echelon.simulation.native.agent_step import (
    check_distances,
    leaves_of,
    memory_size,
    single,
    unflatten,
)
from echelon.simulation.scalars import Node, ScalarGraph, lower, needed, nodes, rewritten
from echelon.simulation.step.alone import Arrived, alone, sent_or_alone
from echelon.simulation.step.motion import PlantStep
from echelon.simulation.step.networks import (
    LateNetwork,
    PacketDeviations,
    PlanDeviations,
    Saying,
    carried_time,
    parts_of,
)
from echelon.simulation.step.records import (
    GroupOffsets,
    Known,
    LawMemories,
    NetworkEstimate,
    Own,
    Seconds,
)
from echelon.simulation.step.run_laws import carried_pieces
from echelon.simulation.step.turns import follow, lead


class LawFunction(NamedTuple):
    """A function of numbers.

    Attributes:
        name: of the function.
        about: what it does, a sentence.
        inputs: name -> how many numbers it has; None for a number that is no array.
        outputs: name -> its numbers.
        valid: whether all that the outputs rest on is finite and accurate; None if not computed.
    """

    name: str
    about: str
    inputs: Mapping[str, int | None]
    outputs: Mapping[str, list[Node]]
    valid: Node | None = None

    @property
    def results(self) -> list[Node]:
        """All outputs, and whether they are valid."""
        valid = [] if self.valid is None else [self.valid]
        return sum(self.outputs.values(), start=valid)

    @property
    def operations(self) -> int:
        """How many operations a call takes at most."""
        return sum(node.op not in ("constant", "leaf") for node in needed(self.results))


def law_functions(own: OwnLaw, bits: int = 64) -> dict[str, LawFunction]:
    """Return what an agent computes, in 64 or 32 bits; else `Unsupported`, with the user's line."""
    check_distances(own.loop)
    return {function.name: function for function in _Traces(own, bits).all()}


@final
class _Traces:
    def __init__(self, own: OwnLaw, bits: int) -> None:
        self.own, self.bits = own, bits
        self.loop, self.law = alone(own.loop, own.number, Arrived(*np.zeros((2, 0)))), own.law
        self.memory = memory_size(self.law)
        self.n, self.s = len(self.loop.model.state_names), len(own.signal_names)
        self.k, self.m = len(own.forward_names), len(self.loop.model.input_names)

    def all(self) -> Iterator[LawFunction]:
        """Yield all functions that the agent needs."""
        yield self._begin()
        if isinstance(self.law, FlatLaw) and self.law.ready.angles:
            yield self._face(self.law)
        yield from self._conversions()
        yield self._signal()
        difference = self._difference()
        yield difference
        yield self._tick(len(difference.outputs["gap"]))
        late = self.own.loop.network
        if isinstance(late, LateNetwork) and isinstance(late.rules.content, PlanDeviations):
            yield from self._expectation(late.rules.content)
        for stage in self.loop.sensing.on_board.stages:
            if isinstance(stage, EstimatingSensor):
                yield from self._estimation(stage.estimator)

    def _offset(self, t: jax.Array) -> GroupOffsets:
        return self.loop.places.of_group(self.loop.model, self.law, t, np.array([0]))

    def _said(self, t: jax.Array, x: jax.Array, flat: jax.Array) -> jax.Array:
        offset, memory = self._offset(t).offset[0], unflatten(self.law.init(), flat)
        return self.loop.laws.speech.of_one(self.law, self.loop.model, x, offset, memory)

    # ---- in any network ----

    def _begin(self) -> LawFunction:
        return self._function(
            "begin",
            "the memory of an agent that begins at x",
            lambda x: (_flat(self.law.begin(self.loop.model, x)),),
            ("memory",),
            {"x": self.n},
        )

    def _face(self, law: FlatLaw) -> LawFunction:
        def face(flat: jax.Array, received: jax.Array) -> tuple[jax.Array]:
            return (_flat(law.beside(unflatten(law.init(), flat), received)),)

        return self._function(
            "face",
            "the memory of an agent that begins late, with its angles, which grow with every turn, "
            "beside those of a received signal",
            face,
            ("memory",),
            {"memory": self.memory, "received": self.s},
        )

    def _conversions(self) -> Iterator[LawFunction]:
        """Yield what makes physical inputs of normalized ones, and the other way round."""
        model = self.loop.model
        # Not `v`, with which numbers in between begin.
        v, about = "normalized_u", f", {normalized_equation(model)}"
        pairs = ("physical", "u", v, model.physical), ("normalized", v, "u", model.normalized)
        for name, result, given, convert in pairs:
            words = "u of normalized inputs v" if given == v else "v of physical inputs u"
            text = f"the {name} inputs {words}{about}"
            yield self._function(
                name, text, lambda x, f=convert: (f(x),), (result,), {given: self.m}
            )

    def _signal(self) -> LawFunction:
        return self._function(
            "signal",
            "the agent's signal at t (s), before it acts",
            lambda t, x, flat: (self._said(t, x, flat),),
            ("signal",),
            {"t": None, "x": self.n, "memory": self.memory},
        )

    def _difference(self) -> LawFunction:
        def gap(t: jax.Array, x: jax.Array, flat: jax.Array, other: jax.Array) -> tuple[jax.Array]:
            said = self._said(t, x, flat)[None]
            other = jnp.where(jnp.isnan(other), said[0], other)[None]
            return (self.loop.laws.speech.difference(self.loop.model)(said, other)[0],)

        return self._function(
            "difference",
            "the difference of the own signal at t (s) from another one, 0 where that is NaN",
            gap,
            ("gap",),
            {"t": None, "x": self.n, "memory": self.memory, "received": self.s},
        )

    def _tick(self, gap: int) -> LawFunction:
        loop, leads, late = self.loop, self.own.leads, self.own.loop.network
        says = late.rules.content if isinstance(late, LateNetwork) else None

        def tick(
            t: jax.Array, x: jax.Array, z: jax.Array, forward: jax.Array, flat: jax.Array
        ) -> tuple[jax.Array, ...]:
            clock = Seconds(t, loop.motion.dt, t, jnp.asarray(False))
            memory, said = unflatten(self.law.init(), flat), self._said(t, x, flat)
            own, offset = Own(jnp.asarray(loop.laws.numbers), x[None]), self._offset(t)
            heard = NetworkEstimate(z[None], jnp.array([leads]))
            links = loop.graph.exchange
            known = Known(clock, True, own, (offset, offset), said[None], links, heard)
            rows = jax.tree.map(lambda row: row[None], memory)
            if leads:
                acted = lead(loop, known, LawMemories(rows, ()))
            else:
                forward = sent_or_alone(loop, t, x, forward)[None]
                acted = follow(loop, known, 1, forward, rows)
            acted = jax.tree.map(lambda row: row[0], acted)
            results = acted.input, _flat(acted.memory), said, acted.message
            # A state less a constant is finite where the state is.
            signal = said if loop.laws.speech.signals else ()
            if says is None or not leads:
                return *results, _flat((x, signal, acted))
            leader = Saying(x, offset.offset[0], memory, said, acted)
            content = says.content(loop, t, leader)
            return *results, content, _flat((x, signal, acted, content))

        words = message_meaning(self.own)
        sent = () if says is None or not leads else ("content",)
        outputs = ("u", "memory", "signal", "message", *sent)
        sizes = {"t": None, "x": self.n, "z": gap, "feed_forward": self.k, "memory": self.memory}
        return self._function(
            "tick",
            "a step at t (s), with z, the sum of weights times `difference`, and the feed-forward "
            f"that was received, NaN if none was; that and the message are {words}",
            tick,
            outputs,
            sizes,
        )

    # ---- where messages are late ----

    def _expectation(self, content_of: PlanDeviations) -> Iterator[LawFunction]:
        loop, s = self.loop, self.s
        size = content_of.size(s, self.k, self.m)
        # A state is carried on in a loop, each round of which is a function here.
        plain = not loop.laws.speech.signals
        in_rounds = plain and isinstance(content_of, PacketDeviations)

        def expected(t: jax.Array, content: jax.Array, age: jax.Array) -> tuple[jax.Array, ...]:
            if in_rounds:
                leader, forward, _ = parts_of(loop, s, content)
            else:
                leader, forward = content_of.expected(loop, s, t, content, age)
            return leader, forward, _flat((leader, forward))

        def pace(age: jax.Array) -> tuple[jax.Array]:
            rounds, duration = carried_pieces(carried_time(age))
            return (jnp.stack([rounds.astype(age.dtype), duration]),)

        def carry(content: jax.Array, duration: jax.Array) -> tuple[jax.Array, ...]:
            x, forward, u = parts_of(loop, s, content)
            moved = jnp.concatenate([rk4(loop.model.velocity, x, u, duration), forward, u])
            return moved, moved

        yield self._function(
            "expected",
            "the signal and the feed-forward that a leader is expected to have at t (s), by its "
            "packet of an age (s)",
            expected,
            ("leader", "feed_forward"),
            {"t": None, "content": size, "age": None},
        )
        if in_rounds:
            about = "how many rounds of `carry`, and of which duration (s), make up an age (s)"
            yield self._function("pace", about, pace, ("pace",), {"age": None})
            about = "a packet of a leader that has moved on for a duration (s)"
            sizes = {"content": size, "duration": None}
            yield self._function("carry", about, carry, ("content",), sizes)

    # ---- where states are measured ----

    def _estimation(self, estimator: Estimator) -> Iterator[LawFunction]:
        """Yield what an agent makes of measurements: numbers, the last of which is 0 at first."""
        model, zero = self.loop.model, jnp.zeros
        like = Estimate(
            zero(self.n), zero(len(estimator.pushed)), zero((estimator.late + 1, self.m))
        )
        size = sum(part.size for part in like) + 1

        def estimate(y: jax.Array) -> tuple[jax.Array]:
            return (jnp.append(_flat(estimator.begin(model, y)), 0.0),)

        def measure(y: jax.Array, flat: jax.Array) -> tuple[jax.Array, ...]:
            before = unflatten(like, flat[:-1])
            x, after = estimator.measure(model, before, y, flat[-1] == 0.0)
            return x, jnp.append(_flat(after), flat[-1]), _flat((x, after))

        def deliver(u: jax.Array, flat: jax.Array) -> tuple[jax.Array]:
            return (jnp.append(_flat(estimator.act(unflatten(like, flat[:-1]), u)), 1.0),)

        about = "the estimate of an agent whose first measurement is y"
        yield self._function("estimate", about, estimate, ("estimate",), {"y": self.n})
        about = "the state x that the agent assumes at a measurement y, and its estimate"
        sizes = {"y": self.n, "estimate": size}
        yield self._function("measure", about, measure, ("x", "estimate"), sizes)
        about = "the estimate after the inputs u were applied"
        sizes = {"u": self.m, "estimate": size}
        yield self._function("deliver", about, deliver, ("estimate",), sizes)

    def _function(
        self,
        name: str,
        about: str,
        compute: Callable[..., PyTree],
        outputs: tuple[str, ...],
        sizes: Mapping[str, int | None],
    ) -> LawFunction:
        """What `compute` returns after its outputs must be finite where the function is valid."""
        graph = ScalarGraph(self.bits)
        leaves = [
            single(graph.leaf(key)) if size is None else leaves_of(graph, key, range(size))
            for key, size in sizes.items()
        ]
        parts = [nodes(graph, part) for part in lower(compute, graph, leaves)]
        exceptions = graph.exceptions_of(sum(parts, start=[]))
        plain = rewritten(sum(parts, start=exceptions), _plainer)
        parts = [[plain[node] for node in part] for part in parts]
        named = dict(zip(outputs, parts, strict=False))
        if len(parts) == len(outputs):
            return LawFunction(name, about, sizes, named)
        valid = _all_finite(graph, parts[-1])
        for truth in _fewer([plain[truth] for truth in exceptions]):
            valid = graph.make("and", valid, graph.make("not", truth))
        return LawFunction(name, about, sizes, named, valid)


def _plainer(node: Node, args: Sequence[Node]) -> Node | bool | None:
    """Return what replaces a node for one agent alone."""
    if node.op == "unlikely":
        # Of choices that save time where many agents take the same side.
        return True
    if node.op not in ("min", "max") or node.truth:
        return None
    for bound, x in (args, args[::-1]):
        if bound.op == "constant" and not math.isnan(bound.value):
            beyond = (bound, x) if node.op == "min" else (x, bound)
            return node.graph.make("select", node.graph.make("lt", *beyond), bound, x)
    return None


def _all_finite(graph: ScalarGraph, numbers: Sequence[Node]) -> Node:
    """Return whether numbers are finite, as their sum then is: one operation for each."""
    total = functools.reduce(operator.add, dict.fromkeys(numbers))
    return graph.make("lt", graph.make("abs", total), math.inf)


def _fewer(truths: Sequence[Node]) -> list[Node]:
    """Return truths of which one holds where one of others does: angles are compared together."""
    together, others = dict[Node, Node](), list[Node]()
    for truth in truths:
        bound, x = truth.args if truth.op == "lt" else (truth, truth)
        if bound.op == "constant" and x.at_least_0:
            together[bound] = together[bound] + x if bound in together else x
        else:
            others.append(truth)
    return [*others, *(x.graph.make("lt", bound, x) for bound, x in together.items())]


def _flat(tree: PyTree) -> jax.Array:
    return jnp.concatenate([jnp.zeros(0), *map(jnp.ravel, jax.tree.leaves(tree))])


# ---- what the numbers of a message are, in words -------------------------------------------------


def normalized_equation(model: ControlAffine) -> str:
    """Return how inputs u and normalized inputs v belong together, with the numbers of a model."""
    scale = "; ".join(map(_row, model.input_scale))
    return f"u = u* + S v, where u* is ({_row(model.trim[1])}) and S has the rows ({scale})"


def _row(numbers: Sequence[float]) -> str:
    return ", ".join(f"{float(number):.9g}" for number in numbers)


def message_meaning(own: OwnLaw) -> str:
    """Return what a message and a feed-forward are."""
    follower, turning = own.loop.laws.follower, own.loop.laws.follower.turning
    more = ", and the heading that the leader follows (rad)" if turning else ""
    return _meaning(follower) + more


def _meaning(follower: Law) -> str:
    if follower.feedforward is Feedforward.NONE:
        return "zeros, since no agent uses others' inputs"
    if isinstance(follower, FlatLaw):
        return "rates zeta' of the stopping point, in units of the outputs per second"
    if _is_own(follower):
        return f"as the law `{type(follower).__name__}` defines them"
    if follower.feedforward is Feedforward.RELAY_VELOCITY:
        return "rates of the states that the normalized inputs v of u = u* + S v make"
    less = isinstance(follower, Consensus) and follower.gain.inner is not None
    less = ", less those of the inner loop" if less else ""
    return f"normalized inputs v of u = u* + S v{less}, and no physical inputs u"


def _is_own(follower: Law) -> bool:
    """Tell whether a law sends something that echelon does not know."""
    broadcast = getattr(type(follower), "broadcast", Feeds.broadcast)
    others = broadcast not in (Feeds.broadcast, Consensus.broadcast)
    return others or Feeds.may(follower, "message")


def message_words(own: OwnLaw) -> list[str]:
    """Return the names of the numbers of a message, none of which is that of a physical input."""
    model, follower, names = own.loop.model, own.loop.laws.follower, list(own.forward_names)
    heading = names[len(names) - follower.turning :]
    names = names[: len(names) - follower.turning]
    if isinstance(follower, FlatLaw):
        names = [f"rate of {name}" for name in names]
    elif follower.feedforward is Feedforward.RELAY_VELOCITY:
        names = [f"rate of {name}" for name in model.state_names]
    elif names == [*model.input_names] and not _is_own(follower):
        names = [f"normalized {name}" for name in names]
    return [*names, *heading]


def move_function(motion: PlantStep) -> LawFunction:
    """Return `move`, a step of an agent's own motion; else `Unsupported`, with the user's line."""
    plant, remembers = motion.plant, motion.motors.remembers
    n, m = len(plant.state_names), len(plant.input_names)

    def move(
        x: jax.Array, u: jax.Array, memory: jax.Array, push: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        field = motion.pushed(push)
        own = memory if remembers else ()
        x, after = motion.motors.integrate(field, own, x, motion.deliver(u), motion)
        return x, after if remembers else memory

    sizes = {"x": n, "u": m, "memory": m if remembers else 0, "push": n}
    graph = ScalarGraph()
    leaves = [leaves_of(graph, name, range(size)) for name, size in sizes.items()]
    x, memory = (nodes(graph, part) for part in lower(move, graph, leaves))
    about = "the state and what the actuators remember, a step later"
    return LawFunction("move", about, sizes, {"x": x, "memory": memory})


def motions_of(motion: PlantStep, agents: int, substeps: int) -> list[PlantStep]:
    """Return the motion of each agent in a part of a step."""
    rows = (jax.tree.map(lambda a, k=k: a[k], motion.rows) for k in range(agents))
    each = map(motion.of_row, rows)
    return [dataclasses.replace(one, dt=motion.dt / substeps) for one in each]
