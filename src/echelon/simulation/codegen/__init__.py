"""Machine code of a step: from a graph of scalars to vectors, to the loops around them."""

from echelon.simulation.codegen.block_copy import copy_rows
from echelon.simulation.codegen.factoring import factored
from echelon.simulation.codegen.kernel_plan import (
    ANNOUNCE,
    PRIOR,
    SHIFTED,
    SLOTS,
    TASK,
    Body,
    Letters,
    Plan,
    stride,
)
from echelon.simulation.codegen.kernel_text import program
from echelon.simulation.codegen.machine_code import (
    Code,
    aligned,
    is_installed,
    vectors,
)
from echelon.simulation.codegen.neighbours import has_flag
from echelon.simulation.codegen.scheduling import shared

__all__ = [
    "ANNOUNCE",
    "PRIOR",
    "SHIFTED",
    "SLOTS",
    "TASK",
    "Body",
    "Code",
    "Letters",
    "Plan",
    "aligned",
    "copy_rows",
    "factored",
    "has_flag",
    "is_installed",
    "program",
    "shared",
    "stride",
    "vectors",
]
