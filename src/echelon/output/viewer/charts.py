"""The charts of the page: formation error, V, distances of agents and inputs over time."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from echelon.core.digits import at_most
from echelon.core.types import Array, JsonObject
from echelon.experiments.results.metrics import SETTLED
from echelon.experiments.results.recording import Recording
from echelon.experiments.results.run_numbers import settling_bound
from echelon.output.plots import style as draw
from echelon.output.plots.style import FLOOR
from echelon.output.viewer.page import Group

NAMED = 6
"""With more followers than this, a chart shows the worst and the median."""
_POINTS = 1200


class Charts(NamedTuple):
    """Charts: their descriptions in the header, times (P,), and curves (P, C)."""

    descriptions: list[JsonObject]
    times: list[float]
    group: Group


class _Sheet:
    def __init__(self, run: Recording) -> None:
        # Denser at the start, where inputs change quickly.
        last = len(run.times) - 1
        even = np.linspace(0.0, last, _POINTS * 2 // 3)
        early = np.linspace(0.0, 0.1 * last, _POINTS // 3)
        self.frames = np.unique(np.concatenate([even, early]).round().astype(int))
        self.columns: list[Array] = []

    def line(
        self, name: str | None, values: Array, colour: int | str, log: bool, floor: float = FLOOR
    ) -> JsonObject:
        return self.thinned(name, values[self.frames], colour, log, floor)

    def thinned(
        self,
        name: str | None,
        values: Array,
        colour: int | str,
        log: bool = False,
        floor: float = FLOOR,
    ) -> JsonObject:
        curve = np.asarray(values, np.float64)
        if log:
            # A logarithm has no 0, and values below the floor are rounding errors.
            with np.errstate(divide="ignore", invalid="ignore"):
                curve = np.where(curve <= floor, -np.inf, np.log10(curve))
        self.columns.append(np.where(curve == np.inf, np.nan, curve))
        line: JsonObject = {"name": name, "colour": colour, "series": len(self.columns) - 1}
        return line | ({"floor": floor} if log else {})


def charts_of(run: Recording) -> Charts:
    """Return the charts of a run."""
    sheet = _Sheet(run)
    descriptions = [_errors(run, sheet), *_lyapunov(run, sheet)]
    descriptions += [*_distances(run, sheet), _inputs(run, sheet)]
    times = [float(f"{t:.6g}") for t in run.times[sheet.frames]]
    return Charts(descriptions, times, Group(np.stack(sheet.columns, axis=1), gaps=True))


def _errors(run: Recording, sheet: _Sheet) -> JsonObject:
    errors, followers = run.formation_errors, list(run.followers)
    here = np.ones_like(errors, bool) if run.presence is None else run.presence
    # An agent that leads is its own goal, and has no error to show.
    leads = run.nearest_then == np.arange(run.agents)
    if 0 < len(followers) <= NAMED:
        shown = np.where(here & ~leads, errors, np.nan)
        lines = [
            sheet.line(str(agent), shown[:, agent], place, True)
            | _without(not here[:, agent].all(), bool(leads[:, agent].any()))
            for place, agent in enumerate(followers)
        ]
    else:
        some = followers or slice(None)
        rows = np.where(here, errors, np.nan)[:, some]
        worst = np.where(here, errors, 0.0)[:, some].max(axis=1)
        median, anybody = np.full(len(rows), np.nan), here[:, some].any(axis=1)
        # A number that is not finite is shown as such, but of agents that are not there.
        middle = np.median if run.presence is None else np.nanmedian
        median[anybody] = middle(rows[anybody], axis=1)
        lines = [sheet.line("worst", worst, 1, True), sheet.line("median", median, 0, True)]
    if run.reference is not None:
        away = _off_reference(run, run.reference)
        name = "leaders" if len(run.leaders) > 1 else "leader"
        lines.append(sheet.line(name, away, "leader", True))
    lines += _slope(run, errors[0].max(), 1.0)
    marks = [{"value": SETTLED, "name": settling_bound(run.length_unit)}]
    return _chart("formation error", run.length_unit, True, lines, marks)


def _without(absent: bool, leads: bool) -> JsonObject:
    """Return what a line shows where an agent has no value; nothing where it always has one."""
    words = " or ".join(["absent"] * absent + ["leads"] * leads)
    return {"none": f"\u2013 {words}"} if words else {}


def _off_reference(run: Recording, reference: Float[Array, "T n"]) -> Float[Array, " T"]:
    """Return the largest distance of a leader from its place beside the reference."""
    leaders, measured = list(run.leaders), list(run.measured)
    if run.presence is not None:
        leads = (run.nearest_then == np.arange(run.agents)) & run.presence
        away = (run.states - run.offsets_in() - reference[:, None])[:, :, measured]
        largest = np.where(leads, np.linalg.norm(away, axis=2), 0.0).max(axis=1)
        return np.where(leads.any(axis=1), largest, np.nan)
    away = run.states[:, leaders] - run.offsets_in()[..., leaders, :] - reference[:, None]
    with np.errstate(over="ignore", invalid="ignore"):
        return np.linalg.norm(away[:, :, measured], axis=2).max(axis=1)


def _slope(run: Recording, begin: float, times: float) -> list[JsonObject]:
    rate = run.rate
    if rate is None or begin <= 0.0 or not np.isfinite(begin):
        return []
    slope = -times * rate / float(np.log(10.0))
    ends = [float(np.log10(begin)), slope]
    name = f"guaranteed slope, \u2212{at_most(times * rate)} 1/s"
    return [
        {"name": name, "colour": "faint", "ends": ends, "dash": True, "mute": True, "bound": True}
    ]


def _lyapunov(run: Recording, sheet: _Sheet) -> list[JsonObject]:
    if run.lyapunov is None:
        return []
    # V is a square, and so are its rounding errors.
    lines = [sheet.line("V", run.lyapunov, 0, True, FLOOR**2)]
    lines += _slope(run, float(run.lyapunov[0]), 2.0)
    return [_chart("Lyapunov function V", "", True, lines, [])]


def _distances(run: Recording, sheet: _Sheet) -> list[JsonObject]:
    near = run.near(sheet.frames)
    if near is None:
        return []
    times = run.times[sheet.frames]
    lines = [sheet.thinned("any two", near.over(times, near.distance), "leader")]
    if near is run.avoidance:
        rows = near.over(times, near.active)
        lines.append(sheet.thinned("active rows", rows, 1) | {"strip": True})
    return [distance_chart(run, lines)]


def distance_chart(run: Recording, lines: list[JsonObject]) -> JsonObject:
    """Return the chart of the smallest distance between agents, with its limits."""
    sizes, marks = run.ellipsoid, list[JsonObject]()
    if sizes is not None:
        marks = [{"value": sizes.touching, "name": "touching", "below": True}]
    title = "smallest distance"
    if sizes is not None and run.avoidance is not None:
        title = "smallest scaled distance"
        marks.append({"value": sizes.limit, "name": "kept"})
    return _chart(title, run.length_unit, False, lines, marks) | {"zero": True}


def _inputs(run: Recording, sheet: _Sheet) -> JsonObject:
    loads = run.loads
    if loads is not None:
        percent = 100.0 * loads.reshape(len(loads), -1)
        lines = [
            sheet.line("largest", np.nanmax(percent, axis=1), 1, False),
            sheet.line("mean", np.nanmean(percent, axis=1), "leader", False),
            sheet.line("smallest", np.nanmin(percent, axis=1), 0, False),
        ]
        marks = [{"value": 100.0, "name": "limit", "below": True}, {"value": 0.0, "name": "limit"}]
        title = "motors" if loads.shape[2] in (2, 4) else "inputs"
        return _chart(title, "% of limit", False, lines, marks)
    sizes = np.abs(run.inputs).max(axis=1)
    units, names = {*run.input_units}, [*zip(run.input_names, run.input_units, strict=True)]
    lines = [
        sheet.line(draw.label(name, unit if len(units) > 1 else ""), sizes[:, k], k, False)
        for k, (name, unit) in enumerate(names[:NAMED])
    ]
    unit = draw.raised(units.pop()) if len(units) == 1 else ""
    return _chart("largest |input|", unit, False, lines, [])


def _chart(
    title: str, unit: str, log: bool, lines: list[JsonObject], marks: list[JsonObject]
) -> JsonObject:
    return {"title": title, "unit": unit, "log": log, "lines": lines, "marks": marks}
