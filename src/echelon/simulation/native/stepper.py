"""Steps the closed loop by machine code, with agents in the lanes of vectors."""

import math
import sys
from collections.abc import Sequence
from concurrent.futures import Executor
from functools import cached_property
from typing import Any, final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from echelon.core.compiled import cached_jit
from echelon.core.types import Array
from echelon.simulation.codegen import aligned, stride
from echelon.simulation.native.agent_step import (
    agent_rows,
    listens_first,
    memory_size,
    shown_size,
)
from echelon.simulation.native.blocks import FormationBlocks, Places, SwarmBlocks, neighbour_slots
from echelon.simulation.native.given_table import GivenTable
from echelon.simulation.native.kernel_cache import KERNELS, LANES
from echelon.simulation.native.lead_table import LeadTable
from echelon.simulation.native.mail_table import MailTable
from echelon.simulation.native.network_table import EmptyTable, NetworkTable
from echelon.simulation.native.pair_watch import PairWatch
from echelon.simulation.native.threads import ThreadPool
from echelon.simulation.native.varying import VaryingNumbers
from echelon.simulation.step.drive import Chunk, Stepper
from echelon.simulation.step.loop import Loop
from echelon.simulation.step.meter import ALWAYS, Sums
from echelon.simulation.step.records import ComponentMemory, LawMemories, LoopState
from echelon.simulation.step.roster import ActiveAgents
from echelon.simulation.step.run_laws import has_angles
from echelon.simulation.step.sequence import begin, said_by

_AGENT_STEPS, _FEWEST = 2_000_000, 4
"""Agent steps of a chunk, which take some hundredths of a second, and its fewest steps."""
_OPERATIONS, _ENOUGH = {64: 3e10, 32: 6e10}, 1_000
"""Operations of a chunk with at most so many steps: about a second of one thread."""
_STEPS, _TASKS, _LEADER_NUMBERS = 2_048, 200_000, 10_000_000
"""Limits of a call: steps, each with its uniform values; tasks; stored numbers of leaders ahead."""


@final
class NativeStepper(Stepper):
    """Steps the agents of a formation, or of many that differ only in numbers, under laws.

    Args:
        loops: of the run, or of each formation.
        states: at its beginning, formation by formation.
        bits: 64 or 32, the precision.
        fallback: repeats a chunk whose numbers are not what JAX computes; None if the caller
            does, by `Chunk.inexact`.
        pool: threads that step formations; None for the caller's only.
        variant: a loop of the same structure: `turn` may change the numbers in which it differs,
            and the weights of edges; None if `turn` is not called.
        threads: that share the steps of one formation; by default depending on its size.

    Raises:
        Unsupported: a law or the model has no scalar operations.
    """

    def __init__(
        self,
        loops: Sequence[Loop],
        states: Float[Array, "N n"],
        bits: int,
        fallback: Stepper | None,
        pool: Executor | None = None,
        variant: Loop | None = None,
        threads: int | None = None,
    ) -> None:
        self.varying = VaryingNumbers(loops, variant)
        self.loop, self.loops, self.states, self.fallback = loops[0], loops, states, fallback
        self.bits, self.dtype = bits, np.dtype(np.float64 if bits == 64 else np.float32)
        batched, lanes = len(loops) > 1, LANES[bits]
        self.places: Places = (
            FormationBlocks(loops, lanes) if batched else SwarmBlocks(self.loop, lanes)
        )
        self.threads, self.buffers = ThreadPool(self.places, pool, threads), BufferPool()
        # Numbers of formations follow each other.
        first = len(self.loop.places.offsets) * np.arange(len(loops))[:, None]
        self.leaders = (first + self.loop.laws.leaders).reshape(-1)
        self.followers = (first + self.loop.laws.followers).reshape(-1)
        row_major, weights_change = self.places.row_major, variant is not None
        apart = weights_change or any(np.any(loop.meter.spacings) for loop in loops)
        self.places.listens_first = listens_first(self.loop)
        self.places.announces = self.loop.network.announces
        self.code, made = KERNELS.of(
            self.varying, bits, batched, row_major, weights_change, apart, self.places.shifts
        )
        _, self.rows, self.plan, self.uniform_count, self._work, self.memories, parts = made
        self.given = GivenTable(self.varying, loops, parts, self.places, self.plan, self.dtype)
        self.table = self._table()
        self._reserve()
        # The moment in the blocks: a chunk that continues from it need not be written there.
        self._moment: LoopState | None = None
        self._fallback_step = -1
        # Which edges have an end that is absent.
        self._unmeasured: Array = np.array(False)
        axes, count = len(self.loop.meter.paired), len(loops)
        rows = self.plan.rows
        self._pairs = PairWatch(self.places, axes, count, self.dtype, _STEPS, rows)

    def _table(self) -> NetworkTable:
        """Return what decides ahead of the kernel what its network does."""
        if self.plan.letters is not None:
            return MailTable(self.loops, self.places, self.plan.letters, self.dtype)
        if self.places.announces:
            return LeadTable(self.loops, self.places, self.plan.rows)
        return EmptyTable()

    # ---- memory ----

    @cached_property
    def _no_sums(self) -> Array:
        rows = self.rows
        # Whole vectors, because to repeat single numbers takes as long as many steps.
        initial = np.zeros((rows.total, self.plan.lanes), self.dtype)
        initial[rows.unsettled.start], initial[rows.inside.start : rows.inside.stop] = -1.0, ALWAYS
        # No minimum yet, as in a kernel.
        initial[rows.peak.start : rows.highest.stop] = ALWAYS
        return initial[rows.errors.start :]

    def _reserve(self) -> None:
        places, plan = self.places, self.plan
        self.blocks = aligned((places.blocks, plan.rows, plan.lanes), self.dtype)
        self.mirrors = places.mirrors(plan, self.dtype)
        message_rows = plan.message_size if plan.leaders_ahead else plan.rows
        self.neighbourhood = places.neighbourhood(plan.width, message_rows, self.dtype)
        self.leader_blocks = int(places.segments[1])
        if plan.leaders_ahead:
            assert isinstance(places, SwarmBlocks)
            near = self.neighbourhood
            arrays = near.neighbours, near.weights, near.edges, near.edge_ends
            bytes_ = sum(part.nbytes for part in (self.blocks, *self.mirrors, *arrays))
            far = 1 if plan.row_major else stride(plan.width, plan.lanes)
            places.measure_reach(near, far, bytes_ // places.blocks)
        self.edges, self.edge_weights = self.neighbourhood.edges, self.neighbourhood.weights

    def _read(self, rows: range, out: Array) -> Array:
        self.threads.copy(self.blocks, rows, out)
        return out

    def _write(self, rows: range, values: Array) -> None:
        self.threads.copy(self.blocks, rows, np.ascontiguousarray(values, self.dtype), inward=True)

    # ---- steps ----

    @property
    def engine(self) -> str:
        """The name of the engine."""
        return "native"

    @property
    def warnings(self) -> tuple[str, ...]:
        """From when on JAX stepped the agents."""
        if self._fallback_step < 0:
            return ()
        start = self._fallback_step * self.loop.motion.dt
        return (
            f"From t = {start:.6g} s on, JAX stepped the agents whenever an angle or a whole "
            "number was too large for native code.",
        )

    @property
    def longest(self) -> int:
        """Steps that take some tenths of a second, or a few steps of very many agents."""
        agents = len(self.states) // len(self.loops)
        more = int(_OPERATIONS[self.bits] / (self._work * agents))
        return max(_FEWEST, _AGENT_STEPS // agents, min(_ENOUGH, more))

    def start(self) -> LoopState:
        """Return the moment at which the run begins."""
        states = np.asarray(self.states, self.dtype)
        memory = self._memory(self._begun() if len(self.rows.memory) else states[:, :0])
        self.table.clear()
        packets = np.zeros((len(states), len(self.rows.packet)))
        others = {
            "network": self.table.memory(0, packets),
            "roster": self.loop.roster.begin(states),
        }
        memory = memory._replace(**others)
        cut = np.zeros((len(states), len(self.rows.input)), np.int8)
        return self._moment_of(0, states, memory, cut)

    def _begun(self) -> Array:
        """Return the memories at the beginning, a row of each agent."""
        by_formation = np.asarray(self.states).reshape(len(self.loops), -1, len(self.rows.state))
        if not self.varying.count:
            memory = jax.tree.map(np.asarray, begin_many(self.loop, by_formation).memory)
            leaves = (memory.laws, memory.sensing, memory.plant)
            # The count is stated, since of an empty memory NumPy cannot find it.
            memory = jax.tree.map(
                lambda leaf: leaf.reshape(leaf.shape[0] * leaf.shape[1], *leaf.shape[2:]), leaves
            )
            return self._rows_of(*memory)
        pairs = zip(self.loops, by_formation, strict=True)
        all_ = [begin(loop, jnp.asarray(x)).memory for loop, x in pairs]
        trees = [(each.laws, each.sensing, each.plant) for each in all_]
        return self._rows_of(*jax.tree.map(lambda *leaves: np.concatenate(leaves), *trees))

    @property
    def _groups(self) -> tuple[Array, Array]:
        return self.leaders, self.followers

    def _rows_of(self, laws: LawMemories, sensing: Any, plant: Any) -> Array:
        """Return memories as rows (N, rows.memory)."""
        rows = np.zeros((len(self.states), len(self.rows.memory)))
        for agents, law in zip(self._groups, laws, strict=True):
            own = jax.tree.map(lambda leaf, some=agents: np.asarray(leaf)[some], (sensing, plant))
            leaves = [
                np.asarray(leaf).reshape(len(agents), -1) for leaf in jax.tree.leaves((law, own))
            ]
            flat = np.concatenate([np.zeros((len(agents), 0)), *leaves], axis=1)
            rows[agents, : flat.shape[1]] = flat
        return rows

    def _memory(self, rows: Array) -> ComponentMemory:
        """Return the memory of rows (N, rows.memory)."""
        laws, bodies = list[Any](), list[Any]()
        for k, (like, agents) in enumerate(zip(self.memories, self._groups, strict=True)):
            size = memory_size(like.laws)
            laws.append(_unflatten(like.laws[k], rows[agents, :size]) if len(agents) else like.laws)
            if len(agents):
                tree = like.sensing, like.plant
                bodies.append((agents, _unflatten(tree, rows[agents, size:])))

        def joined(*leaves: Array) -> Array:
            whole = np.empty((len(rows), *leaves[0].shape[1:]), leaves[0].dtype)
            for (agents, _), leaf in zip(bodies, leaves, strict=True):
                whole[agents] = leaf
            return whole

        sensing, plant = jax.tree.map(joined, *(tree for _, tree in bodies))
        return ComponentMemory(LawMemories(*laws), sensing, plant)

    def _moment_of(self, step: int, states: Any, memory: ComponentMemory, cut: Any) -> LoopState:
        """Return the moment of all formations."""
        stamp: Any = np.asarray(step, np.int32)
        return LoopState(stamp, states, cut, memory)

    def advance(self, now: LoopState, counts: Array, reference: Array | None) -> Chunk:
        """Store frames and take steps; divergence is detected afterwards."""
        if now is not self._moment:
            self._load(now)
        chunk = self._advance(now, counts, reference)
        if self.fallback is None or not np.any(chunk.inexact):
            return chunk
        self._moment = None
        self._fallback_step = int(now.step) if self._fallback_step < 0 else self._fallback_step
        return self.fallback.advance(now, counts, reference)

    def replace_loop(self, loop: Loop) -> None:
        """Continue with a loop of one formation that differs from this one only in numbers."""
        self.loop, self.loops = loop, [loop]
        self.varying.replace_loop(loop)
        self.edge_weights[:] = neighbour_slots(loop, self.places)[2]
        self.given.forget([loop])
        self.table.forget([loop])
        # Offsets and numbers are written with a moment.
        self._moment = None

    def _advance(self, now: LoopState, counts: Array, reference: Array | None) -> Chunk:
        self._clear_sums()
        first = int(now.step)
        table = None if reference is None else np.ascontiguousarray(reference, self.dtype)
        step, agents = first, len(self.places.position)
        start, sizes = np.asarray(now.states), [len(self.rows.state), len(self.rows.input)]
        x, u = (self.buffers.empty((len(counts), agents, size), float) for size in sizes)
        # Neither is written to, and a copy for many agents takes as long as a step.
        same = len(counts) == 1 and start.dtype == x.dtype and self._new(step) is None
        x = start[None] if same else x
        for k, count in enumerate(counts.tolist()):
            if step > first:
                self._read(self.rows.state, x[k])
            elif not same:
                x[k] = start
            self._renew(step, x[k])
            if count:
                self._run(step, count, first, table)
                self._read(self.rows.input, u[k])
                step += count
            elif k == 0 or counts[k - 1]:
                self._read_next_inputs(step, first, table, u[k])
            else:
                u[k] = u[k - 1]
        self._find_inexact()
        self._moment, sums = self._moment_and_sums(first, step)
        return Chunk(self._moment, x, u, sums, inexact=self._inexact)

    def _read_next_inputs(self, step: int, first: int, table: Array | None, out: Array) -> None:
        """Read the inputs of a step that is not taken."""
        self._enter(step)
        arrays = (self.blocks, self.edges, *self.mirrors, *self.table.changing, self._pairs.least)
        copies = [array.copy() for array in arrays]
        self._run(step, 1, first, table)
        self._read(self.rows.input, out)
        self._find_inexact()
        self._pairs.undo()
        self.mirrors.reverse()
        for array, before in zip(arrays, copies, strict=True):
            array[:] = before

    def _run(self, step: int, steps: int, first: int, table: Array | None) -> None:
        """Take steps, one stretch at a time; the rows then have the first inputs."""
        input_step = step
        most = _TASKS // len(self.places.segments)
        if self.plan.leaders_ahead:
            size = self.plan.mirror + self.plan.message_size * self.plan.lanes
            most = min(most, _LEADER_NUMBERS // (self.leader_blocks * size))
        while steps:
            self._begin_span(step)
            constant = self._enter(step)
            self._restart(step)
            count = min(steps, self._pairs.steps, max(1, most), constant)
            later = self._events[self._events > step]
            count = min(count, int(later[0]) - step) if len(later) else count
            count = min(count, self.given.left(step), self.table.left(step))
            for name, values in self.table.rows(step).items():
                self._write(getattr(self.rows, name), values)
            self._call(step, count, input_step, None if table is None else table[step - first :])
            step, steps = step + count, steps - count

    def _enter(self, step: int) -> int:
        """Take the links of a step, and who is there; return for how many steps they stay."""
        row, constant = self.loop.graph.stretch(step)
        self.neighbourhood = self.neighbourhood._replace(weights=self.edge_weights[row])
        roster = self.loop.roster
        if isinstance(roster, ActiveAgents):
            here = np.asarray(roster.rows[row])
            self._write(self.rows.here, np.tile(here, len(self.loops))[:, None])
            leaders = self.places.leaders_of(roster.nearest[row], self.plan.width)
            self.neighbourhood = self.neighbourhood._replace(leaders=leaders)
            self._pairs.among(here)
            ends = here[np.asarray(self.loop.meter.edges)]
            self._unmeasured = self.places.of_edges(np.asarray(~ends.all(axis=1)))
        return constant

    def _new(self, step: int) -> Array | None:
        """Return which agents of all formations begin anew at a step; None for none."""
        new = self.loop.roster.restarting(step)
        return None if new is None or not new.any() else np.tile(new, len(self.loops))

    def _renew(self, step: int, states: Array) -> None:
        """Make states those of the start, of the agents that begin anew at a step."""
        new = self._new(step)
        if new is not None:
            states[new] = np.asarray(self.states, self.dtype)[new]

    def _restart(self, step: int) -> None:
        """Let the agents begin anew that do at a step."""
        new = self._new(step)
        if new is not None:
            x, memory, cut = self._read_moment()
            self._renew(step, x)
            memory[new], cut[new] = self._begun()[new], 0.0
            now = self._whole(step, x, memory, cut)
            angles = has_angles(self.loop.laws.follower)
            self._load(self._beside_others(now, new) if angles else now)

    def _beside_others(self, now: LoopState, new: Array) -> LoopState:
        """Return a moment with the headings of those who begin beside those of the others."""
        laws = list[LawMemories]()
        for k, (loop, begins) in enumerate(zip(self.loops, np.split(new, len(self.loops)))):
            mine = of_formation(self.loops, now, k)
            there = np.asarray(loop.roster.here(mine.step)) & ~begins
            other = said_by(loop, mine)[int(there.argmax())]
            own = mine.memory.laws, jnp.asarray(begins & there.any()), other
            laws.append(loop.laws.beside(*own))
        joined = jax.tree.map(lambda *parts: np.concatenate(parts), *laws)
        return now._replace(memory=now.memory._replace(laws=joined))

    def _call(self, step: int, steps: int, input_step: int, table: Array | None) -> None:
        """Run the kernel; each step exchanges the two mirrors."""
        places, plan, arrays = self.places, self.plan, self.neighbourhood._asdict()
        if plan.leaders_ahead:
            mirrors = aligned((steps + 1, *self._leader_mirror.shape), self.dtype)
            mirrors[0] = self._leader_mirror
            size = (steps, self.leader_blocks, plan.message_size, plan.lanes)
            arrays |= {"leader_mirrors": mirrors, "leader_messages": aligned(size, self.dtype)}
        values = {name: array.ctypes.data for name, array in arrays.items()}
        values |= {} if table is None else {"table": table.ctypes.data}
        values |= {"first_step": step, "steps": steps, "input_step": input_step}
        values |= {"leader_blocks": self.leader_blocks, "row_stride": places.row_stride}
        values |= {"blocks": int(places.segments[-1]), "edge_blocks": places.edge_blocks}
        values["first_steady"] = int(self.loop.meter.first_steady)
        now, after = self.mirrors
        firsts = {"rows": self.blocks, "mirror": now, "next_mirror": after, "edges": self.edges}
        if self.plan.given:
            firsts["ahead"] = self.given.of(step)
            values["ahead_step"] = firsts["ahead"].size
        for all_, own in zip((firsts, values), self.table.arguments(step), strict=True):
            all_ |= own
        firsts["pairs"], values["pair_count"] = self._pairs.least, self._pairs.least.shape[1]
        values["pair_ends"] = self._pairs.ends.ctypes.data
        tape = self._pairs.room(step, steps)
        if tape.size:
            values["tape_step"], firsts["tape"] = tape.size, tape
        uniform_values = np.empty(steps * self.uniform_count, self.dtype)
        totals = self.edges[..., -1, :]
        before = totals.copy() if self._unmeasured.any() else totals
        self.threads.run(self.code, values, firsts, uniform_values)
        if before is not totals:
            np.copyto(totals, before, where=self._unmeasured)
        if steps % 2 and not plan.listens_first:
            self.mirrors.reverse()
        if plan.leaders_ahead:
            self._leader_mirror[:] = arrays["leader_mirrors"][-1]

    @property
    def _leader_mirror(self) -> Array:
        if self.plan.row_major:
            return self.mirrors[0][:, : self.leader_blocks * self.plan.lanes]
        return self.mirrors[0][: self.leader_blocks]

    # ---- spans between events ----

    def _begin_span(self, step: int) -> None:
        """Keep what was measured before an event, if there is one at a step, and begin anew."""
        if step not in self._events:
            return
        rows, size = self.rows, (len(self.places.position), 1)
        late, peak = (self._read(part, np.empty(size)) for part in (rows.unsettled, rows.peak))
        self._end_span(step, late, peak)
        first = rows.errors.start
        for part in (rows.unsettled.start, rows.peak.start):
            self.blocks[:, part] = self._no_sums[part - first]

    def _end_span(self, step: int, late: Array, peak: Array) -> None:
        """Keep the last steps above the bound and the largest errors until a step, each (N, 1)."""
        at = int(np.searchsorted(self._events, step - 1, side="right")) - 1
        self._unsettled = np.maximum(self._unsettled, late)
        if at >= 0:
            self._late[:, at] = np.maximum(self._late, late)[:, at]
            # NaN of a state that is not finite stays, as in JAX.
            self._peaks[:, at] = np.maximum(self._peaks, np.maximum(-peak, 0.0))[:, at]

    # ---- moments and sums ----

    def _load(self, now: LoopState) -> None:
        rows, x = self.rows, np.asarray(now.states, self.dtype)
        offsets = offsets_of(self.loops, self.dtype)
        self._write(rows.state, x)
        self._write(rows.offset, offsets)
        self._write(rows.cut, np.asarray(now.cut))
        self._write(
            rows.varying, np.repeat(self.varying.values, len(self.loop.places.offsets), axis=0)
        )
        if not self.plan.listens_first:
            shown = bool(shown_size(self.loop))
            self._write_mirror(mirror_values(self.loops, now, x, offsets, shown))
        memory = now.memory
        self._write(rows.memory, self._rows_of(memory.laws, memory.sensing, memory.plant))
        self._write(rows.packet, self.table.load(int(now.step), memory.network))
        if len(rows.agent):
            leaves = [
                np.concatenate(part) for part in zip(*map(agent_rows, self.loops), strict=True)
            ]
            flat = [leaf.reshape(len(x), -1) for leaf in leaves[1:]]
            self._write(rows.agent, np.concatenate(flat, axis=1))

    def _write_mirror(self, values: Array) -> None:
        if self.plan.row_major:
            self.mirrors[0][:, : len(self.places.agents)] = values[self.places.agents].T
            return
        if self.plan.batched:
            rows = self.mirrors[0].reshape(self.places.blocks, -1, self.plan.lanes)
            self.threads.copy(rows, range(self.plan.width), values, inward=True)
            return
        lanes = values[self.places.agents].reshape(self.places.blocks, self.plan.lanes, -1)
        wide = self.mirrors[0].reshape(*lanes.shape[:2], -1)
        # NaN as the flag of large angles: the kernel then checks.
        wide[:, :, : self.plan.width] = np.nan
        wide[:, :, : values.shape[1]] = lanes

    def _moment_and_sums(self, first: int, step: int) -> tuple[LoopState, Sums]:
        rows, kind = self.rows, np.float64
        sums = range(rows.errors.start, rows.tracking.start)
        now = self._whole(step, *self._read_moment())
        agents = len(self.places.position)
        return now, self._sums(
            first, step, self._read(sums, self.buffers.empty((agents, len(sums)), kind))
        )

    def _read_moment(self) -> list[Array]:
        """Return states, memories and cuts of all agents."""
        parts, agents = (self.rows.state, self.rows.memory, self.rows.cut), len(self.states)
        return [
            self._read(part, self.buffers.empty((agents, len(part)), self.dtype)) for part in parts
        ]

    def _whole(self, step: int, x: Array, memory: Array, cut: Array) -> LoopState:
        """Return the moment at a step of these, and of what else is in the blocks."""
        whole, packet = self._memory(memory), self.rows.packet
        packets = self._read(packet, np.empty((len(x), len(packet)), self.dtype))
        starts = self.loop.roster.begin(np.asarray(self.states, self.dtype))
        whole = whole._replace(network=self.table.memory(step, packets), roster=starts)
        return self._moment_of(step, x, whole, cut.astype(np.int8))

    def _find_inexact(self) -> None:
        """Note the formations whose numbers are not what JAX computes."""
        row = self.rows.exception.start
        if self.blocks[:, row].any():
            positions = np.flatnonzero(self.blocks[:, row])
            self._inexact[self.places.agents[positions] // len(self.loop.places.offsets)] = True

    def _clear_sums(self) -> None:
        self._inexact = np.zeros(len(self.loops), bool)
        self._pairs.clear()
        self.blocks[:, self.rows.errors.start :] = self._no_sums
        self.edges[..., -1, :] = 0.0
        self._events = np.asarray(self.loop.meter.events)
        size = len(self.places.position), len(self._events)
        self._peaks, self._late = np.zeros(size), np.full(size, -1.0)
        self._unsettled = np.full((size[0], 1), -1.0)

    def _sums(self, first: int, end: int, agent_sums: Array) -> Sums:
        rows, meter = self.rows, self.loop.meter
        first_agents = len(self.loop.places.offsets) * np.arange(len(self.loops))[:, None]
        # Backup leaders are not measured as such.
        leaders = first_agents + np.asarray(meter.leaders)
        steady = max(0, end - max(first, int(meter.first_steady)))
        begin = rows.errors.start

        def of(places: range) -> Array:
            return agent_sums[:, places.start - begin : places.stop - begin]

        def of_leaders(places: range) -> Array:
            block, lane = np.divmod(self.places.position[leaders.reshape(-1)], self.plan.lanes)
            return self.blocks[block, places.start : places.stop, lane].astype(np.float64)

        peak = of(rows.peak) if len(self._events) else np.zeros((len(agent_sums), 1))
        self._end_span(end, of(rows.unsettled), peak)
        # No minimum is infinite, as in JAX.
        low, high = (np.where(x >= ALWAYS, np.inf, x) for x in map(of, (rows.lowest, rows.highest)))
        sums = Sums(
            steps=np.array([end - first, steady]),
            errors=_total_and_window(of(rows.errors)),
            tracking=_total_and_window(of_leaders(rows.tracking)),
            outputs=of_leaders(rows.outputs),
            effort=of(rows.effort)[:, 0],
            spacing=self.places.spacing(self.edges),
            limited=of(rows.limited)[:, 0],
            unsettled=self._unsettled[:, 0],
            inside=np.minimum(of(rows.inside), ALWAYS),
            chatter=of(rows.chatter)[:, 0],
            **dict.fromkeys(("separation", "avoidance"), np.zeros((len(agent_sums), 0))),
            **self._pairs.terms(),
            peaks=self._peaks,
            late=self._late,
            lowest=low,
            highest=-high,
        )
        return Sums(*(np.asarray(part, np.float64) for part in sums)).split(len(self.loops))


def _total_and_window(sums: Array) -> Array:
    """Return the sums of all steps and of the steady window (2, N) from those before and in it."""
    return np.stack([sums[:, 0] + sums[:, 1], sums[:, 1]])


def offsets_of(loops: Sequence[Loop], dtype: np.dtype) -> Float[Array, "N n"]:
    """Return the goals' offsets of all agents, loop by loop."""
    # Runs that differ only in their initial states share one loop, and are often thousands.
    distinct = {id(loop): loop for loop in loops}
    offsets = {k: np.asarray(loop.places.offsets, dtype) for k, loop in distinct.items()}
    if len(offsets) == 1:
        return np.tile(offsets[id(loops[0])], (len(loops), 1))
    return np.concatenate([offsets[id(loop)] for loop in loops])


def mirror_values(
    loops: Sequence[Loop],
    now: LoopState,
    x: Float[Array, "N n"],
    offsets: Float[Array, "N n"],
    with_signals: bool,
) -> Float[Array, "N k"]:
    """Return what neighbours read of all agents.

    Args:
        loops: of formations one after the other, with the same number of agents each.
        now: the moment.
        x: the states at that moment.
        offsets: of their goals.
        with_signals: whether they also send signals.
    """
    relative = x - offsets
    if not with_signals:
        return relative
    each = (said_by(loop, of_formation(loops, now, k)) for k, loop in enumerate(loops))
    return np.concatenate([relative, np.concatenate([*map(np.asarray, each)])], axis=1)


def of_formation(loops: Sequence[Loop], now: LoopState, k: int) -> LoopState:
    """Return the states of one of some formations, and what its laws remember."""
    laws = loops[0].laws
    counts = len(loops[0].places.offsets), len(laws.leaders), len(laws.followers)
    all_, *groups = (slice(k * count, (k + 1) * count) for count in counts)
    pairs = zip(groups, now.memory.laws, strict=True)
    own = (jax.tree.map(lambda x, some=some: x[some], each) for some, each in pairs)
    mine = now._replace(states=now.states[all_], memory=now.memory._replace(laws=LawMemories(*own)))
    return jax.tree.map(jnp.asarray, mine)


@cached_jit
def begin_many(loop: Loop, states: Float[jax.Array, "F N n"]) -> LoopState:
    """Return the moments at which runs begin in one loop."""
    return jax.vmap(begin, (None, 0))(loop, states)


def _unflatten(like: Any, flat: Array) -> Any:
    """Return a tree of leaves (1, ...) with rows of numbers (N, k) in them."""
    leaves, tree = jax.tree.flatten(like)
    ends = np.cumsum([0, *(leaf.size for leaf in leaves)]).tolist()
    parts = zip(leaves, ends[:-1], ends[1:], strict=True)
    return tree.unflatten(
        [flat[:, a:b].reshape((len(flat), *leaf.shape[1:])) for leaf, a, b in parts]
    )


_MOST, _LARGE = 16, 2**20
"""The most arrays of a pool, and their least bytes: smaller ones the system's allocator reuses."""


def _holders(owners: list[Array], k: int) -> int:
    """Return the number of references to one of some arrays, or to views of it."""
    return sys.getrefcount(owners[k])


_UNUSED = _holders([np.empty(0, np.uint8)], 0)


@final
class BufferPool:
    """Returns arrays, in the memory of earlier ones without references, if there are any.

    A large array with new pages costs more time than writing to it: a virtual machine gets them
    from its host, which clears them.
    """

    def __init__(self) -> None:
        self._owners = list[Array]()

    def empty(self, shape: tuple[int, ...], dtype: np.dtype | type) -> Array:
        """Return an array with arbitrary numbers."""
        kind, owners = np.dtype(dtype), self._owners
        size = math.prod(shape) * kind.itemsize
        if size < _LARGE:
            return np.empty(shape, kind)
        free = [k for k in range(len(owners)) if _holders(owners, k) == _UNUSED]
        fits = [k for k in free if len(owners[k]) == size]
        if not fits:
            # Free memory of other sizes is from earlier runs, and is released.
            in_use = [owner for k, owner in enumerate(owners) if k not in free][1 - _MOST :]
            self._owners, fits = [*in_use, np.empty(size, np.uint8)], [-1]
        return self._owners[fits[0]].view(kind).reshape(shape)
