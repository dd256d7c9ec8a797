"""Agents: models of vehicles, their network, the references of leaders, and disturbances."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submodules=["models", "network", "references", "world"],
)
