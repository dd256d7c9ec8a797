"""The heading of an agent, and how vectors turn with it."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from echelon.core.types import Array, Scalar


class Heading(NamedTuple):
    """How a model turns: its heading grows by the angle, and vectors in the plane turn by it.

    Attributes:
        state: name of the state that is the heading, rad.
        vectors: pairs of states that turn, such as ("x", "y"): from the first to the second.
        inputs: pairs of normalized inputs that turn; none where inputs act along the body's axes.
    """

    state: str
    vectors: tuple[tuple[str, str], ...] = ()
    inputs: tuple[tuple[str, str], ...] = ()


class Turn(NamedTuple):
    """A rotation of pairs of entries of a vector (k,), exp(angle G).

    Attributes:
        partners: (k,) the entry with which each entry is mixed.
        signs: (k,) its sign in the mixture; 0 where an entry does not turn.
    """

    partners: Array
    signs: Array

    @classmethod
    def of(cls, names: tuple[str, ...], pairs: tuple[tuple[str, str], ...]) -> "Turn":
        """Return the rotation of pairs of named entries."""
        partners, signs = np.arange(len(names)), np.zeros(len(names))
        for first, second in pairs:
            i, j = names.index(first), names.index(second)
            partners[[i, j]], signs[[i, j]] = (j, i), (-1.0, 1.0)
        return cls(partners, signs)

    def __call__(self, values: Float[jax.Array, " k"], angle: Scalar) -> Float[jax.Array, " k"]:
        """Return values (k,) turned by an angle (rad); entries that do not turn keep their bits."""
        if not self.signs.any():
            return values
        signs = jnp.asarray(self.signs, values.dtype)
        cosines = jnp.where(self.signs != 0.0, jnp.cos(angle), jnp.ones_like(values))
        return cosines * values + jnp.sin(angle) * (signs * values[self.partners])

    @property
    def slope(self) -> Array:
        """G (k, k)."""
        slope = np.zeros((len(self.signs), len(self.signs)))
        slope[np.arange(len(self.signs)), self.partners] = self.signs
        return slope
