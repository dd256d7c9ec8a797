"""The closed loop stepped by code for this machine: agents in the lanes of vectors."""

from collections.abc import Sequence
from concurrent.futures import Executor
from typing import Any, final

import jax
import jax.numpy as jnp
import numpy as np

from echelon.core.types import Array
from echelon.engine.code import LANES, Kernels, follows
from echelon.engine.crew import Crew
from echelon.engine.drive import Chunk, Stepper
from echelon.engine.loop import Loop, Moment, begin, signals
from echelon.engine.own import Own
from echelon.engine.places import Formations, Places, Swarm, heard
from echelon.engine.scalars import memories_of
from echelon.engine.sums import ALWAYS, Sums
from echelon.kernels import aligned
from echelon.world.disturbance import draw

_AGENT_STEPS, _FEWEST = 2_000_000, 4
"""Of a chunk: some tenths of a second."""
_AHEAD, _AT_ONCE = 64, 50_000
"""Holds of wind that are drawn in a call, and the most draws; a call takes half a millisecond."""
_LARGEST = {64: 1e5, 32: 1e3}
"""Of a state: beyond it the sines of the kernels lose digits, and JAX goes on."""
_STEPS = 2_048
"""Of a call: what all agents have in common is kept for each of them."""


def beyond(states: Array, bits: int) -> Array:
    """Return which states are beyond the range of the kernels' sines; NaN is not."""
    return np.abs(states) > _LARGEST[bits]


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
        kernels: those that were made before.
        unlike: a loop like the one of the run: where it differs, `turn` may change it, and the
            weights of edges anyway; None where nothing is turned.
        threads: that share the steps of one formation; by its size when left out.

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
        kernels: Kernels | None = None,
        unlike: Loop | None = None,
        threads: int | None = None,
    ) -> None:
        """Write and compile the step."""
        self.own = Own(loops, unlike)
        self.loop, self.loops, self.states, self.far = loops[0], loops, states, far
        self.follows = follows(self.loop)
        self.bits, self.dtype = bits, np.dtype(np.float64 if bits == 64 else np.float32)
        together, lanes = len(loops) > 1, LANES[bits]
        self.places: Places = Formations(loops, lanes) if together else Swarm(self.loop, lanes)
        self.crew = Crew(self.places, pool, threads)
        # Numbers of formations follow each other.
        each = len(self.loop.offsets) * np.arange(len(loops))[:, None]
        self.leaders = (each + self.loop.leaders).reshape(-1)
        self.followers = (each + self.loop.followers).reshape(-1)
        lines, turned = self.places.lines, unlike is not None
        made = (kernels or Kernels()).of(self.own, bits, together, lines, turned)
        self.code, self.rows, self.plan, self.common = made
        self._reserve()
        # What is in the blocks, so that a chunk that goes on from it need not be written there.
        self._held: Moment | None = None
        self._drawn, self._left = -1, -1
        self._ahead = max(1, min(_AHEAD, _AT_ONCE // len(states)))

    # ---- memory ----

    def _reserve(self) -> None:
        """Make what never changes during a run, and room for what does."""
        places, plan = self.places, self.plan
        self.blocks = aligned((places.blocks, plan.rows, plan.lanes), self.dtype)
        shape = (plan.width, places.line) if plan.lines else (places.blocks, plan.mirror)
        self.mirrors = [aligned(shape, self.dtype) for _ in range(2)]
        self.found = places.find(plan.width, plan.rows, self.dtype)
        self.edges, self.heavy = self.found.edges, self.found.weights

    def _read(self, rows: range) -> Array:
        """Return rows of all agents, (N, rows)."""
        part = self.blocks[:, rows.start : rows.stop].transpose(0, 2, 1)
        return part.reshape(len(self.places.agents), -1)[self.places.of]

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
        return max(_FEWEST, _AGENT_STEPS * len(self.loops) // len(self.states))

    def start(self) -> Moment:
        """Return the moment at which the run begins."""
        parts = np.split(np.asarray(self.states), len(self.loops))
        # Where nothing is remembered all begin alike.
        loops = self.loops if len(self.rows.memory) else self.loops[:1]
        found = [begin(loop, jnp.asarray(x)) for loop, x in zip(loops, parts)]
        found = [jax.tree.map(np.asarray, moment) for moment in found]
        found *= len(self.loops) // len(found)
        many = jax.tree.map(lambda *leaves: np.concatenate(leaves), *(each[1:] for each in found))
        return Moment(found[0].step, *many)._replace(states=np.asarray(self.states, self.dtype))

    def advance(self, now: Moment, counts: Array, reference: Array | None) -> Chunk:
        """Store frames and take steps; what happens on the way is seen afterwards."""
        if now is not self._held:
            self._load(now)
        made = self._fly(int(now.step), counts, reference)
        if self.far is None or not beyond(made.states, self.bits).any():
            return made
        self._held = None
        self._left = int(now.step) if self._left < 0 else self._left
        return self.far.advance(now, counts, reference)

    def turn(self, loop: Loop) -> None:
        """Go on in a loop of one formation that is like the one before, but for its numbers."""
        self.loop, self.loops = loop, [loop]
        self.own.values = self.own.of(loop)[None]
        self.heavy[:] = heard(loop, self.places)[2]
        # Offsets, numbers and the wind are written with a moment.
        self._held = None

    def _fly(self, first: int, counts: Array, reference: Array | None) -> Chunk:
        self._clear_sums()
        table = None if reference is None else np.ascontiguousarray(reference, self.dtype)
        step, states, inputs = first, list[Array](), list[Array]()
        for count in counts.tolist():
            states.append(self._read(self.rows.state))
            if count:
                self._run(step, 1, first, table)
                inputs.append(self._read(self.rows.input))
                self._run(step + 1, count - 1, first, table)
                step += count
            elif step == first or counts[len(inputs) - 1]:
                inputs.append(self._look(step, first, table))
            else:
                inputs.append(inputs[-1])
        self._held = self._moment(step)
        x, u = (np.stack(part).astype(np.float64) for part in (states, inputs))
        return Chunk(self._held, x, u, self._sums(first, step))

    def _look(self, step: int, first: int, table: Array | None) -> Array:
        """Return the inputs of a step that is not taken."""
        changed = (self.blocks, self.edges, *self.mirrors)
        kept, drawn = [array.copy() for array in changed], self._drawn
        self._run(step, 1, first, table)
        found = self._read(self.rows.input)
        self.mirrors.reverse()
        for array, before in zip(changed, kept, strict=True):
            array[:] = before
        # What was drawn for it is gone from the blocks again.
        self._drawn = drawn
        return found

    def _run(self, step: int, steps: int, first: int, table: Array | None) -> None:
        """Take steps under one draw of the wind, and one stretch of the graph, after the other."""
        wind = self.loop.motion.wind
        while steps:
            count = min(steps, _STEPS, self._switch(step))
            if wind is not None:
                hold = int(wind.window)
                self._draw(step // hold, hold)
                count = min(count, hold - step % hold)
            self._call(step, count, None if table is None else table[step - first :])
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
            # What is beyond the end of the run may wrap: nobody asks for it.
            steps = ((first + np.arange(self._ahead)) * hold).astype(np.int32)
            agents = np.arange(len(self.loop.offsets))
            drawn = _drawn([loop.motion.wind for loop in self.loops], steps, agents)
            self._winds = [part if part is None else np.asarray(part) for part in drawn]
        self._drawn = number
        for rows, part in zip((self.rows.push, self.rows.noise), self._winds, strict=True):
            if part is not None:
                self._write(rows, part[at].reshape(len(self.states), -1))

    def _call(self, step: int, steps: int, table: Array | None) -> None:
        """Run the kernel; each step exchanges the two mirrors."""
        arrays = self.found._asdict() | {"segments": self.places.segments}
        values = {name: array.ctypes.data for name, array in arrays.items()}
        values |= {} if table is None else {"table": table.ctypes.data}
        values |= {"first_step": step, "steps": steps, "levels": len(self.places.segments) - 1}
        # The inputs of single steps are read afterwards; those of many would be stored for nothing.
        values |= {"edge_blocks": len(self.found.edge_ends), "shown": int(steps == 1)}
        values["line"] = self.places.line
        values["first_steady"] = int(self.loop.meter.first_steady)
        firsts = {"rows": self.blocks, "mirror": self.mirrors[0], "next_mirror": self.mirrors[1]}
        firsts["edges"] = self.edges
        common = np.empty(steps * self.common, self.dtype)
        self.crew.run(self.code, values, firsts, common)
        if steps % 2:
            self.mirrors.reverse()

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
        if self.plan.width == len(self.rows.state):
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
        wide[:, :, : values.shape[1]] = shown

    def _moment(self, step: int) -> Moment:
        """Return what is in the blocks as a moment."""
        loop, flat = self.loop, self._read(self.rows.memory)
        now: Any = [
            np.asarray(step, np.int32),
            self._read(self.rows.state),
            memories_of(loop.leader, flat[self.leaders]),
            memories_of(loop.follower, flat[self.followers]),
            self._read(self.rows.cut).astype(np.int8),
        ]
        return Moment._make(now)

    def _clear_sums(self) -> None:
        first = self.rows.errors.start
        self.blocks[:, first:] = 0.0
        self.blocks[:, self.rows.unsettled.start] = -1.0
        self.blocks[:, self.rows.inside.start : self.rows.inside.stop] = ALWAYS
        self.edges[..., -1, :] = 0.0

    def _sums(self, first: int, end: int) -> Sums:
        """Return the sums over the steps from one to another."""
        rows, leaders, meter = self.rows, self.leaders, self.loop.meter
        steady = max(0, end - max(first, int(meter.first_steady)))
        begin = rows.errors.start
        kept = self._read(range(begin, rows.total)).astype(np.float64)

        def of(places: range) -> Array:
            return kept[:, places.start - begin : places.stop - begin]

        found = Sums(
            steps=np.array([end - first, steady]),
            errors=of(rows.errors).T,
            tracking=of(rows.tracking)[leaders].T,
            outputs=of(rows.outputs)[leaders],
            effort=of(rows.effort)[:, 0],
            spacing=self.places.spacing(self.edges),
            limited=of(rows.limited)[:, 0],
            unsettled=of(rows.unsettled)[:, 0],
            inside=np.minimum(of(rows.inside), ALWAYS),
            chatter=of(rows.chatter)[:, 0],
        )
        return Sums(*(np.asarray(part, np.float64) for part in found))


@jax.jit
def _drawn(winds: Sequence[Any], steps: jax.Array, agents: jax.Array) -> Any:
    """Return what each wind adds to the rates (T, F, N, n) and noise to the inputs at T steps."""
    many = jax.tree.map(lambda *leaves: jnp.stack([jnp.asarray(leaf) for leaf in leaves]), *winds)
    one = jax.vmap(draw, (None, None, 0))
    return jax.vmap(jax.vmap(one, (0, None, None)), (None, 0, None))(many, steps, agents)
