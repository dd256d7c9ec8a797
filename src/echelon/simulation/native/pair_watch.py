"""The closest two agents over all steps, of positions that a kernel records."""

from typing import final

import numpy as np
from jaxtyping import Float

from echelon.core.types import Array
from echelon.simulation.codegen import aligned
from echelon.simulation.native.blocks import FormationBlocks, Places

_SPAN, _NUMBERS, _TIE = 32, 4_000_000, 1e-9
"""Steps compared at once, recorded numbers, and the relative difference that is not resolved."""
_FEW = 10_000
"""Distances that are computed in less time than it takes to find which are needed."""


@final
class PairWatch:
    """Finds the closest two agents of formations, some steps at a time.

    Args:
        places: of the agents.
        axes: of the positions that a kernel records; 0 if it records none.
        formations: how many follow each other.
        dtype: of the numbers.
        steps: of a call, at most.
        rows: of a block.
    """

    def __init__(
        self, places: Places, axes: int, formations: int, dtype: np.dtype, steps: int, rows: int
    ) -> None:
        watched = axes
        axes = 0 if places.batched else axes
        numbers = places.blocks * axes * places.lanes
        self.steps = max(1, min(steps, _NUMBERS // max(1, numbers)))
        self.tape = aligned((self.steps, places.blocks, axes, places.lanes), dtype)
        self.position, self.formations = places.position, formations
        agents = len(places.position) // formations if watched else 0
        # Where vectors hold many formations, the kernel compares the few pairs of each.
        self.kernel = places.batched and watched > 0
        self.block = (places.swarm if isinstance(places, FormationBlocks) else places).position
        self.shape, self.far = (places.groups, 2, places.lanes), rows * places.lanes
        self._pair(np.ones(agents, bool))
        self.count = formations if self.tape.size or self.least.size else 0
        self.clear()

    def _pair(self, here: Array) -> None:
        i, j = np.triu_indices(len(here), 1)
        self.here, self.pairs = here, (i[here[i] & here[j]], j[here[i] & here[j]])
        groups, *rest = self.shape
        self.least = aligned((groups, len(self.pairs[0]) * self.kernel, *rest), self.tape.dtype)
        ends = np.stack([self.block[end] for end in self.pairs], axis=1) * self.far
        self.ends = np.ascontiguousarray(ends, np.int32)

    def among(self, here: Array) -> None:
        """Compare from now on the agents that are there (N,) alone."""
        if self.count and not np.array_equal(here, self.here):
            self._find()
            self._pair(here)
            self._forget()

    def _forget(self) -> None:
        self.least[:, :, 0], self.least[:, :, 1] = np.inf, 0.0
        self.used, self.first = 0, 0

    def clear(self) -> None:
        """Forget all steps."""
        count = self.count
        self._forget()
        self.closest, self.met = np.full(count, np.inf), np.zeros((count, 3))

    def room(self, step: int, steps: int) -> Array:
        """Return memory in which some steps from one on are recorded; empty where none are."""
        if not self.tape.size:
            return self.tape[0]
        if self.used + steps > self.steps:
            self._find()
            self.used = 0
        self.first = step if not self.used else self.first
        self.used += steps
        return self.tape[self.used - steps]

    def undo(self) -> None:
        """Forget the last step, which is not taken."""
        self.used = max(0, self.used - 1)

    def terms(self) -> dict[str, Array]:
        """Return the terms `closest` and `met` of the sums."""
        self._find()
        return {"closest": self.closest.copy(), "met": self.met.copy()}

    def _find(self) -> None:
        if self.least.size:
            self._compare()
        if len(self.pairs[0]):
            self._search()

    def _compare(self) -> None:
        """Find the closest pairs of those that the kernel kept."""
        squares, steps = self.least.transpose(2, 0, 3, 1).reshape(2, -1, len(self.pairs[0]))
        squares, steps = squares[: self.formations], steps[: self.formations]
        order = np.where(squares == squares.min(axis=1, keepdims=True), steps, np.inf)
        formations, pair = np.arange(self.formations), order.argmin(axis=1)
        step = steps[formations, pair].astype(int) - self.first
        self._keep(formations, squares[formations, pair], step, pair)

    def _places(self) -> Float[np.ndarray, "d S K F N"]:
        """Return the recorded positions in K spans of S steps; the last step fills its span."""
        rows = np.minimum(np.arange(-(-self.used // _SPAN) * _SPAN), self.used - 1)
        # Axis by axis: (T, blocks, d, lanes) -> (d, T, positions).
        by_axis = np.ascontiguousarray(self.tape[rows].transpose(2, 0, 1, 3))
        places = by_axis.reshape(len(by_axis), len(rows), -1)[..., self.position]
        agents = len(self.position) // self.formations
        spans = places.reshape(len(by_axis), -1, _SPAN, self.formations, agents)
        return spans.swapaxes(1, 2)

    @np.errstate(over="ignore", invalid="ignore")
    def _search(self) -> None:
        """Compare the recorded steps with the closest two before."""
        if not self.used:
            return
        if self.used * self.formations * len(self.pairs[0]) <= _FEW:
            self._search_all()
        else:
            self._search_spans(self._places())
        self.used = 0

    def _search_all(self) -> None:
        (i, j), count = self.pairs, self.formations
        axes = self.tape[: self.used].transpose(2, 0, 1, 3).reshape(self.tape.shape[2], -1)
        places = axes.reshape(len(axes), self.used, -1)[..., self.position]
        places = places.reshape(*places.shape[:2], count, -1)
        squares = _squares(places[..., i] - places[..., j]).swapaxes(0, 1)
        squares = squares.reshape(count, -1)
        squares[np.isnan(squares)] = np.inf
        best = squares.argmin(axis=1)
        step, pair = np.divmod(best, len(i))
        self._keep(np.arange(count), squares[np.arange(count), best], step, pair)

    def _keep(self, f: Array, squares: Array, step: Array, pair: Array) -> None:
        least = np.sqrt(squares.astype(float))
        new, (i, j) = least < self.closest[f], self.pairs
        self.closest[f[new]] = least[new]
        rows = self.first + step[new], i[pair[new]], j[pair[new]]
        self.met[f[new]] = np.stack(rows, axis=1)

    def _search_spans(self, places: Float[np.ndarray, "d S K F N"]) -> None:
        """Compare the pairs that may be closer than the closest, span by span."""
        i, j = self.pairs
        # What all agents do together changes no distance.
        moving = places - places.mean(axis=-1, keepdims=True, dtype=float)
        start = moving[:, 0]
        moved = np.sqrt(((moving - start[:, None]) ** 2).sum(axis=0).max(axis=0))
        gaps = np.sqrt(((start[..., i] - start[..., j]) ** 2).sum(axis=0))
        gaps[np.isnan(gaps)] = np.inf
        # Two agents that move by so much within a span come no closer than their gap less that.
        tie = max(_TIE, 16.0 * np.finfo(places.dtype).eps)
        bound = (1.0 - tie) * np.minimum(self.closest, gaps.min(axis=(0, 2)))
        searched = (1.0 - tie) * gaps - moved[..., i] - moved[..., j] < bound[:, None]
        nearest = gaps.swapaxes(0, 1).reshape(self.formations, -1).argmin(axis=1)
        searched[nearest // len(i), np.arange(self.formations), nearest % len(i)] = True
        self._search_some(places, *np.nonzero(searched))

    def _search_some(
        self, places: Float[np.ndarray, "d S K F N"], k: Array, f: Array, p: Array
    ) -> None:
        """Compare pairs p of formations f in spans k."""
        i, j = self.pairs
        squares = _squares(places[:, :, k, f, i[p]] - places[:, :, k, f, j[p]])
        squares[np.isnan(squares)] = np.inf
        least, step = squares.min(axis=0), _SPAN * k + squares.argmin(axis=0)
        order = np.lexsort((p, step, least, f))
        best = order[np.unique(f[order], return_index=True)[1]]
        self._keep(f[best], least[best], step[best], p[best])


def _squares(apart: Float[np.ndarray, "d ..."]) -> Array:
    """Return squared lengths, added up axis by axis in the same precision as in a kernel."""
    total = apart[0] * apart[0]
    for axis in apart[1:]:
        total = total + axis * axis
    return total
