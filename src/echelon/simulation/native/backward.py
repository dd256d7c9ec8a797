"""Reverse-mode derivatives by machine code: the slopes of a cost of the sums of a run.

In the forward pass the moments at the beginnings of stretches are stored. In the backward pass each
stretch is run again and recorded on a tape, and the transposes of its steps are run from it, the
last step first. Cotangents of what agents sent are gathered from their receivers, by the transposed
graph.
"""

import math
from typing import NamedTuple, final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from echelon.core.cache import BoundedCache
from echelon.core.types import Array
from echelon.laws.law import Memory
from echelon.simulation.codegen import Body, aligned, contribution_widths
from echelon.simulation.native.agent_step import BlockRows, signal_size, unflatten
from echelon.simulation.native.blocks import SwarmBlocks
from echelon.simulation.native.kernel_cache import (
    KERNELS,
    LANES,
    MOST,
    Kernel,
    compiled,
    follows,
    plan_of,
)
from echelon.simulation.native.schedule import step_by_step
from echelon.simulation.native.stepper import STEPS, NativeStepper
from echelon.simulation.native.threads import call
from echelon.simulation.native.transpose import (
    CotangentRows,
    Transpose,
    TransposedStep,
    disagreement_size,
    imbalance,
)
from echelon.simulation.native.transposed_graph import (
    check_pairs,
    transpose_graph,
    transposed_arrays,
    transposed_disagreement,
)
from echelon.simulation.native.varying import VaryingNumbers
from echelon.simulation.scalars import Unsupported
from echelon.simulation.step.drive import Chunk
from echelon.simulation.step.loop import Loop, Moment
from echelon.simulation.step.meter import Sums
from echelon.simulation.step.sequence import begin, signals

BITS = 64
_TAPE = 256 * 2**20
"""Bytes of a tape, unless there are so many steps that it needs the square root of all of them."""
_LIGHT = 32 * 2**20
"""Bytes up to which a tape is kept for the next run, because new memory is slow."""


class SlopeNeeds(NamedTuple):
    """What more is needed than slopes along gains and starts.

    Attributes:
        distances: whether the cost depends on the sums of distance errors.
        offsets: whether to differentiate with respect to the goals' offsets.
    """

    distances: bool
    offsets: bool


class _Pair(NamedTuple):
    """The kernels of a recorded step and of its transpose, and the rows of the second."""

    forward: Kernel
    backward: Kernel
    rows: CotangentRows


_pairs = BoundedCache[_Pair](MOST)


def _pair_of(varying: VaryingNumbers, row_major: tuple[bool, bool], needs: SlopeNeeds) -> _Pair:
    """Return the kernels for loops that differ only in varying numbers, from a cache."""
    wind, signature = varying.loop.motion.wind, varying.signature
    # The signature leaves out the wind's numbers, which have rows if there is wind.
    key = (signature, wind is None, wind is None or wind.noise is None, row_major, needs)
    return _pairs.get_or_make(
        None if signature is None else key, lambda: _compiled_pair(varying, row_major, needs)
    )


def _compiled_pair(
    varying: VaryingNumbers, row_major: tuple[bool, bool], needs: SlopeNeeds
) -> _Pair:
    loop, rows = varying.loop, BlockRows.of(varying.loop)
    cotangents, tracks = CotangentRows.of(loop, rows, *needs), follows(loop)
    plan = plan_of(varying, rows, BITS, False, row_major[0], False, True)
    first, others = (
        Transpose(varying, BITS, rows, cotangents, leads, tracks).derive()
        for leads in (True, False)
    )
    tape_rows = max(1, len(first.recorded), len(others.recorded))
    forward = plan._replace(
        first=_recorded(plan.first, first),
        others=_recorded(plan.others, others),
        tape_rows=tape_rows,
    )
    # What a leader receives may be recorded even if its input does not depend on it.
    ahead = plan.leaders_ahead and not forward.first.reads_neighbours
    backward = plan._replace(
        row_major=row_major[1],
        rows=cotangents.total,
        width=disagreement_size(loop) + len(cotangents.place),
        first=first.body,
        others=others.body,
        edges=(),
        tape_rows=tape_rows,
        leaders_ahead=False,
        backward=True,
    )
    forward_kernel = compiled(rows, forward._replace(leaders_ahead=ahead), KERNELS.codes)
    return _Pair(forward_kernel, compiled(rows, backward, KERNELS.codes), cotangents)


def _recorded(body: Body, transpose: TransposedStep) -> Body:
    """Return the body of a step that records on the tape what its transpose reads."""
    graph = body.mirror[0].graph
    return body._replace(tape={k: graph.leaf(*name) for k, name in enumerate(transpose.recorded)})


class CostSlopes(NamedTuple):
    """Slopes of a cost.

    Attributes:
        leaves: along the leaves of the loop that have varying numbers.
        states: along the initial states.
        offsets: along the goals' offsets.
    """

    leaves: list[Array]
    states: Float[Array, "N n"]
    offsets: Float[Array, "N n"]


@final
class Backward:
    """A run that is differentiated, as often as is asked.

    Args:
        varying: the loop, and its numbers with respect to which to differentiate.
        states: at the beginning.
        reference: what the leaders follow at each step, or None.
        steps: of the run.
        needs: what more is needed than slopes along gains and starts.

    Raises:
        Unsupported: a law or the model has no scalar operations.
    """

    def __init__(
        self,
        varying: VaryingNumbers,
        states: Float[Array, "N n"],
        reference: Float[Array, "k n"] | None,
        steps: int,
        needs: SlopeNeeds,
    ) -> None:
        """Generate and compile the step and its transpose."""
        self.varying, self.loop, self.steps, self.states = varying, varying.loop, steps, states
        self.places = SwarmBlocks(self.loop, LANES[BITS])
        if needs.distances:
            check_pairs(self.loop)
        if all(needs):
            raise Unsupported("slopes of distances along the goals' offsets")
        graph = transpose_graph(self.loop, self.places)
        self.pair = _pair_of(varying, (self.places.row_major, graph.row_major), needs)
        self.graph = transposed_arrays(self.loop, self.places, graph, self.pair.backward)
        self.signals, kernel = signal_size(self.loop), self.pair.forward
        self.stepper = NativeStepper(
            [self.loop], states, BITS, None, make=lambda *_: kernel, places=self.places
        )
        self.reference, self.needs = reference, needs
        self._reserve()

    def _reserve(self) -> None:
        """Allocate memory for cotangents, and choose the steps of a tape."""
        plan, places = self.pair.backward.plan, self.places
        shape = (places.blocks, plan.tape_rows, plan.lanes)
        size, moment = 8 * math.prod(shape), 8 * self.states.size * 2
        most = max(_TAPE // size, math.isqrt(self.steps * moment // size))
        self.stretch = min(self.steps, max(1, most))
        self.tape_shape = (self.stretch, *shape)
        self._tape: Array | None = None
        self.cotangents = aligned((places.blocks, plan.rows, plan.lanes), np.float64)
        self.mirrors = places.mirrors(plan, np.float64)
        width = max(1, contribution_widths(plan)[1])
        self.contributions = aligned((len(places.agents), width), np.float64)
        numbers = sum(leaf.size for leaf in self._leaves())
        self.totals = aligned((max(1, numbers), plan.lanes), np.float64)

    @property
    def tape(self) -> Array:
        """The tape, which is allocated by the first run."""
        if self._tape is None:
            self._tape = aligned(self.tape_shape, np.float64)
        return self._tape

    def _leaves(self) -> list[Array]:
        return [leaf.astype(float) for leaf in self.varying.leaves(self.varying.values[0])]

    def update(self, loop: Loop) -> None:
        """Continue with a loop that differs only in the varying numbers."""
        self.loop = loop
        self.varying.replace_loop(loop)
        self.stepper.replace_loop(loop)

    @property
    def size(self) -> int:
        """Bytes of the arrays that are kept from one run to the next."""
        stepper = self.stepper
        arrays = (stepper.neighbourhood, stepper.blocks, stepper.mirrors, self.cotangents)
        arrays += (
            self.mirrors,
            self.contributions,
            self.totals,
            self.table,
            self._tape,
            self.graph,
        )
        return sum(array.nbytes for array in jax.tree.leaves(arrays))

    # ---- the forward pass ----

    def run(self) -> Sums | None:
        """Return the sums of the run; None if they are not what JAX computes."""
        now, self.moments = self.stepper.start(), list[Moment]()
        sums: Sums | None = None
        for first in self._firsts():
            self.moments.append(now)
            # The backward pass begins with the last stretch.
            self.stepper.record(self.tape if first + self.stretch >= self.steps else None, first)
            chunk = self._advance(now, first)
            now, more = chunk.now, chunk.sums.of(0)
            sums = more if sums is None else sums.plus(more)
            if np.any(chunk.inexact):
                self.moments.clear()
                return None
        return sums

    def _firsts(self) -> range:
        return range(0, self.steps, self.stretch)

    def _advance(self, now: Moment, first: int) -> Chunk:
        """Take the steps of the stretch that begins with step `first`."""
        count = min(self.stretch, self.steps - first)
        columns = [] if self.reference is None else [self.reference[first : first + count]]
        self.table = np.hstack([*columns, np.tile(self.varying.values[:1], (count, 1))])
        return self.stepper.advance(now, np.array([count], np.int32), self.table)

    # ---- the backward pass ----

    def slopes(self, cotangents: Sums) -> CostSlopes:
        """Return the slopes of a cost with these slopes along the sums of the run.

        Raises:
            Unsupported: those along the distances of edges differ.
        """
        if np.ptp(cotangents.spacing):
            raise Unsupported("slopes along distances that are not the same for all edges")
        self._begin(cotangents)
        for first in reversed(self._firsts()):
            if first + self.stretch < self.steps:
                self.stepper.record(self.tape, first)
                self._advance(self.moments[first // self.stretch], first)
            self._back(first, min(self.steps, first + self.stretch))
        slopes = self._at_start()
        self.moments.clear()
        if self.tape.nbytes > _LIGHT:
            self._tape = None
            self.stepper.record(None, 0)
        if not self.needs.distances:
            return slopes
        # The transpose of a step covers the distances after it; these are before the first step.
        _, transposed = jax.vjp(self.loop.meter.spacing, jnp.asarray(self.states))
        of_states = np.asarray(transposed(jnp.asarray(cotangents.spacing))[0])
        return slopes._replace(states=slopes.states + of_states)

    def _begin(self, cotangents: Sums) -> None:
        """Write the cotangents of the sums, of each agent once."""
        rows, places, loop = self.pair.rows, self.places, self.loop
        values = np.zeros((len(loop.offsets), rows.total))
        values[:, rows.errors] = cotangents.errors.T
        values[:, rows.effort] = cotangents.effort[:, None]
        values[:, rows.spacing] = cotangents.spacing[0]
        values[loop.leaders, rows.tracking.start : rows.tracking.stop] = cotangents.tracking.T
        values[loop.leaders, rows.outputs.start : rows.outputs.stop] = cotangents.outputs
        once = places.position[places.agents] == np.arange(len(places.agents))
        shaped = (values[places.agents] * once[:, None]).reshape(places.blocks, places.lanes, -1)
        self.cotangents[:] = shaped.transpose(0, 2, 1)
        for array in (*self.mirrors, self.contributions, self.totals):
            array[:] = 0.0

    def _back(self, first: int, end: int) -> None:
        """Run the transposes of the steps from one to another, the last first."""
        while end > first:
            # What was sent at the step after this one is gathered by the graph of that step.
            row, since = self._row_at(end)
            start = max(first, end - STEPS, min(since - 1, end - 1))
            self._write_imbalance(row)
            self._call(start, end - start, first, row)
            end = start

    def _row_at(self, step: int) -> tuple[int, int]:
        """Return the row of the weights at a step, and its first step."""
        if self.loop.switches is None:
            return 0, 0
        steps, rows = self.loop.switches
        place = int(np.searchsorted(steps, step, side="right")) - 1
        return int(rows[place]), int(steps[place])

    def _write_imbalance(self, row: int) -> None:
        rows = self.pair.rows.imbalance
        if len(rows):
            weight = imbalance(self.loop)[row][self.places.agents]
            self.cotangents[:, rows.start] = weight.reshape(-1, self.places.lanes)

    def _call(self, start: int, steps: int, first: int, row: int) -> None:
        kernel, places = self.pair.backward, self.places
        # The last step first, the followers before the leaders.
        schedule = np.ascontiguousarray(step_by_step(places.segments, 0, steps, 0, 1)[::-1])
        arrays = {
            "rows": self.cotangents,
            "mirror": self.mirrors[0],
            "next_mirror": self.mirrors[1],
            "table": self.table[start - first :],
            "schedule": schedule,
            "uniform_values": np.empty(max(1, steps * kernel.uniform_count)),
            "tape": self.tape[start - first :],
            "totals": self.totals,
            "contributions": self.contributions,
        }
        arrays |= self.graph._asdict() | {"weights": self.graph.weights[row]}
        numbers = {"first_step": start, "steps": steps, "count": len(schedule)}
        numbers |= {"groups": 1, "threads": 1, "row_stride": places.row_stride}
        numbers |= {"tape_step": self.tape[0].size}
        numbers |= {"first_steady": int(self.loop.meter.first_steady)}
        call(kernel.code, numbers, arrays)
        if steps % 2:
            self.mirrors.reverse()

    # ---- at the beginning of the run ----

    def _at_start(self) -> CostSlopes:
        """Return the slopes, including those by the initial memories and signals."""
        rows, places = self.pair.rows, self.places
        values = self.cotangents.transpose(0, 2, 1).reshape(len(places.agents), -1)
        values = values[places.position]
        leaves: list[Array] = unflatten(self._leaves(), self.totals.sum(axis=1))
        sent = transposed_disagreement(self.loop, self._of_disagreement())
        states = values[:, rows.state]
        offsets = values[:, rows.offset] if self.needs.offsets else np.zeros_like(states)
        if not (len(rows.memory) or self.signals):
            return CostSlopes(leaves, states + sent, offsets - sent)
        more = self._of_beginning(values[:, rows.memory], sent)
        leaves = [a + np.asarray(b) for a, b in zip(leaves, more[0], strict=True)]
        return CostSlopes(leaves, states + np.asarray(more[1]), offsets + np.asarray(more[2]))

    def _of_disagreement(self) -> Array:
        """Return the cotangents of the disagreements at the first step, (N, s)."""
        places, mirror = self.places, self.mirrors[0]
        in_rows = self.pair.backward.plan.row_major
        mirror = mirror.T if in_rows else mirror.reshape(len(places.agents), -1)
        return mirror[places.position, : self.signals or self.states.shape[1]]

    def _of_beginning(
        self, memory: Array, sent: Array
    ) -> tuple[list[jax.Array], jax.Array, jax.Array]:
        """Return the slopes along leaves, starts and offsets by how agents begin."""
        loop = self.loop

        def start(
            leaves: list[jax.Array], states: jax.Array, offsets: jax.Array
        ) -> tuple[Memory, Memory, jax.Array]:
            now = begin(self.varying.filled(leaves), states)
            signal = signals(self.varying.filled(leaves), now, offsets)
            signal = states - offsets if signal is None else signal
            return now.leader_memory, now.follower_memory, signal

        arguments = jnp.asarray(self.states), jnp.asarray(loop.offsets, float)
        leaves = [jnp.asarray(leaf) for leaf in self._leaves()]
        _, transposed = jax.vjp(start, leaves, *arguments)
        laws = (loop.leader, loop.leaders), (loop.follower, loop.followers)
        memories = (unflatten(law.init(), jnp.asarray(memory[agents])) for law, agents in laws)
        return transposed((*memories, jnp.asarray(sent)))
