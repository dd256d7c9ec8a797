"""echelon: leader-follower formation tracking by consensus, for any agent xdot = f(x) + g(x) u.

Parts in, one verb, one result out: `synthesize` a gain for a model on a graph, `simulate` the
closed loop, `report` what happened. The public names stand in `__init__.pyi`, each once; nothing
heavy is imported until it is used, and importing changes no global setting.
"""

from typing import Any

import lazy_loader

__version__ = "0.2.0"

_load, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> Any:
    try:
        return _load(name)
    except AttributeError as error:
        from echelon.core.gone import RENAMED, no_name

        if name not in RENAMED:
            raise no_name(name) from error
        import warnings

        now = RENAMED[name]
        text = f"`echelon.{name}` is now `echelon.{now}`, and goes with the next version."
        warnings.warn(text, FutureWarning, stacklevel=2)
        return _load(now)
