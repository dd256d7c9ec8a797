"""What decides a run: a key of its bits, and copies that no caller can write to."""

from collections.abc import Hashable
from typing import TypeVar

import equinox as eqx
import jax
import numpy as np

from echelon.agents.network.formation import Formation
from echelon.core.identity import digest
from echelon.simulation.engine.law_drive import Laws
from echelon.simulation.engine.parts import Parts
from echelon.simulation.step.settings import Settings

_T = TypeVar("_T")


def content_of(parts: Parts, settings: Settings, wrt: tuple[str, ...]) -> Hashable | None:
    """Return a key that is equal for runs that differ in the followers' gain alone.

    By its bits: what somebody changes in place is another run. None where the same content may be
    another run, since nobody can tell what a user's classes read.
    """
    if not isinstance(parts, Parts):
        return None
    shape = parts.formation.offsets, parts.formation.motion
    acting = digest((_acting(parts), settings, shape))
    # A graph never changes, so that it is known by who it is.
    return None if acting is None else (acting, parts.graph, wrt)


def _acting(parts: Parts) -> tuple[object, ...]:
    """Return the parts that have code, without the followers' gain."""
    drive = parts.drive
    if isinstance(drive, Laws) and drive.gain is not None:
        law = eqx.tree_at(lambda law: law.gain, drive.follower, None)
        drive = drive.with_follower(law)
    return parts.model, drive, parts.initial, parts.start_error, parts.world


def copied(tree: _T) -> _T:
    """Return a copy of a tree and its arrays, since the caller may write to the original."""

    def alone(leaf: object) -> object:
        # A formation is a leaf to JAX, although it contains an array.
        if isinstance(leaf, Formation):
            return Formation(leaf.offsets, leaf.motion)
        return leaf.copy() if isinstance(leaf, np.ndarray) else leaf

    return jax.tree.map(alone, tree)
