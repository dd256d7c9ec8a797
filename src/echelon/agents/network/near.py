"""What an agent knows of others that may come near it, whatever the graph."""

from typing import NamedTuple

import jax
from jaxtyping import Bool, Float


class Near(NamedTuple):
    """K others as one agent knows them: of each the r points in whose hull its position stays.

    Attributes:
        gaps: own points less theirs, in d coordinates, m.
        leads: which of them lead, and do not give way.
        known: which of them are known; the gaps of the others mean nothing.
    """

    gaps: Float[jax.Array, "K r d"]
    leads: Bool[jax.Array, " K"]
    known: Bool[jax.Array, " K"]
