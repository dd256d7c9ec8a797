"""A run as labelled arrays with units and provenance, as `run.nc` has them."""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING
from weakref import WeakKeyDictionary

import numpy as np

from echelon.agents.models.unlike import UnlikeAgents, title_of
from echelon.core.errors import check_kind
from echelon.core.files import write_atomic
from echelon.core.types import JsonObject, PathLike
from echelon.experiments.results.labelled import Labelled, Variables
from echelon.experiments.results.lyapunov import lyapunov
from echelon.experiments.results.metrics import avoidance, output_errors
from echelon.guarantees.promises.hypotheses import as_mapping
from echelon.guarantees.promises.promise import guarantee
from echelon.simulation.engine.parts import Parts
from echelon.simulation.engine.result import Result
from echelon.simulation.step.settings import Settings

if TYPE_CHECKING:
    import xarray as xr

FORMAT = 5
"""Version of the format of `run.nc`; files of others are refused."""
SUM = "sum_"
"""So begin the names of the sums over all steps, from which `load` computes the metrics."""
STORED: "WeakKeyDictionary[Result, Labelled]" = WeakKeyDictionary()
"""The labelled arrays of runs from disk."""
_SECONDS, _METERS = {"units": "s"}, {"units": "m"}
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
"""The groups of `run.nc` with the dimensions of their variables.

The dimensions of one variable contain those of all others in its group. So no program that reads a
whole group multiplies dimensions that no variable has together.
"""


def dataset(result: Result) -> "xr.Dataset":
    """Return a run as a dataset with dimensions time, agent, state, input, edge.

    Variables: `states`, `inputs`, `error` (deviation from the goal relative to the leader),
    `offset` (and `moving_offset` over time where it changes), `nearest_leader`, `reference`,
    `tracking_error` (the leaders' outputs minus their references'), `lyapunov`, `lyapunov_rate`,
    `lyapunov_drift`, `saturated`, `edge_agents`,
    `edge_weight`, `edge_heard` (whether each end of an edge receives from the other), of a
    switching graph `edge_weight_then` from each `stretch_start` on with its `graph_period`
    (infinite without repetition), where agents are lost or join `presence` (1 where an agent is
    there) and from each `stretch_start` on `present_then` and `nearest_leader_then`, of agents that
    keep apart `scaled_distance` and `active_rows` in slices of the run from `slice_start` on, with
    the radii of their ellipsoids and `kept_distance`, the gain's `P`, `R` and `coupling`, the poles
    of the checked
    modes (`pole_real`, `pole_imaginary`, by `mode_eigenvalue`, for directed graphs with the
    imaginary part `mode_eigenvalue_imaginary`), and the limits of the inputs u, `limit_low` <=
    `limit_matrix` u <= `limit_high`. Over a network that is late also `age` (of the oldest message
    that an agent has of a neighbour, NaN before the first), `edge_age` (of the newest one at each
    end of an edge), `edge_lost` (messages lost since the frame before) and `forget`. The attribute
    `guarantee` is JSON, and `format` the version of this list.
    """
    return labelled(result).dataset()


def save_dataset(run: "Result | xr.Dataset", path: PathLike) -> None:
    """Write the dataset of a run as netCDF, atomically, in the groups of `run.nc`.

    Raises:
        OSError: it cannot be written.
    """
    # In memory first: on a full disk the netCDF library ends the whole process.
    if isinstance(run, Result):
        write_atomic(Path(path), run_file(run))
    else:
        write_atomic(Path(path), bytes(run.to_netcdf(None, engine="h5netcdf")))


def run_file(result: Result, data: Labelled | None = None) -> bytes:
    """Return `run.nc`: the dataset in groups, and the sums over all steps; a flight has none."""
    data = labelled(result) if data is None else data
    return (data if "flight" in data.attributes else with_sums(result, data)).netcdf(group_of)


def group_of(name: str, dimensions: tuple[str, ...]) -> str:
    """Return the group of a variable: the first that has its dimensions, else one of its own."""
    if name.startswith(SUM):
        return f"sums/{name.removeprefix(SUM)}"
    groups = (group for group, whole in _GROUPS.items() if whole.issuperset(dimensions))
    return next(groups, name)


def with_sums(result: Result, data: Labelled | None = None) -> Labelled:
    """Return the labelled arrays of `run.nc`, with the sums over all steps."""
    data = labelled(result) if data is None else data
    sums = {SUM + name: np.asarray(total) for name, total in result.sums._asdict().items()}
    # Each with dimensions of its own.
    own = {
        name: (tuple(f"{name}_{axis}" for axis in range(total.ndim)), total)
        for name, total in sums.items()
    }
    return data._replace(variables=data.variables | own)


def labelled(result: Result) -> Labelled:
    """Return the labelled arrays of `dataset`: as they are stored, of a run from disk."""
    check_kind("result", result, Result)
    stored = STORED.get(result)
    return _labelled(result) if stored is None else stored


def _labelled(result: Result) -> Labelled:
    fixed, per_agent = labelled_parts(result.parts, result.settings), ("time", "agent", "state")
    variables: Variables = {
        "states": (per_agent, result.states),
        "error": (per_agent, result.errors),
        "inputs": (("time", "agent", "input"), result.inputs),
        "saturated": ("agent", result.saturated),
        **fixed.variables,
    }
    if result.presence is not None:
        variables["presence"] = (("time", "agent"), result.presence.astype(np.int8))
    variables |= _followed(result)
    if result.formation.motion is not None:
        variables["moving_offset"] = (per_agent, result.offsets_in())
    variables |= _poles(result)
    for part in result.world.all_parts:
        variables |= part.variables(result)
    kept = avoidance(result)
    if kept is not None:
        variables["slice_start"] = ("slice", kept.times, _SECONDS)
        variables["scaled_distance"] = ("slice", kept.distance, _METERS)
        variables["active_rows"] = ("slice", kept.active)
    v = lyapunov(result)
    if v is not None:
        variables |= {"lyapunov": ("time", v.value), "lyapunov_rate": ("time", v.rate)}
        variables["lyapunov_drift"] = ("time", v.drift)
    coordinates = {"time": ("time", result.times, _SECONDS), **fixed.coordinates}
    return Labelled(variables, coordinates, {**_attributes(result), **fixed.attributes})


def _followed(result: Result) -> Variables:
    if result.reference is None:
        return {}
    variables: Variables = {"reference": (("time", "state"), result.reference)}
    errors = [output_errors(result, leader) for leader in result.graph.leaders]
    errors = [error for error in errors if error is not None]
    if errors:
        variables["tracking_error"] = (("time", "leader", "output"), np.stack(errors, axis=1))
    return variables


def _poles(result: Result) -> Variables:
    """The law `stopping-point` closes chains by its roots; the loop is their agreement alone."""
    stated = guarantee(result.parts, result.settings)
    if not stated.linear or stated.agreement is not None:
        return {}
    poles, values = stated.loop.poles, stated.loop.eigenvalues
    imaginary = {"mode_eigenvalue_imaginary": ("mode", np.imag(values))}
    return {
        "pole_real": (("mode", "pole"), np.real(poles)),
        "pole_imaginary": (("mode", "pole"), np.imag(poles)),
        "mode_eigenvalue": ("mode", np.real(values)),
        **(imaginary if np.iscomplexobj(values) else {}),
    }


def _attributes(result: Result) -> JsonObject:
    solver = {} if result.work is None else {"solver": json.dumps(result.work._asdict())}
    return {
        **result.provenance,
        "provenance": " ".join(result.provenance),
        "computed_by": result.engine,
        "inputs": digest_of(result.files),
        "outcome": result.outcome.name.lower(),
        "message": result.message,
        "warnings": "\n".join(result.warnings),
        "guarantee": json.dumps(guarantee(result.parts, result.settings).as_mapping()),
        **solver,
    }


def digest_of(files: Mapping[str, bytes]) -> str:
    """Return a digest of the files that a scenario names; empty of none."""
    digests = (f"{name}:{hashlib.sha256(files[name]).hexdigest()}" for name in sorted(files))
    return " ".join(digests)


def labelled_parts(parts: Parts, settings: Settings) -> Labelled:
    """Return the arrays of `dataset` that do not depend on how a run went."""
    model, graph = parts.model, parts.graph
    agents, units = np.arange(graph.agents), dict(zip(model.state_names, model.state_units))
    variables: Variables = {
        "offset": (("agent", "state"), parts.formation.offsets),
        "is_leader": ("agent", np.isin(agents, graph.leaders).astype(np.int8)),
        "nearest_leader": ("agent", np.array(graph.nearest_leader())),
        **_edges(parts),
    }
    gain, safety = parts.drive.gain, parts.drive.safety
    if gain is not None:
        # A variable cannot have the same dimension twice, so columns have another one.
        variables["P"] = (("state", "state_column"), gain.P)
        variables["R"] = (("input", "input_column"), gain.R)
        variables["coupling"] = ((), gain.coupling)
    # What is not prepared may have no size yet.
    if safety is not None and (safety.radii or safety.of_model):
        variables["ellipsoid_radius"] = ((), safety.size[0], _METERS)
        variables["ellipsoid_height"] = ((), safety.size[2], _METERS)
        variables["kept_distance"] = ((), safety.distance, _METERS)
    if settings.limits and model.input_limits is not None:
        matrix, low, high = (np.asarray(part, np.float64) for part in model.input_limits)
        variables["limit_matrix"] = (("limit", "input"), matrix)
        variables |= {"limit_low": ("limit", low), "limit_high": ("limit", high)}
    coordinates = {
        "agent": agents,
        "state": list(model.state_names),
        "state_unit": ("state", list(model.state_units)),
        "input": list(model.input_names),
        "input_unit": ("input", list(model.input_units)),
        "output": list(model.output_names),
        # Known of outputs that are states.
        "output_unit": ("output", [units.get(name, "") for name in model.output_names]),
    }
    return Labelled(variables, coordinates, _attributes_of_parts(parts, settings))


def _attributes_of_parts(parts: Parts, settings: Settings) -> JsonObject:
    numbers, model = {**settings._asdict(), "steady_window": settings.window}, parts.model
    radius = model.radius if model.position else None
    return {
        **({} if radius is None else {"radius": float(radius)}),
        **{key: text for key, text in parts.world.describe(model).items() if text is not None},
        **{key: int(v) if isinstance(v, bool) else v for key, v in numbers.items()},
        "settings": json.dumps(settings._asdict(), default=lambda number: number.item()),
        **{
            f"{role}_needs": "; ".join(received) or "nothing"
            for role, received in parts.information._asdict().items()
        },
        "model": title_of(model),
        **({"groups": "; ".join(model.names)} if isinstance(model, UnlikeAgents) else {}),
        "position": " ".join(model.position),
        "directed": int(parts.graph.directed),
        "format": FORMAT,
        **({"events": json.dumps([*map(as_mapping, parts.events)])} if parts.events else {}),
    }


def _edges(parts: Parts) -> Variables:
    graph, schedule = parts.graph, parts.graph.schedule
    variables: Variables = {
        "edge_agents": (("edge", "end"), graph.edges),
        "edge_weight": ("edge", graph.weights),
        "edge_heard": (("edge", "end"), parts.receives.astype(np.int8)),
    }
    if schedule is not None:
        variables["stretch_start"] = ("stretch", schedule.starts, _SECONDS)
        variables["edge_weight_then"] = (("stretch", "edge"), schedule.weights)
        period = np.inf if schedule.period is None else schedule.period
        variables["graph_period"] = ((), period, _SECONDS)
    if schedule is not None and schedule.present is not None:
        over = ("stretch", "agent")
        variables["present_then"] = (over, schedule.present.astype(np.int8))
        variables["nearest_leader_then"] = (over, schedule.nearest)
    return variables
