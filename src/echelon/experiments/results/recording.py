"""A run as its dataset has it: arrays and names, read from `run.nc` without a model's code.

Whatever draws a run draws this, so that what is drawn again is what was drawn first.
"""

import dataclasses
import functools
import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, final

import numpy as np

from echelon.agents.network.switching import Schedule
from echelon.core.errors import OutputError

if TYPE_CHECKING:
    import xarray as xr

FORMAT = 3
"""Of `run.nc`; another one lacks what is read here."""


class InputBounds(NamedTuple):
    """What actuators can deliver, low <= G u <= high: G (k, m), and (k,) twice."""

    matrix: np.ndarray
    low: np.ndarray
    high: np.ndarray


class TrackingErrors(NamedTuple):
    """Leaders' outputs minus their references', (T, L, q), with the outputs' names and units."""

    error: np.ndarray
    names: tuple[str, ...]
    units: tuple[str, ...]


class LoopPoles(NamedTuple):
    """Poles (K, n) of the modes looked at, each with its eigenvalue of the graph (K,)."""

    poles: np.ndarray
    eigenvalues: np.ndarray


@final
@dataclasses.dataclass(frozen=True, eq=False)
class Recording:
    """A run: T stored frames of N agents with n states and m inputs, L of them leaders.

    Attributes:
        name: of the scenario, or of the model.
        model: the name of its class.
        times: (T,) s.
        states: (T, N, n).
        inputs: (T, N, m), as delivered.
        reference: (T, n), what the leaders follow; None where that is nothing.
        errors: (T, N, n), deviation from the goal relative to the nearest leader.
        offsets: (N, n).
        leaders: their numbers.
        nearest: (N,), each agent's nearest leader.
        edges: (E, 2), with `weights` (E,); of a graph that switches, all that are there at times.
        heard: (E, 2), whether each end of an edge hears the other.
        schedule: when which weights hold; None where they never change.
        state_names, state_units, input_names, input_units: as texts.
        position: indices of the coordinates that a picture shows; none of an abstract agent.
        bounds: of the inputs; None where nothing limits them.
        lyapunov: V (T,); None where the law has none.
        lyapunov_rate: its derivative (T,).
        metric: P (n, n) of V, where there is a gain; else None.
        limited: (N,), the part of the steps in which a limit acted.
        tracking: of the leaders; None without a reference.
        modes: None where the laws have no linearization.
        promise: as `Promise.as_mapping` gives it.
        horizon, dt: s.
        attributes: provenance and settings, as they were stored.
    """

    name: str
    model: str
    times: np.ndarray
    states: np.ndarray
    inputs: np.ndarray
    reference: np.ndarray | None
    errors: np.ndarray
    offsets: np.ndarray
    leaders: tuple[int, ...]
    nearest: np.ndarray
    edges: np.ndarray
    weights: np.ndarray
    heard: np.ndarray
    schedule: Schedule | None
    state_names: tuple[str, ...]
    state_units: tuple[str, ...]
    input_names: tuple[str, ...]
    input_units: tuple[str, ...]
    position: tuple[int, ...]
    bounds: InputBounds | None
    lyapunov: np.ndarray | None
    lyapunov_rate: np.ndarray | None
    metric: np.ndarray | None
    limited: np.ndarray
    tracking: TrackingErrors | None
    modes: LoopPoles | None
    promise: Mapping[str, Any]
    horizon: float
    dt: float
    attributes: Mapping[str, Any]

    @property
    def agents(self) -> int:
        """How many there are."""
        return self.states.shape[1]

    @functools.cached_property
    def arrows(self) -> np.ndarray:
        """Edges (K, 2) along which only the second hears the first, turned so where need be."""
        one = self.heard.sum(axis=1) == 1
        return np.where(self.heard[one, 1:], self.edges[one], self.edges[one, ::-1])

    def linked(self, time: float) -> np.ndarray:
        """Return which edges are there at a time (s), (E,)."""
        if self.schedule is None:
            return np.ones(len(self.edges), bool)
        return self.schedule.weights[self.schedule.row(time)] > 0.0

    @functools.cached_property
    def followers(self) -> tuple[int, ...]:
        """Those who do not lead."""
        leads = {*self.leaders}
        return tuple(k for k in range(self.agents) if k not in leads)

    @property
    def measured(self) -> tuple[int, ...]:
        """Indices of the states that errors are measured on: the position if any, else all."""
        return self.position or tuple(range(len(self.state_names)))

    @property
    def unit(self) -> str:
        """The unit of errors: m for a position, else nothing."""
        return "m" if self.position else ""

    @functools.cached_property
    def formation_errors(self) -> np.ndarray:
        """Each agent's distance from its goal, (T, N)."""
        with np.errstate(over="ignore", invalid="ignore"):
            return np.linalg.norm(self.errors[:, :, list(self.measured)], axis=2)

    @property
    def rate(self) -> float | None:
        """At what rate errors are promised to shrink, 1/s; None where nothing is, or no rate."""
        return self.promise["rate"] or None if self.promise["promised"] else None

    def error_bound(self) -> np.ndarray | None:
        """Return what a theorem bounds every formation error by, (T,); None where none does.

        Theorem 1 has S = sum_i delta_i'P delta_i shrink as e^(-2 alpha t), from starts in the
        certified set, without what the scenario adds and while no limit acts. Of a delta with
        delta'P delta <= S the measured part is no longer than the root of S times the largest
        eigenvalue of that block of P^-1.
        """
        told, found = self.promise, self.promise.get("certified_set")
        held = {x["statement"] for x in told["hypotheses"] if x["verdict"] == "holds"}
        proved = told["theorem"] == "T1" and found is not None and self.rate is not None
        if not proved or "starts in the certified set" not in held or self.metric is None:
            return None
        if self.limited.any() or "without what the scenario adds" in told["sentence"]:
            return None
        begin = float(np.einsum("ia,ab,ib->", self.errors[0], self.metric, self.errors[0]))
        block = np.linalg.inv(self.metric)[np.ix_(self.measured, self.measured)]
        widest = float(np.linalg.eigvalsh(block)[-1])
        return np.sqrt(begin * widest) * np.exp(-(self.rate or 0.0) * self.times)

    @property
    def loads(self) -> np.ndarray | None:
        """Rows of G u as fractions of their range, (T, N, k); None where a row has none."""
        if self.bounds is None:
            return None
        matrix, low, high = self.bounds
        if not (np.isfinite(low).all() and np.isfinite(high).all()):
            return None
        return (self.inputs @ matrix.T - low) / (high - low)


def read_recording(file: Path) -> Recording:
    """Return the run in a netCDF file.

    Raises:
        OutputError: it cannot be read, is damaged, or was written by another version.
    """
    import xarray as xr

    try:
        with xr.open_dataset(file, engine="h5netcdf") as data:
            return recording(data.load())
    except OutputError as error:
        raise OutputError(f"`{file}`: {error}") from error
    except (OSError, ValueError, KeyError, TypeError, RuntimeError) as error:
        raise OutputError(
            f"`{file}` cannot be read as a run: it is damaged, or was not written by echelon "
            f"({str(error).splitlines()[0] if str(error) else type(error).__name__})."
        ) from error


def recording(data: "xr.Dataset") -> Recording:
    """Return a dataset of `echelon.dataset` as arrays and names.

    Raises:
        OutputError: the dataset is of another version.
        KeyError: it is no dataset of a run.
    """
    _check_format(data)
    told, values = data.attrs, {str(name): part.values for name, part in data.items()}
    names = tuple(str(name) for name in data["state"].values)
    # As text, since netCDF keeps an empty list as nothing.
    shown = str(told["position"]).split()
    return Recording(
        name=str(told.get("scenario") or told["model"]),
        model=str(told["model"]),
        times=data["time"].values,
        states=values["states"],
        inputs=values["inputs"],
        reference=values.get("reference"),
        errors=values["error"],
        offsets=values["offset"],
        leaders=tuple(int(k) for k in np.flatnonzero(values["is_leader"])),
        nearest=values["nearest_leader"].astype(int),
        edges=values["edge_agents"].astype(int),
        weights=values["edge_weight"],
        heard=values["edge_heard"].astype(bool),
        schedule=_schedule(values),
        state_names=names,
        state_units=_texts(data, "state_unit"),
        input_names=_texts(data, "input"),
        input_units=_texts(data, "input_unit"),
        position=tuple(names.index(name) for name in shown),
        bounds=_bounds(values),
        lyapunov=values.get("lyapunov"),
        lyapunov_rate=values.get("lyapunov_rate"),
        metric=values.get("P"),
        limited=values["saturated"],
        tracking=_tracking(data, values),
        modes=_modes(values),
        promise=json.loads(told["promise"]),
        horizon=float(told["horizon"]),
        dt=float(told["dt"]),
        attributes=dict(told),
    )


def _check_format(data: "xr.Dataset") -> None:
    if "states" not in data or "model" not in data.attrs:
        raise KeyError("it holds no states of agents")
    found = int(data.attrs.get("format", 1))
    if found != FORMAT:
        by = data.attrs.get("version_echelon", "an unknown version")
        raise OutputError(
            f"the run was written in format {found} by echelon {by}, and this version reads format "
            f"{FORMAT}; `echelon run FOLDER --out OTHER` computes it again from its scenario."
        )


def _texts(data: "xr.Dataset", name: str) -> tuple[str, ...]:
    return tuple(str(text) for text in data[name].values)


def _schedule(values: Mapping[str, np.ndarray]) -> Schedule | None:
    if "stretch_start" not in values:
        return None
    period = float(values["graph_period"])
    weights = values["edge_weight_then"]
    return Schedule(values["stretch_start"], weights, period if np.isfinite(period) else None)


def _bounds(values: Mapping[str, np.ndarray]) -> InputBounds | None:
    if "limit_matrix" not in values:
        return None
    return InputBounds(values["limit_matrix"], values["limit_low"], values["limit_high"])


def _tracking(data: "xr.Dataset", values: Mapping[str, np.ndarray]) -> TrackingErrors | None:
    if "tracking_error" not in values:
        return None
    return TrackingErrors(
        values["tracking_error"], _texts(data, "output"), _texts(data, "output_unit")
    )


def _modes(values: Mapping[str, np.ndarray]) -> LoopPoles | None:
    if "pole_real" not in values:
        return None
    poles = values["pole_real"] + 1j * values["pole_imaginary"]
    return LoopPoles(poles, values["mode_eigenvalue"])
