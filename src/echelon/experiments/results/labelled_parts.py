"""Labelled arrays of the parts of a run, which are known before it starts."""

import json

import numpy as np

from echelon.agents.models.model import ControlAffine
from echelon.core.types import JsonObject
from echelon.experiments.results.labelled import Labelled, Variables
from echelon.experiments.results.recording import FORMAT
from echelon.guarantees.promises.hypotheses import as_mapping
from echelon.simulation.engine.parts import Parts
from echelon.simulation.step.settings import Settings


def labelled_parts(parts: Parts, settings: Settings) -> Labelled:
    """Return the arrays of `dataset` that do not depend on how a run went.

    Args:
        parts: of the run, with its drive completed.
        settings: of the run.
    """
    model, graph = parts.model, parts.graph
    agents = np.arange(graph.agents)
    variables: Variables = {
        "offset": (("agent", "state"), parts.formation.offsets),
        "is_leader": ("agent", np.isin(agents, graph.leaders).astype(np.int8)),
        "nearest_leader": ("agent", np.array(graph.nearest_leader())),
        **_edges(parts),
        **_gain(parts),
        **_ellipsoid(parts),
        **_limits(model, settings),
    }
    coordinates = {
        "agent": agents,
        "state": list(model.state_names),
        "state_unit": ("state", list(model.state_units)),
        "input": list(model.input_names),
        "input_unit": ("input", list(model.input_units)),
        "output": list(model.output_names),
        "output_unit": ("output", _output_units(model)),
    }
    return Labelled(variables, coordinates, _attributes(parts, settings))


def _attributes(parts: Parts, settings: Settings) -> JsonObject:
    """Return parts and settings as attributes that netCDF can hold."""
    numbers = {**settings._asdict(), "steady_window": settings.window}
    world = parts.world.describe(parts.model)
    model = parts.model
    radius = model.radius if model.position else None
    return {
        **({} if radius is None else {"radius": float(radius)}),
        **{key: text for key, text in world.items() if text is not None},
        **{key: int(v) if isinstance(v, bool) else v for key, v in numbers.items()},
        "settings": json.dumps(settings._asdict(), default=lambda number: number.item()),
        **{
            f"{role}_needs": "; ".join(received) or "nothing"
            for role, received in parts.information._asdict().items()
        },
        "model": type(parts.model).__name__,
        "position": " ".join(parts.model.position),
        "directed": int(parts.graph.directed),
        "format": FORMAT,
        **({"events": json.dumps([*map(as_mapping, parts.events)])} if parts.events else {}),
    }


def _edges(parts: Parts) -> Variables:
    """Return the edges of the graph, who receives along them, and their weights over time."""
    graph, schedule = parts.graph, parts.graph.schedule
    variables: Variables = {
        "edge_agents": (("edge", "end"), graph.edges),
        "edge_weight": ("edge", graph.weights),
        "edge_heard": (("edge", "end"), parts.receives.astype(np.int8)),
    }
    if schedule is not None:
        variables["stretch_start"] = ("stretch", schedule.starts, {"units": "s"})
        variables["edge_weight_then"] = (("stretch", "edge"), schedule.weights)
        period = np.inf if schedule.period is None else schedule.period
        variables["graph_period"] = ((), period, {"units": "s"})
    if schedule is not None and schedule.present is not None:
        over = ("stretch", "agent")
        variables["present_then"] = (over, schedule.present.astype(np.int8))
        variables["nearest_leader_then"] = (over, schedule.nearest)
    return variables


def _output_units(model: ControlAffine) -> list[str]:
    """Return the units of the outputs, known for those that are states."""
    units = dict(zip(model.state_names, model.state_units, strict=True))
    return [units.get(name, "") for name in model.output_names]


def _gain(parts: Parts) -> Variables:
    """Return the gain; nothing without one."""
    gain = parts.drive.gain
    if gain is None:
        return {}
    return {
        # A variable cannot have the same dimension twice, so columns have another one.
        "P": (("state", "state_column"), gain.P),
        "R": (("input", "input_column"), gain.R),
        "coupling": ((), gain.coupling),
    }


def _ellipsoid(parts: Parts) -> Variables:
    """Return the ellipsoid about agents that keep apart; nothing where they do not."""
    safety, meters = parts.drive.safety, {"units": "m"}
    # What is not prepared may have no size yet.
    if safety is None or not (safety.radii or safety.of_model):
        return {}
    return {
        "ellipsoid_radius": ((), safety.size[0], meters),
        "ellipsoid_height": ((), safety.size[2], meters),
        "kept_distance": ((), safety.distance, meters),
    }


def _limits(model: ControlAffine, settings: Settings) -> Variables:
    """Return the limits of the inputs; nothing without limits."""
    limits = model.input_limits if settings.limits else None
    if limits is None:
        return {}
    matrix, low, high = (np.asarray(part, np.float64) for part in limits)
    rows = {"limit_low": ("limit", low), "limit_high": ("limit", high)}
    return {"limit_matrix": (("limit", "input"), matrix), **rows}
