"""The network: communication graphs and formations."""

from typing import Any

from echelon.agents.network.events import Cut, Join, Lose
from echelon.agents.network.formation import Formation
from echelon.agents.network.formation_motion import OffsetMotion, Reshape, Rotate, Scale
from echelon.agents.network.graph import Graph
from echelon.agents.network.spectrum import Spectrum
from echelon.agents.part import Event
from echelon.core.gone import no_name

__all__ = [
    "Cut",
    "Event",
    "Formation",
    "Graph",
    "Join",
    "Lose",
    "OffsetMotion",
    "Reshape",
    "Rotate",
    "Scale",
    "Spectrum",
]


def __getattr__(name: str) -> Any:
    raise no_name(f"network.{name}")
