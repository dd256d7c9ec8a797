"""The closed loop stepped by code for this machine: agents in the lanes of vectors."""

from collections.abc import Sequence
from concurrent.futures import Executor
from typing import Any, final

import jax
import jax.numpy as jnp
import numpy as np

from echelon.core.types import Array
from echelon.engine.code import KERNELS, LANES, Make
from echelon.engine.crew import Crew
from echelon.engine.drive import Chunk, Stepper
from echelon.engine.loop import Loop, Moment, begin, begin_forgetful, signals
from echelon.engine.own import Own
from echelon.engine.places import Formations, Places, Swarm, heard
from echelon.engine.scalars import memories_of, signals_of
from echelon.engine.sums import ALWAYS, Sums
from echelon.engine.winds import draw_holds, holds_at_once
from echelon.kernels import aligned, needed, stride

_AGENT_STEPS, _FEWEST = 2_000_000, 4
"""Of a chunk: some hundredths of a second."""
_OPERATIONS, _ENOUGH = {64: 2e10, 32: 4e10}, 1_000
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
        self.own = Own(loops, unlike)
        self.loop, self.loops, self.states, self.far = loops[0], loops, states, far
        self.bits, self.dtype = bits, np.dtype(np.float64 if bits == 64 else np.float32)
        together, lanes = len(loops) > 1, LANES[bits]
        known = places or (Formations(loops, lanes) if together else Swarm(self.loop, lanes))
        self.places: Places = known
        self.crew = Crew(self.places, pool, threads)
        # Numbers of formations follow each other.
        each = len(self.loop.offsets) * np.arange(len(loops))[:, None]
        self.leaders = (each + self.loop.leaders).reshape(-1)
        self.followers = (each + self.loop.followers).reshape(-1)
        lines, turned = self.places.lines, unlike is not None
        made = (make or KERNELS.of)(self.own, bits, together, lines, turned)
        self.code, self.rows, self.plan, self.common = made
        self._signaled = signals_of(self.loop)
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
            assert isinstance(places, Swarm)
            parts = (self.blocks, *self.mirrors, *self.found[1:3], *self.found[5:7])
            bytes_ = sum(part.nbytes for part in parts) // places.blocks
            far = 1 if plan.lines else stride(plan.width, plan.lanes)
            places.measure(self.found, far, bytes_)
        self.edges, self.heavy = self.found.edges, self.found.weights

    def _read(self, *parts: range, out: Array | None = None) -> Array:
        """Return parts of the rows of all agents, (N, rows), in an array that is given or new."""
        ends = np.cumsum([len(rows) for rows in parts]).tolist()
        dtype = self.dtype if out is None else out.dtype
        turned = np.empty((len(self.blocks), self.plan.lanes, ends[-1]), dtype)
        for rows, end in zip(parts, ends, strict=True):
            part = self.blocks[:, rows.start : rows.stop]
            turned[..., end - len(rows) : end] = part.transpose(0, 2, 1)
        flat = turned.reshape(len(self.places.agents), -1)
        # Places are right, and to look at each would take a copy.
        return np.take(flat, self.places.of, axis=0, out=out, mode="clip")

    def _write(self, rows: range, values: Array) -> None:
        """Write values of all agents, (N, rows)."""
        lanes = self.places.lanes
        shaped = values[self.places.agents].reshape(self.places.blocks, lanes, len(rows))
        self.blocks[:, rows.start : rows.stop] = shaped.transpose(0, 2, 1)

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
        if self.far is None or not beyond(made.states, self.bits).any():
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
        x, u = (np.empty((len(counts), agents, len(r))) for r in (self.rows.state, self.rows.input))
        for k, count in enumerate(counts.tolist()):
            if step == first:
                x[k] = now.states
            else:
                self._read(self.rows.state, out=x[k])
            if count:
                self._run(step, count, first, table)
                self._read(self.rows.input, out=u[k])
                step += count
            elif step == first or counts[k - 1]:
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
        self._read(self.rows.input, out=out)
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
        row, count = self.loop.stretch(step)
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
        offsets = np.concatenate([np.asarray(loop.offsets, self.dtype) for loop in self.loops])
        self._write(rows.state, x)
        self._write(rows.offset, offsets)
        self._write(rows.cut, np.asarray(now.cut))
        self._write(rows.own, np.repeat(self.own.values, len(self.loop.offsets), axis=0))
        self._show(np.concatenate([x - offsets, *self._signals(now, offsets)], axis=1))
        memory = np.zeros((len(x), len(rows.memory)))
        for who, tree in ((self.leaders, now.leader_memory), (self.followers, now.follower_memory)):
            leaves = [np.asarray(leaf).reshape(len(who), -1) for leaf in jax.tree.leaves(tree)]
            flat = np.concatenate([np.zeros((len(who), 0)), *leaves], axis=1)
            memory[who, : flat.shape[1]] = flat
        self._write(rows.memory, memory)
        self._drawn = -1

    def _signals(self, now: Moment, offsets: Array) -> list[Array]:
        """Return what neighbours hear of all agents beside their states, (N, s), if anything."""
        if not self._signaled:
            return []
        counts = [len(self.loop.offsets), len(self.loop.leaders), len(self.loop.followers)]
        found = list[Array]()
        for k, loop in enumerate(self.loops):
            all_, led, others = (slice(k * count, (k + 1) * count) for count in counts)
            mine = now._replace(
                states=now.states[all_],
                leader_memory=jax.tree.map(lambda leaf, led=led: leaf[led], now.leader_memory),
                follower_memory=jax.tree.map(lambda leaf, o=others: leaf[o], now.follower_memory),
            )
            found.append(np.asarray(signals(loop, mine, jnp.asarray(offsets[all_]))))
        return [np.concatenate(found)]

    def _show(self, values: Array) -> None:
        """Write what neighbours read of all agents, (N, n), or more beside their states."""
        if self.plan.lines:
            self.mirrors[0][:, : len(self.places.agents)] = values[self.places.agents].T
            return
        shown = values[self.places.agents].reshape(self.places.blocks, self.plan.lanes, -1)
        if self.plan.together:
            self.mirrors[0][:] = shown.transpose(0, 2, 1).reshape(self.places.blocks, -1)
            return
        wide = self.mirrors[0].reshape(*shown.shape[:2], -1)
        # Whether an angle is large is left open, and seen by the kernel.
        wide[:, :, : self.plan.width] = np.nan
        wide[:, :, : values.shape[1]] = shown

    def _leave(self, first: int, step: int) -> tuple[Moment, Sums]:
        """Return what is in the blocks as a moment, and the sums from one step to another."""
        loop, rows = self.loop, self.rows
        sums = range(rows.errors.start, rows.tracking.start)
        parts = (rows.state, rows.memory, rows.cut, sums)
        # All at once, since each reads the memory of all agents in another order.
        found = np.split(self._read(*parts), np.cumsum([len(r) for r in parts[:-1]]), axis=1)
        x, memory, cut, kept = found
        now: Any = [
            np.asarray(step, np.int32),
            np.ascontiguousarray(x),
            memories_of(loop.leader, memory[self.leaders]),
            memories_of(loop.follower, memory[self.followers]),
            cut.astype(np.int8),
        ]
        return Moment._make(now), self._sums(first, step, kept)

    def _clear_sums(self) -> None:
        first = self.rows.errors.start
        self.blocks[:, first:] = 0.0
        self.blocks[:, self.rows.unsettled.start] = -1.0
        self.blocks[:, self.rows.inside.start : self.rows.inside.stop] = ALWAYS
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
        return Sums(*(np.asarray(part, np.float64) for part in found))


def _whole(parted: Array) -> Array:
    """Return sums of all steps and of the steady window (2, N) from those before it and in it."""
    return np.stack([parted.sum(axis=1), parted[:, 1]])
