"""Whether offsets that change with time have the derivatives that T5 asks of them."""

from collections.abc import Iterator
from fractions import Fraction
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from echelon.agents.network.formation_motion import ORDER, FormationMotion, Rotate, Scale, blend
from echelon.core.cache import memoize
from echelon.core.enclosure.taylor import enclose_finely
from echelon.core.errors import GainError
from echelon.core.types import Array
from echelon.guarantees.stopping.path_smoothness import compare_derivatives

_MOST_PLACES = 256
"""Different rows of places that are looked at."""


def offset_fault(motion: FormationMotion | None, order: int, horizon: float) -> str:
    """Return why offsets are not known to have bounded derivatives; empty where they have.

    As of a path, every function in a user's motion must be smooth on the values that it takes until
    the horizon (s), from each place and along each way of a reshape.
    """
    if motion is None:
        return ""
    if len(motion.begins) and order > ORDER + 1:
        return f"a reshape has {ORDER} continuous derivatives, and {order - 1} are needed"
    if motion.bundled:
        return ""
    try:
        _check(motion, order, horizon)
    except GainError as error:
        name = next(type(m).__name__ for m in motion.motions if type(m) not in (Rotate, Scale))
        why = str(error).rstrip(".").replace("a path", "it")
        return f"the motion `{name}` is not known to have {order} bounded derivatives, since {why}"
    return ""


@memoize
def _check(motion: FormationMotion, order: int, horizon: float) -> None:
    """Check the motion of all places.

    Raises:
        GainError: it may lack a derivative, or there are too many places.
    """
    rows = np.unique(motion.places, axis=0)
    if len(rows) > _MOST_PLACES:
        raise GainError(f"{len(rows)} places are different, and {_MOST_PLACES} are looked at")
    for piece in _pieces(motion, rows, horizon):
        span = Fraction(piece.begin), Fraction(piece.end)
        list(enclose_finely(piece, span, 0))
        compare_derivatives(piece, order, piece.begin, piece.end)


class _Stretch(NamedTuple):
    """The offsets from a time until another one (s), between which at most one reshape goes on."""

    motion: FormationMotion
    rows: Array
    begin: float
    end: float

    def __call__(self, t: jax.Array) -> jax.Array:
        """Return all offsets (K d,) at a time: as the law computes them, without its clipping."""
        begins, spans = self.motion.begins, self.motion.spans
        after = (self.begin >= begins + spans).astype(float)
        under_way = (self.begin >= begins) & (after == 0.0)
        places = self.rows[:, 0] + np.tensordot(np.diff(self.rows, axis=1), after, (1, 0))
        places = jnp.asarray(places)
        for k in np.flatnonzero(under_way).tolist():
            way = self.rows[:, k + 1] - self.rows[:, k]
            places = places + blend((t - begins[k]) / spans[k]) * way
        for change in self.motion.motions:
            places = jnp.stack([change(place, t) for place in places])
        return places.ravel()


def _pieces(motion: FormationMotion, rows: Array, horizon: float) -> Iterator[_Stretch]:
    """Yield the pieces of a motion between the ends of its reshapes, until a horizon (s)."""
    ends = {*motion.begins.tolist(), *(motion.begins + motion.spans).tolist()}
    times = [0.0, *sorted(end for end in ends if 0.0 < end < horizon), horizon]
    for begin, end in zip(times, times[1:], strict=False):
        yield _Stretch(motion, rows, begin, end)
