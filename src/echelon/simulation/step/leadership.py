"""Who takes the lead when nobody hears of the leader any more.

Each packet of a leader has a term. A backup leader that hears of no leader for long raises the term
by one and leads along the plan, at its own offset; everybody, an old leader too, follows the packet
of the highest term. The next ones wait longer by a timeout each, so that no agent must know who is
left.
"""

import dataclasses
import math
from collections.abc import Sequence
from typing import NamedTuple, final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from echelon.agents.network.channel import Network
from echelon.agents.network.graph import Graph
from echelon.core.errors import SimulationError, is_number
from echelon.core.types import Array

_NO_HEIR = -1
_ROUNDED = 1e-9
"""s; what differences of times leave."""


@final
@dataclasses.dataclass(frozen=True)
class Leadership:
    """Who takes the lead when nobody hears of the leader any more.

    Args:
        backups: the numbers of followers, in the order in which they take over.
        timeout: s without news of a leader after which the first of them does, the second after
            twice that, and so on.

    Raises:
        SimulationError: there is no backup leader, or the timeout is not positive and finite.
    """

    backups: Sequence[int]
    timeout: float = 0.3

    def __post_init__(self) -> None:
        object.__setattr__(self, "backups", tuple(self.backups))
        if not self.backups:
            raise SimulationError("`backups` is empty, and must name at least one follower.")
        if not (is_number(self.timeout) and 0.0 < float(self.timeout) < math.inf):
            raise SimulationError(f"`timeout` is {self.timeout}, and must be positive and finite.")

    def check_network(self, network: Network | None) -> None:
        """Check that backup leaders wait longer than messages of an undisturbed network take.

        Raises:
            SimulationError: they do not.
        """
        least = 0.0 if network is None else 2.0 / network.rate + network.delay + network.jitter
        if self.timeout < least:
            raise SimulationError(
                f"`timeout` of the leadership is {self.timeout:g} s, and must be at least two "
                f"periods of the network, its delay and its jitter together, {least:g} s."
            )


class Failover(NamedTuple):
    """The backup leaders of a run.

    Attributes:
        rank: (N,) the place of each agent among the backup leaders; -1 of no backup leader.
        first: (N,) who leads at the start.
        timeout: s.
    """

    rank: Int[np.ndarray, " N"]
    first: Bool[np.ndarray, " N"]
    timeout: Array

    @classmethod
    def of(cls, graph: Graph, leadership: Leadership | None) -> "Failover | None":
        """Return the backup leaders of a run; None without any."""
        if leadership is None:
            return None
        rank = np.full(graph.agents, _NO_HEIR, np.int32)
        rank[list(leadership.backups)] = np.arange(len(leadership.backups))
        first = np.isin(np.arange(graph.agents), graph.leaders)
        return cls(rank, first, np.asarray(float(leadership.timeout)))

    def silent(
        self,
        number: Int[jax.Array, " K"] | Array,
        leader: Int[jax.Array, " K"] | Array,
        waited: Float[jax.Array, " K"] | Array,
    ) -> Bool[jax.Array, " K"]:
        """Return which of `number` take the lead, having `waited` (s) for whom they follow."""
        rank = jnp.asarray(self.rank)[number]
        # Beyond rounding, so that all see the same step.
        late = jnp.asarray(waited) > jnp.asarray(self.timeout) * (rank + 1) + _ROUNDED
        return (rank != _NO_HEIR) & (jnp.asarray(leader) != number) & late
