"""How what one agent felt of a step is pulled back through it, as scalars: the step's transpose.

It is `jax.vjp` of the very step that is run (`scalars.agent_step`), so that its derivatives are
those of JAX. Of the step itself it finds on a tape what it rests on.
"""

import functools
import operator
from typing import Any, NamedTuple, final

import jax
import jax.numpy as jnp
import numpy as np

from echelon.core.types import Array
from echelon.simulation.codegen import Body, from_tape, stride
from echelon.simulation.native.agent_step import (
    BlockRows,
    StepInputs,
    agent_step,
    known_of,
    leaves_of,
    memory_size,
    own_leaves,
    shaped,
    signals_of,
    single,
)
from echelon.simulation.native.kernel_cache import LANES
from echelon.simulation.native.varying import VaryingNumbers
from echelon.simulation.scalars import Node, ScalarGraph, Unsupported, lower, nodes
from echelon.simulation.step.loop import Loop
from echelon.simulation.step.meter import spacing_error


class CotangentRows(NamedTuple):
    """Where the slopes of an agent lie in its block on the way back; each a range of rows.

    Attributes:
        state, memory: the slopes along what the step before made of it.
        offset: along its goal's offset, added up, where that is wanted.
        heard: along its disagreement at the step after this, where it is asked for again.
        place: its position then and that of its goal, where slopes along distances are wanted.
        lean: by how much weight it then heard more than it was heard, where some do.
        spacing, errors, tracking, outputs, effort: along what it adds to `Sums` at each step.
        total: how many rows there are.
    """

    state: range
    memory: range
    offset: range
    heard: range
    place: range
    lean: range
    spacing: range
    errors: range
    tracking: range
    outputs: range
    effort: range
    total: int

    @classmethod
    def of(cls, loop: Loop, rows: BlockRows, spaced: bool, moved: bool) -> "CotangentRows":
        """Return the rows of a loop of such rows, `spaced` with `place`, `moved` with `offset`."""
        leaning, n, q = leans(loop), len(rows.state), len(loop.meter.measured)
        heard = heard_by(loop) * (leaning or spaced)
        sizes = [n, len(rows.memory), n * moved, heard, 2 * q * spaced]
        sizes += [int(leaning), 1, 2, 2, len(rows.outputs), 1]
        ends = np.cumsum([0, *sizes]).tolist()
        found: Any = [*(range(a, b) for a, b in zip(ends[:-1], ends[1:], strict=True)), ends[-1]]
        return cls(*found)


def heard_by(loop: Loop) -> int:
    """Return of how many numbers an agent's disagreement is."""
    return signals_of(loop) or len(loop.model.state_names)


def leans(loop: Loop) -> bool:
    """Tell whether some agent hears more, or less, than it is heard."""
    return bool(lean(loop).any())


def lean(loop: Loop) -> Array:
    """Return by how much weight each agent hears more than it is heard, (stretches, N)."""
    exchange, agents = loop.exchange, len(loop.offsets)

    def sums(ends: Array, weights: Array) -> Array:
        return np.bincount(np.asarray(ends), weights, agents)

    rows = np.atleast_2d(np.asarray(exchange.weights))
    return np.stack([sums(exchange.receivers, w) - sums(exchange.senders, w) for w in rows])


class _Moving(NamedTuple):
    """What of an agent's step there are slopes along."""

    x: Any
    offset: Any
    z: Any
    told: Any
    memory: Any
    leader: Any


_SMOOTH = ("state", "memory", "tell", "errors", "tracking", "outputs", "effort", "saying")
"""What of a step there are slopes of; the rest is counted."""


class TransposedStep(NamedTuple):
    """The transpose of a step: its body, and the leaves that the step leaves on its tape."""

    body: Body
    kept: list[tuple[str, int]]


@final
class Transpose:
    """What makes the transpose of the leaders' or of all others' step.

    Args:
        own: the loop, and its numbers along which slopes are wanted.
        bits: 64 or 32.
        rows: where the numbers of an agent lie in a step.
        felt: where its slopes lie on the way back.
        leads: whether leaders are meant.
        follows: whether they follow a reference, which stands in the table.
    """

    def __init__(
        self,
        own: VaryingNumbers,
        bits: int,
        rows: BlockRows,
        felt: CotangentRows,
        leads: bool,
        follows: bool,
    ) -> None:
        """Begin a graph."""
        self.own, self.loop, self.rows, self.felt = own, own.loop, rows, felt
        self.leads, self.follows, self.graph = leads, follows, ScalarGraph(bits)
        self.law = own.loop.leader if leads else own.loop.follower
        self.signals, self.measured = signals_of(own.loop), own.loop.meter.measured

    def made(self) -> TransposedStep:
        """Return the transpose.

        What is added to totals are the slopes along the numbers of the loop's own, leaf by leaf.

        Raises:
            Unsupported: the law or the model uses what has no scalar operations.
        """
        self._check_difference()
        known = known_of(self.loop, self.graph, self.rows, self.law, self.leads, self.follows)
        moving = _Moving(*(getattr(known, name) for name in _Moving._fields))
        leaves = own_leaves(self.own, self.graph, self.rows, self.follows, True)
        after = self._after()
        arguments = [leaves, known, moving, self._given(after)]
        found = [nodes(self.graph, part) for part in lower(self._pull, self.graph, arguments)]
        tree = jax.tree.structure(moving, is_leaf=lambda part: isinstance(part, np.ndarray))
        along = [node for part in found[: len(leaves)] for node in part]
        body = self._body(known, tree.unflatten(found[len(leaves) :]), after, along)
        return TransposedStep(*from_tape(body, {"felt": "row", "heard": "z"}))

    def _pull(self, leaves: list[Any], known: StepInputs, moving: _Moving, given: Any) -> Any:
        def act(leaves: list[Any], moving: _Moving) -> tuple[Any, ...]:
            step = agent_step(self.own.filled(leaves), self.leads)
            done = step(known._replace(**moving._asdict()))
            return tuple(getattr(done, name) for name in _SMOOTH)

        return jax.vjp(act, leaves, moving)[1](given)

    def _leaf(self, places: range, kind: str = "felt") -> np.ndarray:
        return leaves_of(self.graph, kind, places)

    # ---- what neighbours felt ----

    def _check_difference(self) -> None:
        """Refuse a difference of states whose slopes are not 1 along the one, -1 along the other.

        Raises:
            Unsupported: so it is.
        """
        if self.signals:
            return
        n, difference = len(self.rows.state), self.loop.model.difference
        given = [self._leaf(range(n), kind) for kind in ("own", "their", "felt")]

        def pull(own: Any, their: Any, felt: Any) -> Any:
            return jax.vjp(difference, own, their)[1](felt)

        found = [nodes(self.graph, part) for part in lower(pull, self.graph, given)]
        if found != [list(given[2]), [-node for node in given[2]]]:
            raise Unsupported("a `difference` of states that is not x - y but for whole turns")

    def _after(self) -> np.ndarray:
        """Return the slopes along what neighbours read after a step."""
        heard = heard_by(self.loop)
        found = self._leaf(range(heard), "heard")
        if not len(self.felt.lean):
            return found
        # What is gathered has as many of one's own as one was heard by, and not as one heard.
        return found + self._leaf(self.felt.lean) * self._leaf(self.felt.heard)

    def _now(self, heard: int) -> list[Node]:
        """Return what neighbours read of an agent at hand."""
        if not len(self.felt.place):
            # Plain differences are gathered from memory alone.
            return [self.graph.constant(0.0)] * heard
        return [*self._leaf(self.felt.heard), *self._leaf(self.felt.place)]

    def _difference(self) -> list[Node]:
        """Return what is gathered of what neighbours show, entry by entry."""
        heard, q = heard_by(self.loop), len(self.measured)
        own, their = (self._leaf(range(heard + 2 * q), kind) for kind in ("own", "their"))
        plain = [self.graph.make("sub", a, b) for a, b in zip(own, their, strict=True)]
        if not len(self.felt.place):
            return plain[:heard]

        def pull(own: Any, their: Any) -> Any:
            goals = jnp.sqrt(jnp.sum((own[q:] - their[q:]) ** 2))
            return jax.grad(lambda p: spacing_error(jnp.sum((p - their[:q]) ** 2), goals))(own[:q])

        [apart] = lower(pull, self.graph, [own[heard:], their[heard:]])
        return [*plain[:heard], *nodes(self.graph, apart)]

    # ---- the step ----

    def _given(self, after: np.ndarray) -> tuple[Any, ...]:
        """Return the slopes along what a step comes to, in the order of `_SMOOTH`."""
        felt, told = self.felt, range(len(self.rows.tell))
        feeds = self.leads or self.loop.levels is not None
        reads = self.leads and self.follows
        state = self._leaf(felt.state)
        if len(felt.place):
            heard = heard_by(self.loop)
            apart = self._leaf(range(heard, heard + len(self.measured)), "heard")
            state[list(self.measured)] += self._leaf(felt.spacing) * apart
        return (
            state if self.signals else state + after,
            shaped(self._leaf(felt.memory[: memory_size(self.law)]), self.law.init()),
            self._leaf(told, "fed") if feeds else np.zeros(len(told)),
            self._leaf(felt.errors),
            self._leaf(felt.tracking) if reads else np.zeros(2),
            self._leaf(felt.outputs) if reads else np.zeros(len(self.rows.outputs)),
            single(self._leaf(felt.effort)[0]),
            after if self.signals else np.zeros(0),
        )

    def _body(self, known: StepInputs, back: _Moving, after: np.ndarray, along: list[Node]) -> Body:
        """Return the body, of the slopes that a step's have become."""
        felt, measured, place = self.felt, list(self.measured), list[Node]()
        x, offset = np.array(back.x, object), np.array(back.offset, object)
        if not self.signals:
            # What neighbours read is x - offset, after the step.
            offset = offset - after
        if self.leads:
            # What followers measured their errors from is its own x - offset.
            begin = stride(len(self.rows.tell), LANES[self.graph.bits])
            fed = self._leaf(range(begin, begin + len(measured)), "fed")
            x[measured] += fed
            offset[measured] -= fed
        if len(felt.place):
            place = [*known.x[measured], *known.offset[measured]]
        memory = jax.tree.leaves(back.memory, is_leaf=lambda part: isinstance(part, list))
        stores = dict(zip(felt.state, x, strict=True))
        stores |= zip(felt.memory, functools.reduce(operator.add, memory, []), strict=False)
        stores |= zip(felt.heard, back.z, strict=False)
        return Body(
            stores=stores | dict(zip(felt.place, place, strict=True)),
            sums=dict(zip(felt.offset, offset, strict=False)),
            greatest={},
            least={},
            shown={},
            now=self._now(len(back.z)),
            mirror=[*back.z, *place],
            difference=self._difference(),
            totals={k: node for k, node in enumerate(along) if not _is_nothing(node)},
            to_sources=[] if self.leads else back.told,
            to_leaders=[] if self.leads else [back.leader[k] for k in measured],
        )


def _is_nothing(node: Node) -> bool:
    """Tell whether a slope is always 0."""
    return node.op == "constant" and node.value == 0.0
