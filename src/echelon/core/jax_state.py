"""Whether JAX can run in this process as echelon needs it."""

import functools
import os

import jax
import numpy as np
from jax._src import xla_bridge

from echelon.core.errors import EchelonError

_ASKS = ("jax_platforms", "jax_platform_name", "jax_default_device")
"""Settings of JAX that choose a device; their environment variables are the same in capitals."""
_forked = False
"""Whether this process is a fork of one in which JAX had started."""


def require_jax() -> None:
    """Check that JAX can run; cheap after the first call.

    Raises:
        EchelonError: it cannot, and would fail or hang later without saying why.
    """
    if _forked:
        raise EchelonError(
            "JAX had started before this process was forked, and would hang in it; start processes"
            " with `multiprocessing.get_context('spawn')`, or use `echelon sweep`."
        )
    if jax.config.jax_disable_jit:  # pyright: ignore[reportAttributeAccessIssue]
        raise EchelonError(
            "JAX's `jax_disable_jit` (`JAX_DISABLE_JIT`) is on, which echelon does not support;"
            " turn it off, and debug a model by calling its functions alone."
        )
    _require_device()


@functools.cache
def _require_device() -> None:
    try:
        # An array, since JAX looks for its default device only when it makes one.
        jax.device_put(np.float32(0.0))
    # JAX raises errors of many types, an AssertionError without text among them.
    except Exception as error:
        for name in _ASKS:
            asked = jax.config.values.get(name)
            if asked:
                own = name.upper() if name.upper() in os.environ else name
                raise EchelonError(
                    f"`{own}` asks JAX for `{asked}`, which this machine lacks; unset it, and JAX"
                    " uses a device that exists, such as `cpu`."
                ) from error
        cause = (str(error) or type(error).__name__).splitlines()[0]
        raise EchelonError(f"JAX finds no device on this machine ({cause}).") from error


def _note_fork() -> None:
    global _forked
    _forked = _forked or bool(xla_bridge._backends)


# Windows cannot fork.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_note_fork)
