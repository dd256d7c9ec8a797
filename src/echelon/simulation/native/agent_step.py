"""The step of one agent as scalar operations, and the rows of a block that hold its numbers.

It is traced from the same laws, model, integrator and meter that `step.loop` runs.
"""

import functools
import itertools
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from echelon.core.types import Array, PyTree
from echelon.laws.law import Law, LocalView, Memory
from echelon.laws.law_check import signal_size as numbers_said
from echelon.simulation.codegen import Body, factored
from echelon.simulation.native.varying import VaryingNumbers
from echelon.simulation.scalars import (
    Node,
    ScalarGraph,
    Unsupported,
    lower,
    may_be_exception,
    needed,
    nodes,
)
from echelon.simulation.step.loop import Loop
from echelon.simulation.step.own_members import own_members
from echelon.simulation.step.places import MovingPlaces
from echelon.simulation.step.run_laws import limit_sides
from echelon.simulation.step.turns import by_depth


class BlockRows(NamedTuple):
    """Where the numbers of an agent are in its block; each a range of rows.

    Attributes:
        state: x (n,).
        offset: of its goal (n,).
        push, noise: what wind adds to its rate (n,), and noise to its input (m,).
        memory: of its law, one number after the other.
        cut: to which side limits moved each input in the previous step (m,).
        message: what it sends besides its state.
        input: that is applied (m,).
        varying: numbers of its law and model that differ between formations.
        errors, tracking: as in `Sums`, but of the steps before the steady window and in it.
        effort, limited, unsettled, inside, chatter, outputs: as in `Sums`.
        peak: minus the largest squared error since the last event; empty without events.
        lowest, highest: as in `Sums`, the latter with its sign changed.
        exception: 1 where the numbers are not what JAX computes.
        total: how many rows there are.
    """

    state: range
    offset: range
    push: range
    noise: range
    memory: range
    cut: range
    message: range
    input: range
    varying: range
    errors: range
    effort: range
    limited: range
    unsettled: range
    inside: range
    chatter: range
    peak: range
    lowest: range
    highest: range
    tracking: range
    outputs: range
    exception: range
    total: int

    @classmethod
    def of(cls, loop: Loop, varying: int = 0) -> "BlockRows":
        """Return a loop's rows; `Unsupported` if memory is not numbers, or messages take time."""
        check_information(loop)
        if not loop.motion.ideal:
            raise Unsupported(
                "substeps, actuators that lag, correlated wind, air, or agents that differ"
            )
        n, m = len(loop.model.state_names), len(loop.model.input_names)
        weather, q = loop.motion.weather, len(loop.model.output_names)
        noisy = any(part.noise is not None for part in weather)
        memory = max(memory_size(law) for law in (loop.laws.leader, loop.laws.follower))
        sizes = [n, n, n if weather else 0, m if noisy else 0, memory, m]
        sizes += [
            loop.laws.message_size(loop.model, jax.eval_shape(loop.laws.leader.init)),
            m,
            varying,
        ]
        sizes += [2, 1, 1, 1, len(loop.meter.charted), 1]
        sizes += [min(1, len(loop.meter.events)), *[loop.meter.extremes] * 2, 2, q, 1]
        ends = np.cumsum([0, *sizes]).tolist()
        return cls._make([*(range(a, b) for a, b in itertools.pairwise(ends)), ends[-1]])


def check_information(loop: Loop) -> None:
    """Raise `Unsupported` unless agents know exact states, current messages, and nothing else."""
    for fault, text in (
        (isinstance(loop.places, MovingPlaces), "formations that change with time"),
        (loop.network.late, "a network that is not ideal"),
        (own_members(loop), f"the member `{own_members(loop)}` of your own"),
        (loop.sensing.stages, "agents that measure their states late or with noise"),
    ):
        if fault:
            raise Unsupported(text)
    check_distances(loop)


def check_distances(loop: Loop) -> None:
    """Raise `Unsupported` if agents keep distances, come or go, or have backup leaders."""
    changes = loop.roster.changes or loop.laws.backups
    for fault, text in (
        (loop.surroundings.keeps_apart, "agents that keep away from each other"),
        (changes, "agents that are lost, join or take the lead"),
    ):
        if fault:
            raise Unsupported(text)


def memory_size(law: Law) -> int:
    """Return how many numbers a law's memory has; `Unsupported` of others, as a random key."""
    leaves = jax.tree.leaves(jax.eval_shape(law.init))
    for leaf in leaves:
        if not jnp.issubdtype(leaf.dtype, jnp.floating):
            raise Unsupported(f"a memory of the type {leaf.dtype}")
    return sum(leaf.size for leaf in leaves)


def unflatten(like: PyTree, flat: Array | jax.Array) -> PyTree:
    """Return a tree of the structure and shapes of another, or many, from numbers (..., k)."""
    leaves, tree = jax.tree.flatten(like)
    ends = np.cumsum([0, *(np.size(leaf) for leaf in leaves)]).tolist()
    parts = zip(leaves, ends[:-1], ends[1:], strict=True)
    return tree.unflatten(
        [flat[..., a:b].reshape((*flat.shape[:-1], *np.shape(leaf))) for leaf, a, b in parts]
    )


def signal_size(loop: Loop) -> int:
    """Return how many numbers neighbours receive from an agent besides its state."""
    size = numbers_said(loop.laws.follower, loop.model) if loop.laws.speech.signals else 0
    return size or 0


def _signal_of(loop: Loop, law: Law, x: jax.Array, offset: jax.Array, memory: Memory) -> jax.Array:
    speech = loop.laws.speech
    if not speech.signals:
        return jnp.zeros(0, x.dtype)
    return speech.of_one(law, loop.model, x, offset, memory)


Entries: TypeAlias = Any
"""A traced array, an array of nodes, or a list of nodes."""


class StepInputs(NamedTuple):
    """What an agent's step depends on, entry by entry: arrays of nodes, or traced arrays."""

    t: Entries
    step: Entries
    steady: Entries
    reference: Entries
    x: Entries
    offset: Entries
    z: Entries
    message: Entries
    memory: Memory
    leader: Entries
    push: Entries
    noise: Entries
    previous_cut: Entries


class StepOutputs(NamedTuple):
    """The results of an agent's step."""

    state: Entries
    memory: Memory
    cut: Entries
    message: Entries
    input: Entries
    errors: Entries
    tracking: Entries
    outputs: Entries
    effort: Entries
    limited: Entries
    unsettled: Entries
    inside: Entries
    deviation: Entries
    chatter: Entries
    signal: Entries
    next_signal: Entries


def agent_step(loop: Loop, leads: bool) -> Callable[[StepInputs], StepOutputs]:
    """Return the step of a leader, or of another agent, as a function for JAX."""
    law = loop.laws.leader if leads else loop.laws.follower
    model, motion, meter = loop.model, loop.motion, loop.meter

    def step(inputs: StepInputs) -> StepOutputs:
        x, offset = inputs.x, inputs.offset
        view = LocalView(inputs.t, x, offset, inputs.z, inputs.message, motion.dt)
        rows = law, view, inputs.memory, leads
        desired, u, memory, message = loop.laws.act(model, motion, *rows)
        limited, cut = limit_sides(model, u, desired)
        metered = meter.of_agent(inputs.step, inputs.steady, x, offset, inputs.leader, u)
        tracking, outputs = jnp.zeros(2), jnp.zeros(len(model.output_names))
        if inputs.reference is not None:
            tracking, outputs = meter.of_leader(inputs.steady, x, offset, inputs.reference)
        still = not motion.weather
        field = motion.plant.velocity if still else motion.pushed(inputs.push, inputs.noise)
        state, _ = motion.motors.integrate(field, (), x, u, motion)
        return StepOutputs(
            state=state,
            memory=memory,
            cut=cut,
            message=message,
            input=u,
            errors=metered.errors,
            tracking=tracking,
            outputs=outputs,
            effort=metered.effort,
            limited=jnp.where(limited.any(), 1.0, 0.0),
            unsettled=metered.unsettled,
            inside=metered.inside,
            deviation=metered.deviation,
            chatter=jnp.where((cut * inputs.previous_cut < 0.0).any(), 1.0, 0.0),
            signal=_signal_of(loop, law, x, offset, inputs.memory),
            next_signal=_signal_of(loop, law, state, offset, memory),
        )

    return step


def body_of(
    varying: VaryingNumbers, bits: int, rows: BlockRows, leads: bool, follows: bool
) -> Body:
    """Return what the leaders or all others compute in a step.

    Args:
        varying: the loop of the run, and its numbers that differ between formations.
        bits: 64 or 32.
        rows: where the numbers of an agent are.
        leads: whether it is the body of the leaders.
        follows: whether they follow a reference, which is in the table.

    Raises:
        Unsupported: the law or the model has no scalar operations.
    """
    graph, loop = ScalarGraph(bits), varying.loop
    law = loop.laws.leader if leads else loop.laws.follower
    inputs = _step_inputs(loop, graph, rows, law, leads, follows)

    def step(leaves: list[jax.Array], inputs: StepInputs) -> StepOutputs:
        return agent_step(varying.filled(leaves), leads)(inputs)

    leaves = varying.leaves(leaves_of(graph, "row", rows.varying))
    results = lower(step, graph, [leaves, inputs])
    shapes = jax.tree.structure(StepOutputs(*[0] * 16)._replace(memory=law.init()))
    outputs: StepOutputs = shapes.unflatten([nodes(graph, part) for part in results])
    memory = jax.tree.leaves(outputs.memory, is_leaf=lambda part: isinstance(part, list))
    stores = {"state": outputs.state, "memory": sum(memory, start=[])}
    # Where no limit is, nothing was ever cut.
    if any(node is not graph.constant(0.0) for node in outputs.cut):
        stores["cut"] = outputs.cut
    # Steps ascend, so that the later one replaces the earlier one; -1 is no step.
    earlier = leaves_of(graph, "row", rows.unsettled)
    none = [graph.make("lt", step, 0.0) for step in outputs.unsettled]
    pairs = zip(none, earlier, outputs.unsettled, strict=True)
    stores["unsettled"] = [graph.make("select", *each) for each in pairs]
    # Unless inputs are passed on from parents, nobody reads the message of a follower.
    if leads or by_depth(loop):
        stores["message"] = outputs.message
    sums = {name: getattr(outputs, name) for name in ("effort", "limited", "chatter")}
    sums |= {"errors": _before_and_in_window(inputs, outputs.errors)}
    if leads and follows:
        tracking = _before_and_in_window(inputs, outputs.tracking)
        sums |= {"tracking": tracking, "outputs": outputs.outputs}
    # Rows of the smallest numbers serve for the largest too.
    minima = {"inside": outputs.inside, "lowest": outputs.deviation}
    largest = {"peak": outputs.errors[: len(rows.peak)], "highest": outputs.deviation}
    minima |= {name: [graph.make("sub", 0.0, x) for x in part] for name, part in largest.items()}
    subtract = functools.partial(map, functools.partial(graph.make, "unfused_sub"))
    body = Body(
        stores=_placed(rows, stores),
        sums=_placed(rows, sums),
        minima=_placed(rows, minima),
        on_request=_placed(rows, {"input": outputs.input}),
        tape=dict(enumerate(inputs.x[list(loop.meter.paired)].tolist())),
        mirror_before=[*subtract(inputs.x, inputs.offset), *outputs.signal],
        mirror=[*subtract(outputs.state, inputs.offset), *outputs.next_signal],
        difference=_difference(loop, graph, len(inputs.x), len(outputs.signal)),
    )
    body = body._replace(exceptions=exceptions_of(graph, body))
    return body.map_nodes(factored(body.all()))


def _before_and_in_window(inputs: StepInputs, sums: list[Node]) -> list[Node]:
    """Split sums into before and in the steady window: each step adds to one of the two only."""
    all_, steady = sums
    return [all_.graph.make("select", inputs.steady[()], 0.0, all_), steady]


def _difference(loop: Loop, graph: ScalarGraph, states: int, signals: int) -> list[Node]:
    """Return the differences of what neighbours read: of states by the model, of signals plain."""
    # Of the first loop's model: the difference of two states is the same for all formations.
    kinds = "self", "neighbour"
    mine, theirs = (leaves_of(graph, kind, range(states + signals)) for kind in kinds)
    [difference] = lower(loop.model.difference, graph, [mine[:states], theirs[:states]])
    plain = zip(mine[states:], theirs[states:], strict=True)
    return [*nodes(graph, difference), *(graph.make("sub", a, b) for a, b in plain)]


def _step_inputs(
    loop: Loop, graph: ScalarGraph, rows: BlockRows, law: Law, leads: bool, follows: bool
) -> StepInputs:
    n, signals = len(rows.state), signal_size(loop)

    def row(places: range) -> np.ndarray:
        return leaves_of(graph, "row", places)

    x, offset, size = row(rows.state), row(rows.offset), memory_size(law)
    # A truth and not a number, since it chooses between sums.
    late = graph.make("ne", graph.leaf("steady", uniform=True), 0.0)
    return StepInputs(
        t=single(graph.leaf("time", uniform=True)),
        step=single(graph.leaf("step", uniform=True)),
        steady=single(late),
        reference=leaves_of(graph, "table", range(n), True) if leads and follows else None,
        x=x,
        offset=offset,
        z=leaves_of(graph, "z", range(n, n + signals) if signals else range(n)),
        # A leader receives no input of another agent.
        message=np.zeros(len(rows.input))
        if leads
        else leaves_of(graph, "message", range(len(rows.message))),
        memory=unflatten(law.init(), row(rows.memory[:size])),
        # A leader is its own leader, so that its error is zero.
        leader=x - offset if leads else leaves_of(graph, "leader", range(n)),
        push=row(rows.push) if len(rows.push) else None,
        noise=row(rows.noise) if len(rows.noise) else None,
        previous_cut=row(rows.cut),
    )


def leaves_of(
    graph: ScalarGraph, kind: str, places: Sequence[int], uniform: bool = False
) -> np.ndarray:
    """Return leaves of one kind, one for each place."""
    entries = np.empty(len(places), object)
    entries[:] = [graph.leaf(kind, place, uniform=uniform) for place in places]
    return entries


def single(node: Node) -> np.ndarray:
    """Return a node as an array without axes."""
    array = np.empty((), object)
    array[()] = node
    return array


def _placed(rows: BlockRows, named: dict[str, list[Node]]) -> dict[int, Node]:
    return {
        row: node
        for name, entries in named.items()
        for row, node in zip(getattr(rows, name), entries, strict=name != "memory")
    }


_SIZES = (1e9, 1e6, 1e3)
"""Sizes of what neighbours read, of which the first is taken for which a difference is right."""


def exceptions_of(graph: ScalarGraph, body: Body) -> list[Node]:
    """Return where an agent's numbers are not what JAX computes; `Unsupported` if not known."""
    truths, false = graph.exceptions_of(body.results()), graph.constant(False)
    truths += _between(graph, body)
    uniform = [truth for truth in truths if truth.uniform]
    truths = [truth for truth in truths if not truth.uniform]
    # One truth of a step for all agents.
    return [*truths, functools.reduce(functools.partial(graph.make, "or"), uniform, false)]


def _between(graph: ScalarGraph, body: Body) -> Iterator[Node]:
    """Yield where what neighbours read of an agent is too large for the differences of two."""
    inside = [node for node in needed(body.difference) if node in graph.exceptions]
    if not inside:
        return
    for size in _SIZES:
        if not any(may_be_exception(graph, node, size) for node in inside):
            break
    else:
        raise Unsupported("a `difference` with angles of which no bound is known")
    for mine in body.mirror_before:
        yield graph.make("lt", size, graph.make("abs", mine))
