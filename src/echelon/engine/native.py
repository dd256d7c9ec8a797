"""The closed loop stepped by code for this machine: agents in the lanes of vectors."""

from pathlib import Path
from typing import Any, final

import jax
import jax.numpy as jnp
import numpy as np

from echelon.core.types import Array
from echelon.engine.drive import Chunk, Stepper
from echelon.engine.loop import Loop, Moment, begin
from echelon.engine.places import Places, edge_blocks, heard
from echelon.engine.scalars import Rows, body_of
from echelon.engine.sums import ALWAYS, Sums
from echelon.kernels import SLOTS, Code, Plan, aligned, program, stride
from echelon.laws.law import Law, Memory
from echelon.world.disturbance import draw

_LANES = {64: 8, 32: 16}
"""Vectors of 512 bits; where a processor's are shorter, LLVM takes two."""
_AGENT_STEPS, _FEWEST = 2_000_000, 4
"""Of a chunk: some tenths of a second."""
_LARGEST = {64: 1e5, 32: 1e3}
"""Of a state: beyond it the sines of the kernels lose digits, and JAX goes on."""


@final
class NativeStepper(Stepper):
    """Moves agents under laws.

    Args:
        loop: of the run.
        states: (N, n) at its beginning.
        bits: 64 or 32, the precision.
        far: what goes on where a state is beyond the range of the kernels' sines.

    Raises:
        Unsupported: a law or the model uses what has no scalar operations.
    """

    def __init__(self, loop: Loop, states: Array, bits: int, far: Stepper) -> None:
        """Write and compile the step."""
        self.loop, self.states, self.far = loop, states, far
        self.follows = loop.leader.reference_states(loop.model, jnp.zeros(1)) is not None
        self.bits, self.dtype = bits, np.dtype(np.float64 if bits == 64 else np.float32)
        self.places, self.rows = Places(loop, _LANES[bits]), Rows.of(loop)
        starts, positions, weights = heard(loop, self.places)
        self.plan = self._plan(bool((weights != 1.0)[positions >= 0].any()))
        # Where JAX was told to keep what it compiles, so that one setting rules both.
        cache = getattr(jax.config, "jax_compilation_cache_dir", None)
        self.code = Code(program(self.plan), Path(cache) if cache else None)
        self._reserve(starts, positions, weights)
        # What is in the blocks, so that a chunk that goes on from it need not be written there.
        self._held: Moment | None = None
        self._drawn, self._left = -1, -1

    def _plan(self, weighted: bool) -> Plan:
        loop, rows = self.loop, self.rows
        n, alone = len(rows.state), len(loop.leaders) == 1
        return Plan(
            bits=self.bits,
            lanes=self.places.lanes,
            rows=rows.total,
            width=n,
            first=body_of(loop, self.bits, rows, True, self.follows),
            others=body_of(loop, self.bits, rows, False, self.follows),
            tell=rows.tell.start,
            told=len(rows.tell),
            one_source=alone and loop.parents is None,
            one_leader=alone,
            weighted=weighted,
            edges=loop.meter.measured,
            table=n if self.follows else 0,
            dt=loop.motion.dt,
        )

    # ---- memory ----

    def _reserve(self, starts: Array, positions: Array, weights: Array) -> None:
        """Make what never changes during a run, and room for what does."""
        loop, places, plan = self.loop, self.places, self.plan
        lanes, of, far = plan.lanes, places.of, stride(plan.width, plan.lanes)
        self.blocks = aligned((places.blocks, plan.rows, lanes), self.dtype)
        self.mirrors = [aligned((len(places.agents), far), self.dtype) for _ in range(2)]
        nearest = np.asarray(loop.meter.nearest)[places.agents]
        sender = nearest
        if loop.parents is not None:
            parents = np.asarray(loop.parents)[places.agents]
            # A leader is sent nothing, and its own place does as well as any.
            sender = np.where(parents < 0, places.agents, parents)
        held = of[sender]
        heavy = aligned(weights.shape, self.dtype)
        heavy[:] = weights
        self.edges, ends = edge_blocks(loop, places, self.dtype)
        self.fixed = {
            "segments": places.segments,
            "neighbour_starts": starts,
            "neighbours": np.ascontiguousarray(positions * far, np.int32),
            "weights": heavy,
            "sources": ((held // lanes) * plan.rows * lanes + held % lanes).astype(np.int32),
            "leaders": (of[nearest] * far).astype(np.int32),
            "edges": self.edges,
            "edge_ends": ends,
        }

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
        return max(_FEWEST, _AGENT_STEPS // len(self.states))

    def start(self) -> Moment:
        """Return the moment at which the run begins."""
        return jax.tree.map(np.asarray, begin(self.loop, jnp.asarray(self.states)))

    def advance(self, now: Moment, counts: Array, reference: Array | None) -> Chunk:
        """Store frames and take steps; what happens on the way is seen afterwards."""
        if now is not self._held:
            self._load(now)
        made = self._fly(int(now.step), counts, reference)
        # NaN is beyond nothing, and is lost in either way.
        if not (np.abs(made.states) > _LARGEST[self.bits]).any():
            return made
        self._held = None
        self._left = int(now.step) if self._left < 0 else self._left
        return self.far.advance(now, counts, reference)

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
        kept = [array.copy() for array in changed]
        self._run(step, 1, first, table)
        found = self._read(self.rows.input)
        self.mirrors.reverse()
        for array, before in zip(changed, kept, strict=True):
            array[:] = before
        return found

    def _run(self, step: int, steps: int, first: int, table: Array | None) -> None:
        """Take steps under one draw of the wind after the other."""
        wind = self.loop.motion.wind
        while steps:
            count = steps
            if wind is not None:
                hold = int(wind.window)
                self._draw(step // hold, hold)
                count = min(steps, hold - step % hold)
            self._call(step, count, None if table is None else table[step - first :])
            step, steps = step + count, steps - count

    def _draw(self, number: int, hold: int) -> None:
        """Write what wind and noise are during a hold."""
        if number == self._drawn:
            return
        self._drawn = number
        push, noise = _draw_all(self.loop, number * hold, len(self.states))
        self._write(self.rows.push, np.asarray(push))
        if noise is not None:
            self._write(self.rows.noise, np.asarray(noise))

    def _call(self, step: int, steps: int, table: Array | None) -> None:
        """Run the kernel; each step exchanges the two mirrors."""
        arrays = {"rows": self.blocks, "mirror": self.mirrors[0], "next_mirror": self.mirrors[1]}
        arrays |= self.fixed | ({} if table is None else {"table": table})
        numbers = {"first_step": step, "steps": steps, "levels": len(self.places.segments) - 1}
        # The inputs of single steps are read afterwards; those of many would be stored for nothing.
        numbers |= {"edge_blocks": len(self.edges), "shown": int(steps == 1)}
        numbers["first_steady"] = int(self.loop.meter.first_steady)
        values = {name: array.ctypes.data for name, array in arrays.items()} | numbers
        self.code.call(np.array([values.get(name, 0) for name in SLOTS], np.int64))
        if steps % 2:
            self.mirrors.reverse()

    # ---- moments and sums ----

    def _load(self, now: Moment) -> None:
        """Write a moment into the blocks."""
        loop, rows = self.loop, self.rows
        x, offsets = np.asarray(now.states, self.dtype), np.asarray(loop.offsets, self.dtype)
        self._write(rows.state, x)
        self._write(rows.offset, offsets)
        self._write(rows.cut, np.asarray(now.cut))
        self.mirrors[0][:, : x.shape[1]] = (x - offsets)[self.places.agents]
        memory = np.zeros((len(x), len(rows.memory)))
        for who, tree in ((loop.leaders, now.leader_memory), (loop.followers, now.follower_memory)):
            leaves = [np.asarray(leaf).reshape(len(who), -1) for leaf in jax.tree.leaves(tree)]
            flat = np.concatenate([np.zeros((len(who), 0)), *leaves], axis=1)
            memory[who, : flat.shape[1]] = flat
        self._write(rows.memory, memory)
        self._drawn = -1

    def _moment(self, step: int) -> Moment:
        """Return what is in the blocks as a moment."""
        loop, flat = self.loop, self._read(self.rows.memory)
        now: Any = [
            np.asarray(step, np.int32),
            self._read(self.rows.state),
            _memory(loop.leader, flat[loop.leaders]),
            _memory(loop.follower, flat[loop.followers]),
            self._read(self.rows.cut).astype(np.int8),
        ]
        return Moment._make(now)

    def _clear_sums(self) -> None:
        first = self.rows.errors.start
        self.blocks[:, first:] = 0.0
        self.blocks[:, self.rows.unsettled.start] = -1.0
        self.blocks[:, self.rows.inside.start : self.rows.inside.stop] = ALWAYS
        self.edges[:, -1] = 0.0

    def _sums(self, first: int, end: int) -> Sums:
        """Return the sums over the steps from one to another."""
        rows, leaders, meter = self.rows, self.loop.leaders, self.loop.meter
        steady = max(0, end - max(first, int(meter.first_steady)))
        found = Sums(
            steps=np.array([end - first, steady]),
            errors=self._read(rows.errors).T,
            tracking=self._read(rows.tracking)[leaders].T,
            outputs=self._read(rows.outputs)[leaders],
            effort=self._read(rows.effort)[:, 0],
            spacing=self.edges[:, -1].reshape(-1)[: len(meter.edges)],
            limited=self._read(rows.limited)[:, 0],
            unsettled=self._read(rows.unsettled)[:, 0],
            inside=np.minimum(self._read(rows.inside).astype(np.float64), ALWAYS),
            chatter=self._read(rows.chatter)[:, 0],
        )
        return Sums(*(np.asarray(part, np.float64) for part in found))


def _memory(law: Law, flat: Array) -> Memory:
    """Return memories of agents from their numbers (agents, numbers)."""
    leaves, tree = jax.tree.flatten(law.init())
    ends = np.cumsum([0, *(np.size(leaf) for leaf in leaves)]).tolist()
    parts = zip(leaves, ends[:-1], ends[1:], strict=True)
    return tree.unflatten(
        [flat[:, a:b].reshape(len(flat), *np.shape(leaf)) for leaf, a, b in parts]
    )


def _draw_all(loop: Loop, step: int, agents: int) -> tuple[jax.Array, jax.Array | None]:
    """Return what wind adds to the rates (N, n) and noise to the inputs (N, m) at a step."""
    return _drawn(loop.motion.wind, jnp.asarray(step, jnp.int32), jnp.arange(agents))


@jax.jit
def _drawn(wind: Any, step: jax.Array, agents: jax.Array) -> Any:
    return jax.vmap(lambda agent: draw(wind, step, agent))(agents)
