"""Machine code of a step: from a graph of scalars to vectors, to the loops around them."""

from echelon.simulation.codegen.angle_differences import winds
from echelon.simulation.codegen.block_copy import move
from echelon.simulation.codegen.factoring import shortened
from echelon.simulation.codegen.ir_blocks import SLOTS, TURN, Body, Plan, stride
from echelon.simulation.codegen.kernel_text import program
from echelon.simulation.codegen.machine_code import Code, aligned, is_installed, vectors
from echelon.simulation.codegen.tape import fed_widths, from_tape
from echelon.simulation.codegen.uniform_values import shared

__all__ = [
    "SLOTS",
    "TURN",
    "Body",
    "Code",
    "Plan",
    "aligned",
    "fed_widths",
    "from_tape",
    "is_installed",
    "move",
    "program",
    "shared",
    "shortened",
    "stride",
    "vectors",
    "winds",
]
