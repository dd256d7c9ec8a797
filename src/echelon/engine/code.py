"""The code that steps loops, made once for those that are alike but for their numbers."""

from collections.abc import Hashable, MutableMapping
from pathlib import Path
from typing import NamedTuple, final
from weakref import WeakValueDictionary

import jax
import jax.numpy as jnp
import numpy as np

from echelon.engine.loop import Loop
from echelon.engine.own import Own
from echelon.engine.scalars import Rows, body_of, signals_of
from echelon.kernels import Code, Plan, program, shared

LANES = {64: 8, 32: 16}
"""Vectors of 512 bits; where a processor's are shorter, LLVM takes two."""
_KEPT = 8
"""Kernels that are kept for other runs."""


def follows(loop: Loop) -> bool:
    """Tell whether the leaders of a loop follow a reference."""
    return loop.leader.reference_states(loop.model, jnp.zeros(1)) is not None


class _Kernel(NamedTuple):
    """The code that steps some loops, the rows that it works on, its plan, and `common.shared`."""

    code: Code
    rows: Rows
    plan: Plan
    common: int


def _kernel(
    own: Own,
    bits: int,
    together: bool,
    lines: bool,
    weighted: bool,
    codes: MutableMapping[str, Code],
) -> _Kernel:
    """Return the code that steps some loops, the rows that it works on, and its plan.

    `codes` are those that were made, by their texts: other graphs are other numbers in the same.

    Raises:
        Unsupported: a law or the model uses what has no scalar operations.
    """
    loop, rows, wanted = own.loop, Rows.of(own.loop, own.count), follows(own.loop)
    n, alone = len(rows.state), len(loop.leaders) == 1
    plan = Plan(
        bits=bits,
        lanes=LANES[bits],
        together=together,
        lines=lines,
        rows=rows.total,
        width=n + signals_of(loop),
        first=body_of(own, bits, rows, True, wanted),
        others=body_of(own, bits, rows, False, wanted),
        tell=rows.tell.start,
        told=len(rows.tell),
        one_source=alone and loop.parents is None,
        one_leader=alone,
        weighted=weighted or bool((np.asarray(loop.exchange.weights) != 1.0).any()),
        edges=loop.meter.measured,
        table=n if wanted else 0,
        dt=loop.motion.dt,
    )
    # Where JAX was told to keep what it compiles, so that one setting rules both.
    cache = getattr(jax.config, "jax_compilation_cache_dir", None)
    text = program(plan)
    code = codes.get(text) or Code(text, Path(cache) if cache else None)
    codes[text] = code
    return _Kernel(code, rows, plan, len(shared(plan)))


@final
class Kernels:
    """Those that were made, so that loops alike but for their own numbers share one."""

    def __init__(self) -> None:
        """Begin with none."""
        self._made: dict[Hashable, _Kernel] = {}
        self._codes: MutableMapping[str, Code] = WeakValueDictionary()

    def of(
        self, own: Own, bits: int, together: bool, lines: bool = False, weighted: bool = False
    ) -> _Kernel:
        """Return what steps some loops, `weighted` where their edges' weights may become others.

        Raises:
            Unsupported: a law or the model uses what has no scalar operations.
        """
        # Of wind and noise too: their rows are there only where these are.
        wind = jax.tree.structure(own.loop.motion.wind)
        key = (own.signature, wind, bits, together, lines, weighted)
        if key not in self._made:
            # The oldest goes: a sweep over models has one after the other.
            while len(self._made) >= _KEPT:
                self._made.pop(next(iter(self._made)))
            self._made[key] = _kernel(own, bits, together, lines, weighted, self._codes)
        return self._made[key]
