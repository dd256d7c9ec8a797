"""What is guaranteed of a run, theorem T5, and an independent check of both."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__, submodules=["promises", "stopping", "verifier"]
)
