"""Compiled kernels, shared by loops that differ only in their numbers."""

from typing import NamedTuple, final

import jax
import numpy as np

from echelon.core.cache import BoundedCache, load_or_compute
from echelon.core.numerics import precision
from echelon.laws.law import Travels
from echelon.simulation.codegen import Body, Code, Letters, Plan, has_flag, program, shared
from echelon.simulation.native.agent_step import (
    BlockRows,
    letter_sizes,
    memories_of,
    program_of,
    shown_goals,
    shown_size,
)
from echelon.simulation.native.blocks import Shifts
from echelon.simulation.native.varying import VaryingNumbers
from echelon.simulation.scalars import HostPart, needed
from echelon.simulation.step.loop import Loop
from echelon.simulation.step.records import ComponentMemory
from echelon.simulation.step.turns import by_depth

LANES = {64: 8, 32: 16}
"""Vectors of 512 bits; where a processor's are shorter, LLVM takes two."""
_MOST = 8
"""Kernels, and codes, that are cached."""


def follows(loop: Loop) -> bool:
    """Tell whether the leaders of a loop follow a reference."""
    # In the precision in which references are sampled, so that nothing is compiled for this alone.
    with precision("float64"):
        return (
            Travels.of(loop.laws.leader).reference_states(loop.model, jax.device_put(np.zeros(1)))
            is not None
        )


class KernelText(NamedTuple):
    """What steps some loops, before it is machine code.

    Attributes:
        text: for LLVM.
        rows: that it works on.
        plan: that it was written from, whose bodies are empty now.
        uniform_count: how many numbers are the same for all agents at a step.
        work: how many operations a step of a follower has.
        memories: of a leader and a follower, as shapes.
        given: what the host computes ahead for leaders and all others.
    """

    text: str
    rows: BlockRows
    plan: Plan
    uniform_count: int
    work: int
    memories: tuple[ComponentMemory, ComponentMemory]
    given: tuple[HostPart, HostPart]


class Kernel(NamedTuple):
    """The machine code that steps some loops, and from what it was made."""

    code: Code
    made: KernelText


def letters_of(loop: Loop, rows: BlockRows) -> Letters | None:
    """Return what is sent over a network on which it takes time; None over another one."""
    late = letter_sizes(loop)
    if late is None:
        return None
    chosen = late.network.rules.neighbours.chooses
    return Letters(late.total, late.value, rows.packet, late.network.medium.slots, chosen)


def plan_of(
    varying: VaryingNumbers,
    rows: BlockRows,
    bits: int,
    batched: bool,
    row_major: bool,
    weighted: bool,
    apart: bool = True,
    shifts: Shifts = ((), ()),
) -> tuple[Plan, tuple[HostPart, HostPart]]:
    """Return the plan of loops, and what is given; `apart` is false if all goals are one.

    Raises:
        Unsupported: there is no native code for them.
    """
    loop, tracks = varying.loop, follows(varying.loop)
    n, one_leader = len(rows.state), len(loop.meter.leaders) == 1
    first, others = (program_of(varying, bits, rows, leads, tracks) for leads in (True, False))
    bodies = (first.body, others.body)
    if batched:
        bodies = tuple(body._replace(tape={}) for body in bodies)
    weights, letters = np.asarray(loop.graph.exchange.weights), letters_of(loop, rows)
    weighted = weighted or bool((weights != 1.0).any()) or loop.network.late and not batched
    weighted = weighted or letters is not None and letters.chosen
    plan = Plan(
        bits=bits,
        lanes=LANES[bits],
        batched=batched,
        row_major=row_major,
        rows=rows.total,
        width=n + shown_size(loop),
        first=bodies[0],
        others=bodies[1],
        message_start=rows.message.start,
        message_size=len(rows.message),
        one_source=one_leader and by_depth(loop) is None and first.announce is None,
        one_leader=one_leader,
        weighted=weighted,
        edges=loop.meter.measured,
        apart=apart,
        shifts=shifts[0],
        edge_shifts=shifts[1],
        exception_row=rows.exception.start,
        table=n if tracks else 0,
        goals=shown_goals(loop),
        letters=letters,
        given=max(first.given.size, others.given.size),
        prior_first=first.prior,
        prior_others=others.prior,
        announce=first.announce,
        tape_rows=0 if batched else len(loop.meter.paired),
        paired=tuple(rows.state[k] for k in loop.meter.paired) if batched else (),
    )
    # A leader that receives nothing waits for nobody.
    alone = not (plan.first.reads_neighbours or plan.listens_first or plan.announce)
    ahead = not batched and by_depth(loop) is None and alone
    plan = plan._replace(width=plan.width + has_flag(plan), leaders_ahead=ahead)
    return plan, (first.given, others.given)


def text_of(
    rows: BlockRows,
    plan: Plan,
    given: tuple[HostPart, HostPart],
    memories: tuple[ComponentMemory, ComponentMemory],
) -> KernelText:
    """Return the text of a plan, without the nodes from which it was written."""
    work, count = 1 + len(needed(plan.others.results())), len(shared(plan))
    bare = plan._replace(**dict.fromkeys(plan.bodies, Body()))
    return KernelText(program(plan), rows, bare, count, work, memories, given)


@final
class Kernels:
    """A cache of kernels; loops that differ only in their varying numbers share one.

    If a trace may differ the next time, such as of a user's classes, only machine code is shared,
    by its text.

    Attributes:
        codes: machine code by its text.
    """

    def __init__(self) -> None:
        # A sweep over models has one after the other.
        self.codes, self._kernels = BoundedCache[Code](_MOST), BoundedCache[Kernel](_MOST)

    def of(
        self,
        varying: VaryingNumbers,
        bits: int,
        batched: bool,
        row_major: bool = False,
        weighted: bool = False,
        apart: bool = True,
        shifts: Shifts = ((), ()),
    ) -> Kernel:
        """Return the kernel of loops, `weighted` if weights may change; as `plan_of`."""
        loop, signature = varying.loop, varying.signature
        options = bits, batched, row_major, weighted, apart, shifts
        # Also by what has rows of agents, only if it exists.
        own = jax.tree.structure((loop.places, loop.motion.rows))
        key = signature, own, LANES[bits], *options

        def write() -> KernelText:
            memories = memories_of(loop)
            rows = BlockRows.of(loop, memories, varying.count)
            return text_of(rows, *plan_of(varying, rows, *options), memories)

        def make() -> Kernel:
            # To trace a step takes longer than to read its text; numbers given ahead are no text.
            known = signature, loop.places, loop.motion.rows, *key[2:]
            made = write() if signature is None else load_or_compute(write, "kernel", *known)
            # By its text, since another graph has the same code.
            return Kernel(self.codes.get_or_make(made.text, lambda: Code(made.text)), made)

        return self._kernels.get_or_make(None if signature is None else key, make)


KERNELS = Kernels()
"""The cache of all runs."""
