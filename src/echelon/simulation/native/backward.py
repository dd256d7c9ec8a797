"""A run taken back step by step, by code for this machine: the slopes of a cost of its sums.

Forwards the moments at the beginnings of stretches are kept. Backwards each stretch is run again
onto a tape, and from it the transposes of its steps are run, the last step first. What neighbours
made of what they heard is gathered as they gathered it, from the transposed graph.
"""

import math
from typing import Any, NamedTuple, final

import jax
import jax.numpy as jnp
import numpy as np

from echelon.core.memoize import BoundedCache
from echelon.core.types import Array
from echelon.simulation.codegen import SLOTS, Body, aligned, fed_widths
from echelon.simulation.native.agent_step import BlockRows, signals_of
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
from echelon.simulation.native.stepper import STEPS, NativeStepper, any_beyond
from echelon.simulation.native.transpose import (
    CotangentRows,
    Transpose,
    TransposedStep,
    heard_by,
    lean,
)
from echelon.simulation.native.transposed_graph import (
    check_pairs,
    heard_back,
    reach_of,
    turned_about,
)
from echelon.simulation.native.varying import VaryingNumbers
from echelon.simulation.scalars import Unsupported
from echelon.simulation.step.loop import Loop, Moment
from echelon.simulation.step.meter import Sums
from echelon.simulation.step.sequence import begin, signals

BITS = 64
_TAPE = 256 * 2**20
"""Bytes of a tape, unless steps are so many that it takes the root of what all would."""
_LIGHT = 32 * 2**20
"""Bytes of a tape that is kept for the next run, since they take a while to be had."""


class Wants(NamedTuple):
    """Whether slopes come along the sums of distances, and are wanted along goals' offsets."""

    spaced: bool
    moved: bool


class _Pair(NamedTuple):
    """The kernels of a step onto a tape and of its transpose, and the rows of the second."""

    forward: Kernel
    backward: Kernel
    felt: CotangentRows


_pairs = BoundedCache[_Pair](MOST)


def _pair(own: VaryingNumbers, lines: tuple[bool, bool], wants: Wants) -> _Pair:
    """Return the kernels for loops alike but for their own numbers, made once."""
    wind, signature = own.loop.motion.wind, own.signature
    # The signature is of all but the wind's numbers, which have rows where there is one.
    key = (signature, wind is None, wind is None or wind.noise is None, lines, wants)
    return _pairs.get_or_make(None if signature is None else key, lambda: _made(own, lines, wants))


def _made(own: VaryingNumbers, lines: tuple[bool, bool], wants: Wants) -> _Pair:
    loop, rows = own.loop, BlockRows.of(own.loop)
    felt, wanted = CotangentRows.of(loop, rows, *wants), follows(loop)
    plan = plan_of(own, rows, BITS, False, lines[0], False, True)
    ways = [Transpose(own, BITS, rows, felt, leads, wanted).made() for leads in (True, False)]
    taped = max(1, *(len(way.kept) for way in ways))
    forward = plan._replace(
        first=_onto_tape(plan.first, ways[0]), others=_onto_tape(plan.others, ways[1]), taped=taped
    )
    # What a leader hears may be wanted though it does not act by it.
    forward = forward._replace(ahead=plan.ahead and not forward.first.hears)
    backward = plan._replace(
        lines=lines[1],
        rows=felt.total,
        width=heard_by(loop) + len(felt.place),
        first=ways[0].body,
        others=ways[1].body,
        edges=(),
        taped=taped,
        ahead=False,
        backward=True,
    )
    onward, back = (compiled(rows, way, KERNELS.codes) for way in (forward, backward))
    return _Pair(onward, back, felt)


def _onto_tape(body: Body, way: TransposedStep) -> Body:
    """Return the body of a step that leaves on the tape what its transpose wants."""
    graph = body.mirror[0].graph
    return body._replace(tape={k: graph.leaf(*name) for k, name in enumerate(way.kept)})


class CostSlopes(NamedTuple):
    """Slopes of a cost.

    Attributes:
        leaves: along the leaves of the loop in which numbers are its own.
        states: along the starts (N, n).
        offsets: along the goals' offsets (N, n).
    """

    leaves: list[Array]
    states: Array
    offsets: Array


@final
class Backward:
    """A run of laws that is taken forwards and then back, as often as is asked.

    Args:
        own: the loop, and its numbers along which there are slopes.
        states: (N, n) at the beginning.
        reference: (steps, n) what the leaders follow, or None.
        steps: of the run.
        wants: what more than the least is wanted.

    Raises:
        Unsupported: a law or the model uses what has no scalar operations.
    """

    def __init__(
        self, own: VaryingNumbers, states: Array, reference: Array | None, steps: int, wants: Wants
    ) -> None:
        """Write and compile the step and its transpose."""
        self.own, self.loop, self.steps, self.states = own, own.loop, steps, states
        self.places = SwarmBlocks(own.loop, LANES[BITS])
        if wants.spaced:
            check_pairs(own.loop)
        if all(wants):
            raise Unsupported("slopes of distances along the goals' offsets")
        turned = turned_about(own.loop, self.places)
        self.pair = _pair(own, (self.places.lines, turned.lines), wants)
        self.reach = reach_of(own.loop, self.places, turned, self.pair.backward)
        self.signals, kernel = signals_of(own.loop), self.pair.forward
        self.stepper = NativeStepper(
            [own.loop], states, BITS, None, make=lambda *_: kernel, places=self.places
        )
        self.reference, self.wants = reference, wants
        self._reserve()

    def _reserve(self) -> None:
        """Make room for slopes, and for a tape of so many steps that all are few."""
        plan, places = self.pair.backward.plan, self.places
        shape = (places.blocks, plan.taped, plan.lanes)
        size, moment = 8 * math.prod(shape), 8 * self.states.size * 2
        few = max(_TAPE // size, math.isqrt(self.steps * moment // size))
        self.stretch = min(self.steps, max(1, few))
        self.shape, self._room = (self.stretch, *shape), None
        self.felt = aligned((places.blocks, plan.rows, plan.lanes), np.float64)
        lined = (plan.width, places.line) if plan.lines else (places.blocks, plan.mirror)
        self.mirrors = [aligned(lined, np.float64) for _ in range(2)]
        self.fed = aligned((len(places.agents), max(1, fed_widths(plan)[1])), np.float64)
        self.forms = [leaf.shape for leaf in self._leaves()]
        self.totals = aligned((max(1, sum(map(math.prod, self.forms))), plan.lanes), np.float64)

    @property
    def tape(self) -> Array:
        """The tape, which is there from the first run on."""
        if self._room is None:
            self._room = aligned(self.shape, np.float64)
        return self._room

    def _leaves(self) -> list[Array]:
        return [leaf.astype(float) for leaf in self.own.leaves(self.own.values[0])]

    def turn(self, loop: Loop) -> None:
        """Go on with a loop that its own numbers cover."""
        self.loop = loop
        self.own.turn(loop)
        self.stepper.turn(loop)

    @property
    def size(self) -> int:
        """Bytes of the arrays that are held from one run to the next."""
        found, blocks = self.stepper.found, (self.stepper.blocks, *self.stepper.mirrors)
        room = (self.felt, *self.mirrors, self.fed, self.totals, self.table, self._room)
        return sum(array.nbytes for array in jax.tree.leaves((found, blocks, room, self.reach)))

    # ---- forwards ----

    def run(self) -> Sums | None:
        """Return the sums of the run; None where a state is beyond the range of the kernels."""
        now, self.moments = self.stepper.start(), list[Moment]()
        sums: Sums | None = None
        for first in self._firsts():
            self.moments.append(now)
            # The last stretch is the first that is taken back.
            self.stepper.record(self.tape if first + self.stretch >= self.steps else None, first)
            made = self._advance(now, first)
            now, more = made.now, made.sums.of(0)
            sums = more if sums is None else sums.plus(more)
            if any_beyond(now.states, BITS):
                self.moments.clear()
                return None
        return sums

    def _firsts(self) -> range:
        return range(0, self.steps, self.stretch)

    def _advance(self, now: Moment, first: int) -> Any:
        """Take the steps of the stretch that begins with one."""
        count = min(self.stretch, self.steps - first)
        columns = [] if self.reference is None else [self.reference[first : first + count]]
        self.table = np.hstack([*columns, np.tile(self.own.values[:1], (count, 1))])
        return self.stepper.advance(now, np.array([count], np.int32), self.table)

    # ---- backwards ----

    def pull(self, slopes: Sums) -> CostSlopes:
        """Return the slopes of what has these along the sums of the run.

        Raises:
            Unsupported: the distances of edges have several.
        """
        if np.ptp(slopes.spacing):
            raise Unsupported("slopes along distances that are not the same for all edges")
        self._begin(slopes)
        for first in reversed(self._firsts()):
            if first + self.stretch < self.steps:
                self.stepper.record(self.tape, first)
                self._advance(self.moments[first // self.stretch], first)
            self._back(first, min(self.steps, first + self.stretch))
        found = self._ended()
        self.moments.clear()
        if self.tape.nbytes > _LIGHT:
            self._room = None
            self.stepper.record(None, 0)
        if not self.wants.spaced:
            return found
        # The transpose of a step adds what distances were after it; this is before the first.
        _, pull = jax.vjp(self.loop.meter.spacing, jnp.asarray(self.states))
        return found._replace(
            states=found.states + np.asarray(pull(jnp.asarray(slopes.spacing))[0])
        )

    def _begin(self, slopes: Sums) -> None:
        """Write the slopes along the sums, of each agent once."""
        felt, places, loop = self.pair.felt, self.places, self.loop
        rows = np.zeros((len(loop.offsets), felt.total))
        rows[:, felt.errors] = slopes.errors.T
        rows[:, felt.effort] = slopes.effort[:, None]
        rows[:, felt.spacing] = slopes.spacing[0]
        rows[loop.leaders, felt.tracking.start : felt.tracking.stop] = slopes.tracking.T
        rows[loop.leaders, felt.outputs.start : felt.outputs.stop] = slopes.outputs
        once = places.of[places.agents] == np.arange(len(places.agents))
        shaped = (rows[places.agents] * once[:, None]).reshape(places.blocks, places.lanes, -1)
        self.felt[:] = shaped.transpose(0, 2, 1)
        for array in (*self.mirrors, self.fed, self.totals):
            array[:] = 0.0

    def _back(self, first: int, end: int) -> None:
        """Take back the steps from one to another, the last first."""
        while end > first:
            # What neighbours heard of the step after this one is gathered by the graph of then.
            row, begun = self._row_at(end)
            start = max(first, end - STEPS, min(begun - 1, end - 1))
            self._lean(row)
            self._call(start, end - start, first, row)
            end = start

    def _row_at(self, step: int) -> tuple[int, int]:
        """Return which row of the weights holds at a step, and since when."""
        if self.loop.switches is None:
            return 0, 0
        steps, rows = self.loop.switches
        place = int(np.searchsorted(steps, step, side="right")) - 1
        return int(rows[place]), int(steps[place])

    def _lean(self, row: int) -> None:
        if len(self.pair.felt.lean):
            leaning = lean(self.loop)[row][self.places.agents]
            self.felt[:, self.pair.felt.lean.start] = leaning.reshape(-1, self.places.lanes)

    def _call(self, start: int, steps: int, first: int, row: int) -> None:
        kernel, places, reach = self.pair.backward, self.places, self.reach
        segments, tape = places.segments, self.tape[start - first :]
        # The last step first, the followers before the leaders.
        turns = np.ascontiguousarray(step_by_step(segments, 0, steps, 0, 1)[::-1])
        common = np.empty(max(1, steps * kernel.common))
        arrays = {
            "rows": self.felt,
            "mirror": self.mirrors[0],
            "next_mirror": self.mirrors[1],
            "table": self.table[start - first :],
            "turns": turns,
            "common": common,
            "tape": tape,
            "totals": self.totals,
            "fed": self.fed,
        }
        arrays |= reach._asdict() | {"weights": reach.weights[row]}
        told = {name: array.ctypes.data for name, array in arrays.items()}
        told |= {"first_step": start, "steps": steps, "count": len(turns)}
        told |= {"groups": 1, "threads": 1, "line": places.line, "tape_step": self.tape[0].size}
        told["first_steady"] = int(self.loop.meter.first_steady)
        kernel.code.call(np.array([told.get(name, 0) for name in SLOTS], np.int64))
        if steps % 2:
            self.mirrors.reverse()

    # ---- at the beginning of the run ----

    def _ended(self) -> CostSlopes:
        """Return the slopes, with what the beginning of the run adds to them."""
        felt, loop = self.pair.felt, self.loop
        found = self.felt.transpose(0, 2, 1).reshape(len(self.places.agents), -1)[self.places.of]
        ends = np.cumsum([0, *map(math.prod, self.forms)]).tolist()
        total, parts = self.totals.sum(axis=1), zip(self.forms, ends[:-1], ends[1:], strict=True)
        leaves = [total[begin:end].reshape(form) for form, begin, end in parts]
        heard = heard_back(loop, self._shown())
        states = found[:, felt.state]
        offsets = found[:, felt.offset] if self.wants.moved else np.zeros_like(states)
        if not (len(felt.memory) or self.signals):
            return CostSlopes(leaves, states + heard, offsets - heard)
        more = self._begun(found[:, felt.memory], heard)
        leaves = [a + np.asarray(b) for a, b in zip(leaves, more[0], strict=True)]
        return CostSlopes(leaves, states + np.asarray(more[1]), offsets + np.asarray(more[2]))

    def _shown(self) -> Array:
        """Return the slopes along what agents heard at the first step, (N, s)."""
        places, shown = self.places, self.mirrors[0]
        lined = self.pair.backward.plan.lines
        shown = shown.T if lined else shown.reshape(len(places.agents), -1)
        return shown[places.of, : self.signals or self.states.shape[1]]

    def _begun(self, memory: Array, heard: Array) -> Any:
        """Return the slopes along leaves, starts and offsets of how agents begin."""
        loop = self.loop

        def start(leaves: list[Any], states: Any, offsets: Any) -> Any:
            now = begin(self.own.filled(leaves), states)
            said = signals(self.own.filled(leaves), now, offsets)
            said = states - offsets if said is None else said
            return now.leader_memory, now.follower_memory, said

        given = jnp.asarray(self.states), jnp.asarray(loop.offsets, float)
        made, pull = jax.vjp(start, [jnp.asarray(leaf) for leaf in self._leaves()], *given)
        felt = list[Any]()
        for who, tree in ((loop.leaders, made[0]), (loop.followers, made[1])):
            flat, leaves = memory[who], list[Any]()
            for leaf in jax.tree.leaves(tree):
                size = leaf[0].size
                leaves.append(jnp.asarray(flat[:, :size]).reshape(leaf.shape))
                flat = flat[:, size:]
            felt.append(jax.tree.unflatten(jax.tree.structure(tree), leaves))
        return pull((*felt, jnp.asarray(heard)))
