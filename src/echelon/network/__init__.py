"""Who hears whom, and where each belongs: graphs and formations."""

from echelon.network.formation import Formation
from echelon.network.graph import Graph
from echelon.network.topology import recommend_edges, recommend_leaders

__all__ = ["Formation", "Graph", "recommend_edges", "recommend_leaders"]
