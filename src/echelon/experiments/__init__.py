"""A run as a file, its numbers, comparisons of methods, and many runs at once."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__, submodules=["results", "scenario", "studies", "sweeps"]
)
