"""What one agent does in a step, as scalars, and the rows of a block where they lie.

It is traced from the same laws, model, integrator and meter that `loop` runs.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from echelon.core.types import Array
from echelon.laws.law import Law, LocalView, Memory
from echelon.simulation.codegen import Body, shortened
from echelon.simulation.native.varying import VaryingNumbers
from echelon.simulation.scalars import Node, ScalarGraph, Unsupported, lower, nodes
from echelon.simulation.step.action import act, feedforward_of, limit_sides
from echelon.simulation.step.loop import Loop


class BlockRows(NamedTuple):
    """Where the numbers of an agent lie in its block; each a range of rows.

    Attributes:
        state: x (n,).
        offset: its goal's (n,).
        push, noise: what wind adds to its rate (n,), and noise to its input (m,).
        memory: of its law, one number after the other.
        cut: to which side limits moved each input in the step before (m,).
        tell: what it sends besides its state.
        input: what is delivered to it (m,).
        own: numbers of its law and model that are others in other formations.
        errors, tracking: as in `Sums`, but of the steps before the steady window and in it.
        effort, limited, unsettled, inside, chatter, outputs: as in `Sums`.
        total: how many rows there are.
    """

    state: range
    offset: range
    push: range
    noise: range
    memory: range
    cut: range
    tell: range
    input: range
    own: range
    errors: range
    effort: range
    limited: range
    unsettled: range
    inside: range
    chatter: range
    tracking: range
    outputs: range
    total: int

    @classmethod
    def of(cls, loop: Loop, own: int = 0) -> "BlockRows":
        """Return the rows of a loop of which so many numbers differ between formations.

        Raises:
            Unsupported: a law remembers what is no number, or messages take time.
        """
        if loop.channel is not None:
            raise Unsupported("a network that is not ideal")
        n, m = len(loop.model.state_names), len(loop.model.input_names)
        wind, q = loop.motion.wind, len(loop.model.output_names)
        noisy = wind is not None and wind.noise is not None
        memory = max(memory_size(law) for law in (loop.leader, loop.follower))
        sizes = [n, n, n if wind else 0, m if noisy else 0, memory, m, told_by(loop), m, own]
        sizes += [2, 1, 1, 1, len(loop.meter.charted), 1, 2, q]
        ends = np.cumsum([0, *sizes]).tolist()
        rows: Any = [*(range(a, b) for a, b in zip(ends[:-1], ends[1:], strict=True)), ends[-1]]
        return cls(*rows)


def memory_size(law: Law) -> int:
    """Return how many numbers one agent under a law remembers.

    Raises:
        Unsupported: it remembers what is no number, such as a random key.
    """
    leaves = jax.tree.leaves(law.init())
    for leaf in leaves:
        if not jnp.issubdtype(jnp.asarray(leaf).dtype, jnp.floating):
            raise Unsupported(f"a memory of the type {jnp.asarray(leaf).dtype}")
    return sum(np.size(leaf) for leaf in leaves)


def memories_of(like: Memory, flat: Array) -> Memory:
    """Return memories of agents, alike to one, from their numbers (agents, numbers)."""
    leaves, tree = jax.tree.flatten(like)
    ends = np.cumsum([0, *(np.size(leaf) for leaf in leaves)]).tolist()
    parts = zip(leaves, ends[:-1], ends[1:], strict=True)
    return tree.unflatten(
        [flat[:, a:b].reshape(len(flat), *np.shape(leaf)) for leaf, a, b in parts]
    )


def told_by(loop: Loop) -> int:
    """Return how many numbers an agent sends besides its state."""
    n, m = len(loop.model.state_names), len(loop.model.input_names)
    turning = loop.follower.turning

    # Of what is told alone: a trace of all that a leader does takes as long as the code of it.
    def told(x: Any, v: Any) -> Any:
        follower = loop.follower.facing(x[0]) if turning else loop.follower
        return feedforward_of(follower, loop.model, x, v, loop.leader.init())

    return jax.eval_shape(told, np.zeros(n), np.zeros(m)).shape[0] + turning


def signals_of(loop: Loop) -> int:
    """Return how many numbers neighbours hear of an agent besides its state."""
    nothing = jnp.zeros(len(loop.model.state_names))
    law = loop.follower
    said = jax.eval_shape(lambda: _said(loop, law, nothing, nothing, law.init()))
    return said.shape[0]


def _said(loop: Loop, law: Law, x: Any, offset: Any, memory: Memory) -> Any:
    """Return the signal of an agent, of no numbers where it has none."""
    signal = law.signal(loop.model, x, offset, memory)
    return jnp.zeros(0, x.dtype) if signal is None else signal


class StepInputs(NamedTuple):
    """What an agent's step rests on, entry by entry."""

    t: Any
    step: Any
    steady: Any
    wanted: Any
    x: Any
    offset: Any
    z: Any
    told: Any
    memory: Memory
    leader: Any
    push: Any
    noise: Any
    before: Any


class StepOutputs(NamedTuple):
    """What it comes to."""

    state: Any
    memory: Memory
    cut: Any
    tell: Any
    input: Any
    errors: Any
    tracking: Any
    outputs: Any
    effort: Any
    limited: Any
    unsettled: Any
    inside: Any
    chatter: Any
    said: Any
    saying: Any


def agent_step(loop: Loop, leads: bool) -> Callable[[StepInputs], StepOutputs]:
    """Return what a leader or another agent does in a step, as a function for JAX."""
    law = loop.leader if leads else loop.follower
    model, motion, meter = loop.model, loop.motion, loop.meter

    def step(known: StepInputs) -> StepOutputs:
        x, offset = known.x, known.offset
        view = LocalView(known.t, x, offset, known.z, known.told, motion.dt)
        desired, u, memory, told = act(loop, law, view, known.memory, leads)
        limited, cut = limit_sides(u, desired)
        read = meter.of_agent(known.step, known.steady, x, offset, known.leader, u)
        tracking, outputs = jnp.zeros(2), jnp.zeros(len(model.output_names))
        if known.wanted is not None:
            tracking, outputs = meter.of_leader(known.steady, x, offset, known.wanted)
        state = motion.move(x, u, known.push, known.noise)
        return StepOutputs(
            state=state,
            memory=memory,
            cut=cut,
            tell=told,
            input=u,
            errors=read.errors,
            tracking=tracking,
            outputs=outputs,
            effort=read.effort,
            limited=jnp.where(limited.any(), 1.0, 0.0),
            unsettled=read.unsettled,
            inside=read.inside,
            chatter=jnp.where((cut * known.before < 0.0).any(), 1.0, 0.0),
            said=_said(loop, law, x, offset, known.memory),
            saying=_said(loop, law, state, offset, memory),
        )

    return step


def body_of(
    own: VaryingNumbers,
    bits: int,
    rows: BlockRows,
    leads: bool,
    follows: bool,
    tabled: bool = False,
) -> Body:
    """Return what the leaders or all others do in a step.

    Args:
        own: the loop of the run, and its numbers that differ between formations.
        bits: 64 or 32.
        rows: where its numbers lie.
        leads: whether leaders are meant.
        follows: whether they follow a reference, which stands in the table.
        tabled: whether the loop's own numbers are the same for all, and stand there behind it.

    Raises:
        Unsupported: the law or the model uses what has no scalar operations.
    """
    graph, loop = ScalarGraph(bits), own.loop
    law = loop.leader if leads else loop.follower
    known = known_of(loop, graph, rows, law, leads, follows)

    def act(leaves: list[Any], known: StepInputs) -> StepOutputs:
        return agent_step(own.filled(leaves), leads)(known)

    found = lower(act, graph, [own_leaves(own, graph, rows, follows, tabled), known])
    shapes = jax.tree.structure(StepOutputs(*[0] * 15)._replace(memory=law.init()))
    done: StepOutputs = shapes.unflatten([nodes(graph, part) for part in found])
    remembered = jax.tree.leaves(done.memory, is_leaf=lambda part: isinstance(part, list))
    stores = {"state": done.state, "cut": done.cut, "memory": sum(remembered, start=[])}
    if leads or loop.levels is not None:
        stores["tell"] = done.tell
    sums = {name: getattr(done, name) for name in ("effort", "limited", "chatter")}
    sums |= {"errors": _parted(known, done.errors)}
    if leads and follows:
        sums |= {"tracking": _parted(known, done.tracking), "outputs": done.outputs}
    apart = functools.partial(map, functools.partial(graph.make, "apart"))
    body = Body(
        stores=_placed(rows, stores),
        sums=_placed(rows, sums),
        greatest=_placed(rows, {"unsettled": done.unsettled}),
        least=_placed(rows, {"inside": done.inside}),
        shown=_placed(rows, {"input": done.input}),
        now=[*apart(known.x, known.offset), *done.said],
        mirror=[*apart(done.state, known.offset), *done.saying],
        difference=_difference(loop, graph, len(known.x), len(done.said)),
    )
    return body.become(shortened(body.all()))


def _parted(known: StepInputs, twice: list[Node]) -> list[Node]:
    """Return a number of all steps and of the steady window as one before and one in it.

    Only one of the two is then added to at a step.
    """
    all_, steady = twice
    return [all_.graph.make("select", known.steady[()], 0.0, all_), steady]


def own_leaves(
    own: VaryingNumbers, graph: ScalarGraph, rows: BlockRows, follows: bool, tabled: bool
) -> list[np.ndarray]:
    """Return the leaves of a loop in which numbers are its own: in rows, or in the table."""
    begin = len(rows.state) if follows else 0
    places = range(begin, begin + own.count) if tabled else rows.own
    return own.leaves(leaves_of(graph, "table" if tabled else "row", places, tabled))


def _difference(loop: Loop, graph: ScalarGraph, states: int, signals: int) -> list[Node]:
    """Return the differences of what neighbours read: of states by the model, of signals plain."""
    # Of the model as it is: how far two states are apart is the same for all formations.
    own, their = (leaves_of(graph, kind, range(states + signals)) for kind in ("own", "their"))
    [found] = lower(loop.model.difference, graph, [own[:states], their[:states]])
    plain = zip(own[states:], their[states:], strict=True)
    return [*nodes(graph, found), *(graph.make("sub", a, b) for a, b in plain)]


def known_of(
    loop: Loop, graph: ScalarGraph, rows: BlockRows, law: Law, leads: bool, follows: bool
) -> StepInputs:
    """Return what a step rests on as leaves of a graph."""
    n, signals = len(rows.state), signals_of(loop)

    def row(places: range) -> np.ndarray:
        return leaves_of(graph, "row", places)

    x, offset, size = row(rows.state), row(rows.offset), memory_size(law)
    late = graph.make("ne", graph.leaf("steady", uniform=True), 0.0)
    return StepInputs(
        t=single(graph.leaf("time", uniform=True)),
        step=single(graph.leaf("step", uniform=True)),
        steady=single(late),
        wanted=leaves_of(graph, "table", range(n), True) if leads and follows else None,
        x=x,
        offset=offset,
        z=leaves_of(graph, "z", range(n, n + signals) if signals else range(n)),
        # Nobody is before a leader whose input it could be sent.
        told=np.zeros(len(rows.input))
        if leads
        else leaves_of(graph, "told", range(len(rows.tell))),
        memory=shaped(row(rows.memory[:size]), law.init()),
        leader=x - offset if leads else leaves_of(graph, "leader", range(n)),
        push=row(rows.push) if len(rows.push) else None,
        noise=row(rows.noise) if len(rows.noise) else None,
        before=row(rows.cut),
    )


def leaves_of(
    graph: ScalarGraph, kind: str, places: Sequence[int], uniform: bool = False
) -> np.ndarray:
    """Return leaves of one kind, a number each."""
    entries = np.empty(len(places), object)
    entries[:] = [graph.leaf(kind, place, uniform=uniform) for place in places]
    return entries


def single(node: Node) -> np.ndarray:
    """Return a node as an array without axes."""
    array = np.empty((), object)
    array[()] = node
    return array


def shaped(entries: np.ndarray, like: Memory) -> Memory:
    """Return a memory whose numbers are entries, in the order of its tree."""
    leaves, tree = jax.tree.flatten(like)
    ends = np.cumsum([0, *(np.size(leaf) for leaf in leaves)]).tolist()
    parts = zip(leaves, ends[:-1], ends[1:], strict=True)
    return tree.unflatten([entries[a:b].reshape(np.shape(leaf)) for leaf, a, b in parts])


def _placed(rows: BlockRows, named: dict[str, list[Node]]) -> dict[int, Node]:
    """Return row -> node for the entries of each name."""
    return {
        row: node
        for name, entries in named.items()
        for row, node in zip(getattr(rows, name), entries, strict=name != "memory")
    }
