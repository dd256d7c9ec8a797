"""The step of one agent as scalar operations, and the rows of a block that hold its numbers.

It is traced from `step.sequence`, which steps all agents, with one row of each member. What an
agent remembers is one number after the other, whatever the members are. What depends on the step
and on its number alone, such as what is drawn, the host computes ahead.
"""

import dataclasses
import functools
import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple, TypeAlias, final

import jax
import jax.numpy as jnp
import numpy as np

from echelon.agents.network.exchange import Exchange
from echelon.core.types import Array, PyTree
from echelon.laws.law_check import signal_size
from echelon.simulation.codegen import Body, factored
from echelon.simulation.native.varying import VaryingNumbers
from echelon.simulation.scalars import (
    HostPart,
    Node,
    ScalarGraph,
    Unsupported,
    lower,
    may_be_exception,
    needed,
    nodes,
)
from echelon.simulation.step.alone import one_row
from echelon.simulation.step.leadership import NOBODY, FixedLeaders
from echelon.simulation.step.loop import IdealNetwork, Loop
from echelon.simulation.step.meter import ALWAYS
from echelon.simulation.step.networks import LateNetwork
from echelon.simulation.step.own_members import own_members
from echelon.simulation.step.places import MovingPlaces
from echelon.simulation.step.records import (
    Clock,
    ComponentMemory,
    Known,
    LawMemories,
    LeaderPackets,
    LeaderSpeech,
    LoopState,
    Mask,
    Messages,
    NetworkEstimate,
    Own,
    Steps,
    choose,
)
from echelon.simulation.step.roster import Everybody, Links
from echelon.simulation.step.sequence import act, begin, hear, held, saying
from echelon.simulation.step.turns import by_depth, lead

# ---- what native code cannot step ----------------------------------------------------------------

_OF_ONE = frozenset({"sensing", "motion"})
"""Members that are traced as they are, a user's too: each acts on one agent alone."""


def check_loop(loop: Loop) -> None:
    """Raise `Unsupported` of a loop that native code cannot step."""
    own = own_members(loop, _OF_ONE)
    if own:
        raise Unsupported(f"the member `{own}` of your own")
    check_distances(loop)


def check_distances(loop: Loop) -> None:
    """Raise `Unsupported` if agents need others' hulls."""
    if loop.surroundings.keeps_apart:
        raise Unsupported("agents that keep away from each other")


# ---- the rows of a block -------------------------------------------------------------------------


class BlockRows(NamedTuple):
    """Where the numbers of an agent are in its block; each a range of rows.

    Attributes:
        state: x (n,).
        offset: of its goal (n,), at the start.
        agent: all other numbers in which agents differ.
        memory: of its law, its sensors and its plant, one number after the other.
        sensed: what it knows of its state, what it says, and what it makes of its messages; none
            where it knows and says x.
        packet: of the newest message from a leader, what a leader says of itself, and over a late
            network when.
        cut: to which side limits moved each input in the previous step (m,).
        message: what it sends besides its state.
        input: that is applied (m,).
        varying: numbers of its law and model that differ between formations.
        here: whether it is there, where some come or go.
        lead: 1 while it leads, 2 where it takes the lead, where backup leaders do.
        sent: 1 while an agent that leads announces to it what it does.
        errors, tracking: as in `Sums`, but of the steps before the steady window and in it.
        effort, limited, unsettled, inside, chatter, outputs: as in `Sums`.
        peak: minus the largest squared error since the last event; empty without events.
        lowest, highest: as in `Sums`, the latter with its sign changed.
        exception: 1 where the numbers are not what JAX computes.
        total: how many rows there are.
    """

    state: range
    offset: range
    agent: range
    memory: range
    sensed: range
    packet: range
    cut: range
    message: range
    input: range
    varying: range
    here: range
    lead: range
    sent: range
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
    def of(
        cls, loop: Loop, memories: tuple[ComponentMemory, ComponentMemory], varying: int = 0
    ) -> "BlockRows":
        """Return a loop's rows, given what its agents remember."""
        n, m = len(loop.model.state_names), len(loop.model.input_names)
        sizes = [n, n, sum(map(row_size, agent_rows(loop)[1:])), max(map(memory_size, memories))]
        late = letter_sizes(loop)
        sizes += [sum(sensed_sizes(loop)) * listens_first(loop)]
        forward, announces = forward_size(loop), loop.network.announces
        packet = forward * announces if late is None else late.packet + 1
        sizes += [packet, m, forward, m, varying]
        sizes += [loop.roster.changes, loop.laws.backups, announces]
        sizes += [2, 1, 1, 1, len(loop.meter.charted), 1]
        sizes += [min(1, len(loop.meter.events)), *[loop.meter.extremes] * 2]
        sizes += [2, len(loop.model.output_names), 1]
        ends = np.cumsum([0, *sizes]).tolist()
        return cls._make([*(range(a, b) for a, b in itertools.pairwise(ends)), ends[-1]])


def agent_rows(loop: Loop) -> list[Array]:
    """Return the numbers in which agents differ, each with a row of each agent; offsets first."""
    return jax.tree.leaves((loop.places.rows, loop.motion.rows))


def row_size(leaf: Array | jax.Array) -> int:
    """Return how many numbers a row has."""
    return int(np.prod(np.shape(leaf)[1:]))


def listens_first(loop: Loop) -> bool:
    """Tell whether all agents sense and say before any of them acts.

    Otherwise what an agent says in the next step is known at the end of this one.
    """
    moves = isinstance(loop.places, MovingPlaces)
    return bool(loop.sensing.stages) or moves or loop.network.late


def forward_size(loop: Loop) -> int:
    """Return how many numbers a leader sends to its followers in the same step."""
    return loop.laws.message_size(loop.model, jax.eval_shape(loop.laws.leader.init))


class LetterSizes(NamedTuple):
    """How many numbers a letter has: a value for neighbours, and a packet that is passed on."""

    network: LateNetwork
    value: int
    packet: int

    @property
    def total(self) -> int:
        """With the stamps of both."""
        return self.value + self.packet + 2


def letter_sizes(loop: Loop) -> LetterSizes | None:
    """Return what letters contain; None where all is heard at once."""
    network = loop.network
    if not isinstance(network, LateNetwork):
        return None
    s, k, m = said_size(loop), forward_size(loop), len(loop.model.input_names)
    return LetterSizes(network, s, network.rules.content.size(s, k, m))


def sensed_sizes(loop: Loop) -> list[int]:
    """Return the sizes of what an agent knows before it acts.

    Its state, what it says, and over a late network where it expects its leader, the feed-forward,
    and whether it knows of a leader.
    """
    n, s, late = len(loop.model.state_names), said_size(loop), loop.network.late
    return [n, s, *[s, forward_size(loop), 1] * late]


def said_size(loop: Loop) -> int:
    """Return how many numbers an agent says."""
    n = len(loop.model.state_names)
    return (signal_size(loop.laws.follower, loop.model) or 0) if loop.laws.speech.signals else n


def shown_size(loop: Loop) -> int:
    """Return how many numbers neighbours read of an agent besides its state less its offset."""
    said = loop.laws.speech.signals or listens_first(loop)
    said = said and not loop.network.late
    return len(shown_goals(loop)) + said_size(loop) * said


def shown_goals(loop: Loop) -> tuple[int, ...]:
    """Return which of what neighbours read is a goal that changes; what is said comes behind."""
    n, moves = len(loop.model.state_names), isinstance(loop.places, MovingPlaces)
    return tuple(range(n, n + len(loop.meter.measured) * moves))


def memory_of(loop: Loop, leads: bool) -> ComponentMemory:
    """Return the memory of one agent, as shapes."""
    group = loop.laws.leaders if leads else loop.laws.followers
    if not len(group):
        return ComponentMemory(LawMemories((), ()))

    def begun() -> ComponentMemory:
        rows = [jnp.asarray(leaf)[:1] for leaf in agent_rows(loop)]
        own = _of_one(loop, leads, jnp.zeros((), jnp.int32), rows, _Hears(_first(leads), ()))
        return begin(own, jnp.zeros((1, len(loop.model.state_names)))).memory

    return jax.eval_shape(begun)


def memories_of(loop: Loop) -> tuple[ComponentMemory, ComponentMemory]:
    """Return that of a leader and of a follower; `Unsupported` if there is no native code."""
    check_loop(loop)
    memories = memory_of(loop, True), memory_of(loop, False)
    for memory in memories:
        memory_size(memory)
    return memories


def memory_size(memory: PyTree) -> int:
    """Return how many numbers a memory has; `Unsupported` of others, as a random key."""
    leaves = jax.tree.leaves(memory)
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


# ---- one agent -----------------------------------------------------------------------------------

Entries: TypeAlias = Any
"""A traced array, an array of nodes, or a list of nodes."""


@final
class _Present(Everybody):
    """Whether one agent is there, as it is given."""

    present: Any

    def here(self, step: jax.Array) -> Mask:
        """Return it."""
        return self.present


@final
class _Hears(IdealNetwork):
    """What one agent hears, as it is given."""

    estimate: Any

    def receive(self, loop: Loop, memory: PyTree, known: Known) -> tuple[NetworkEstimate, PyTree]:
        """Return it."""
        return self.estimate, memory


@final
class _Reads(LateNetwork):
    """What one agent makes of the newest packet, from which it knows of a leader."""

    packet: Any
    # Which of the rows take the lead.
    elected: Any

    def receive(self, loop: Loop, memory: PyTree, known: Known) -> tuple[NetworkEstimate, PyTree]:
        """Return it; what neighbours say is added up elsewhere."""
        nobody = jnp.zeros(1, jnp.int32)
        mail = self.rules.begin(nobody, 0, known.said, self.packet.content.shape[1])
        own = known.own._replace(number=nobody)
        stamp = jnp.where(self.elected, known.clock.now, self.packet.stamp)
        mail = mail._replace(packet=self.packet._replace(stamp=stamp))
        return self.rules.read(loop, mail, known._replace(own=own)), memory


@final
class _Writes(LateNetwork):
    """What one agent hears, and the letter that it writes, which is its memory."""

    packet: Any
    estimate: Any

    def receive(self, loop: Loop, memory: PyTree, known: Known) -> tuple[NetworkEstimate, PyTree]:
        """Return what it hears."""
        return self.estimate, memory

    def send(self, loop: Loop, memory: PyTree, known: Known, speech: LeaderSpeech) -> PyTree:
        """Return the letter, and when it is written."""
        packet, stamp = self.packet, known.clock.now
        mail = Messages(known.said, packet.leader, packet)
        content = self.rules.contents(loop, mail, known, speech)
        rows = jnp.zeros(1, jnp.int32), stamp, known.said, content
        difference = loop.laws.speech.difference(loop.model)
        sent, _ = self.rules.write(mail, known.heard, *rows, difference)
        return sent.value, sent.packet.content, sent.packet.stamp, stamp


def _network_of(loop: Loop, leads: bool, inputs: "StepInputs", acts: bool) -> IdealNetwork:
    """Return the network of one agent that hears what is given, before it acts or as it does."""
    z, late, elected = inputs.z[None], letter_sizes(loop), np.array([False])
    leading: Any = np.array([leads])
    if inputs.lead is not None:
        leading, elected = inputs.lead > 0.0, inputs.lead > 1.0
    first = FixedLeaders(leading)
    if late is None:
        return _Hears(first, NetworkEstimate(z, jnp.asarray(leading), inputs.message[None]))
    rules = dataclasses.replace(late.network.rules, leadership=first)
    # Whom it follows: itself or another one.
    leader = jnp.where(jnp.asarray(leading), 0, NOBODY)
    content, stamp = inputs.packet[None, :-1], inputs.packet[-1:]
    packet = LeaderPackets(leader, stamp, content, ())
    if not acts:
        return _Reads(first, rules, late.network.medium, packet, elected)
    _, said, expected, forward, knows = _parts(loop, inputs.sensed)
    if inputs.alone is not None:
        rows = said[None], expected[None], knows != 0.0
        z = jnp.where(inputs.alone, rules.alone(loop, *rows), z)
    rows = forward[None], expected[None], jnp.zeros(1, jnp.int32), packet
    heard = NetworkEstimate(z, jnp.asarray(leading), *rows)
    return _Writes(first, rules, late.network.medium, packet, heard)


def _parts(loop: Loop, sensed: jax.Array) -> list[jax.Array]:
    """Return what an agent knows before it acts, in parts of `sensed_sizes`."""
    return jnp.split(sensed, np.cumsum(sensed_sizes(loop))[:-1].tolist())


def _first(leads: bool) -> FixedLeaders:
    return FixedLeaders(np.array([leads]))


def _of_one(
    loop: Loop, leads: bool, number: jax.Array, rows: Sequence[jax.Array], network: IdealNetwork
) -> Loop:
    """Return the loop of one agent of a number, with its row of `agent_rows`."""
    tree = jax.tree.structure((loop.places.rows, loop.motion.rows))
    places, plant = tree.unflatten(rows)
    nobody = Links(Exchange(np.zeros(0, int), np.zeros(0, int), np.zeros(0)))
    own = {"places": loop.places.of_rows(places), "graph": nobody, "network": network}
    return one_row(loop, leads, number[None], plant, **own)


class StepInputs(NamedTuple):
    """What an agent's step depends on, entry by entry: arrays of nodes, or traced arrays.

    Attributes:
        step, steady: the number of the step, and whether it is in the steady window.
        reference: that leaders follow (n,), or None.
        x: its state (n,).
        rows: its own of `agent_rows`, (1, ...) each.
        memory: of its law, sensors and plant.
        sensed: what it knows of its state, and what it says, where that is known before it acts.
        z: what it hears of its neighbours.
        message: what it is sent.
        leader: its leader's state less its offset; None of a leader that always leads.
        previous_cut: as in `LoopState`.
        packet: the newest of a leader.
        alone: whether it uses no message, a truth; None where all use those of all neighbours.
        here: whether it is there, a truth; None where all always are.
        lead: as in `BlockRows`; None where that never changes.
        sent: whether it is sent a message in this step, else it has that of the packet; None where
            nobody announces anything.
    """

    step: Entries
    steady: Entries
    reference: Entries
    x: Entries
    rows: Entries
    memory: ComponentMemory
    sensed: Entries
    z: Entries
    message: Entries
    leader: Entries
    previous_cut: Entries
    packet: Entries
    alone: Entries
    here: Entries
    lead: Entries
    sent: Entries

    def received(self) -> "StepInputs":
        """Return the same with the message that counts."""
        if self.sent is None:
            return self
        return self._replace(message=jnp.where(self.sent, self.message, self.packet))


Outputs: TypeAlias = dict[str, Entries]
"""Results of an agent's step by the name of their rows, and some others."""


def _flat(tree: PyTree) -> jax.Array:
    return jnp.concatenate([jnp.zeros(0), *(jnp.ravel(leaf) for leaf in jax.tree.leaves(tree))])


def _moment(inputs: StepInputs) -> LoopState:
    return LoopState(inputs.step, inputs.x[None], inputs.previous_cut[None], inputs.memory)


def prior_step(own: Loop, inputs: StepInputs) -> Outputs:
    """Return what an agent senses, says and reads before anybody acts."""
    now, clock = _moment(inputs), Steps(inputs.step, own.motion.dt)
    known, sensing, _ = hear(own, now, clock)
    goal = _goal(own, clock, inputs)
    goals = goal[np.array(own.meter.measured[: len(shown_goals(own))], int)]
    heard, said = known.heard, known.said[0]
    sensed, packet = [known.own.x[0], said], inputs.packet
    sensing = choose(known.here, sensing, inputs.memory.sensing)
    if own.network.late:
        packet = jnp.append(heard.packet.content[0], heard.packet.stamp)
        knows = heard.leads | (clock.age(heard.packet.stamp) < jnp.inf)
        # What leaders receive of others' inputs is not used.
        forward = jnp.where(heard.leads, 0.0, heard.feedforward[0])
        sensed += [heard.leader[0], forward, jnp.where(knows, 1.0, 0.0)]
    return {
        "memory": _flat(inputs.memory._replace(sensing=sensing)),
        "sensed": jnp.concatenate(sensed),
        "packet": packet,
        "mirror": jnp.concatenate([inputs.x - goal, goals, *[said] * (not own.network.late)]),
    }


def _goal(own: Loop, clock: Clock, inputs: StepInputs) -> jax.Array:
    goals = own.places.goals(clock.t)
    return inputs.rows[0][0] if goals is None else goals[0]


def _known(
    own: Loop, now: LoopState, clock: Steps, inputs: StepInputs
) -> tuple[Known, PyTree, PyTree]:
    """Return what an agent knows, and what sensing and network remember after it."""
    if inputs.sensed is None:
        return hear(own, now, clock)
    x, said = (part[None] for part in _parts(own, inputs.sensed)[:2])
    offsets = own.places.groups(own.model, own.laws, clock.t)
    mine = Own(jnp.asarray(own.laws.numbers), x)
    here = own.roster.here(clock.step)
    known = Known(clock, here, mine, offsets, said, own.graph.exchange)
    heard, network = own.network.receive(own, (), known)
    return known._replace(heard=heard), now.memory.sensing, network


def announcing_step(own: Loop, inputs: StepInputs) -> Outputs:
    """Return what an agent announces to all others if it leads, before anybody acts."""
    now, clock = _moment(inputs), Steps(inputs.step, own.motion.dt)
    known = _known(own, now, clock, inputs)[0]
    message = lead(own, known, now.memory.laws).message[0]
    return {"message": message, "mirror_before": _shown_before(own, inputs, known)}


def agent_step(own: Loop, inputs: StepInputs) -> Outputs:
    """Return what an agent does in a step."""
    now, clock, meter = _moment(inputs), Steps(inputs.step, own.motion.dt), own.meter
    x, goal = inputs.x, _goal(own, clock, inputs)
    known, *rest = _known(own, now, clock, inputs)
    acted = act(own, now, known, *rest)
    u, cut = acted.inputs[0], acted.cut[0]
    # A leader is its own leader, so that its error is zero.
    leader = x - goal if inputs.leader is None else inputs.leader
    metered = meter.of_agent(inputs.step, inputs.steady, x, goal, leader, u)
    tracking, outputs = jnp.zeros(2), jnp.zeros(len(own.model.output_names))
    if inputs.reference is not None:
        tracking, outputs = meter.of_leader(inputs.steady, x, goal, inputs.reference)
    plant = now.memory.plant, now.states, acted.inputs, inputs.step, known.own.number
    states, plant = own.motion.advance(*plant)
    after = LoopState(inputs.step, states, acted.cut, acted.memory._replace(plant=plant))
    after = held(own, known.here, after, now)
    states, memory = after.states, after.memory
    mirrors = dict[str, jax.Array]()
    if inputs.sensed is None:
        later = Steps(inputs.step + 1, own.motion.dt)
        next_said = saying(own, states, memory.laws, later)[1][0]
        mirrors = {"mirror": _shown(own, states[0] - goal, next_said)}
        mirrors["mirror_before"] = _shown_before(own, inputs, known)
    elif own.network.late:
        _, said, expected, _, knows = _parts(own, inputs.sensed)
        mirrors["mirror_before"] = jnp.concatenate([said, expected, knows])
        mirrors["letter"] = _flat(acted.memory.network)
    else:
        mirrors["mirror_before"] = _shown_before(own, inputs, known)
    sums = {
        "errors": metered.errors,
        "tracking": tracking,
        "outputs": outputs,
        "effort": metered.effort[None],
        "limited": jnp.where(acted.limited, 1.0, 0.0),
        "unsettled": metered.unsettled[None],
        "inside": metered.inside,
        **dict.fromkeys(("lowest", "highest"), metered.deviation),
        "chatter": jnp.where((cut * inputs.previous_cut < 0.0).any(), 1.0, 0.0)[None],
    }
    nothing = {name: jnp.full_like(x, _NOTHING.get(name, 0.0)) for name, x in sums.items()}
    return (
        mirrors
        | choose(known.here, sums, nothing)
        | {
            "state": states[0],
            "memory": _flat(memory._replace(network=())),
            "cut": after.cut[0],
            "message": acted.message[0],
            "packet": inputs.message,
            "input": u,
        }
    )


_NOTHING = {"unsettled": -1.0, "inside": ALWAYS, "lowest": np.inf, "highest": -np.inf}
"""What an agent that is absent adds to sums, where it is not 0."""


def _shown_before(own: Loop, inputs: StepInputs, known: Known) -> jax.Array:
    """Return what neighbours read of an agent before it acts, in a network that is not late."""
    goal, said = _goal(own, known.clock, inputs), known.said[0]
    if inputs.sensed is None:
        return _shown(own, inputs.x - goal, said)
    goals = jnp.zeros(len(shown_goals(own)))
    return jnp.concatenate([inputs.x - goal, goals, said])


def _shown(own: Loop, y: jax.Array, said: jax.Array) -> jax.Array:
    return jnp.concatenate([y, said]) if own.laws.speech.signals else y


# ---- its scalar operations -----------------------------------------------------------------------


class Program(NamedTuple):
    """What leaders or all others compute in a step.

    Attributes:
        body: of a step, after everybody has sensed and spoken if that is a part of its own.
        prior: that part; None without one.
        given: what the host computes ahead of both.
        announce: what leaders announce in between; None of nothing.
    """

    body: Body
    prior: Body | None
    given: HostPart
    announce: Body | None = None


def program_of(
    varying: VaryingNumbers, bits: int, rows: BlockRows, leads: bool, follows: bool
) -> Program:
    """Return what the leaders or all others compute in a step.

    Args:
        varying: the loop of the run, and its numbers that differ between formations.
        bits: 64 or 32.
        rows: where the numbers of an agent are.
        leads: whether it is that of the leaders.
        follows: whether they follow a reference, which is in the table.

    Raises:
        Unsupported: a law or the model has no scalar operations.
    """
    graph, loop, given = ScalarGraph(bits), varying.loop, HostPart()
    if not len(loop.laws.leaders if leads else loop.laws.followers):
        return Program(Body(), Body() if len(rows.sensed) else None, given)
    inputs = _step_inputs(loop, graph, rows, leads, leads and follows)
    leaves = varying.leaves(leaves_of(graph, "row", rows.varying))

    def traced(step: Callable[[Loop, StepInputs], Outputs], inputs: StepInputs) -> Outputs:
        def one(
            keys: list[jax.Array], number: jax.Array, leaves: list[jax.Array], inputs: StepInputs
        ) -> list[jax.Array]:
            own = varying.filled(leaves, keys)
            inputs = inputs.received()
            network = _network_of(own, leads, inputs, step is not prior_step)
            own = _of_one(own, leads, number, inputs.rows, network)
            present = _Present(True if inputs.here is None else inputs.here)
            results.update(step(own.replace(roster=present), inputs))
            return [results[name] for name in sorted(results)]

        results = Outputs()
        known = [*varying.keys_of(loop)], np.zeros((), np.int32)
        parts = lower(one, graph, [leaves, inputs], known, given)
        return {k: nodes(graph, part) for k, part in zip(sorted(results), parts, strict=True)}

    prior = None
    if len(rows.sensed):
        mine = traced(prior_step, inputs._replace(sensed=None))
        stores = _placed(rows, mine, ("memory", "sensed", "packet"))
        prior = _finished(graph, Body(stores=stores, mirror=mine["mirror"]))
    announce = None
    if leads and loop.network.announces:
        mine = traced(announcing_step, inputs)
        stores, before = _placed(rows, mine, ("message",)), mine["mirror_before"]
        difference = _difference(loop, graph)
        announce = Body(stores=stores, mirror_before=before, difference=difference)
        announce = _finished(graph, announce)
    body = _body(loop, graph, rows, inputs, traced(agent_step, inputs), leads, leads and follows)
    return Program(_finished(graph, body), prior, given, announce)


def _finished(graph: ScalarGraph, body: Body) -> Body:
    body = body._replace(exceptions=exceptions_of(graph, body))
    return body.map_nodes(factored(body.all()))


def _body(
    loop: Loop,
    graph: ScalarGraph,
    rows: BlockRows,
    inputs: StepInputs,
    outputs: Outputs,
    leads: bool,
    tracks: bool,
) -> Body:
    """Return a step by its results."""
    stores = _placed(rows, outputs, ("state", "memory"))
    # Where no limit is, nothing was ever cut.
    if any(node is not graph.constant(0.0) for node in outputs["cut"]):
        stores |= _placed(rows, outputs, ("cut",))
    # Steps ascend, so that the later one replaces the earlier one; -1 is no step.
    earlier = leaves_of(graph, "row", rows.unsettled)
    none = [graph.make("lt", step, 0.0) for step in outputs["unsettled"]]
    pairs = zip(none, earlier, outputs["unsettled"], strict=True)
    last = {"unsettled": [graph.make("select", *each) for each in pairs]}
    stores |= _placed(rows, last, ("unsettled",))
    # Unless inputs are passed on from parents, nobody reads the message of a follower.
    announces = loop.network.announces
    if (leads or by_depth(loop)) and not (loop.network.late or announces):
        stores |= _placed(rows, outputs, ("message",))
    stores |= _placed(rows, outputs, ("packet",) * announces)
    sums = {name: outputs[name] for name in ("effort", "limited", "chatter")}
    sums |= {"errors": _before_and_in_window(inputs, outputs["errors"])}
    if tracks:
        tracking = _before_and_in_window(inputs, outputs["tracking"])
        sums |= {"tracking": tracking, "outputs": outputs["outputs"]}
    # Rows of the smallest numbers serve for the largest too.
    minima = {"inside": outputs["inside"], "lowest": outputs["lowest"]}
    largest = {"peak": outputs["errors"][: len(rows.peak)], "highest": outputs["highest"]}
    minima |= {name: [graph.make("sub", 0.0, x) for x in part] for name, part in largest.items()}
    return Body(
        stores=stores,
        sums=_placed(rows, sums, sums),
        minima=_placed(rows, minima, minima),
        on_request=_placed(rows, outputs, ("input",)),
        tape=dict(enumerate(inputs.x[list(loop.meter.paired)].tolist())),
        mirror_before=outputs["mirror_before"],
        mirror=outputs.get("mirror", ()),
        letter=outputs.get("letter", ()),
        difference=_difference(loop, graph),
    )


def _before_and_in_window(inputs: StepInputs, sums: list[Node]) -> list[Node]:
    """Split sums into before and in the steady window: each step adds to one of the two only."""
    all_, steady = sums
    return [all_.graph.make("select", inputs.steady[()], 0.0, all_), steady]


def _link(loop: Loop, late: LetterSizes, graph: ScalarGraph) -> list[Node]:
    """Return the difference to what an agent makes of the last letter that came by a link."""
    s, model = late.value, loop.model

    def difference(step: jax.Array, mine: jax.Array, kept: jax.Array) -> jax.Array:
        said, leader, knows = mine[None, :s], mine[None, s:-1], mine[-1:] != 0.0
        clock, stamp = Steps(step, loop.motion.dt), kept[-1:]
        nobody, none = np.zeros(1, np.int32), Own(jnp.zeros(1, jnp.int32), said)
        links = Exchange(nobody, nobody, np.ones(1))
        known = Known(clock, True, none, loop.places.groups(model, loop.laws, clock.t), said, links)
        mail = Messages(kept[None, :s], jnp.zeros(1, jnp.int32), None, stamp)  # type: ignore[arg-type]
        rows = mail, clock.age(stamp), leader, knows, known
        received, _ = late.network.rules.received(*rows)
        return loop.laws.speech.difference(model)(said, received)[0]

    step = single(graph.leaf("step", uniform=True))
    pairs = (("self", 2 * s + 1), ("link", s + 1))
    [found] = lower(difference, graph, [step, *(leaves_of(graph, k, range(n)) for k, n in pairs)])
    return nodes(graph, found)


def _difference(loop: Loop, graph: ScalarGraph) -> list[Node]:
    """Return the differences of what neighbours read, of which the last are of what is said."""
    late = letter_sizes(loop)
    if late is not None:
        return _link(loop, late, graph)
    # Of the first loop's: the difference of two states is the same for all formations.
    n, s, shown = len(loop.model.state_names), said_size(loop), shown_size(loop)
    kinds = "self", "neighbour"
    mine, theirs = (leaves_of(graph, kind, range(n + shown)) for kind in kinds)
    speech, model = loop.laws.speech, loop.model

    def difference(a: jax.Array, b: jax.Array) -> jax.Array:
        return speech.difference(model)(a[None], b[None])[0]

    [said] = lower(difference, graph, [mine[-s:], theirs[-s:]])
    plain = zip(mine[:-s], theirs[:-s], strict=True)
    return [*(graph.make("sub", a, b) for a, b in plain), *nodes(graph, said)]


def _step_inputs(
    loop: Loop, graph: ScalarGraph, rows: BlockRows, leads: bool, tracks: bool
) -> StepInputs:
    n = len(rows.state)

    def row(places: range) -> np.ndarray:
        return leaves_of(graph, "row", places)

    x, offset, memory = row(rows.state), row(rows.offset), memory_of(loop, leads)
    here = [graph.make("ne", leaf, 0.0) for leaf in row(rows.here)]
    changes = loop.laws.backups
    shown = said_size(loop) if loop.network.late else n + shown_size(loop)
    # A truth and not a number, since it chooses between sums.
    steady = _truth(graph, graph.leaf("steady", uniform=True))
    late = letter_sizes(loop)
    chooses = late is not None and late.network.rules.neighbours.chooses
    ends = [*itertools.accumulate(map(row_size, agent_rows(loop)))]
    own = np.concatenate([offset, row(rows.agent)])
    shapes = [(1, *np.shape(leaf)[1:]) for leaf in agent_rows(loop)]
    pairs = zip([0, *ends[:-1]], ends, shapes, strict=True)
    return StepInputs(
        step=single(graph.leaf("step", uniform=True)),
        steady=steady,
        reference=leaves_of(graph, "table", range(n), True) if tracks else None,
        x=x,
        rows=[own[a:b].reshape(shape) for a, b, shape in pairs],
        memory=unflatten(memory, row(rows.memory[: memory_size(memory)])),
        sensed=row(rows.sensed) if len(rows.sensed) else None,
        z=leaves_of(graph, "z", range(shown - said_size(loop), shown)),
        # A leader receives no input of another agent.
        message=np.zeros(len(rows.message))
        if leads and not changes
        else leaves_of(graph, "message", range(len(rows.message))),
        leader=None if leads and not changes else leaves_of(graph, "leader", range(n)),
        previous_cut=row(rows.cut),
        packet=row(rows.packet),
        alone=_truth(graph, graph.leaf("alone")) if chooses else None,
        here=np.array(here, object) if here else None,
        lead=row(rows.lead) if leads and changes else None,
        sent=_truth(graph, row(rows.sent)[0]) if len(rows.sent) else None,
    )


def leaves_of(
    graph: ScalarGraph, kind: str, places: Sequence[int], uniform: bool = False
) -> np.ndarray:
    """Return leaves of one kind, one for each place."""
    entries = np.empty(len(places), object)
    entries[:] = [graph.leaf(kind, place, uniform=uniform) for place in places]
    return entries


def _truth(graph: ScalarGraph, leaf: Node) -> np.ndarray:
    return single(graph.make("ne", leaf, 0.0))


def single(node: Node) -> np.ndarray:
    """Return a node as an array without axes."""
    array = np.empty((), object)
    array[()] = node
    return array


def _placed(
    rows: BlockRows, results: dict[str, list[Node]], names: Iterable[str]
) -> dict[int, Node]:
    """Return some results by their rows; what is as it was is not stored."""
    pairs = (
        (row, node)
        for name in names
        for row, node in zip(getattr(rows, name), results[name], strict=name != "memory")
    )
    return {row: node for row, node in pairs if node.value != ("row", row)}


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
    for mine in (*body.mirror_before, *body.letter):
        yield graph.make("lt", size, graph.make("abs", mine))
