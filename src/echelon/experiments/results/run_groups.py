"""The groups of variables in `run.nc`.

In a group, the dimensions of one variable contain those of all others. So no program that reads a
whole group multiplies dimensions that no variable has together.
"""

SUM = "sum_"
"""So begin the names of the sums over all steps, from which `load` computes the metrics."""

_GROUPS = {
    "": {"time", "agent", "state"},
    "inputs": {"time", "agent", "input"},
    "tracking": {"time", "leader", "output"},
    "graph": {"edge", "end"},
    "links": {"time", "edge", "end"},
    "schedule": {"stretch", "edge"},
    "agents": {"stretch", "agent"},
    "gain": {"state", "state_column"},
    "input_weight": {"input", "input_column"},
    "limits": {"limit", "input"},
    "modes": {"mode", "pole"},
    "avoidance": {"slice"},
}


def group_of(name: str, dimensions: tuple[str, ...]) -> str:
    """Return the group of a variable: the first that has its dimensions, else one of its own."""
    if name.startswith(SUM):
        return f"sums/{name.removeprefix(SUM)}"
    groups = (group for group, whole in _GROUPS.items() if whole.issuperset(dimensions))
    return next(groups, name)
