"""What one agent computes on board, as functions on graphs of scalars.

They are the step of `Agent`, lowered whole: what it says and does, and its rules for messages.
"""

import dataclasses
import functools
import math
import operator
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import final

import jax
import jax.numpy as jnp
import numpy as np

from echelon.agents.network.channel import NEVER
from echelon.core.trace import place_of
from echelon.core.types import PyTree, State
from echelon.simulation.engine.agent import OwnLaw, hull_names
from echelon.simulation.onboard.message_words import normalized_equation
from echelon.simulation.onboard.source_code import LawFunction
from echelon.simulation.scalars import Node, ScalarGraph, Unsupported, lower, nodes, rewritten
from echelon.simulation.step.alone import (
    Arrived,
    after_mail,
    alone,
    begin_alone,
    step_alone,
)
from echelon.simulation.step.leadership import NOBODY
from echelon.simulation.step.motion import PlantStep
from echelon.simulation.step.networks import LateNetwork
from echelon.simulation.step.own_members import own_classes
from echelon.simulation.step.records import LeaderPackets, Messages


def senders_of(own: OwnLaw) -> list[int]:
    """Return whose messages an agent uses: first its neighbours'."""
    late = isinstance(own.loop.network, LateNetwork)
    others = [] if late or own.source is None else [own.source]
    others += [k for k in range(own.loop.agents) if k != own.number] if hull_names(own) else []
    return [*dict.fromkeys([*own.neighbours, *others])]


def message_sizes(own: OwnLaw) -> dict[str, int]:
    """Return the parts of a message in their order, and how many numbers each has."""
    s, k, m = len(own.signal_names), len(own.forward_names), len(own.loop.model.input_names)
    network, hull = own.loop.network, {"hull": len(hull_names(own))}
    sizes = {"signal": s, "feed_forward": k}
    if isinstance(network, LateNetwork):
        size = network.rules.content.size(s, k, m)
        sizes = {"time": 1, "hops": 1, "signal": s, "leader": 1, "said": 1, "content": size}
        sizes |= {"term": 1} if network.rules.leadership.changes else {}
    return sizes | {name: size for name, size in hull.items() if size}


def agent_functions(own: OwnLaw, bits: int = 64) -> dict[str, LawFunction]:
    """Return what an agent computes, in 64 or 32 bits; else `Unsupported`, with the user's line."""
    _check_members(own)
    return {function.name: function for function in _Traces(own, bits).all()}


def _check_members(own: OwnLaw) -> None:
    """Raise `Unsupported` where an agent by itself has echelon's member in place of the user's."""
    loop, network = own.loop, own.loop.network
    rules = [network.leadership, network.rules] if isinstance(network, LateNetwork) else []
    inner = (kind for part in (loop.turns, loop.graph, *rules) for kind in own_classes(part))
    for kind in (type(network), type(loop.surroundings), *inner):
        if not kind.__module__.startswith("echelon."):
            raise Unsupported(f"the member `{kind.__name__}` of your own ({place_of(kind)})")


@final
class _Traces:
    def __init__(self, own: OwnLaw, bits: int) -> None:
        self.own, self.bits, self.sizes = own, bits, message_sizes(own)
        self.loop = alone(own.loop, own.number, Arrived(*np.zeros((2, 0))), own.schedule)
        network = own.loop.network
        self.late = isinstance(network, LateNetwork)
        self.needs_packet = isinstance(network, LateNetwork) and network.rules.content.needs_packet
        self.senders, self.width = senders_of(own), sum(self.sizes.values())
        # The form of the memory, known once it has begun.
        self.like: PyTree = None

    def all(self) -> Iterator[LawFunction]:
        """Yield all functions that the agent needs."""
        sizes: dict[str, int | None] = {"x": len(self.loop.model.state_names)}
        [memory] = _lowered(self._begin, sizes, self.bits)
        about = "the memory of an agent that begins at x"
        yield _function("begin", about, sizes, {"memory": memory})
        rows = {"received": len(self.senders) * self.width, "memory": len(memory)}
        sizes = {"t": None, **sizes, **rows}
        u, memory, message, finite, hello, said = _lowered(self._step, sizes, self.bits)
        if not self.late:
            about = "its message at t (s) before it acts, whose feed-forward is NaN"
            yield _function("speak", about, sizes, {"message": hello}, said)
        about = "a step at t (s) with the last message of each sender, NaN for none"
        outputs = {"u": u, "memory": memory, "message": message}
        yield _function("step", about, sizes, outputs, finite)
        yield from self._conversions()

    def _conversions(self) -> Iterator[LawFunction]:
        """Yield what makes physical inputs of normalized ones, and the other way round."""
        model, m = self.loop.model, len(self.loop.model.input_names)
        # Not `v`, with which numbers in between begin.
        v, about = "normalized_u", f", {normalized_equation(model)}"
        pairs = ("physical", "u", v, model.physical), ("normalized", v, "u", model.normalized)
        for name, result, given, convert in pairs:
            words = "u of normalized inputs v" if given == v else "v of physical inputs u"
            [numbers] = _lowered(lambda x, f=convert: f(x), {given: m}, self.bits)
            text = f"the {name} inputs {words}{about}"
            yield _function(name, text, {given: m}, {result: numbers})

    def _begin(self, x: State) -> jax.Array:
        memory = begin_alone(self.loop, x)
        self.like = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype), memory)
        return _flat(memory)

    def _step(
        self, t: jax.Array, x: State, received: jax.Array, flat: jax.Array
    ) -> tuple[jax.Array, ...]:
        """Return inputs, memory, message, what is finite, and the same before the agent acts."""
        loop = after_mail(self.loop, self._arrived(received))
        acted, after = step_alone(loop, _unflat(self.like, flat), t, x)
        said, near = acted.said[0], _flat(acted.memory.near)
        message = _flat([said, acted.message[0], near])
        hello = _flat([said, jnp.full(acted.message.shape[1], jnp.nan), near])
        if self.late:
            sent: Messages = jax.tree.map(lambda row: row[0], acted.memory.network[0])
            leader, stamp, content, term = sent.packet
            none = stamp == NEVER
            packet = [leader, stamp, content, *jax.tree.leaves(term)]
            packet = [jnp.where(none, jnp.nan, part) for part in packet]
            time = jnp.where(none, jnp.nan, t) if self.needs_packet else t
            message = _flat([time, sent.hops, sent.value, packet, near])
        finite = [x for x in jax.tree.leaves((x, acted)) if jnp.issubdtype(x.dtype, jnp.inexact)]
        return acted.inputs[0], _flat(after), message, _flat(finite), hello, _flat([said, near])

    def _arrived(self, received: jax.Array) -> Arrived:
        """Return what messages contain, a row of each sender."""
        rows = received.reshape(len(self.senders), self.width)
        ends = np.cumsum([0, *self.sizes.values()])
        parts = {name: rows[:, a:b] for name, a, b in zip(self.sizes, ends, ends[1:], strict=False)}
        place, k = self.senders.index, len(self.own.neighbours)
        heard, forward = parts["signal"][:k], jnp.full(len(self.own.forward_names), jnp.nan)
        if not self.late and self.own.source is not None:
            forward = parts["feed_forward"][place(self.own.source)]
        messages = self._messages({name: part[:k] for name, part in parts.items()})
        hulls = jnp.zeros((0, 1, 1))
        if "hull" in parts:
            others = [place(who) for who in range(self.own.loop.agents) if who != self.own.number]
            d = len(self.loop.model.position)
            hulls = parts["hull"][np.array(others)].reshape(len(others), -1, d)
        return Arrived(heard, forward, messages, hulls)

    def _messages(self, parts: dict[str, jax.Array]) -> PyTree:
        """Return those of the neighbours over a late network, with stamps in s."""
        if not self.late:
            return ()
        term = _whole(parts["term"][:, 0], 0) if "term" in parts else ()
        said = _stamp(parts["said"][:, 0])
        packets = LeaderPackets(_whole(parts["leader"][:, 0]), said, parts["content"], term)
        # Of an output that a sender does not have it is taken to be where the leader is.
        value = jnp.where(jnp.isnan(parts["signal"]), 0.0, parts["signal"])
        return Messages(value, _whole(parts["hops"][:, 0]), packets, _stamp(parts["time"][:, 0]))


def _stamp(time: jax.Array) -> jax.Array:
    return jnp.where(jnp.isnan(time), float(NEVER), time)


def _whole(numbers: jax.Array, otherwise: int = NOBODY) -> jax.Array:
    numbers = jnp.where(jnp.isnan(numbers), float(otherwise), numbers)
    return jnp.clip(numbers, 0.0, float(NOBODY)).astype(jnp.int32)


def _flat(tree: PyTree) -> jax.Array:
    leaves = [jnp.ravel(leaf) for leaf in jax.tree.leaves(tree)]
    return jnp.concatenate([jnp.zeros(0), *(leaf.astype(float) for leaf in leaves)])


def _unflat(like: PyTree, flat: jax.Array) -> PyTree:
    """Return a tree of the form of another one from numbers, whole ones and truths among them."""
    leaves, tree = jax.tree.flatten(like)
    ends = np.cumsum([0, *(leaf.size for leaf in leaves)]).tolist()
    parts = zip(leaves, ends[:-1], ends[1:], strict=True)
    return tree.unflatten([
        flat[a:b].reshape(leaf.shape).astype(leaf.dtype) for leaf, a, b in parts
    ])  # fmt: skip


# ---- a function of numbers -----------------------------------------------------------------------


def _lowered(
    compute: Callable[..., PyTree], sizes: Mapping[str, int | None], bits: int = 64
) -> list[list[Node]]:
    """Return the results of a function of arguments by name; None is the size of a number."""
    graph = ScalarGraph(bits, loops=True)
    leaves = [
        np.array(graph.leaf(key) if size is None else [graph.leaf(key, k) for k in range(size)])
        for key, size in sizes.items()
    ]
    results = lower(compute, graph, [np.asarray(leaf, object) for leaf in leaves])
    return [nodes(graph, part) for part in results]


def _function(
    name: str,
    about: str,
    sizes: Mapping[str, int | None],
    outputs: Mapping[str, list[Node]],
    finite: Sequence[Node] = (),
) -> LawFunction:
    """Return a function, which is valid where some numbers are finite; always without any."""
    results = sum(outputs.values(), start=[*finite])
    graph = results[0].graph
    exceptions = graph.exceptions_of(results)
    plain = rewritten([*results, *exceptions], _plainer)
    named = {key: [plain[node] for node in part] for key, part in outputs.items()}
    if not finite:
        return LawFunction(name, about, sizes, named)
    # Their sum is finite where they are: one operation for each.
    total = functools.reduce(operator.add, dict.fromkeys(plain[node] for node in finite))
    valid = graph.make("lt", graph.make("abs", total), math.inf)
    for truth in _fewer([plain[truth] for truth in exceptions]):
        valid = graph.make("and", valid, graph.make("not", truth))
    return LawFunction(name, about, sizes, named, valid)


def _plainer(node: Node, args: Sequence[Node]) -> Node | bool | None:
    """Return what replaces a node for one agent alone."""
    if node.op in ("unlikely", "rare"):
        # Of choices that save time where many agents take the same side.
        return True
    if node.op not in ("min", "max") or node.truth:
        return None
    for bound, x in (args, args[::-1]):
        if bound.op == "constant" and not math.isnan(bound.value):
            beyond = (bound, x) if node.op == "min" else (x, bound)
            return node.graph.make("select", node.graph.make("lt", *beyond), bound, x)
    return None


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


# ---- simulated vehicles --------------------------------------------------------------------------


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
    about = "the state and what the actuators remember, a step later"
    x, memory = _lowered(move, sizes)
    return _function("move", about, sizes, {"x": x, "memory": memory})


def motions_of(motion: PlantStep, agents: int, substeps: int) -> list[PlantStep]:
    """Return the motion of each agent in a part of a step."""
    rows = (jax.tree.map(lambda a, k=k: a[k], motion.rows) for k in range(agents))
    each = map(motion.of_row, rows)
    return [dataclasses.replace(one, dt=motion.dt / substeps) for one in each]
