"""The dataset of a run with units and provenance (netCDF), and its summary (JSON)."""

import hashlib
import json
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar
from weakref import WeakKeyDictionary

import numpy as np

from echelon.core.errors import check_kind
from echelon.core.files import write_atomic
from echelon.core.types import Array, JsonObject, PathLike
from echelon.experiments.results.agent_metrics import (
    EdgeMetrics,
    Metrics,
    representatives,
    steady_error,
)
from echelon.experiments.results.avoidance import avoidance
from echelon.experiments.results.event_outcomes import event_outcomes
from echelon.experiments.results.labelled import Labelled, Variables
from echelon.experiments.results.labelled_parts import labelled_parts
from echelon.experiments.results.lyapunov import lyapunov
from echelon.experiments.results.metrics import metrics, output_errors
from echelon.experiments.results.quantity import Shown
from echelon.experiments.results.recording import Recording, recording
from echelon.experiments.results.run_groups import SUM, group_of
from echelon.experiments.results.run_numbers import AGENT_NUMBERS, RUN_NUMBERS, RunNumbers, shown_in
from echelon.guarantees.promises.hypotheses import events_in_words
from echelon.guarantees.promises.promise import promise
from echelon.laws.law import gain_of
from echelon.simulation.engine.law_drive import Laws
from echelon.simulation.engine.parts import Parts
from echelon.simulation.engine.result import Result
from echelon.simulation.step.drive import Drive
from echelon.simulation.step.settings import Settings
from echelon.synthesis.gains.gain import Gain

if TYPE_CHECKING:
    import xarray as xr

_LISTED = 5_000
"""Most rows of a list in the summary; the dataset contains the numbers of all agents."""
_Row = TypeVar("_Row")


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
    end of an edge), `edge_lost` (messages lost since the frame before) and `forget`; of leaders
    that wait for stragglers `late`, how late their plan is. The attribute
    `promise` is JSON, and `format` the version of this list.
    """
    return labelled(result).dataset()


STORED: "WeakKeyDictionary[Result, Labelled]" = WeakKeyDictionary()
"""The labelled arrays of runs from disk."""


def labelled(result: Result) -> Labelled:
    """Return the labelled arrays of `dataset`: as they are stored, of a run from disk."""
    check_kind("result", result, Result)
    stored = STORED.get(result)
    return _labelled(result) if stored is None else stored


def _labelled(result: Result) -> Labelled:
    """Return the labelled arrays of `dataset`, computed."""
    fixed, per_agent = labelled_parts(result.parts, result.settings), ("time", "agent", "state")
    variables: Variables = {
        "states": (per_agent, result.states),
        "error": (per_agent, result.errors),
        "inputs": (("time", "agent", "input"), result.inputs),
        "saturated": ("agent", result.saturated),
        **fixed.variables,
        **_presence(result),
        **_followed(result),
        **_moving(result),
        **_poles(result),
        **_messages(result),
        **_avoidance(result),
    }
    v = lyapunov(result)
    if v is not None:
        variables |= {"lyapunov": ("time", v.value), "lyapunov_rate": ("time", v.rate)}
        variables["lyapunov_drift"] = ("time", v.drift)
    coordinates = {"time": ("time", result.times, {"units": "s"}), **fixed.coordinates}
    return Labelled(variables, coordinates, {**_attributes(result), **fixed.attributes})


def recording_of(run: Result | Recording) -> Recording:
    """Return a run as figures draw it; of a run from disk no part is built."""
    if isinstance(run, Recording):
        return run
    data = labelled(run)
    return recording(data.arrays(), data.attributes)


def _moving(result: Result) -> Variables:
    """Return offsets that change with time; nothing of constant ones."""
    if result.formation.motion is None:
        return {}
    return {"moving_offset": (("time", "agent", "state"), result.offsets_in())}


def _presence(result: Result) -> Variables:
    """Return which agents are there; nothing where all always are."""
    if result.presence is None:
        return {}
    return {"presence": (("time", "agent"), result.presence.astype(np.int8))}


def _followed(result: Result) -> Variables:
    """Return the reference and the leaders' tracking errors; nothing without a reference."""
    if result.reference is None:
        return {}
    variables: Variables = {"reference": (("time", "state"), result.reference)}
    if result.late is not None:
        variables["late"] = ("time", result.late, {"units": "s"})
    errors = [output_errors(result, leader) for leader in result.graph.leaders]
    errors = [error for error in errors if error is not None]
    if errors:
        variables["tracking_error"] = (("time", "leader", "output"), np.stack(errors, axis=1))
    return variables


def _messages(result: Result) -> Variables:
    """Return the ages and losses of messages; nothing in the ideal network."""
    network, traffic = result.world.network, result.traffic
    if network is None or traffic is None:
        return {}
    link, seconds = ("time", "edge", "end"), {"units": "s"}
    ages = traffic.of_agents(result.graph.edges, result.graph.agents, result.presence)
    return {
        "age": (("time", "agent"), ages, seconds),
        "edge_age": (link, traffic.ages, seconds),
        "edge_lost": (link, traffic.losses),
        "forget": ((), network.forget, seconds),
    }


def _avoidance(result: Result) -> Variables:
    """Return how agents kept apart; nothing where they do not."""
    numbers, meters = avoidance(result), {"units": "m"}
    if numbers is None:
        return {}
    return {
        "slice_start": ("slice", numbers.times, {"units": "s"}),
        "scaled_distance": ("slice", numbers.distance, meters),
        "active_rows": ("slice", numbers.active),
    }


def _poles(result: Result) -> Variables:
    """Return the poles of the linearized loop; nothing where laws have none.

    The law `stopping-point` closes chains by its roots, and only their agreement is in the loop.
    """
    guarantee = promise(result.parts, result.settings)
    if not guarantee.linear or guarantee.agreement is not None:
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
    """Return how a run was computed and ended, as attributes that netCDF can hold."""
    solver = {} if result.work is None else {"solver": json.dumps(result.work._asdict())}
    return {
        **result.provenance,
        "provenance": " ".join(result.provenance),
        "computed_by": result.engine,
        "inputs": digest_of(result.files),
        "outcome": result.outcome.name.lower(),
        "message": result.message,
        "warnings": "\n".join(result.warnings),
        "promise": json.dumps(promise(result.parts, result.settings).as_mapping()),
        **solver,
    }


def digest_of(files: Mapping[str, bytes]) -> str:
    """Return a digest of the files that a scenario names; empty of none."""
    digests = (f"{name}:{hashlib.sha256(files[name]).hexdigest()}" for name in sorted(files))
    return " ".join(digests)


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
    """Return `run.nc`: the dataset in groups, and the sums over all steps.

    Args:
        result: the run.
        data: its labelled arrays, computed if None.
    """
    return with_sums(result, data).netcdf(group_of)


def with_sums(result: Result, data: Labelled | None = None) -> Labelled:
    """Return the labelled arrays of `run.nc`, with the sums over all steps."""
    data = labelled(result) if data is None else data
    sums = {
        SUM + name: _numbered(SUM + name, total) for name, total in result.sums._asdict().items()
    }
    return data._replace(variables=data.variables | sums)


def _numbered(name: str, values: Array) -> tuple[tuple[str, ...], Array]:
    """Return an array with dimensions of its own."""
    return tuple(f"{name}_{axis}" for axis in range(np.ndim(values))), np.asarray(values)


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
        "gain": _gain_numbers(gain),
        "leader_gain": _gain_numbers(leader_gain_of(parts.drive)),
        "promise": promise(parts, settings).as_mapping(),
        **({"events": events_in_words(parts, promise(parts, settings))} if parts.events else {}),
        "lambda_min": spectrum.low,
        "lambda_max": spectrum.high,
    }


def _gain_numbers(gain: Gain | None) -> JsonObject | None:
    if gain is None:
        return None
    numbers = {"P": gain.P.tolist(), "R": gain.R.tolist()}
    return {"method": gain.method, "coupling": gain.coupling, **numbers}


def leader_gain_of(drive: Drive) -> Gain | None:
    """Return the leaders' own gain; None without one."""
    return gain_of(drive.leader) if isinstance(drive, Laws) else None


_NUMBERS = tuple(x.key or name for name, x in shown_in(RUN_NUMBERS, Shown.SUMMARY).items())
OBSERVED = ("outcome", "leader", "leaders", "followers", "edges", *_NUMBERS)
OBSERVED += ("event_outcomes", "steady_window_s", "warnings", "engine", "wall_time_s", "versions")
"""The other entries of a summary, which only the run itself gives."""


def summary(result: Result, numbers: Metrics | None = None) -> JsonObject:
    """Return the run's summary as JSON data; numbers that do not exist are None."""
    numbers = metrics(result) if numbers is None else numbers
    name = result.provenance.get("scenario", "")
    guarantee = promise(result.parts, result.settings)
    return {
        **statement(result.parts, result.settings, name),
        "outcome": {"name": result.outcome.name.lower(), "message": result.message},
        "leader": numbers.leader._asdict(),
        "leaders": [leader._asdict() for leader in numbers.leaders],
        "followers": [_follower(row._asdict()) for row in _listed(numbers.followers, steady_error)],
        "edges": [
            {"edge": list(row.edge), "distance_rmse": row.distance_rmse}
            for row in _listed(numbers.edges, _distance_error)
        ],
        **RunNumbers(result, numbers, guarantee).json(Shown.SUMMARY),
        **_outcomes(result),
        "steady_window_s": numbers.steady_window,
        "warnings": list(result.warnings),
        "engine": result.engine,
        "wall_time_s": result.wall_time if math.isfinite(result.wall_time) else None,
        "versions": {
            key[8:]: text for key, text in result.provenance.items() if key.startswith("version_")
        },
    }


def _outcomes(result: Result) -> JsonObject:
    """Return what followed the events; nothing without any."""
    if not result.parts.events:
        return {}
    return {"event_outcomes": [outcome.as_mapping() for outcome in event_outcomes(result)]}


def _listed(rows: Sequence[_Row], error: Callable[[_Row], float]) -> Sequence[_Row]:
    """Return all rows; if they are too many for JSON tools, the best, the median and the worst."""
    return rows if len(rows) <= _LISTED else representatives(rows, error)


def _distance_error(edge: EdgeMetrics) -> float:
    return np.inf if edge.distance_rmse is None else edge.distance_rmse


def _follower(entry: JsonObject) -> JsonObject:
    keys = {name: quantity.key or name for name, quantity in AGENT_NUMBERS.items()}
    return {keys.get(name, name): value for name, value in entry.items()}
