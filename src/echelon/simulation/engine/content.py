"""What a run rests on: told by its bits, and apart from what a caller may write to."""

from collections.abc import Hashable
from typing import Any

import equinox as eqx
import jax
import numpy as np

from echelon.agents.network.formation import Formation
from echelon.core.disk_cache import is_ours
from echelon.core.memoize import identify
from echelon.simulation.engine.law_drive import Laws
from echelon.simulation.engine.parts import Parts
from echelon.simulation.step.settings import Settings


def content_of(parts: Parts, settings: Settings, wrt: tuple[str, ...]) -> Hashable:
    """Return all that a run rests on but the followers' gain; None where that cannot be told.

    By its bits: what somebody changes in place is another run.
    """
    if not isinstance(parts, Parts):
        return None
    try:
        key = identify((_acting(parts), parts.graph, parts.formation.offsets, settings, wrt))
        hash(key)
    except TypeError:
        return None
    return key


def lasts(parts: Parts, settings: Settings) -> bool:
    """Tell whether the same content is the same run; what a user's classes read, nobody can tell.

    It is the same for all of one content, which says the classes too.
    """
    return is_ours((_acting(parts), settings))


def _acting(parts: Parts) -> Any:
    """Return the parts that have code, without the followers' gain."""
    drive = parts.drive
    if isinstance(drive, Laws) and drive.gain is not None:
        law: Any = eqx.tree_at(lambda law: law.gain, drive.follower, None)
        drive = drive.with_follower(law)
    return parts.model, drive, parts.initial, parts.start_error, parts.world


def copied(tree: Any) -> Any:
    """Return a tree with arrays of its own, since somebody may write to those that were given."""

    def alone(leaf: Any) -> Any:
        if isinstance(leaf, Formation):
            return Formation(leaf.offsets)
        return leaf.copy() if isinstance(leaf, np.ndarray) else leaf

    return jax.tree.map(alone, tree)
