"""The dataset of a run with units and provenance (netCDF), and its summary (JSON)."""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from echelon.agents.models.model import ControlAffine
from echelon.core.files import write_atomic
from echelon.core.types import JsonObject
from echelon.experiments.results.foreseen import heard_in
from echelon.experiments.results.labelled import Labelled, Variables
from echelon.experiments.results.lyapunov import lyapunov
from echelon.experiments.results.metrics import (
    EdgeMetrics,
    Metrics,
    metrics,
    output_errors,
    representatives,
    steady_error,
)
from echelon.experiments.results.recording import FORMAT, Recording, recording
from echelon.guarantees.promises.promise import promise
from echelon.simulation.engine.parts import Parts
from echelon.simulation.engine.result import Result
from echelon.simulation.step.settings import Settings

if TYPE_CHECKING:
    import xarray as xr

_LISTED = 5_000
"""Most rows of a list in the summary; the dataset contains the numbers of all agents."""
_Row = TypeVar("_Row")


def dataset(result: Result) -> "xr.Dataset":
    """Return a run as a dataset with dimensions time, agent, state, input, edge.

    Variables: `states`, `inputs`, `error` (deviation from the goal relative to the leader),
    `offset`, `nearest_leader`, `reference`, `tracking_error` (the leaders' outputs minus their
    references'), `lyapunov`, `lyapunov_rate`, `lyapunov_drift`, `saturated`, `edge_agents`,
    `edge_weight`, `edge_heard` (whether each end of an edge receives from the other), of a
    switching graph `edge_weight_then` from each `stretch_start` on with its `graph_period`
    (infinite without repetition), the gain's `P`, `R` and `coupling`, the poles of the checked
    modes (`pole_real`, `pole_imaginary`, by `mode_eigenvalue`, for directed graphs with the
    imaginary part `mode_eigenvalue_imaginary`), and the limits of the inputs u, `limit_low` <=
    `limit_matrix` u <= `limit_high`. The attribute `promise` is JSON, and `format` the version of
    this list.
    """
    return labelled(result).dataset()


def labelled(result: Result) -> Labelled:
    """Return the labelled arrays of `dataset`."""
    model, per_agent = result.model, ("time", "agent", "state")
    variables: Variables = {
        "states": (per_agent, result.states),
        "error": (per_agent, result.errors),
        "inputs": (("time", "agent", "input"), result.inputs),
        "offset": (("agent", "state"), result.formation.offsets),
        "saturated": ("agent", result.saturated),
        "is_leader": (
            "agent",
            np.isin(np.arange(result.graph.agents), result.graph.leaders).astype(np.int8),
        ),
        "nearest_leader": ("agent", np.array(result.graph.nearest_leader())),
        **_edges(result),
    }
    v = lyapunov(result)
    if v is not None:
        variables |= {"lyapunov": ("time", v.value), "lyapunov_rate": ("time", v.rate)}
        variables["lyapunov_drift"] = ("time", v.drift)
    variables |= {**_followed(result), **_gain(result), **_limits(result), **_poles(result)}
    coordinates = {
        "time": ("time", result.times, {"units": "s"}),
        "agent": np.arange(result.graph.agents),
        "state": list(model.state_names),
        "state_unit": ("state", list(model.state_units)),
        "input": list(model.input_names),
        "input_unit": ("input", list(model.input_units)),
        "output": list(model.output_names),
        "output_unit": ("output", _output_units(model)),
    }
    return Labelled(variables, coordinates, _attributes(result))


def recording_of(result: Result) -> Recording:
    """Return a run as figures draw it."""
    data = labelled(result)
    return recording(data.arrays(), data.attributes)


def _edges(result: Result) -> Variables:
    """Return the edges of the graph, who receives along them, and their weights over time."""
    graph, schedule = result.graph, result.graph.schedule
    variables: Variables = {
        "edge_agents": (("edge", "end"), graph.edges),
        "edge_weight": ("edge", graph.weights),
        "edge_heard": (("edge", "end"), heard_in(result.parts).astype(np.int8)),
    }
    if schedule is not None:
        variables["stretch_start"] = ("stretch", schedule.starts, {"units": "s"})
        variables["edge_weight_then"] = (("stretch", "edge"), schedule.weights)
        period = np.inf if schedule.period is None else schedule.period
        variables["graph_period"] = ((), period, {"units": "s"})
    return variables


def _output_units(model: ControlAffine) -> list[str]:
    """Return the units of the outputs, known for those that are states."""
    units = dict(zip(model.state_names, model.state_units, strict=True))
    return [units.get(name, "") for name in model.output_names]


def _followed(result: Result) -> Variables:
    """Return the reference and the leaders' tracking errors; nothing without a reference."""
    if result.reference is None:
        return {}
    variables: Variables = {"reference": (("time", "state"), result.reference)}
    errors = [output_errors(result, leader) for leader in result.graph.leaders]
    errors = [error for error in errors if error is not None]
    if errors:
        variables["tracking_error"] = (("time", "leader", "output"), np.stack(errors, axis=1))
    return variables


def _gain(result: Result) -> Variables:
    """Return the gain; nothing without one."""
    gain = result.drive.gain
    if gain is None:
        return {}
    return {
        # A variable cannot have the same dimension twice, so columns have another one.
        "P": (("state", "state_column"), gain.P),
        "R": (("input", "input_column"), gain.R),
        "coupling": ((), gain.coupling),
    }


def _limits(result: Result) -> Variables:
    """Return the limits of the inputs; nothing without limits."""
    limits = result.model.input_limits if result.settings.limits else None
    if limits is None:
        return {}
    matrix, low, high = (np.asarray(part, np.float64) for part in limits)
    rows = {"limit_low": ("limit", low), "limit_high": ("limit", high)}
    return {"limit_matrix": (("limit", "input"), matrix), **rows}


def _poles(result: Result) -> Variables:
    """Return the poles of the linearized loop; nothing where laws have none."""
    guarantee = promise(result.parts, result.settings)
    if not guarantee.linear:
        return {}
    poles, values = guarantee.loop.poles, guarantee.loop.eigenvalues
    imaginary = {"mode_eigenvalue_imaginary": ("mode", np.imag(values))}
    imaginary = imaginary if np.iscomplexobj(values) else {}
    return {
        "pole_real": (("mode", "pole"), np.real(poles)),
        "pole_imaginary": (("mode", "pole"), np.imag(poles)),
        "mode_eigenvalue": ("mode", np.real(values)),
        **imaginary,
    }


def _attributes(result: Result) -> JsonObject:
    """Return provenance and settings as attributes that netCDF can hold."""
    settings = {**result.settings._asdict(), "steady_window": result.settings.window}
    settings = {key: int(v) if isinstance(v, bool) else v for key, v in settings.items()}
    laws = {
        f"{role}_needs": "; ".join(sent) or "nothing"
        for role, sent in result.drive.information._asdict().items()
    }
    attributes = {
        key: text for key, text in result.world.describe(result.model).items() if text is not None
    }
    attributes |= {"outcome": result.outcome.name.lower(), "message": result.message}
    attributes |= {"warnings": "\n".join(result.warnings)}
    attributes |= {"promise": json.dumps(promise(result.parts, result.settings).as_mapping())}
    if result.work is not None:
        attributes["solver"] = json.dumps(result.work._asdict())
    return {
        **result.provenance,
        **attributes,
        **settings,
        **laws,
        "model": type(result.model).__name__,
        "position": " ".join(result.model.position),
        "directed": int(result.graph.directed),
        "format": FORMAT,
    }


def save_dataset(run: "Result | Labelled | xr.Dataset", path: Path) -> None:
    """Write the dataset of a run as netCDF, atomically.

    Raises:
        OSError: it cannot be written.
    """
    # In memory first: on a full disk the netCDF library ends the whole process.
    data = labelled(run) if isinstance(run, Result) else run
    if isinstance(data, Labelled):
        write_atomic(path, data.netcdf())
    else:
        write_atomic(path, bytes(data.to_netcdf(None, engine="h5netcdf")))


def statement(parts: Parts, settings: Settings, name: str) -> JsonObject:
    """Return the entries of a summary that follow from the parts of a run, without running it."""
    gain, spectrum = parts.drive.gain, parts.graph.spectrum()
    return {
        "scenario": name,
        "agents": parts.graph.agents,
        "unit": "m" if parts.model.position else "state",
        "horizon_s": settings.horizon,
        "dt_s": settings.dt,
        "seed": settings.seed,
        **parts.world.describe(parts.model),
        "gain": None
        if gain is None
        else {
            "method": gain.method,
            "coupling": gain.coupling,
            "P": gain.P.tolist(),
            "R": gain.R.tolist(),
        },
        "promise": promise(parts, settings).as_mapping(),
        "lambda_min": spectrum.low,
        "lambda_max": spectrum.high,
    }


OBSERVED = ("outcome", "leader", "leaders", "followers", "edges", "minimum_distance")
OBSERVED += ("saturation_fraction", "alternations", "steady_window_s", "warnings", "engine")
OBSERVED += ("wall_time_s", "versions")
"""The other entries of a summary, which only the run itself gives."""


def summary(result: Result, numbers: Metrics | None = None) -> JsonObject:
    """Return the run's summary as JSON data; numbers that do not exist are None."""
    numbers = metrics(result) if numbers is None else numbers
    name = result.provenance.get("scenario", "")
    return {
        **statement(result.parts, result.settings, name),
        "outcome": {"name": result.outcome.name.lower(), "message": result.message},
        "leader": numbers.leader._asdict(),
        "leaders": [each._asdict() for each in numbers.leaders],
        "followers": [
            _follower(each._asdict()) for each in _listed(numbers.followers, steady_error)
        ],
        "edges": [
            {"edge": list(each.edge), "distance_rmse": each.distance_rmse}
            for each in _listed(numbers.edges, _distance_error)
        ],
        "minimum_distance": numbers.minimum_distance,
        "saturation_fraction": numbers.saturation_fraction,
        "alternations": int(result.chatter.max()),
        "steady_window_s": numbers.steady_window,
        "warnings": list(result.warnings),
        "engine": result.engine,
        "wall_time_s": result.wall_time,
        "versions": {
            key[8:]: text for key, text in result.provenance.items() if key.startswith("version_")
        },
    }


def _listed(rows: Sequence[_Row], error: Callable[[_Row], float]) -> Sequence[_Row]:
    """Return all rows; if they are too many for JSON tools, the best, the median and the worst."""
    return rows if len(rows) <= _LISTED else representatives(rows, error)


def _distance_error(edge: EdgeMetrics) -> float:
    return np.inf if edge.distance_rmse is None else edge.distance_rmse


def _follower(entry: JsonObject) -> JsonObject:
    return {
        "settling_time_s" if key == "settling_time" else key: value for key, value in entry.items()
    }
