"""The closed loop as code for this machine: one agent's step as scalars, agents in vectors.

What an agent does is traced from the same laws, model, integrator and meter that `loop` runs; here
stands only where its numbers lie. Agents stand in blocks: leaders first, then the followers level
by level, so that whoever is sent an input of this step comes after who sends it.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, final

import jax
import jax.numpy as jnp
import numpy as np

from echelon.core.types import Array
from echelon.engine.drive import Chunk, Stepper
from echelon.engine.loop import Loop, Moment, begin
from echelon.engine.sums import SETTLED, Sums, on_host, output_error
from echelon.kernels import SLOTS, Body, Code, Graph, Plan, Unsupported, aligned, lower, nodes
from echelon.kernels import program as write
from echelon.laws.law import Law, LocalView

_LANES = {64: 8, 32: 16}
_AGENT_STEPS, _FEWEST = 2_000_000, 4


class Rows(NamedTuple):
    """Where the numbers of an agent lie in its block; each a range of rows."""

    state: range
    offset: range
    push: range
    noise: range
    memory: range
    tell: range
    input: range
    errors: range
    tracking: range
    outputs: range
    effort: int
    limited: int
    unsettled: int
    count: int


def _rows(loop: Loop, memory: int, told: int) -> Rows:
    n, m = len(loop.model.state_names), len(loop.model.input_names)
    q, wind = len(loop.model.output_names), loop.motion.wind
    sizes = [n, n, n if wind else 0, m if wind and wind.noise is not None else 0, memory, told, m]
    sizes += [2, 2, q]
    ends = np.cumsum([0, *sizes]).tolist()
    ranges = [range(a, b) for a, b in zip(ends[:-1], ends[1:], strict=True)]
    end = ends[-1]
    return Rows(*ranges, end, end + 1, end + 2, end + 3)


# ---- what one agent does -------------------------------------------------------------------------


class _Acted(NamedTuple):
    """What one agent does in a step, and what it is measured by."""

    state: Any
    mirror: Any
    memory: Any
    tell: Any
    input: Any
    errors: Any
    tracking: Any
    outputs: Any
    effort: Any
    limited: Any
    unsettled: Any


def _agent(loop: Loop, law: Law, leads: bool, follows: bool) -> Callable[..., _Acted]:
    """Return what an agent under a law does, as a function for JAX.

    Args:
        loop: of the run.
        law: the agent's.
        leads: whether it is a leader.
        follows: whether leaders follow a reference.
    """
    model, motion, meter = loop.model, loop.motion, loop.meter
    measured = np.array(meter.measured)

    def act(
        t: Any,
        steady: Any,
        wanted: Any,
        x: Any,
        offset: Any,
        z: Any,
        told: Any,
        memory: Any,
        leader: Any,
        push: Any,
        noise: Any,
    ) -> _Acted:
        asked, after = law.update(model, LocalView(t, x, offset, z, told), memory)
        u = motion.plant.limit(asked) if motion.limits else asked
        v = model.normalized(u)
        tell = _tell(loop, x, v)
        new = motion.move(x, u, push, noise)
        y = x - offset
        away = (y - leader)[measured]
        square = jnp.sum(away * away)
        tracking, outputs = jnp.zeros(()), jnp.zeros(len(model.output_names))
        if leads and follows:
            off = (y - wanted)[measured]
            tracking = jnp.sum(off * off)
            # The offset back in: outputs are nonlinear in the state.
            outputs = output_error(model, x, wanted + offset) ** 2
        twice = jnp.stack([jnp.asarray(True), steady])
        return _Acted(
            state=new,
            mirror=(new, offset),
            memory=after,
            tell=tell,
            input=u,
            errors=jnp.where(twice, square, 0.0),
            tracking=jnp.where(twice, tracking, 0.0),
            outputs=outputs,
            effort=jnp.sum(v * v),
            limited=jnp.where(jnp.any((u != asked) & ~jnp.isnan(asked)), 1.0, 0.0),
            unsettled=jnp.logical_not(jnp.sqrt(square) <= SETTLED),
        )

    return act


def _tell(loop: Loop, x: Any, v: Any) -> Any:
    """Return what an agent at x that does v sends to followers."""
    from echelon.core.words import Feedforward

    if loop.follower.feedforward is Feedforward.NONE:
        return jnp.zeros_like(v)
    return loop.follower.broadcast(loop.model, x, v)


# ---- bodies --------------------------------------------------------------------------------------


def _leaves(graph: Graph, kind: str, places: Any, uniform: bool = False) -> np.ndarray:
    entries = np.empty(len(places), object)
    entries[:] = [graph.leaf(kind, place, uniform=uniform) for place in places]
    return entries


def _one(entry: Any) -> np.ndarray:
    array = np.empty((), object)
    array[()] = entry
    return array


def _shaped(entries: np.ndarray, like: Any) -> Any:
    """Return a memory whose numbers are entries, in the order of its tree."""
    leaves, tree = jax.tree.flatten(like)
    sizes = np.cumsum([0, *(np.size(leaf) for leaf in leaves)]).tolist()
    parts = zip(leaves, sizes[:-1], sizes[1:], strict=True)
    return tree.unflatten([entries[a:b].reshape(np.shape(leaf)) for leaf, a, b in parts])


def _body(
    loop: Loop, bits: int, rows: Rows, law: Law, leads: bool, follows: bool, told: int
) -> Body:
    graph, n = Graph(bits), len(loop.model.state_names)
    memory = law.init()
    size = sum(np.size(leaf) for leaf in jax.tree.leaves(memory))
    x, offset = (_leaves(graph, "row", r) for r in (rows.state, rows.offset))
    push, noise = (
        _leaves(graph, "row", r) if len(r) else None for r in (rows.push, rows.noise)
    )
    wanted = _leaves(graph, "table", range(n), True) if follows else np.zeros(n)
    sent = np.zeros(told) if leads else _leaves(graph, "told", range(told))
    own_y = x - offset
    inputs = [
        _one(graph.leaf("time", uniform=True)),
        _one(_truth(graph, "steady")),
        wanted,
        x,
        offset,
        _leaves(graph, "z", range(n)),
        sent,
        _shaped(_leaves(graph, "row", rows.memory[:size]), memory),
        own_y if leads else _leaves(graph, "leader", range(n)),
        push,
        noise,
    ]
    found = lower(_agent(loop, law, leads, follows), graph, inputs)
    tree = jax.tree.structure(_Acted(*[0] * 2, memory, *[0] * 8)._replace(mirror=(0, 0)))
    acted: _Acted = jax.tree.unflatten(tree, [nodes(graph, a) for a in found])
    stores = dict(zip(rows.state, acted.state, strict=True))
    stores |= dict(zip(rows.tell, acted.tell, strict=True))
    stores |= dict(zip(rows.input, acted.input, strict=True))
    kept = [e for leaf in jax.tree.leaves(acted.memory, is_leaf=lambda a: isinstance(a, list)) for e in leaf]
    stores |= dict(zip(rows.memory[:size], kept, strict=True))
    sums = dict(zip(rows.errors, acted.errors, strict=True))
    sums |= {rows.effort: acted.effort[0], rows.limited: acted.limited[0]}
    if leads and follows:
        sums |= dict(zip(rows.tracking, acted.tracking, strict=True))
        sums |= dict(zip(rows.outputs, acted.outputs, strict=True))
    own, theirs = _leaves(graph, "own", range(n)), _leaves(graph, "their", range(n))
    [difference] = lower(loop.model.difference, graph, [own, theirs])
    return Body(
        stores=stores,
        sums=sums,
        latest={rows.unsettled: acted.unsettled[0]},
        now=[graph.make("apart", a, b) for a, b in zip(x, offset, strict=True)],
        mirror=[graph.make("apart", a, b) for a, b in zip(acted.state, offset, strict=True)],
        difference=nodes(graph, difference),
    )


def _truth(graph: Graph, name: str) -> Any:
    # A comparison is what makes a truth of a leaf.
    return graph.make("ne", graph.leaf(name, uniform=True), 0.0)


# ---- where agents stand --------------------------------------------------------------------------


@final
class Places:
    """Where agents stand: positions in blocks of `lanes`, which their level fills with copies."""

    def __init__(self, loop: Loop, lanes: int) -> None:
        levels = [loop.followers] if loop.levels is None else [
            loop.followers[np.unique(row)] for row in loop.levels
        ]
        filled = [np.resize(a, -(-len(a) // lanes) * lanes) for a in (loop.leaders, *levels)]
        self.lanes, self.agents = lanes, np.concatenate(filled)
        self.segments = np.cumsum([0, *(len(a) // lanes for a in filled)]).astype(np.int64)
        # Of copies the first stands for the agent.
        _, self.of = np.unique(self.agents, return_index=True)

    @property
    def blocks(self) -> int:
        """How many blocks there are."""
        return len(self.agents) // self.lanes


def _neighbours(loop: Loop, places: Places) -> tuple[Array, Array, Array, bool]:
    """Return starts of slots by block, positions (slots, lanes) and weights, and whether they vary."""
    exchange, lanes, N = loop.exchange, places.lanes, len(loop.offsets)
    order = np.argsort(exchange.receivers, kind="stable")
    senders, weights = np.asarray(exchange.senders)[order], np.asarray(exchange.weights)[order]
    starts = np.searchsorted(np.asarray(exchange.receivers)[order], np.arange(N + 1))
    degrees = np.diff(starts)
    slots = degrees[places.agents].reshape(-1, lanes).max(axis=1)
    first = np.concatenate([[0], np.cumsum(slots)])
    block = np.repeat(np.arange(places.blocks), slots)
    k = np.arange(first[-1]) - first[block]
    agents = places.agents.reshape(-1, lanes)[block]
    there = k[:, None] < degrees[agents]
    edge = np.minimum(starts[agents] + k[:, None], max(len(senders) - 1, 0))
    own = np.arange(places.blocks * lanes).reshape(-1, lanes)[block]
    # Who has fewer neighbours hears itself, from which it differs by nothing.
    positions = np.where(there, places.of[senders[edge]], own)
    weighted = bool((weights != 1.0).any())
    return first.astype(np.int64), positions, np.where(there, weights[edge], 0.0), weighted


@final
class NativeStepper(Stepper):
    """Moves agents under laws by code for this machine.

    Raises:
        Unsupported: a law or the model uses what has no scalar operations.
    """

    def __init__(self, loop: Loop, states: Array, follows: bool, bits: int) -> None:
        self.loop, self.states, self.follows = loop, states, follows
        self.bits, self.dtype = bits, np.float64 if bits == 64 else np.float32
        lanes, n = _LANES[bits], len(loop.model.state_names)
        self.places = Places(loop, lanes)
        told = _width_told(loop)
        sizes = [_memory_size(law) for law in (loop.leader, loop.follower)]
        self.rows = _rows(loop, max(sizes), told)
        starts, self.positions, weights, weighted = _neighbours(loop, self.places)
        alone = len(loop.leaders) == 1
        self.plan = Plan(
            bits=bits,
            lanes=lanes,
            rows=self.rows.count,
            width=n,
            first=_body(loop, bits, self.rows, loop.leader, True, follows, told),
            others=_body(loop, bits, self.rows, loop.follower, False, follows, told),
            tell=self.rows.tell.start,
            told=told,
            one_source=alone and loop.parents is None,
            one_leader=alone,
            weighted=weighted,
            edges=loop.meter.measured,
            table=n if follows else 0,
            dt=loop.motion.dt,
        )
        self.code = Code(write(self.plan))
        self._tables(starts, weights)
        self._held: Moment | None = None
        self._probed = False

    # ---- memory ----

    def _tables(self, starts: Array, weights: Array) -> None:
        """Make what never changes during a run, and room for what does."""
        loop, places, plan = self.loop, self.places, self.plan
        n, lanes, of = plan.width, plan.lanes, places.of
        self.block_rows = aligned((places.blocks, plan.rows, lanes), self.dtype)
        self.mirrors = [aligned((len(places.agents), n), self.dtype) for _ in range(2)]
        nearest = np.asarray(loop.meter.nearest)[places.agents]
        sender = nearest if loop.parents is None else np.asarray(loop.parents)[places.agents]
        # A leader is sent nothing, and its own place does as well as any.
        sender = np.where(sender < 0, places.agents, sender)
        from_ = of[sender]
        self.fixed = {
            "segments": places.segments,
            "neighbour_starts": starts,
            "neighbours": np.ascontiguousarray(self.positions * n, np.int32),
            "weights": _as_aligned(weights, self.dtype),
            "sources": ((from_ // lanes) * plan.rows * lanes + from_ % lanes).astype(np.int32),
            "leaders": (of[nearest] * n).astype(np.int32),
        }
        self._edges()

    def _edges(self) -> None:
        """Make the blocks of edges: differences of goals, distances, sums."""
        meter, lanes, n = self.loop.meter, self.plan.lanes, self.plan.width
        count = len(meter.edges)
        blocks = -(-count // lanes)
        ends = np.resize(self.places.of[np.asarray(meter.edges)] * n, (blocks * lanes, 2))
        goals = np.asarray(meter.offsets)[:, list(meter.measured)]
        i, j = np.asarray(meter.edges).T
        apart = np.resize(goals[i] - goals[j], (blocks * lanes, len(meter.measured)))
        q = len(meter.measured)
        self.edge_rows = aligned((blocks, q + 2, lanes), self.dtype)
        self.edge_rows[:, :q] = apart.reshape(blocks, lanes, q).transpose(0, 2, 1)
        self.edge_rows[:, q] = np.resize(meter.spacings, blocks * lanes).reshape(blocks, lanes)
        pairs = ends.reshape(blocks, lanes, 2).transpose(0, 2, 1)
        self.fixed["edge_ends"] = np.ascontiguousarray(pairs, np.int32)

    def _column(self, rows: range | int) -> Array:
        """Return rows of all positions, (positions, rows), as a view turned about."""
        cut = slice(rows, rows + 1) if isinstance(rows, int) else slice(rows.start, rows.stop)
        part = self.block_rows[:, cut].transpose(0, 2, 1)
        return part.reshape(len(self.places.agents), -1)

    def _put(self, rows: range, values: Array) -> None:
        """Write values (positions, rows) into rows."""
        shaped = values.reshape(self.places.blocks, self.plan.lanes, len(rows))
        self.block_rows[:, rows.start : rows.stop] = shaped.transpose(0, 2, 1)

    # ---- stepping ----

    @property
    def longest(self) -> int:
        """Steps that take some tenths of a second, or a few of very many agents."""
        return max(_FEWEST, _AGENT_STEPS // len(self.states))

    def start(self) -> Moment:
        """Return the moment at which the run begins."""
        return on_numpy(begin(self.loop, jnp.asarray(self.states)))

    def advance(self, now: Moment, counts: Array, reference: Array | None) -> Chunk:
        """Store frames and take steps; what happens on the way is seen afterwards."""
        if now is not self._held:
            self._load(now)
        self._clear_sums()
        first = step = int(now.step)
        agents, m = len(self.states), len(self.loop.model.input_names)
        states = np.empty((len(counts), agents, self.plan.width))
        inputs = np.empty((len(counts), agents, m))
        table = None if reference is None else np.ascontiguousarray(reference, self.dtype)
        asked = None
        for k, count in enumerate(counts.tolist()):
            states[k] = self._column(self.rows.state)[self.places.of]
            if count:
                self._run(step, 1, first, table)
                inputs[k] = self._column(self.rows.input)[self.places.of]
                self._run(step + 1, count - 1, first, table)
                step, asked = step + count, None
            else:
                asked = self._probe(step, first, table) if asked is None else asked
                inputs[k] = asked
        self._held = self._moment(step)
        return Chunk(self._held, states, inputs, self._sums(first, step))

    def _probe(self, step: int, first: int, table: Array | None) -> Array:
        """Return the inputs of a step that is not taken."""
        kept = [a.copy() for a in (self.block_rows, self.edge_rows, *self.mirrors)]
        self._run(step, 1, first, table)
        found = self._column(self.rows.input)[self.places.of]
        if self.flipped:
            self.mirrors.reverse()
        for a, b in zip((self.block_rows, self.edge_rows, *self.mirrors), kept, strict=True):
            a[:] = b
        return found

    flipped = False

    def _run(self, step: int, steps: int, first: int, table: Array | None) -> None:
        """Take steps; each ends with the two mirrors exchanged."""
        self.flipped = bool(steps % 2)
        if not steps:
            return
        slots = np.zeros(len(SLOTS), np.int64)
        at = {"rows": self.block_rows, "mirror": self.mirrors[0], "next_mirror": self.mirrors[1]}
        at |= {"edges": self.edge_rows, **self.fixed}
        if table is not None:
            at["table"] = table[step - first :]
        for place, name in enumerate(SLOTS):
            if name in at:
                slots[place] = at[name].ctypes.data
        numbers = {"first_step": step, "steps": steps, "levels": len(self.places.segments) - 1}
        numbers |= {
            "edge_blocks": len(self.edge_rows),
            "first_steady": int(self.loop.meter.first_steady),
        }
        for name, value in numbers.items():
            slots[SLOTS.index(name)] = value
        self.code.call(slots.ctypes.data)
        if self.flipped:
            self.mirrors.reverse()

    # ---- moments and sums ----

    def _load(self, now: Moment) -> None:
        """Write a moment into the blocks."""
        agents, loop = self.places.agents, self.loop
        x, offsets = np.asarray(now.states, self.dtype), np.asarray(loop.offsets, self.dtype)
        self._put(self.rows.state, x[agents])
        self._put(self.rows.offset, offsets[agents])
        self.mirrors[0][:] = (x - offsets)[agents]
        memory = np.zeros((len(agents), len(self.rows.memory)), self.dtype)
        for who, tree in ((loop.leaders, now.leader_memory), (loop.followers, now.follower_memory)):
            flat = _flat_memory(tree, len(who))
            row = np.full(len(x), -1)
            row[who] = np.arange(len(who))
            mine = row[agents] >= 0
            memory[mine, : flat.shape[1]] = flat[row[agents][mine]]
        self._put(self.rows.memory, memory)

    def _moment(self, step: int) -> Moment:
        """Return what is in the blocks as a moment."""
        loop, of = self.loop, self.places.of
        flat = self._column(self.rows.memory)[of]
        return Moment(
            np.asarray(step, np.int32),
            self._column(self.rows.state)[of],
            _memory(loop.leader, flat[loop.leaders]),
            _memory(loop.follower, flat[loop.followers]),
        )

    def _clear_sums(self) -> None:
        self.block_rows[:, self.rows.errors.start : self.rows.unsettled] = 0.0
        self.block_rows[:, self.rows.unsettled] = -1.0
        self.edge_rows[:, -1] = 0.0

    def _sums(self, first: int, end: int) -> Sums:
        """Return the sums over the steps from one to another."""
        rows, of, leaders = self.rows, self.places.of, self.loop.leaders
        steady = max(0, end - max(first, int(self.loop.meter.first_steady)))
        edges = self.edge_rows[:, -1].reshape(-1)[: len(self.loop.meter.edges)]
        found = Sums(
            steps=np.array([end - first, steady]),
            errors=self._column(rows.errors)[of].T,
            tracking=self._column(rows.tracking)[of][leaders].T,
            outputs=self._column(rows.outputs)[of][leaders],
            effort=self._column(rows.effort)[of][:, 0],
            spacing=edges,
            limited=self._column(rows.limited)[of][:, 0],
            unsettled=self._column(rows.unsettled)[of][:, 0],
        )
        return Sums(*(np.asarray(part, np.float64) for part in found))


def _as_aligned(values: Array, dtype: Any) -> Array:
    made = aligned(values.shape, dtype)
    made[:] = values
    return made


def on_numpy(now: Moment) -> Moment:
    """Return a moment whose numbers are NumPy's."""
    return jax.tree.map(np.asarray, now)


def _memory_size(law: Law) -> int:
    leaves = jax.tree.leaves(law.init())
    for leaf in leaves:
        if not jnp.issubdtype(jnp.asarray(leaf).dtype, jnp.floating):
            raise Unsupported(f"a memory of the type {jnp.asarray(leaf).dtype}")
    return sum(np.size(leaf) for leaf in leaves)


def _flat_memory(tree: Any, agents: int) -> Array:
    """Return the numbers of memories, (agents, numbers)."""
    leaves = [np.asarray(leaf).reshape(agents, -1) for leaf in jax.tree.leaves(tree)]
    return np.concatenate(leaves, axis=1) if leaves else np.zeros((agents, 0))


def _memory(law: Law, flat: Array) -> Any:
    """Return memories of agents from their numbers (agents, numbers)."""
    leaves, tree = jax.tree.flatten(law.init())
    ends = np.cumsum([0, *(np.size(leaf) for leaf in leaves)]).tolist()
    parts = zip(leaves, ends[:-1], ends[1:], strict=True)
    return tree.unflatten(
        [flat[:, a:b].reshape(len(flat), *np.shape(leaf)) for leaf, a, b in parts]
    )


def _width_told(loop: Loop) -> int:
    """Return how many numbers an agent sends besides its state."""
    n, m = len(loop.model.state_names), len(loop.model.input_names)
    shape = jax.eval_shape(lambda x, v: _tell(loop, x, v), jnp.zeros(n), jnp.zeros(m))
    return shape.shape[0]
