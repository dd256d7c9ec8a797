"""Code for this machine: from a trace to scalars, to vectors, to the loops about them."""

from echelon.kernels.adjoint import fed_widths, from_tape
from echelon.kernels.common import shared
from echelon.kernels.drivers import program
from echelon.kernels.entries import Unsupported, nodes
from echelon.kernels.frame import SLOTS, TURN, Body, Plan, stride
from echelon.kernels.lowering import lower
from echelon.kernels.moving import move
from echelon.kernels.native import Code, aligned, is_installed, vectors
from echelon.kernels.products import shortened
from echelon.kernels.scalar import Graph, Node, needed
from echelon.kernels.winding import winds

__all__ = [
    "SLOTS",
    "TURN",
    "Body",
    "Code",
    "Graph",
    "Node",
    "Plan",
    "Unsupported",
    "aligned",
    "fed_widths",
    "from_tape",
    "is_installed",
    "lower",
    "move",
    "needed",
    "nodes",
    "program",
    "shared",
    "shortened",
    "stride",
    "vectors",
    "winds",
]
