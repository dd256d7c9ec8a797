"""Helper that runs a function of one agent's numbers as native code, one agent in each lane."""

import numpy as np

from echelon.simulation.codegen import (
    SLOTS,
    Body,
    Code,
    Plan,
    aligned,
    program,
    shared,
    shortened,
)
from echelon.simulation.scalars import ScalarGraph, lower, nodes

NOTHING = Body({}, {}, {}, {}, {}, [], [], [])


def lowered(function, count, bits=64):
    """Return the graph's results of a function for JAX of `count` numbers, as nodes."""
    graph = ScalarGraph(bits)
    x = np.empty(count, object)
    x[:] = [graph.leaf("row", k) for k in range(count)]
    found = [node for part in lower(function, graph, [x]) for node in nodes(graph, part)]
    short = shortened(found)
    found = [short[node] for node in found]
    return [graph.make("select", n, 1.0, 0.0) if n.truth else n for n in found]


def text_of(function, count, bits=64, lanes=None):
    """Return the code of a function, how many results it has, and its plan."""
    results = lowered(function, count, bits)
    body = NOTHING._replace(stores=dict(enumerate(results, count)))
    plan = Plan(
        bits=bits,
        lanes=lanes or 512 // bits,
        together=False,
        lines=False,
        rows=count + len(results),
        width=0,
        first=body,
        others=NOTHING,
        tell=0,
        told=0,
        one_source=False,
        one_leader=False,
        weighted=False,
        edges=(),
        table=0,
        dt=0.0,
    )
    return program(plan), len(results), plan


def run(function, columns, bits=64, lanes=None, cache=None):
    """Return what a function for JAX makes of columns (count, N), as (results, N)."""
    lanes, (count, agents) = lanes or 512 // bits, columns.shape
    text, results, plan = text_of(function, count, bits, lanes)
    blocks, dtype = -(-agents // lanes), np.float64 if bits == 64 else np.float32
    rows = aligned((blocks, count + results, lanes), dtype)
    padded = np.resize(columns.T, (blocks * lanes, count))
    rows[:, :count] = padded.reshape(blocks, lanes, count).transpose(0, 2, 1)
    turn, slots = np.array([0, 0, 0, blocks, 0, 0, 0, 0]), np.zeros(len(SLOTS), np.int64)
    values = {"rows": rows.ctypes.data, "turns": turn.ctypes.data}
    common = aligned((1 + len(shared(plan)),), dtype)
    values |= {"common": common.ctypes.data}
    values |= dict.fromkeys(("steps", "count", "groups", "threads"), 1)
    for name, value in values.items():
        slots[SLOTS.index(name)] = value
    Code(text, cache).call(slots)
    found = rows[:, count:].transpose(0, 2, 1)
    return found.reshape(blocks * lanes, results)[:agents].T.copy()
