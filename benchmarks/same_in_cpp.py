"""A follower's step as C++ with vector types, operation by operation, to compare code with.

What LLVM makes native code of is written out a second time and compiled by `g++ -O3`: the same
nodes in the same order, without the branches that native code takes around what seldom happens.
"""

import ctypes
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeAlias, final

import numpy as np

from echelon.simulation.codegen import Body, Code, Plan, aligned, program, shared
from echelon.simulation.codegen.emitter import general_case
from echelon.simulation.native.agent_step import program_of
from echelon.simulation.native.kernel_cache import LANES
from echelon.simulation.native.stepper import NativeStepper
from echelon.simulation.native.threads import call, step_by_step
from echelon.simulation.scalars import Node, needed, rewritten

Run: TypeAlias = Callable[[np.ndarray, int], None]
"""Takes some steps of agents in rows (blocks, rows, lanes)."""
_BLOCKS = 64
"""Of agents, whose rows stay in a cache: code is compared, and not memory."""

_HEAD = """
#include <immintrin.h>
#include <string.h>
typedef {T} V __attribute__((vector_size(64)));
typedef {I} M __attribute__((vector_size(64)));
static inline V all({T} x) {{ return x - (V){{}}; }}
static inline M bits(V x) {{ return (M)x; }}
extern "C" void run({T} *rows, long blocks, long steps) {{
for (long step = 0; step < steps; step++) for (long b = 0; b < blocks; b++) {{
{T} *at = rows + b * {size};
"""
_INFIX = {"add": "+", "sub": "-", "unfused_sub": "-", "mul": "*", "div": "/", "exact_div": "/"}
_INFIX |= {"lt": "<", "le": "<=", "eq": "==", "ne": "!=", "and": "&", "or": "|", "xor": "^"}
_CALLS = {
    "fma": "{0} * {1} + {2}",
    "fms": "{0} * {1} - {2}",
    "fnma": "{2} - {0} * {1}",
    "sqrt": "(V)_mm512_sqrt_{s}((__m512{t}){0})",
    "floor": "(V)_mm512_roundscale_{s}((__m512{t}){0}, 9)",
    "ceil": "(V)_mm512_roundscale_{s}((__m512{t}){0}, 10)",
    "rint": "(V)_mm512_roundscale_{s}((__m512{t}){0}, 8)",
    "min": "(V)_mm512_min_{s}((__m512{t}){0}, (__m512{t}){1})",
    "max": "(V)_mm512_max_{s}((__m512{t}){0}, (__m512{t}){1})",
    "abs": "(V)_mm512_abs_{s}((__m512{t}){0})",
    "copysign": "(V)((bits({0}) & ~{sign}) | (bits({1}) & {sign}))",
    "neg": "-{0}",
    "not": "~{0}",
    "select": "({0} ? {1} : {2})",
    "bit0": "((bits({0}) & 1) != 0)",
    "bit1": "((bits({0}) & 2) != 0)",
    "pow2": "(V)(bits({0} + all({magic})) << {shift})",
    "exponent": "__builtin_convertvector((bits({0}) - {root}) >> {shift}, V)",
    "mantissa": "(V)(bits({0}) - (((bits({0}) - {root}) >> {shift}) << {shift}))",
}
_KINDS: dict[int, dict[str, Any]] = {
    64: {"T": "double", "I": "long", "s": "pd", "t": "d", "shift": 52, "magic": 1.5 * 2**52 + 1023},
    32: {"T": "float", "I": "int", "s": "ps", "t": "", "shift": 23, "magic": 1.5 * 2**23 + 127},
}
_KINDS[64] |= {"sign": "(1L << 63)", "root": "0x3FE6A09E667F3BCDL"}
_KINDS[32] |= {"sign": "(1 << 31)", "root": "0x3F3504F3"}


@final
class Follower:
    """What a follower does in a step, with what it hears and is told read from rows of its own.

    Args:
        stepper: of the agents, of which the first follower is taken.
        bits: 64 or 32.
    """

    def __init__(self, stepper: NativeStepper, bits: int) -> None:
        """Put all that is read into rows, and all that is written."""
        self.bits, self.lanes, varying = bits, LANES[bits], stepper.varying
        follows = bool(stepper.plan.table)
        body = program_of(varying, bits, stepper.rows, False, follows).body
        places: dict[Any, int] = {}

        def read(node: Node, _: Any) -> Node | None:
            if node.op != "leaf" or node.value[0] == "row":
                return None
            place = places.setdefault(node.value, stepper.rows.total + len(places))
            return node.graph.leaf("row", place)

        after = body.map_nodes(rewritten(body.results(), read))
        graph = next(iter(after.stores.values())).graph
        pairs = ((after.sums, "add"), (after.minima, "min"))
        self.stores = dict(after.stores) | {
            row: graph.make(op, graph.leaf("row", row), node)
            for results, op in pairs
            for row, node in results.items()
        }
        self.rows, self.state = stepper.rows.total + len(places), stepper.rows.state
        self.first = np.asarray(stepper.states[1:2]).T

    def memory(self) -> np.ndarray:
        """Return rows of agents that begin near the first follower, and hear little."""
        kind = np.float64 if self.bits == 64 else np.float32
        rows = aligned((_BLOCKS, self.rows, self.lanes), kind)
        rows[:] = 1e-3 * np.random.default_rng(0).uniform(-1, 1, rows.shape)
        rows[:, self.state.start : self.state.stop] += self.first
        return rows

    def after(self, run: Run, start: np.ndarray, steps: int) -> np.ndarray:
        """Return the rows after some steps."""
        rows = aligned(start.shape, start.dtype)
        rows[:] = start
        run(rows, steps)
        return rows

    def rate(self, run: Run, start: np.ndarray, steps: int) -> float:
        """Return agent-steps per second of CPU time, of one turn."""
        begin = time.process_time()
        self.after(run, start, steps)
        return start.shape[0] * start.shape[2] * steps / (time.process_time() - begin)

    def native(self) -> Run:
        """Return it as native code."""
        plan = Plan(
            bits=self.bits,
            lanes=self.lanes,
            batched=False,
            row_major=False,
            rows=self.rows,
            width=0,
            first=Body(stores=self.stores),
            others=Body(),
            message_start=0,
            message_size=0,
            one_source=False,
            one_leader=False,
            weighted=False,
            edges=(),
            apart=False,
            exception_row=0,
            table=0,
        )
        code = Code(program(plan))

        def run(rows: np.ndarray, steps: int) -> None:
            schedule = step_by_step(np.array([0, len(rows)]), 0, steps, 0, 1)
            uniform_values = aligned((steps, 1 + len(shared(plan))), rows.dtype)
            arrays = {"rows": rows, "schedule": schedule, "uniform_values": uniform_values}
            numbers = {"steps": steps, "count": len(schedule), "groups": 1, "threads": 1}
            call(code, numbers, arrays)

        return run

    def cpp(self) -> Run:
        """Return it as C++, compiled."""
        with tempfile.TemporaryDirectory() as folder:
            source, made = Path(folder) / "step.cpp", Path(folder) / "step.so"
            source.write_text(self._text())
            flags = "-O3 -march=native -std=c++17 -shared -fPIC".split()
            subprocess.run(["g++", *flags, source, "-o", made], check=True)
            library = ctypes.CDLL(str(made))

        def run(rows: np.ndarray, steps: int) -> None:
            at = ctypes.c_void_p(rows.ctypes.data)
            library.run(at, ctypes.c_long(len(rows)), ctypes.c_long(steps))

        return run

    def _text(self) -> str:
        """Return the step as C++."""
        kind, complete = _KINDS[self.bits], general_case(list(self.stores.values()))
        results = {row: complete[node] for row, node in self.stores.items()}
        lines = [_HEAD.format(size=self.rows * self.lanes, **kind)]
        for node in needed(results.values()):
            lines.append(f"const {'M' if node.truth else 'V'} v{node.number} = {self._one(node)};")
        for row, node in results.items():
            lines.append(f"*(V*)(at + {row * self.lanes}) = v{node.number};")
        return "\n".join([*lines, "}}", ""])

    def _one(self, node: Node) -> str:
        """Return an operation."""
        args, kind = [f"v{a.number}" for a in node.args], _KINDS[self.bits]
        if node.op == "constant":
            value = float(np.float32(node.value)) if self.bits == 32 else node.value
            return f"(M){{}} {'==' if node.value else '!='} 0" if node.truth else _shown(value)
        if node.op == "leaf":
            return f"*(const V*)(at + {node.value[1] * self.lanes})"
        if node.op in _INFIX:
            return f"{args[0]} {_INFIX[node.op]} {args[1]}"
        return _CALLS[node.op].format(*args, **kind)


def _shown(value: float) -> str:
    """Return a constant for all lanes."""
    if np.isfinite(value):
        return f"all({float(value).hex()})"
    return (
        'all(__builtin_nan(""))'
        if np.isnan(value)
        else f"all({value:+f})".replace("inf", "__builtin_inf()")
    )
