"""Synthesis: methods that compute gains, and the certificates of their guarantees."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(__name__, submodules=["certificates", "gains"])
