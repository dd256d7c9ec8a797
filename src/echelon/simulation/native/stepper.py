"""The closed loop stepped by code for this machine: agents in the lanes of vectors."""

from collections.abc import Sequence
from concurrent.futures import Executor
from typing import Any, final

import jax
import jax.numpy as jnp
import numpy as np

from echelon.core.types import Array
from echelon.simulation.codegen import aligned, stride
from echelon.simulation.native.agent_step import memories_of, signals_of
from echelon.simulation.native.blocks import FormationBlocks, Places, SwarmBlocks, heard
from echelon.simulation.native.buffers import BufferPool
from echelon.simulation.native.kernel_cache import KERNELS, LANES, Make
from echelon.simulation.native.signals import offsets_of, shown_by
from echelon.simulation.native.threads import ThreadPool
from echelon.simulation.native.varying import VaryingNumbers
from echelon.simulation.native.wind_draws import draw_holds, holds_at_once
from echelon.simulation.scalars import needed
from echelon.simulation.step.drive import Chunk, Stepper
from echelon.simulation.step.loop import Loop, Moment, begin_forgetful, stretch_at
from echelon.simulation.step.meter import ALWAYS, Sums
from echelon.simulation.step.sequence import begin

_AGENT_STEPS, _FEWEST = 2_000_000, 4
"""Of a chunk: some hundredths of a second."""
_OPERATIONS, _ENOUGH = {64: 3e10, 32: 6e10}, 1_000
"""Of a chunk with no more steps than enough: about a second of one thread."""
_LARGEST = {64: 1e5, 32: 1e3}
"""Of a state: beyond it the sines of the kernels lose digits, and JAX goes on."""
STEPS, _TURNS, _KEPT = 2_048, 200_000, 10_000_000
"""Of a call: what all agents have in common is kept for each of them, and each level has a turn.

And the numbers of leaders ahead that are kept.
"""


def beyond(states: Array, bits: int) -> Array:
    """Return which states are beyond the range of the kernels' sines; NaN is not."""
    # Truths alone, since another array of so many numbers takes longer than all the rest of it.
    return (states > _LARGEST[bits]) | (states < -_LARGEST[bits])


def any_beyond(states: Array, bits: int) -> bool:
    """Tell whether one of the states is beyond that range."""
    most = _LARGEST[bits]
    # A third of the time of truths for all; of NaN no comparison holds, and the truths tell.
    fit = -most <= states.min(initial=0.0) and states.max(initial=0.0) <= most
    return not fit and bool(beyond(states, bits).any())


@final
class NativeStepper(Stepper):
    """Moves the agents of a formation, or of many that are alike, under laws.

    Args:
        loops: of the run, or of each formation.
        states: (N, n) at its beginning, formation by formation.
        bits: 64 or 32, the precision.
        far: what goes on where a state is beyond the range of the kernels' sines; None where the
            caller looks.
        pool: threads that step formations; None for the caller's alone.
        make: makes the kernel, or has made it before; those of all runs when left out.
        unlike: a loop like the one of the run: where it differs, `turn` may change it, and the
            weights of edges anyway; None where nothing is turned.
        threads: that share the steps of one formation; by its size when left out.
        places: of the agents, where they are known.

    Raises:
        Unsupported: a law or the model uses what has no scalar operations.
    """

    def __init__(
        self,
        loops: Sequence[Loop],
        states: Array,
        bits: int,
        far: Stepper | None,
        pool: Executor | None = None,
        make: Make | None = None,
        unlike: Loop | None = None,
        threads: int | None = None,
        places: Places | None = None,
    ) -> None:
        """Write and compile the step."""
        self.own = VaryingNumbers(loops, unlike)
        self.loop, self.loops, self.states, self.far = loops[0], loops, states, far
        self.bits, self.dtype = bits, np.dtype(np.float64 if bits == 64 else np.float32)
        together, lanes = len(loops) > 1, LANES[bits]
        known = places or (
            FormationBlocks(loops, lanes) if together else SwarmBlocks(self.loop, lanes)
        )
        self.places: Places = known
        self.crew, self.room = ThreadPool(self.places, pool, threads), BufferPool()
        # Numbers of formations follow each other.
        each = len(self.loop.offsets) * np.arange(len(loops))[:, None]
        self.leaders = (each + self.loop.leaders).reshape(-1)
        self.followers = (each + self.loop.followers).reshape(-1)
        lines, turned = self.places.lines, unlike is not None
        made = (make or KERNELS.of)(self.own, bits, together, lines, turned)
        self.code, self.rows, self.plan, self.common = made
        self._signaled = signals_of(self.loop)
        # Once, since to ask a law takes as long as many small steps.
        self.memories = self.loop.leader.init(), self.loop.follower.init()
        self._work = 1 + len(needed(self.plan.others.results()))
        self._reserve()
        # What is in the blocks, so that a chunk that goes on from it need not be written there.
        self._held: Moment | None = None
        self._drawn, self._left = -1, -1
        self._tape: Array | None = None
        self._ahead = holds_at_once(len(states))

    # ---- memory ----

    def _reserve(self) -> None:
        """Make what never changes during a run, and room for what does."""
        places, plan = self.places, self.plan
        self.blocks = aligned((places.blocks, plan.rows, plan.lanes), self.dtype)
        shape = (plan.width, places.line) if plan.lines else (places.blocks, plan.mirror)
        self.mirrors = [aligned(shape, self.dtype) for _ in range(2)]
        self.found = places.find(plan.width, plan.told if plan.ahead else plan.rows, self.dtype)
        self.led = int(places.segments[1])
        if plan.ahead:
            assert isinstance(places, SwarmBlocks)
            parts = (self.blocks, *self.mirrors, *self.found[1:3], *self.found[5:7])
            bytes_ = sum(part.nbytes for part in parts) // places.blocks
            far = 1 if plan.lines else stride(plan.width, plan.lanes)
            places.measure(self.found, far, bytes_)
        self.edges, self.heavy = self.found.edges, self.found.weights

    def _read(self, rows: range, out: Array) -> Array:
        """Read rows of all agents into an array (N, rows), and return it."""
        self.crew.move(self.blocks, rows, out)
        return out

    def _write(self, rows: range, values: Array) -> None:
        """Write values of all agents, (N, rows)."""
        self.crew.move(self.blocks, rows, np.ascontiguousarray(values, self.dtype), inward=True)

    # ---- steps ----

    @property
    def engine(self) -> str:
        """What computes the steps."""
        return "native"

    @property
    def warnings(self) -> tuple[str, ...]:
        """Where it left the steps to JAX."""
        told = (
            f"JAX stepped the agents from t = {self._left * self.loop.motion.dt:.6g} s on where a "
            f"state was beyond {_LARGEST[self.bits]:g}, since the sines of native code lose digits "
            "there."
        )
        return (told,) * (self._left >= 0)

    @property
    def longest(self) -> int:
        """Steps that take some tenths of a second, or a few of very many agents."""
        agents = len(self.states) // len(self.loops)
        more = int(_OPERATIONS[self.bits] / (self._work * agents))
        return max(_FEWEST, _AGENT_STEPS // agents, min(_ENOUGH, more))

    @property
    def largest(self) -> float:
        """The magnitude of states beyond which kernels lose digits."""
        return _LARGEST[self.bits]

    def start(self) -> Moment:
        """Return the moment at which the run begins."""
        states = np.asarray(self.states, self.dtype)
        if not len(self.rows.memory):
            return begin_forgetful(self.loop, states)
        each = zip(self.loops, np.split(np.asarray(self.states), len(self.loops)), strict=True)
        found = [jax.tree.map(np.asarray, begin(loop, jnp.asarray(x))) for loop, x in each]
        many = jax.tree.map(lambda *leaves: np.concatenate(leaves), *(each[1:] for each in found))
        return Moment(found[0].step, *many)._replace(states=states)

    def advance(self, now: Moment, counts: Array, reference: Array | None) -> Chunk:
        """Store frames and take steps; what happens on the way is seen afterwards."""
        if now is not self._held:
            self._load(now)
        made = self._fly(now, counts, reference)
        if self.far is None or not any_beyond(made.states, self.bits):
            return made
        self._held = None
        self._left = int(now.step) if self._left < 0 else self._left
        return self.far.advance(now, counts, reference)

    def turn(self, loop: Loop) -> None:
        """Go on in a loop of one formation that is like the one before, but for its numbers."""
        self.loop, self.loops = loop, [loop]
        self.own.turn(loop)
        self.heavy[:] = heard(loop, self.places)[2]
        # Offsets, numbers and the wind are written with a moment.
        self._held = None

    def record(self, tape: Array | None, first: int) -> None:
        """Keep what derivatives need of the steps from one on: (steps, blocks, taped, lanes)."""
        self._tape, self._taped_from = tape, first

    def _fly(self, now: Moment, counts: Array, reference: Array | None) -> Chunk:
        self._clear_sums()
        first = int(now.step)
        table = None if reference is None else np.ascontiguousarray(reference, self.dtype)
        step, agents = first, len(self.places.of)
        begun, sizes = np.asarray(now.states), [len(self.rows.state), len(self.rows.input)]
        x, u = (self.room.empty((len(counts), agents, size), float) for size in sizes)
        # Nobody writes to either, and to copy many takes as long as a step.
        same = len(counts) == 1 and begun.dtype == x.dtype
        x = begun[None] if same else x
        for k, count in enumerate(counts.tolist()):
            if step > first:
                self._read(self.rows.state, x[k])
            elif not same:
                x[k] = begun
            if count:
                self._run(step, count, first, table)
                self._read(self.rows.input, u[k])
                step += count
            elif k == 0 or counts[k - 1]:
                self._look(step, first, table, u[k])
            else:
                u[k] = u[k - 1]
        self._held, sums = self._leave(first, step)
        return Chunk(self._held, x, u, sums)

    def _look(self, step: int, first: int, table: Array | None, out: Array) -> None:
        """Read the inputs of a step that is not taken."""
        changed = (self.blocks, self.edges, *self.mirrors)
        kept, drawn = [array.copy() for array in changed], self._drawn
        self._run(step, 1, first, table)
        self._read(self.rows.input, out)
        self.mirrors.reverse()
        for array, before in zip(changed, kept, strict=True):
            array[:] = before
        # What was drawn for it is gone from the blocks again.
        self._drawn = drawn

    def _run(self, step: int, steps: int, first: int, table: Array | None) -> None:
        """Take steps under one draw of the wind, and one stretch of the graph, after the other.

        The inputs of the first one are left in the rows.
        """
        wind, shown = self.loop.motion.wind, step
        most = _TURNS // len(self.places.segments)
        if self.plan.ahead:
            each = self.plan.mirror + self.plan.told * self.plan.lanes
            most = min(most, _KEPT // (self.led * each))
        while steps:
            count = min(steps, STEPS, max(1, most), self._switch(step))
            if wind is not None:
                hold = int(wind.window)
                self._draw(step // hold, hold)
                count = min(count, hold - step % hold)
            self._call(step, count, shown, None if table is None else table[step - first :])
            step, steps = step + count, steps - count

    def _switch(self, step: int) -> int:
        """Take the weights that hold at a step, and return for how many steps they do."""
        row, count = stretch_at(self.loop, step)
        self.found = self.found._replace(weights=self.heavy[row])
        return count

    def _draw(self, number: int, hold: int) -> None:
        """Write what wind and noise are during a hold."""
        if number == self._drawn:
            return
        first, at = number - number % self._ahead, number % self._ahead
        if first != self._drawn - self._drawn % self._ahead or self._drawn < 0:
            self._winds = draw_holds(self.loops, first + np.arange(self._ahead), hold)
        self._drawn = number
        for rows, part in zip((self.rows.push, self.rows.noise), self._winds, strict=True):
            if part is not None:
                self._write(rows, part[at].reshape(len(self.states), -1))

    def _call(self, step: int, steps: int, shown: int, table: Array | None) -> None:
        """Run the kernel; each step exchanges the two mirrors."""
        places, plan, arrays = self.places, self.plan, self.found._asdict()
        if plan.ahead:
            arrays["ahead"] = aligned((steps + 1, *self._led.shape), self.dtype)
            arrays["told"] = aligned((steps, self.led, plan.told, plan.lanes), self.dtype)
            arrays["ahead"][0] = self._led
        values = {name: array.ctypes.data for name, array in arrays.items()}
        values |= {} if table is None else {"table": table.ctypes.data}
        values |= {"first_step": step, "steps": steps, "shown": shown, "led_blocks": self.led}
        values |= {"blocks": int(places.segments[-1]), "edge_blocks": places.edge_blocks}
        values |= {"line": places.line, "first_steady": int(self.loop.meter.first_steady)}
        if self._tape is not None:
            now = self._tape[step - self._taped_from]
            values |= {"tape": now.ctypes.data, "tape_step": now.size}
        firsts = {"rows": self.blocks, "mirror": self.mirrors[0], "next_mirror": self.mirrors[1]}
        firsts["edges"] = self.edges
        common = np.empty(steps * self.common, self.dtype)
        self.crew.run(self.code, values, firsts, common)
        if steps % 2:
            self.mirrors.reverse()
        if plan.ahead:
            self._led[:] = arrays["ahead"][-1]

    @property
    def _led(self) -> Array:
        """What leaders show."""
        if self.plan.lines:
            return self.mirrors[0][:, : self.led * self.plan.lanes]
        return self.mirrors[0][: self.led]

    # ---- moments and sums ----

    def _load(self, now: Moment) -> None:
        """Write a moment into the blocks."""
        rows, x = self.rows, np.asarray(now.states, self.dtype)
        offsets = offsets_of(self.loops, self.dtype)
        self._write(rows.state, x)
        self._write(rows.offset, offsets)
        self._write(rows.cut, np.asarray(now.cut))
        self._write(rows.own, np.repeat(self.own.values, len(self.loop.offsets), axis=0))
        self._show(shown_by(self.loops, now, x, offsets, bool(self._signaled)))
        memory = np.zeros((len(x), len(rows.memory)))
        for who, tree in ((self.leaders, now.leader_memory), (self.followers, now.follower_memory)):
            leaves = [np.asarray(leaf).reshape(len(who), -1) for leaf in jax.tree.leaves(tree)]
            flat = np.concatenate([np.zeros((len(who), 0)), *leaves], axis=1)
            memory[who, : flat.shape[1]] = flat
        self._write(rows.memory, memory)
        self._drawn = -1

    def _show(self, values: Array) -> None:
        """Write what neighbours read of all agents, (N, n), or more beside their states."""
        if self.plan.lines:
            self.mirrors[0][:, : len(self.places.agents)] = values[self.places.agents].T
            return
        if self.plan.together:
            rows = self.mirrors[0].reshape(self.places.blocks, -1, self.plan.lanes)
            self.crew.move(rows, range(self.plan.width), values, inward=True)
            return
        shown = values[self.places.agents].reshape(self.places.blocks, self.plan.lanes, -1)
        wide = self.mirrors[0].reshape(*shown.shape[:2], -1)
        # Whether an angle is large is left open, and seen by the kernel.
        wide[:, :, : self.plan.width] = np.nan
        wide[:, :, : values.shape[1]] = shown

    def _leave(self, first: int, step: int) -> tuple[Moment, Sums]:
        """Return what is in the blocks as a moment, and the sums from one step to another."""
        rows = self.rows
        sums = range(rows.errors.start, rows.tracking.start)
        parts = (rows.state, self.dtype), (rows.memory, self.dtype), (rows.cut, self.dtype)
        x, memory, cut, kept = (
            self._read(part, self.room.empty((len(self.places.of), len(part)), kind))
            for part, kind in (*parts, (sums, np.float64))
        )
        now: Any = [
            np.asarray(step, np.int32),
            x,
            memories_of(self.memories[0], memory[self.leaders]),
            memories_of(self.memories[1], memory[self.followers]),
            cut.astype(np.int8),
        ]
        return Moment(*now), self._sums(first, step, kept)

    def _clear_sums(self) -> None:
        rows = self.rows
        nothing = np.zeros((rows.total, 1), self.dtype)
        nothing[rows.unsettled.start], nothing[rows.inside.start : rows.inside.stop] = -1.0, ALWAYS
        self.blocks[:, rows.errors.start :] = nothing[rows.errors.start :]
        self.edges[..., -1, :] = 0.0

    def _sums(self, first: int, end: int, kept: Array) -> Sums:
        """Return the sums over the steps from one to another, of which agents keep theirs."""
        rows, leaders, meter = self.rows, self.leaders, self.loop.meter
        steady = max(0, end - max(first, int(meter.first_steady)))
        begin = rows.errors.start

        def of(places: range) -> Array:
            return kept[:, places.start - begin : places.stop - begin]

        def led(places: range) -> Array:
            block, lane = np.divmod(self.places.of[leaders], self.plan.lanes)
            return self.blocks[block, places.start : places.stop, lane].astype(np.float64)

        found = Sums(
            steps=np.array([end - first, steady]),
            errors=_whole(of(rows.errors)),
            tracking=_whole(led(rows.tracking)),
            outputs=led(rows.outputs),
            effort=of(rows.effort)[:, 0],
            spacing=self.places.spacing(self.edges),
            limited=of(rows.limited)[:, 0],
            unsettled=of(rows.unsettled)[:, 0],
            inside=np.minimum(of(rows.inside), ALWAYS),
            chatter=of(rows.chatter)[:, 0],
        )
        sums = Sums(*(np.asarray(part, np.float64) for part in found))
        return sums.split(len(self.loops))


def _whole(parted: Array) -> Array:
    """Return sums of all steps and of the steady window (2, N) from those before it and in it."""
    return np.stack([parted[:, 0] + parted[:, 1], parted[:, 1]])
