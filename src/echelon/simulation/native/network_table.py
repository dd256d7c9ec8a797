"""What a network decides some steps ahead of a kernel, as it depends on no state of agents."""

import abc
from collections.abc import Sequence
from typing import final

import jax
import numpy as np

from echelon.core.types import Array, PyTree
from echelon.simulation.step.loop import Loop


class NetworkTable(abc.ABC):
    """What a network decides of F formations.

    Attributes:
        changing: arrays that a step of the kernel changes.
    """

    changing: tuple[Array, ...] = ()

    @abc.abstractmethod
    def clear(self) -> None:
        """Begin before the first message."""

    @abc.abstractmethod
    def forget(self, loops: Sequence[Loop]) -> None:
        """Continue with loops that may have other numbers."""

    @abc.abstractmethod
    def left(self, step: int) -> int:
        """Return for how many steps from one on the kernel can run with the same rows."""

    @abc.abstractmethod
    def rows(self, step: int) -> dict[str, Array]:
        """Return what a step needs in rows of all agents (F N, k), by names of `BlockRows`."""

    @abc.abstractmethod
    def arguments(self, step: int) -> tuple[dict[str, Array], dict[str, int]]:
        """Return arrays by groups of formations from a step on, and other arguments of a kernel."""

    @abc.abstractmethod
    def load(self, step: int, memory: PyTree) -> Array:
        """Take the memory of the network at a step; return the rows of packets (F N, p)."""

    @abc.abstractmethod
    def memory(self, step: int, packets: Array) -> PyTree:
        """Return the memory of the network at a step, with the rows of packets (F N, p)."""


@final
class EmptyTable(NetworkTable):
    """Nothing: all is received in the same step, and leaders stay."""

    def clear(self) -> None:
        """Begin anew."""

    def forget(self, loops: Sequence[Loop]) -> None:
        """Continue."""

    def left(self, step: int) -> int:
        """Return the most steps."""
        return np.iinfo(np.int64).max

    def rows(self, step: int) -> dict[str, Array]:
        """Return no rows."""
        return {}

    def arguments(self, step: int) -> tuple[dict[str, Array], dict[str, int]]:
        """Return none."""
        return {}, {}

    def load(self, step: int, memory: PyTree) -> Array:
        """Return no rows."""
        return np.zeros((0, 0))

    def memory(self, step: int, packets: Array) -> PyTree:
        """Return nothing."""
        return ()


def stacked(trees: Sequence[PyTree]) -> tuple[PyTree, PyTree]:
    """Return a tree in which leaves that differ, such as keys, have an axis of formations.

    And the axes of its leaves for `jax.vmap`.
    """
    flat, tree = [jax.tree.leaves(each) for each in trees], jax.tree.structure(trees[0])
    differs = [len({np.asarray(x).tobytes() for x in leaves}) > 1 for leaves in zip(*flat)]
    joined = [
        np.stack([np.asarray(x) for x in leaves]) if own else leaves[0]
        for own, leaves in zip(differs, zip(*flat, strict=True), strict=True)
    ]
    return tree.unflatten(joined), tree.unflatten([0 if own else None for own in differs])
