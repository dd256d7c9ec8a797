"""The data of a replay page: places, angles and motors at each frame, charts, and texts."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from echelon.core.digits import at_most
from echelon.core.errors import OutputError
from echelon.core.statement import Hypothesis
from echelon.core.types import Array, JsonObject
from echelon.core.words import Verdict
from echelon.experiments.results.recording import MessageAges, Recording
from echelon.output.plots.space import Space, body_width, clipped_places, space_of
from echelon.output.plots.style import raised
from echelon.output.viewer.charts import charts_of
from echelon.output.viewer.pack import BYTE, COARSE, Group, pack
from echelon.output.viewer.page import page

FLOCK = 200
"""With more agents than this, bodies are flat, and a motor load takes one byte."""
_RATE, _FLOCK_RATE = 50.0, 25.0
"""Stored frames per second; the page interpolates."""
_MOST = 20_000_000
"""Numbers in one file, which take some 25 MB."""


def replay_page(*runs: Recording, reports: Sequence[str] = ()) -> str:
    """Return one run, or two beside each other with the same clock, as a self-contained HTML page.

    Args:
        runs: to show.
        reports: the text of each, which the page shows on demand; none by default.

    Raises:
        OutputError: a run has no frame or is too large.
        MissingExtraError: the page's three.js is not built.
    """
    texts = reports or [""] * len(runs)
    return page(" and ".join(run.name for run in runs), *map(replay_data, runs, texts))


def replay_data(run: Recording, report: str = "") -> bytes:
    """Return a run packed for the page, with its report.

    Raises:
        OutputError: it has no frame, or is too large.
    """
    if not len(run.times):
        raise OutputError("the run has no stored frame; a page needs at least one.")
    space, charts = space_of(run), charts_of(run)
    frames = frames_of(run)
    groups = {"positions": Group(_flat(clipped_places(run, space.axes)[0][frames]), gaps=True)}
    if space.angles:
        # Without jumps, so that the page can interpolate.
        angles = run.states[:, :, list(space.angles)]
        angles = space.sign * np.unwrap(np.where(np.isfinite(angles), angles, 0.0), axis=0)
        groups["angles"] = Group(_flat(angles[frames]))
    if run.moving is not None:
        groups["moving"] = Group(_flat(run.moving[frames][:, :, list(space.axes)]))
    if run.reference is not None:
        path = run.reference[frames][:, list(space.axes)]
        groups["reference"] = Group(path, gaps=True)
    loads, many = motor_loads(run, space), run.agents > FLOCK
    if loads is not None:
        groups["motors"] = Group(_flat(loads[frames]), BYTE if many else COARSE, (0.0, 1.0))
    if run.messages is not None:
        groups["shades"] = Group(_shades(run, run.messages, frames), BYTE, (0.0, 2.0))
    _check_size(run, groups, len(frames))
    description = {
        **header(run, space),
        "report": report,
        "frames": len(frames),
        "clock": _clock(run, frames),
        "closest": _closest(run),
        "thrust": loads is not None,
        "charts": charts.descriptions,
        "chartTimes": charts.times,
    }
    return pack(description, {**groups, "series": charts.group})


def _shades(run: Recording, messages: MessageAges, frames: Array) -> Array:
    """Return how each link is drawn at some frames, (F, E)."""
    lost = np.diff(messages.lost.cumsum(axis=0)[frames], axis=0, prepend=0)
    return link_shades(messages.edges[frames], lost, messages.forget, run.heard)


def link_shades(ages: Array, lost: Array, forget: float, heard: Array) -> Array:
    """Return 1 for a link with a new message, down to 0 as it ages, and 2 where one was lost.

    Args:
        ages: (..., E, 2) of the newest message at each end of the links, s; NaN for none.
        lost: (..., E, 2) how many were lost since the last picture.
        forget: age beyond which messages are not used, s.
        heard: (E, 2) which ends receive.
    """
    old = np.where(np.isfinite(ages), ages, np.inf)
    oldest = np.where(heard, old, 0.0).max(axis=-1)
    fresh = np.clip(1.0 - oldest / forget, 0.0, 1.0)
    return np.where((lost > 0).any(axis=-1), 2.0, fresh)


def frames_of(run: Recording) -> Array:
    """Return the frames of the page: evenly spaced, and the last."""
    times, last = run.times, len(run.times) - 1
    if last < 1:
        return np.array([0])
    rate = _RATE if run.agents <= FLOCK else _FLOCK_RATE
    # Half a frame of tolerance, since times are rounded multiples of the step.
    stride = max(1, int(1.0 / (rate * (times[1] - times[0])) + 0.5))
    return np.unique([*range(0, last, stride), last])


def _clock(run: Recording, frames: Array) -> dict[str, float]:
    """Return the times of frames: evenly spaced except for the last."""
    times = run.times[frames]
    step = float(times[1] - times[0]) if len(times) > 1 else 1.0
    return {"start": float(times[0]), "step": step, "last": float(times[-1])}


def _closest(run: Recording) -> list[list[float]]:
    """Return each time at which two agents were closer than any before, how close, and who."""
    pairs = run.approaches(run.scales)
    return [[*map(_rounded, (pair.time, pair.distance)), *pair.agents] for pair in pairs]


def _rounded(value: float) -> float:
    return float(f"{value:.6g}")


def motor_loads(run: Recording, space: Space) -> Array | None:
    """Return motor loads as fractions of their limits, (T, N, k), of bodies with k motors."""
    motors = {"quadrotor": 4, "birotor": 2}.get(space.shape)
    loads = run.loads
    return None if loads is None or loads.shape[2] != motors else np.clip(loads, 0.0, 1.0)


def _flat(values: Array) -> Array:
    return values.reshape(len(values), -1)


def _check_size(run: Recording, groups: Mapping[str, Group], frames: int) -> None:
    numbers = sum(group.values.size for group in groups.values())
    if numbers > _MOST:
        fits = max(1, int(frames * _MOST / numbers))
        raise OutputError(
            f"{run.agents} agents at {frames} times are too many for one page; store at most about "
            f"{fits} times with `simulation.store_every`."
        )


# ---- texts and space ----------------------------------------------------------------------------


def header(run: Recording, space: Space) -> JsonObject:
    """Return the header of the replay and live pages: all of a run but its frames."""
    size, note = _size(run, space)
    return {
        "title": run.name,
        "facts": facts(run),
        "notes": _notes(run, space),
        "promise": _badge_of_run(run),
        "agents": run.agents,
        "leaders": list(run.leaders),
        "nearest": run.nearest.tolist(),
        "edges": run.edges.tolist(),
        "heard": heard_by(run.heard),
        "schedule": _schedule(run),
        "ellipsoid": ellipsoid_of(run, space),
        "moments": [[event["at"], event["text"]] for event in run.events],
        "referenced": run.reference is not None,
        "offsets": [[float(f"{x:.7g}") for x in row] for row in run.offsets[:, list(space.axes)]],
        "space": {
            "kind": space.kind,
            "names": list(space.names),
            "units": [raised(unit) for unit in space.units],
            "stretch": list(space.stretch),
        },
        "box": {"low": space.low.tolist(), "high": space.high.tolist()},
        "shape": space.shape,
        "size": size,
        "drawn": note,
        "thrust": False,
        "duration": float(run.times[-1]) if len(run.times) else run.horizon,
    }


def ellipsoid_of(run: Recording, space: Space) -> JsonObject | None:
    """Return the ellipsoid about each agent along the axes of a picture; None of a point."""
    sizes = run.ellipsoid
    if sizes is None or not run.position:
        return None
    return {
        "radii": sizes.radii(space.names).tolist(),
        "touching": sizes.touching,
        "limit": sizes.limit,
        "kept": run.avoidance is not None,
    }


def heard_by(heard: Array) -> list[int]:
    """Return the receivers of each edge: 1 its second end, 2 its first, 3 both, 0 none."""
    return (heard @ (2, 1)).tolist()


def _schedule(run: Recording) -> JsonObject | None:
    """Return the schedule of edges, each graph as a text of 1 and 0."""
    if run.schedule is None:
        return None
    starts, weights, period = run.schedule[:3]
    rows = ["".join("1" if weight else "0" for weight in row) for row in weights]
    nearest = run.schedule.nearest
    follow = {} if nearest is None else {"nearest": nearest.tolist()}
    return {"starts": starts.tolist(), "rows": rows, "period": period, **follow}


def facts(run: Recording) -> list[str]:
    """Return the texts beside the title."""
    leaders = len(run.leaders)
    texts = [f"{run.agents} agents", _spaced(run.model)]
    texts += [f"{leaders} leaders"] if leaders > 1 else []
    if "coupling" in run.promise and run.promise["coupling"] is not None:
        texts.append(f"coupling {run.promise['coupling']:.3g}")
    return texts


def _spaced(name: str) -> str:
    """Return `PlanarQuadrotor` as `planar quadrotor`."""
    words = "".join(f" {letter.lower()}" if letter.isupper() else letter for letter in name)
    return words.strip()


def _notes(run: Recording, space: Space) -> list[str]:
    notes = [] if run.attributes.get("outcome") == "completed" else [str(run.attributes["message"])]
    if space.clipped:
        notes.append("Agents farther away than ten times the formation are drawn at that border.")
    return notes


def promise_badge(promise: Mapping[str, Any]) -> dict[str, str]:
    """Return the badge of a promise: its state `holds` or `lost`, a short and a whole text."""
    if not promise["promised"]:
        if not promise.get("conditions"):
            return {"state": "lost", "short": "no guarantee", "whole": promise["sentence"]}
        short = f"no guarantee: {promise['theorem']} holds while {promise['conditions'][0]}"
        return {"state": "edge", "short": short, "whole": promise["sentence"]}
    apart = (promise.get("anywhere") or {}).get("separation")
    if apart is not None:
        return _badge_of_distances(apart["ideal"], promise)
    rate, kind = promise["rate"], promise["kind"]
    source = promise["theorem"] or kind
    short = f"guaranteed: {f'{at_most(rate)} 1/s' if rate else 'V does not rise'}, {source}"
    whole = f"{promise['sentence']} {_rate_in_words(promise)}".rstrip()
    return {"state": "holds", "short": short, "whole": whole}


def _badge_of_distances(ideal: bool, promise: Mapping[str, Any]) -> dict[str, str]:
    """Return the badge of agents that keep apart, in the world of the theorem or in another."""
    short = f"guaranteed: agents stay apart, {promise['theorem']}"
    short = short if ideal else "distances observed, not proved"
    return {"state": "holds" if ideal else "edge", "short": short, "whole": promise["sentence"]}


_WIDER = {
    Hypothesis.SWITCHING: "all graphs of the scenario",
    Hypothesis.HEADING_FRAME: "all turns of the leader",
}
"""What a rate holds for beyond one graph and one heading, by the line that says so."""


def _rate_in_words(promise: Mapping[str, Any]) -> str:
    """Return a sentence on the rate in the badge; empty if the promise's sentence states it."""
    rate, slowest = promise["rate"], promise.get("slowest_mode")
    if not rate or promise["theorem"]:
        return ""
    if slowest is None or abs(rate + slowest) <= 1e-6 * rate:
        return f"The rate of {at_most(rate)} 1/s is that of the slowest mode."
    holding = {
        x["statement"] for x in promise.get("hypotheses", ()) if x["verdict"] == str(Verdict.HOLDS)
    }
    what = " and ".join(text for name, text in _WIDER.items() if name.value in holding)
    what = what or "inputs that are held over a step"
    return (
        f"The rate of {at_most(rate)} 1/s holds for {what}; the slowest mode alone decays at "
        f"{at_most(-slowest)} 1/s."
    )


def _badge_of_run(run: Recording) -> dict[str, str] | None:
    """Return the badge of a run, withdrawn if the guarantee does not cover the run.

    None where no guarantee was computed.
    """
    if not run.promise["sentence"]:
        return None
    badge, outcome = promise_badge(run.promise), run.attributes.get("outcome")
    if badge["state"] != "holds" or outcome not in ("left_chart", "diverged"):
        return badge
    short, whole = "the guarantee does not cover this run", badge["whole"]
    return {"state": "lost", "short": short, "whole": f"{run.attributes['message']} {whole}"}


def _size(run: Recording, space: Space) -> tuple[float, str]:
    """Return the scale of bodies, and a note on it."""
    width = body_width(run, space)
    spans = {"quadrotor": 1.15, "birotor": 1.35, "car": 0.9, "ball": 0.52, "dot": 0.5}
    if space.kind in ("phase", "time"):
        return width / spans["dot"], ""
    return width / spans[space.shape], f"vehicles drawn {width:.2g} m wide, not to scale"
