"""The step as machine code: memory blocks, schedule, and threads."""

# What the rest of the library asks about native code.
from echelon.simulation.codegen import is_installed, vectors

__all__ = ["is_installed", "vectors"]
