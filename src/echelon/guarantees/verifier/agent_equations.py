"""Agent models of a saved gain, rebuilt from its parameters and evaluated."""

import importlib
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from echelon.agents import models
from echelon.agents.models.model import ControlAffine
from echelon.core.numerics import precision
from echelon.core.types import Array
from echelon.guarantees.verifier.saved_gain import SavedModel

_TOGETHER = 384
"""States evaluated at once; a fixed number, so that a model is compiled once."""
_MOST_DIMENSIONS = 1000
"""A larger integer cannot be a dimension and is converted to a float."""


class Evaluated(NamedTuple):
    """A model evaluated at K states x and normalized inputs v.

    Attributes:
        velocities: f + g (u* + S v), (K, n).
        sizes: the sum of the absolute values of its terms, which bounds rounding, (K, n).
        jacobians: by reverse differentiation, (K, n, n).
        maps: g S, (K, n, m).
    """

    velocities: Array
    sizes: Array
    jacobians: Array
    maps: Array


class NoModel(NamedTuple):
    """Why there is no model; `broken` if the file names a bundled model that cannot be built."""

    reason: str
    broken: bool


def model_of(saved: SavedModel) -> ControlAffine | NoModel:
    """Return the bundled model named in a file.

    No other module is imported: reading a file must not execute code that it names.
    """
    module, _, name = saved.path.partition(":")
    # With the dot, since other packages may have the same prefix. Files of version 0.2 store the
    # module of a model, later ones its public name.
    if not (module + ".").startswith(("echelon.models.", "echelon.agents.models.")):
        return NoModel(
            f"`{name}` is not bundled; pass it by `--scenario` or `verify(path, model)`", False
        )
    if saved.parameters is None:
        return NoModel(f"the file holds no parameters of `{name}`", False)
    try:
        cls = getattr(models, name, None) or getattr(importlib.import_module(module), name)
        # Checked before the call: a module also contains other names.
        if not (isinstance(cls, type) and issubclass(cls, ControlAffine)):
            return NoModel(f"`{saved.path}` is not a model", True)
        return cls(**{key: _to_parameter(value) for key, value in saved.parameters.items()})
    # False parameters can raise any exception in a class.
    except Exception as error:
        return NoModel(f"`{saved.path}` cannot be built: {error}", True)


def _to_parameter(value: object) -> object:
    # As a dimension it would exhaust the memory; as a parameter a float is equivalent.
    if isinstance(value, int) and abs(value) > _MOST_DIMENSIONS:
        return float(value)
    return tuple(map(_to_parameter, value)) if isinstance(value, list) else value


def evaluate(model: ControlAffine, saved: SavedModel, x: Array, v: Array) -> Evaluated:
    """Evaluate a model at states (K, n) and normalized inputs (K, m), in float64."""
    parts = []
    with precision("float64"):
        u, S = jnp.asarray(saved.input), jnp.asarray(saved.scale)
        for k in range(0, len(x), _TOGETHER):
            some = x[k : k + _TOGETHER], v[k : k + _TOGETHER]
            # Padded to one shape, since another one would be compiled again.
            full = (np.resize(item, (_TOGETHER, item.shape[1])) for item in some)
            result = _evaluate(model, u, S, *map(jnp.asarray, full))
            parts.append([np.asarray(item)[: len(some[0])] for item in result])
    return Evaluated(*map(np.concatenate, zip(*parts, strict=True)))


@eqx.filter_jit
def _evaluate(
    model: ControlAffine, u: jax.Array, S: jax.Array, states: jax.Array, inputs: jax.Array
) -> tuple[jax.Array, ...]:
    def velocity(x: jax.Array, v: jax.Array) -> jax.Array:
        return model.drift(x) + model.input_map(x) @ (u + S @ v)

    def all_of(x: jax.Array, v: jax.Array) -> tuple[jax.Array, ...]:
        f, g = model.drift(x), model.input_map(x)
        size = jnp.abs(f) + jnp.abs(g) @ (jnp.abs(u) + jnp.abs(S @ v))
        # Reverse mode, while the synthesis uses forward mode: an error in either is detected.
        return f + g @ (u + S @ v), size, jax.jacrev(velocity)(x, v), g @ S

    return jax.vmap(all_of)(states, inputs)
