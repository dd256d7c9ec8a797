"""What a run rests on: told by its bits, and apart from what a caller may write to."""

from collections.abc import Hashable
from typing import Any

import equinox as eqx
import jax
import numpy as np

from echelon.core.kept import identify
from echelon.core.store import is_ours
from echelon.engine.laws import Laws
from echelon.engine.parts import Parts
from echelon.engine.settings import Settings
from echelon.network.formation import Formation


def content_of(parts: Parts, settings: Settings, wrt: tuple[str, ...]) -> Hashable:
    """Return all that a run rests on but the followers' gain; None where that cannot be told.

    By its bits: what somebody changes in place is another run. What a user's classes and functions
    read, nobody can tell.
    """
    if not isinstance(parts, Parts):
        return None
    drive = parts.drive
    if isinstance(drive, Laws) and drive.gain is not None:
        law: Any = eqx.tree_at(lambda law: law.gain, drive.follower, None)
        parts = parts.replace(drive=drive.with_follower(law))
    acting = parts.model, parts.drive, parts.initial, parts.start_error, parts.world
    if not is_ours((acting, settings, wrt)):
        return None
    try:
        key = identify((acting, parts.graph, parts.formation.offsets, settings, wrt))
        hash(key)
    except TypeError:
        return None
    return key


def copied(tree: Any) -> Any:
    """Return a tree with arrays of its own, since somebody may write to those that were given."""

    def alone(leaf: Any) -> Any:
        if isinstance(leaf, Formation):
            return Formation(leaf.offsets)
        return leaf.copy() if isinstance(leaf, np.ndarray) else leaf

    return jax.tree.map(alone, tree)
