"""Code for this machine: from a trace to scalars, from scalars to vectors, from vectors to loops."""

from echelon.kernels.drivers import Body, Plan, SLOTS, program
from echelon.kernels.lowering import Unsupported, lower, nodes
from echelon.kernels.native import Code, aligned, is_installed
from echelon.kernels.scalar import Graph, Node

__all__ = [
    "SLOTS",
    "Body",
    "Code",
    "Graph",
    "Node",
    "Plan",
    "Unsupported",
    "aligned",
    "is_installed",
    "lower",
    "nodes",
    "program",
]
