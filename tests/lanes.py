"""Runs a function of one agent's numbers as native code, with one agent per lane."""

import numpy as np

from echelon.simulation.codegen import (
    SLOTS,
    Body,
    Code,
    Plan,
    aligned,
    factored,
    program,
    shared,
)
from echelon.simulation.scalars import ScalarGraph, lower, nodes


def lowered(function, count, bits=64):
    """Return the graph's results of a function for JAX of `count` numbers, as nodes."""
    graph = ScalarGraph(bits)
    x = np.empty(count, object)
    x[:] = [graph.leaf("row", k) for k in range(count)]
    results = [node for part in lower(function, graph, [x]) for node in nodes(graph, part)]
    after = factored(results)
    results = [after[node] for node in results]
    return [graph.make("select", n, 1.0, 0.0) if n.truth else n for n in results]


def text_of(function, count, bits=64, lanes=None):
    """Return the code of a function, how many results it has, and its plan."""
    results = lowered(function, count, bits)
    exceptions = results[0].graph.exceptions_of(results)
    body = Body(stores=dict(enumerate(results, count)), exceptions=exceptions)
    plan = Plan(
        bits=bits,
        lanes=lanes or 512 // bits,
        batched=False,
        row_major=False,
        rows=count + len(results) + 1,
        width=0,
        first=body,
        others=Body(),
        message_start=0,
        message_size=0,
        one_source=False,
        one_leader=False,
        weighted=False,
        edges=(),
        apart=False,
        exception_row=count + len(results),
        table=0,
    )
    return program(plan), len(results), plan


def run(function, columns, bits=64, lanes=None):
    """Return what a function for JAX makes of columns (count, N), as (results, N)."""
    return run_with_exceptions(function, columns, bits, lanes)[:-1]


def run_with_exceptions(function, columns, bits=64, lanes=None):
    """Return the same, and in a last row 1 for each column of which JAX is to make it."""
    lanes, (count, agents) = lanes or 512 // bits, columns.shape
    text, results, plan = text_of(function, count, bits, lanes)
    blocks, dtype = -(-agents // lanes), np.float64 if bits == 64 else np.float32
    rows = aligned((blocks, plan.rows, lanes), dtype)
    padded = np.resize(columns.T, (blocks * lanes, count))
    rows[:, :count] = padded.reshape(blocks, lanes, count).transpose(0, 2, 1)
    task, slots = np.array([0, 0, 0, blocks, 0, 0, 0, 0]), np.zeros(len(SLOTS), np.int64)
    values = {"rows": rows.ctypes.data, "schedule": task.ctypes.data}
    uniform_values = aligned((1 + len(shared(plan)),), dtype)
    values |= {"uniform_values": uniform_values.ctypes.data}
    values |= dict.fromkeys(("steps", "count", "groups", "threads"), 1)
    for name, value in values.items():
        slots[SLOTS.index(name)] = value
    Code(text).call(slots)
    after = rows[:, count:].transpose(0, 2, 1)
    return after.reshape(blocks * lanes, results + 1)[:agents].T.copy()
