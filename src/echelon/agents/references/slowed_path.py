"""A path in space at a fraction of its speed."""

import functools
from collections.abc import Callable, Iterator, Sequence
from typing import final

import jax

from echelon.agents.models.model import ControlAffine
from echelon.agents.references.reference import LeaderPath, Reference
from echelon.core.errors import ReferenceError, is_number
from echelon.core.types import Scalar


@final
class SlowedPath(Reference):
    """The points of another path at times that are `factor` as long: path(t / factor).

    Raises:
        ReferenceError: the other is no path in space, or the factor is not positive and finite.
    """

    path: Reference
    factor: float

    def __check_init__(self) -> None:
        if not isinstance(self.path, Reference):
            # States and inputs over time fit the model's equations at their own speed only.
            raise ReferenceError(
                f"`{type(self.path).__name__}` cannot be slowed down: it is no path in space."
            )
        if not (is_number(self.factor) and 0.0 < self.factor < float("inf")):
            raise ReferenceError(f"`slowdown` is {self.factor}, and must be positive and finite.")

    @property
    def joined(self) -> int:  # pyright: ignore
        """How many derivatives are continuous where the parts of the path meet."""
        return self.path.joined

    def __call__(self, t: Scalar) -> jax.Array:
        """Return (x, y, z, yaw) at time t (s)."""
        return self.path(t / self.factor)

    def parts(self, horizon: float) -> Sequence[tuple[float, Callable[[Scalar], jax.Array]]]:
        """Return the smooth paths that it is joined of until the horizon, and their ends (s)."""
        pieces = self.path.parts(horizon / self.factor)
        return [(end * self.factor, functools.partial(self._at, piece)) for end, piece in pieces]

    def _at(self, piece: Callable[[Scalar], jax.Array], t: Scalar) -> jax.Array:
        return piece(t / self.factor)

    def turns(self, model: ControlAffine) -> bool:
        """Tell whether the heading may differ from the trim's at some time."""
        return self.path.turns(model)

    def variants(self) -> Iterator[tuple[str, str, LeaderPath]]:
        """Yield what may force motion, with the key that ends it and the path then."""
        for why, key, path in self.path.variants():
            yield why, key, slowed(path, self.factor)

    def remarks(self) -> tuple[str, ...]:
        """Return what is probably not meant, a sentence each."""
        return self.path.remarks()

    def span(self) -> tuple[float, float]:
        """Return the times (s) between which the path changes."""
        first, last = self.path.span()
        return first * self.factor, last * self.factor

    def fit(self, model: ControlAffine) -> None:
        """Raise `LawError`, which says why, unless a model can be led along it."""
        self.path.fit(model)


def slowed(path: LeaderPath, factor: float) -> LeaderPath:
    """Return a path that takes `factor` as long; the path itself for 1.

    Raises:
        ReferenceError: as of `SlowedPath`.
    """
    return path if factor == 1.0 else SlowedPath(path, factor)  # type: ignore[arg-type]
