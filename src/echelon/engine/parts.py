"""What a run is made of."""

from typing import Any, NamedTuple

from echelon.laws.law import Law
from echelon.models.model import ControlAffine
from echelon.network.formation import Formation
from echelon.network.graph import Graph


class Parts(NamedTuple):
    """What a scenario is made of, ready for `simulate`; `settings` are its other arguments.

    Plant and disturbance stand there too, None where the scenario has none.
    """

    model: ControlAffine
    graph: Graph
    formation: Formation
    leader: Law
    follower: Law
    settings: dict[str, Any]
