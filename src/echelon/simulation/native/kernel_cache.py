"""The code that steps loops, made once for those that are alike but for their numbers."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, TypeAlias, final

import jax
import numpy as np

from echelon.core.memoize import BoundedCache
from echelon.core.numerics import precision
from echelon.simulation.codegen import Code, Plan, program, shared, winds
from echelon.simulation.native.agent_step import BlockRows, body_of, signals_of
from echelon.simulation.native.varying import VaryingNumbers
from echelon.simulation.step.loop import Loop

LANES = {64: 8, 32: 16}
"""Vectors of 512 bits; where a processor's are shorter, LLVM takes two."""
MOST = 8
"""Kernels, and codes, that are kept for other runs."""


def follows(loop: Loop) -> bool:
    """Tell whether the leaders of a loop follow a reference."""
    # As references are sampled, so that nothing is compiled for this alone.
    with precision("float64"):
        return loop.leader.reference_states(loop.model, jax.device_put(np.zeros(1))) is not None


class Kernel(NamedTuple):
    """The code that steps some loops, the rows that it works on, its plan, and `common.shared`."""

    code: Code
    rows: BlockRows
    plan: Plan
    common: int


def plan_of(
    own: VaryingNumbers,
    rows: BlockRows,
    bits: int,
    together: bool,
    lines: bool,
    weighted: bool,
    tabled: bool,
) -> Plan:
    """Return what is written of some loops, whose own numbers may stand in the table (`tabled`).

    Raises:
        Unsupported: a law or the model uses what has no scalar operations.
    """
    loop, wanted = own.loop, follows(own.loop)
    n, alone = len(rows.state), len(loop.leaders) == 1
    plan = Plan(
        bits=bits,
        lanes=LANES[bits],
        together=together,
        lines=lines,
        rows=rows.total,
        width=n + signals_of(loop),
        first=body_of(own, bits, rows, True, wanted, tabled),
        others=body_of(own, bits, rows, False, wanted, tabled),
        tell=rows.tell.start,
        told=len(rows.tell),
        one_source=alone and loop.parents is None,
        one_leader=alone,
        weighted=weighted or bool((np.asarray(loop.exchange.weights) != 1.0).any()),
        edges=loop.meter.measured,
        table=(n if wanted else 0) + (own.count if tabled else 0),
        dt=loop.motion.dt,
    )
    # A leader that hears nobody, and is told nothing, waits for nobody.
    ahead = not together and loop.levels is None and not plan.first.hears
    return plan._replace(width=plan.width + winds(plan), ahead=ahead)


def compiled(rows: BlockRows, plan: Plan, codes: BoundedCache[Code]) -> Kernel:
    """Return the code of a plan, and with it what is known of it.

    `codes` are those that were made, by their texts: other graphs are other numbers in the same.
    """
    # Where JAX was told to keep what it compiles, so that one setting rules both.
    cache = getattr(jax.config, "jax_compilation_cache_dir", None)
    text = program(plan)
    code = codes.get_or_make(text, lambda: Code(text, Path(cache) if cache else None))
    return Kernel(code, rows, plan, len(shared(plan)))


Make: TypeAlias = Callable[[VaryingNumbers, int, bool, bool, bool], Kernel]
"""What makes kernels, or has made them, as `Kernels.of` does."""


@final
class Kernels:
    """Those that were made, so that loops alike but for their own numbers share one.

    Of loops whose trace may be another one the next time, such as of a user's classes, only machine
    code is shared, by its text.

    Attributes:
        codes: those by their texts.
    """

    def __init__(self) -> None:
        """Begin with none."""
        # A sweep over models has one after the other.
        self.codes, self._kernels = BoundedCache[Code](MOST), BoundedCache[Kernel](MOST)

    def of(
        self,
        own: VaryingNumbers,
        bits: int,
        together: bool,
        lines: bool = False,
        weighted: bool = False,
    ) -> Kernel:
        """Return what steps some loops, `weighted` where their edges' weights may become others.

        Raises:
            Unsupported: a law or the model uses what has no scalar operations.
        """
        # Of wind and noise too: their rows are there only where these are.
        wind = jax.tree.structure(own.loop.motion.wind)
        key = (own.signature, wind, bits, LANES[bits], together, lines, weighted)

        def make() -> Kernel:
            rows = BlockRows.of(own.loop, own.count)
            plan = plan_of(own, rows, bits, together, lines, weighted, False)
            return compiled(rows, plan, self.codes)

        return self._kernels.get_or_make(None if own.signature is None else key, make)


KERNELS = Kernels()
"""Those of all runs."""
