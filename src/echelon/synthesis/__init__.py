"""How a gain is found, and what its certificate proves."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submodules=["certificates", "gains"],
)
