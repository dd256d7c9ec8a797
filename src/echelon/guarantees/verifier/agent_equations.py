"""A saved gain's agents, made again from their equations."""

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
"""States at which a model is evaluated at once, so that it is compiled once."""
_MOST_DIMENSIONS = 1000
"""A whole number above it counts no dimensions, and is made a float."""


class Evaluated(NamedTuple):
    """What a model is at each of K points, in deviations x and normalized inputs v.

    Attributes:
        velocities: f + g (u* + S v), (K, n).
        sizes: the same with absolute values, which is what rounding is of, (K, n).
        jacobians: by reverse differentiation, (K, n, n).
        maps: g S, (K, n, m).
    """

    velocities: Array
    sizes: Array
    jacobians: Array
    maps: Array


class NoModel(NamedTuple):
    """Why there is no model; `broken` where the file promised one that cannot be made."""

    reason: str
    broken: bool


def model_of(saved: SavedModel) -> ControlAffine | NoModel:
    """Return the bundled model of a file.

    A class of any other module is not imported: reading a file must not run what it names.
    """
    module, _, name = saved.path.partition(":")
    # With the dot, since other packages may begin with the same letters. Files of version 0.2 name
    # the module of a model, later ones its public name.
    if not (module + ".").startswith(("echelon.models.", "echelon.agents.models.")):
        return NoModel(
            f"`{name}` is not bundled; `--scenario`, or `verify(path, model)`, takes its own", False
        )
    if saved.parameters is None:
        return NoModel(f"the file holds no parameters of `{name}`", False)
    try:
        cls = getattr(models, name, None) or getattr(importlib.import_module(module), name)
        # Asked before it is called: a module has other names than those of models.
        if not (isinstance(cls, type) and issubclass(cls, ControlAffine)):
            return NoModel(f"`{saved.path}` is no model", True)
        return cls(**{key: _frozen(value) for key, value in saved.parameters.items()})
    # Parameters of a false file can break a class in any way.
    except Exception as error:
        return NoModel(f"`{saved.path}` cannot be made: {error}", True)


def _frozen(value: object) -> object:
    # As a dimension it would be a model too large to hold; as a parameter its float is the same.
    if isinstance(value, int) and abs(value) > _MOST_DIMENSIONS:
        return float(value)
    return tuple(map(_frozen, value)) if isinstance(value, list) else value


def evaluate(model: ControlAffine, saved: SavedModel, x: Array, v: Array) -> Evaluated:
    """Evaluate a model at states (K, n) and normalized inputs (K, m), in float64."""
    parts = []
    with precision("float64"):
        u, S = jnp.asarray(saved.input), jnp.asarray(saved.scale)
        for k in range(0, len(x), _TOGETHER):
            some = x[k : k + _TOGETHER], v[k : k + _TOGETHER]
            # The last points once more, for one shape.
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
        # The synthesis differentiates forwards: a fault of either mode would show.
        return f + g @ (u + S @ v), size, jax.jacrev(velocity)(x, v), g @ S

    return jax.vmap(all_of)(states, inputs)
