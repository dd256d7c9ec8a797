"""Who receives from whom, and where each belongs: graphs and formations."""

from echelon.network.formation import Formation
from echelon.network.graph import Graph
from echelon.network.spectrum import Spectrum
from echelon.network.topology import recommend_edges, recommend_leaders

__all__ = ["Formation", "Graph", "Spectrum", "recommend_edges", "recommend_leaders"]
