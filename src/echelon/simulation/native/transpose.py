"""The transpose of one agent's step as scalar operations: it maps cotangents backward in time.

It is `jax.vjp` of the step that is run (`agent_step.agent_step`), so that its derivatives are those
of JAX. It reads from a tape what the step depended on.
"""

import functools
import operator
from typing import NamedTuple, final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from echelon.core.types import Array
from echelon.laws.law import Memory
from echelon.simulation.codegen import Body, from_tape, stride
from echelon.simulation.native.agent_step import (
    BlockRows,
    Entries,
    StepInputs,
    agent_step,
    leaves_of,
    memory_size,
    row_ranges,
    signal_size,
    single,
    step_inputs,
    unflatten,
    varying_leaves,
)
from echelon.simulation.native.kernel_cache import LANES
from echelon.simulation.native.varying import VaryingNumbers
from echelon.simulation.scalars import Node, ScalarGraph, Unsupported, lower, nodes
from echelon.simulation.step.distances import spacing_error
from echelon.simulation.step.loop import Loop


class CotangentRows(NamedTuple):
    """Where the cotangents of an agent are in its block in the backward pass; ranges of rows.

    Attributes:
        state, memory: of the results of the previous step.
        offset: of its goal's offset, added up, if it is needed.
        disagreement: of its disagreement at the following step, if it is needed again.
        place: its position then and that of its goal, if distances have cotangents.
        imbalance: the weight by which it then received more than it sent, if that is not 0 for all.
        spacing, errors, tracking, outputs, effort: of what it adds to `Sums` at each step.
        total: how many rows there are.
    """

    state: range
    memory: range
    offset: range
    disagreement: range
    place: range
    imbalance: range
    spacing: range
    errors: range
    tracking: range
    outputs: range
    effort: range
    total: int

    @classmethod
    def of(cls, loop: Loop, rows: BlockRows, distances: bool, offsets: bool) -> "CotangentRows":
        """Return the rows of a loop, with `place` for `distances`, with `offset` for `offsets`."""
        n, q = len(rows.state), len(loop.meter.measured)
        unbalanced = bool(imbalance(loop).any())
        disagreement = disagreement_size(loop) * (unbalanced or distances)
        sizes = [n, len(rows.memory), n * offsets, disagreement, 2 * q * distances]
        sizes += [int(unbalanced), 1, 2, 2, len(rows.outputs), 1]
        return cls(*row_ranges(sizes))


def disagreement_size(loop: Loop) -> int:
    """Return how many numbers the disagreement of an agent has."""
    return signal_size(loop) or len(loop.model.state_names)


def imbalance(loop: Loop) -> Float[Array, "k N"]:
    """Return the weight by which each agent receives more than it sends, for each stretch."""
    exchange, agents = loop.exchange, len(loop.offsets)

    def sums(ends: Array, weights: Array) -> Array:
        return np.bincount(np.asarray(ends), weights, agents)

    rows = np.atleast_2d(np.asarray(exchange.weights))
    return np.stack([sums(exchange.receivers, w) - sums(exchange.senders, w) for w in rows])


class _Arguments(NamedTuple):
    """Inputs of an agent's step that have cotangents, or these cotangents."""

    x: Entries
    offset: Entries
    z: Entries
    message: Entries
    memory: Memory
    leader: Entries


_RESULTS = (
    "state",
    "memory",
    "message",
    "errors",
    "tracking",
    "outputs",
    "effort",
    "next_signal",
)
"""Outputs of a step that have cotangents; the others are counts."""


class TransposedStep(NamedTuple):
    """The transpose of a step: its body, and the leaves that the step records on a tape."""

    body: Body
    recorded: list[tuple[str, int]]


@final
class Transpose:
    """Derives the transpose of the leaders' or of all others' step.

    Args:
        varying: the loop, and its numbers with respect to which to differentiate.
        bits: 64 or 32.
        rows: where the numbers of an agent are in a step.
        cotangents: where its cotangents are in the backward pass.
        leads: whether it is the step of the leaders.
        follows: whether they follow a reference, which is in the table.
    """

    def __init__(
        self,
        varying: VaryingNumbers,
        bits: int,
        rows: BlockRows,
        cotangents: CotangentRows,
        leads: bool,
        follows: bool,
    ) -> None:
        """Begin a graph."""
        self.varying, self.loop, self.rows, self.cotangents = (
            varying,
            varying.loop,
            rows,
            cotangents,
        )
        self.leads, self.follows, self.graph = leads, follows, ScalarGraph(bits)
        self.law = self.loop.leader if leads else self.loop.follower
        self.has_signals = signal_size(self.loop) > 0
        self.measured, self.width = list(self.loop.meter.measured), disagreement_size(self.loop)

    def derive(self) -> TransposedStep:
        """Return the transpose.

        Its totals are the slopes along the varying numbers, leaf by leaf.

        Raises:
            Unsupported: the law or the model has no scalar operations.
        """
        self._check_difference()
        inputs = step_inputs(self.loop, self.graph, self.rows, self.law, self.leads, self.follows)
        arguments = _Arguments(*(getattr(inputs, name) for name in _Arguments._fields))
        leaves = varying_leaves(self.varying, self.graph, self.rows, self.follows, True)
        of_mirror = self._of_mirror()
        values = [leaves, inputs, arguments, self._of_results(of_mirror)]
        parts = [nodes(self.graph, part) for part in lower(self._transposed, self.graph, values)]
        tree = jax.tree.structure(arguments, is_leaf=lambda part: isinstance(part, np.ndarray))
        of_varying = [node for part in parts[: len(leaves)] for node in part]
        back: _Arguments = tree.unflatten(parts[len(leaves) :])
        body = self._body(inputs, back, of_mirror, of_varying)
        return TransposedStep(*from_tape(body, {"cotangent": "row", "gathered": "z"}))

    def _transposed(
        self,
        leaves: list[jax.Array],
        inputs: StepInputs,
        arguments: _Arguments,
        cotangents: tuple[Entries, ...],
    ) -> tuple[list[jax.Array], _Arguments]:
        def step(leaves: list[jax.Array], arguments: _Arguments) -> tuple[Entries, ...]:
            act = agent_step(self.varying.filled(leaves), self.leads)
            outputs = act(inputs._replace(**arguments._asdict()))
            return tuple(getattr(outputs, name) for name in _RESULTS)

        return jax.vjp(step, leaves, arguments)[1](cotangents)

    def _leaf(self, places: range, kind: str = "cotangent") -> np.ndarray:
        return leaves_of(self.graph, kind, places)

    # ---- neighbours ----

    def _check_difference(self) -> None:
        """Check that the slopes of the difference of two states are 1 and -1.

        Raises:
            Unsupported: they are not.
        """
        if self.has_signals:
            return
        n, difference = len(self.rows.state), self.loop.model.difference
        values = [self._leaf(range(n), kind) for kind in ("self", "neighbour", "cotangent")]

        def transposed(x: jax.Array, y: jax.Array, w: jax.Array) -> tuple[jax.Array, ...]:
            return jax.vjp(difference, x, y)[1](w)

        slopes = [nodes(self.graph, part) for part in lower(transposed, self.graph, values)]
        # The backward pass gathers plain differences, which is the transpose for these slopes only.
        if slopes != [list(values[2]), [-node for node in values[2]]]:
            raise Unsupported("a `difference` of states that is not x - y up to whole turns")

    def _of_mirror(self) -> np.ndarray:
        """Return the cotangents of what neighbours read after a step."""
        gathered = self._leaf(range(self.width), "gathered")
        if not len(self.cotangents.imbalance):
            return gathered
        # The sum over receivers has the agent's own cotangent once per receiver, not per sender.
        weight = self._leaf(self.cotangents.imbalance)
        return gathered + weight * self._leaf(self.cotangents.disagreement)

    def _mirror_before(self) -> list[Node]:
        """Return what neighbours read of an agent, from its block."""
        if not len(self.cotangents.place):
            # Plain differences are gathered from mirrors only.
            return [self.graph.constant(0.0)] * self.width
        return [*self._leaf(self.cotangents.disagreement), *self._leaf(self.cotangents.place)]

    def _difference(self) -> list[Node]:
        """Return the differences that are gathered of what neighbours read, entry by entry."""
        width, q = self.width, len(self.measured)
        kinds = "self", "neighbour"
        mine, theirs = (self._leaf(range(width + 2 * q), kind) for kind in kinds)
        plain = [self.graph.make("sub", a, b) for a, b in zip(mine, theirs, strict=True)]
        if not len(self.cotangents.place):
            return plain[:width]

        def slope(x: jax.Array, y: jax.Array) -> jax.Array:
            goals = jnp.sqrt(jnp.sum((x[q:] - y[q:]) ** 2))
            return jax.grad(lambda p: spacing_error(jnp.sum((p - y[:q]) ** 2), goals))(x[:q])

        [slopes] = lower(slope, self.graph, [mine[width:], theirs[width:]])
        return [*plain[:width], *nodes(self.graph, slopes)]

    # ---- the step ----

    def _of_results(self, of_mirror: np.ndarray) -> tuple[Entries, ...]:
        """Return the cotangents of the results of a step, in the order of `_RESULTS`."""
        rows, message = self.cotangents, range(len(self.rows.message))
        sends = self.leads or self.loop.levels is not None
        tracks = self.leads and self.follows
        state = self._leaf(rows.state)
        if len(rows.place):
            places = range(self.width, self.width + len(self.measured))
            slopes = self._leaf(places, "gathered")
            state[self.measured] += self._leaf(rows.spacing) * slopes
        return (
            state if self.has_signals else state + of_mirror,
            unflatten(self.law.init(), self._leaf(rows.memory[: memory_size(self.law)])),
            self._leaf(message, "contribution") if sends else np.zeros(len(message)),
            self._leaf(rows.errors),
            self._leaf(rows.tracking) if tracks else np.zeros(2),
            self._leaf(rows.outputs) if tracks else np.zeros(len(self.rows.outputs)),
            single(self._leaf(rows.effort)[0]),
            of_mirror if self.has_signals else np.zeros(0),
        )

    def _body(
        self, inputs: StepInputs, back: _Arguments, of_mirror: np.ndarray, of_varying: list[Node]
    ) -> Body:
        """Return the body of the transpose, from the cotangents of a step's arguments."""
        rows, measured, place = self.cotangents, self.measured, list[Node]()
        x, offset = np.array(back.x, object), np.array(back.offset, object)
        if not self.has_signals:
            # Neighbours read x - offset, after the step.
            offset = offset - of_mirror
        if self.leads:
            # Followers measured their errors from the leader's x - offset.
            begin = stride(len(self.rows.message), LANES[self.graph.bits])
            of_place = self._leaf(range(begin, begin + len(measured)), "contribution")
            x[measured] += of_place
            offset[measured] -= of_place
        if len(rows.place):
            place = [*inputs.x[measured], *inputs.offset[measured]]
        memory = jax.tree.leaves(back.memory, is_leaf=lambda part: isinstance(part, list))
        stores = dict(zip(rows.state, x, strict=True))
        stores |= zip(rows.memory, functools.reduce(operator.add, memory, []), strict=False)
        stores |= zip(rows.disagreement, back.z, strict=False)
        return Body(
            stores=stores | dict(zip(rows.place, place, strict=True)),
            sums=dict(zip(rows.offset, offset, strict=False)),
            mirror=[*back.z, *place],
            to_sources=[] if self.leads else back.message,
            to_leaders=[] if self.leads else [back.leader[k] for k in measured],
            totals={k: n for k, n in enumerate(of_varying) if not _is_zero(n)},
            mirror_before=self._mirror_before(),
            difference=self._difference(),
        )


def _is_zero(node: Node) -> bool:
    return node.op == "constant" and node.value == 0.0
