"""The gradient of a cost of a run by native code."""

from collections.abc import Sequence
from functools import partial
from typing import Any, final

import equinox as eqx
import jax
import numpy as np

from echelon.core.cache import memoize
from echelon.core.compiled import cached_jit
from echelon.core.jaxpr import used_leaves
from echelon.core.types import Array
from echelon.simulation.engine.differentiable_run import (
    Cost,
    DifferentiableRun,
    Gradient,
    cost_number,
    symmetric,
)
from echelon.simulation.native.backward import Backward, SlopeNeeds
from echelon.simulation.native.varying import VaryingNumbers, bare
from echelon.simulation.scalars import Unsupported
from echelon.simulation.step.loop import Loop
from echelon.simulation.step.meter import Sums

_PARTS = {"P": ("P",), "R": ("R", "R_inverse"), "coupling": ("coupling",)}
"""The fields of a gain that change with each variable."""


@final
class Native:
    """A run that native code differentiates, for any number of costs.

    Args:
        run: the run.
        steps: its number of steps.
    """

    def __init__(self, run: DifferentiableRun, steps: int) -> None:
        """Find the numbers of the gain that have derivatives."""
        self.run, self.steps = run, steps
        names = [part for name in run.values for part in _PARTS.get(name, ())]
        self._varying, self._order = _gain_numbers(run.loop, names)
        self._shapes = tuple(np.shape(part) for part in run.loop.meter.zero_sums())
        self._passes = dict[bool, Backward | Unsupported]()

    def update(self, run: DifferentiableRun) -> bool:
        """Replace the gain; return False if the runs differ in more than its numbers."""
        if not self._varying.covers(run.loop):
            return False
        self.run = run
        for backward in self._passes.values():
            if isinstance(backward, Backward):
                backward.update(run.loop)
        return True

    @property
    def size(self) -> int:
        """Bytes stored from one cost to the next."""
        return sum(each.size for each in self._passes.values() if isinstance(each, Backward))

    def gradient(self, cost: Cost) -> Gradient:
        """Return the gradient of a cost.

        Raises:
            Unsupported: native code is unavailable for this run.
            MissingExtraError: llvmlite is not installed.
        """
        backward = self._backward(_uses_distances(cost, self._shapes))
        sums = backward.run()
        if sums is None:
            raise Unsupported("angles or whole numbers as large as these")
        value, by_sums = _cost_slopes(cost, sums)
        slopes = backward.slopes(by_sums)
        parts = dict(zip(self._order, slopes.leaves, strict=True))
        parts |= {"initial": slopes.states, "offsets": slopes.offsets}
        if "R" in parts:
            inverse = self.run.loop.follower.gain.R_inverse  # type: ignore[attr-defined]
            parts["R"] = parts["R"] - inverse.T @ parts["R_inverse"] @ inverse.T
        by_variable = {name: symmetric(name, parts[name]) for name in self.run.values}
        return Gradient(float(value), by_variable, sums, "native")

    def _backward(self, distances: bool) -> Backward:
        """Return the backward pass of costs that depend on distances, or do not."""
        if distances not in self._passes:
            run, needs = self.run, SlopeNeeds(distances, "offsets" in self.run.values)
            data = self._varying, run.states, run.reference, self.steps, needs
            try:
                self._passes[distances] = Backward(*data)
            except Unsupported as reason:
                # Stored, so that the next call does not trace the run again to fail again.
                self._passes[distances] = reason
        backward = self._passes[distances]
        if isinstance(backward, Unsupported):
            raise backward
        return backward


@memoize
def _uses_distances(cost: Cost, shapes: tuple[tuple[int, ...], ...]) -> bool:
    """Tell whether a cost depends on the distances between agents."""
    number = partial(cost_number, cost)
    return Sums(*used_leaves(number, Sums(*map(np.zeros, shapes)))).spacing


def _gain_numbers(loop: Loop, names: Sequence[str]) -> tuple[VaryingNumbers, list[str]]:
    """Return the numbers of some fields of the followers' gain, and the fields in their order."""

    def places(loop: Loop) -> list[Array]:
        law: Any = loop.follower
        return [getattr(law.gain, name) for name in names]

    if not names:
        return VaryingNumbers([loop]), []
    # Doubled, each number differs from its original, except for zeros, which then fold.
    variant = eqx.tree_at(places, loop, [2.0 * np.asarray(part) for part in places(loop)])
    marked = jax.tree.leaves(eqx.tree_at(places, bare(loop), list(names)))
    return VaryingNumbers([loop], variant), [leaf for leaf in marked if isinstance(leaf, str)]


@cached_jit
def _cost_slopes(cost: Cost, sums: Sums) -> tuple[jax.Array, Sums]:
    """Return a cost of sums, and its derivatives by those that are differentiable."""
    names = ("errors", "tracking", "outputs", "effort", "spacing")
    smooth = {name: getattr(sums, name) for name in names}
    value, slopes = jax.value_and_grad(lambda part: cost_number(cost, sums._replace(**part)))(
        smooth
    )
    return value, sums._replace(**slopes)
