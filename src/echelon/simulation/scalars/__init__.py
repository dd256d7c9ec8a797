"""A function for JAX as a graph of scalar operations."""

from echelon.simulation.scalars.host_part import HostPart
from echelon.simulation.scalars.lowering import lower
from echelon.simulation.scalars.scalar_graph import Node, ScalarGraph, needed, rewritten, within
from echelon.simulation.scalars.traced_entries import Unsupported, nodes
from echelon.simulation.scalars.whole_numbers import may_be_exception

__all__ = [
    "HostPart",
    "Node",
    "ScalarGraph",
    "Unsupported",
    "lower",
    "may_be_exception",
    "needed",
    "nodes",
    "rewritten",
    "within",
]
