"""One step of the closed loop, its machine code, whole runs, and the optimization baseline."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submodules=["codegen", "engine", "native", "optimal", "scalars", "step"],
)
