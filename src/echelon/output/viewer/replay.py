"""The page of a run: places, angles and motors at each frame, charts, texts; or as it grows."""

import contextlib
import dataclasses
import threading
from collections.abc import Sequence
from typing import Final, final

import numpy as np

from echelon.core.claim import number_in
from echelon.core.errors import OutputError
from echelon.core.types import Array, JsonObject
from echelon.experiments.results.recording import Recording, group_name, is_unlike
from echelon.output.plots.space import Space, body_width, clipped_places, space_of
from echelon.output.plots.style import raised
from echelon.output.reports.guarantee_text import guarantee_text, short_form
from echelon.output.viewer.charts import charts_of
from echelon.output.viewer.page import BYTE, COARSE, Group, pack, page
from echelon_flight.page_server import Handler

FLOCK = 200
"""With more agents than this, bodies are flat, and a motor load takes one byte."""
_RATE, _FLOCK_RATE = 50.0, 25.0
"""Stored frames per second; the page interpolates."""
_MOST = 20_000_000
"""Numbers in one file, which take some 25 MB."""
_PATIENCE: Final = 10.0
"""Seconds after which a page that waits for a part of a run gets an empty answer."""


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
        sent = run.messages
        lost = np.diff(sent.lost.cumsum(axis=0)[frames], axis=0, prepend=0)
        shades = link_shades(sent.edges[frames], lost, sent.forget, run.heard)
        groups["shades"] = Group(shades, BYTE, (0.0, 2.0))
    numbers = sum(group.values.size for group in groups.values())
    if numbers > _MOST:
        fits = max(1, int(len(frames) * _MOST / numbers))
        raise OutputError(
            f"{run.agents} agents at {len(frames)} times are too many for one page; store at most "
            f"about {fits} times with `simulation.store_every`."
        )
    # Evenly spaced except for the last.
    times = run.times[frames].tolist()
    step = times[1] - times[0] if len(times) > 1 else 1.0
    pairs = run.approaches(run.scales)
    description = {
        **header(run, space),
        "report": report,
        "frames": len(frames),
        "clock": {"start": times[0], "step": step, "last": times[-1]},
        # Each time at which two agents were closer than any before, how close, and who.
        "closest": [
            [*(float(f"{x:.6g}") for x in (pair.time, pair.distance)), *pair.agents]
            for pair in pairs
        ],
        "thrust": loads is not None,
        "charts": charts.descriptions,
        "chartTimes": charts.times,
    }
    return pack(description, {**groups, "series": charts.group})


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


def motor_loads(run: Recording, space: Space) -> Array | None:
    """Return motor loads as fractions of their limits, (T, N, k), of bodies with k motors."""
    motors = {"quadrotor": 4, "birotor": 2}.get(space.shape)
    loads = run.loads
    return None if loads is None or loads.shape[2] != motors else np.clip(loads, 0.0, 1.0)


def _flat(values: Array) -> Array:
    return values.reshape(len(values), -1)


# ---- texts and space ----------------------------------------------------------------------------


def header(run: Recording, space: Space) -> JsonObject:
    """Return the header of the replay and live pages: all of a run but its frames."""
    width, attributes, sizes = body_width(run, space), run.attributes, run.ellipsoid
    spans = {"quadrotor": 1.15, "birotor": 1.35, "car": 0.9, "ball": 0.52, "dot": 0.5}
    solid = space.kind in ("space", "plane")
    notes = [] if attributes.get("outcome") == "completed" else [str(attributes["message"])]
    if space.clipped:
        notes.append("Agents farther away than ten times the formation are drawn at that border.")
    schedule = ellipsoid = None
    if run.schedule is not None:
        starts, weights, period = run.schedule[:3]
        # Each graph as a text of 1 and 0.
        rows = ["".join("1" if weight else "0" for weight in row) for row in weights]
        nearest = run.schedule.nearest
        follow = {} if nearest is None else {"nearest": nearest.tolist()}
        schedule = {"starts": starts.tolist(), "rows": rows, "period": period, **follow}
    if sizes is not None and run.position:
        ellipsoid = {
            "radii": sizes.radii(space.names).tolist(),
            "touching": sizes.touching,
            "limit": sizes.limit,
            "kept": run.avoidance is not None,
        }
    return {
        "title": run.name,
        "facts": facts(run),
        "notes": notes,
        "promise": _badge_of_run(run),
        "agents": run.agents,
        "leaders": list(run.leaders),
        "unlike": [group_name(run, k) for k in range(run.agents)] if is_unlike(run) else None,
        "nearest": run.nearest.tolist(),
        "edges": run.edges.tolist(),
        "heard": heard_by(run.heard),
        "schedule": schedule,
        "ellipsoid": ellipsoid,
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
        "size": width / spans[space.shape if solid else "dot"],
        "drawn": f"vehicles drawn {width:.2g} m wide, not to scale" if solid else "",
        "thrust": False,
        "duration": float(run.times[-1]) if len(run.times) else run.horizon,
    }


def heard_by(heard: Array) -> list[int]:
    """Return the receivers of each edge: 1 its second end, 2 its first, 3 both, 0 none."""
    return (heard @ (2, 1)).tolist()


def facts(run: Recording) -> list[str]:
    """Return the texts beside the title."""
    leaders = len(run.leaders)
    # `PlanarQuadrotor` is `planar quadrotor`.
    words = "".join(f" {x.lower()}" if x.isupper() else x for x in run.model)
    texts = [f"{run.agents} agents", words.strip()]
    texts += [f"{leaders} leaders"] if leaders > 1 else []
    if run.guarantee and number_in(run.guarantee, "coupling") is not None:
        texts.append(f"coupling {number_in(run.guarantee, 'coupling'):.3g}")
    return texts


def guarantee_badge(stated: JsonObject) -> dict[str, str]:
    """Return the badge of a guarantee: `holds`, `edge` or `lost`, a short and a whole text."""
    states = {"guaranteed": "holds", "conditional": "edge", "none": "lost"}
    state = states[stated["verdict"]]
    return {"state": state, "short": short_form(stated), "whole": guarantee_text(stated)}


def _badge_of_run(run: Recording) -> dict[str, str] | None:
    """None where no guarantee was computed; withdrawn if it does not cover the run."""
    if not run.guarantee:
        return None
    badge, outcome = guarantee_badge(run.guarantee), run.attributes.get("outcome")
    if badge["state"] != "holds" or outcome not in ("left_chart", "diverged"):
        return badge
    short, whole = "the guarantee does not cover this run", badge["whole"]
    return {"state": "lost", "short": short, "whole": f"{run.attributes['message']}\n{whole}"}


# ---- a run that is still being computed --------------------------------------------------------


@final
class Growing:
    """The parts of a run so far, for any number of pages."""

    def __init__(self, run: Recording) -> None:
        more = {"growing": True, "horizon": run.horizon}
        self.html = page(run.name, pack(header(run, space_of(run)) | more, {})).encode()
        self.blocks, self.done = list[bytes](), False
        self.changed = threading.Condition()
        self.last: Recording | None = None

    def add(self, stretch: Recording) -> None:
        """Add a part, which begins where the previous one ended.

        Raises:
            OutputError: it is too large for a page.
        """
        if not len(stretch.times):
            return
        block = replay_data(stretch if self.last is None else _joined(self.last, stretch))
        with self.changed:
            self.blocks.append(block)
            self.last = stretch
            self.changed.notify_all()

    def finish(self, run: Recording, report: str) -> None:
        """Replace the parts by the complete run with its report, which all pages then load.

        Raises:
            OutputError: it is too large for a page.
        """
        html = replay_page(run, reports=[report]).encode()
        with self.changed:
            self.html, self.done = html, True
            self.changed.notify_all()

    def block(self, number: int) -> bytes | None:
        """Return a part; b"" if it is not there in time, None once the run is complete."""
        with self.changed:
            self.changed.wait_for(lambda: self.done or len(self.blocks) > number, _PATIENCE)
            if self.done:
                return None
            return self.blocks[number] if len(self.blocks) > number else b""


def _joined(before: Recording, stretch: Recording) -> Recording:
    """Return a part with the last frame of the previous one, for interpolation."""
    names = ("times", "states", "inputs", "lyapunov", "reference")
    parts = {
        name: np.concatenate([getattr(before, name)[-1:], getattr(stretch, name)])
        for name in names
        if getattr(stretch, name) is not None
    }
    return dataclasses.replace(stretch, **parts)


def growing_page(run: Growing) -> type[Handler]:
    """Return the handler of a run that is being computed."""

    class GrowingRun(Handler):
        """The handler of this run: its page, and its parts by number."""

        def do_GET(self) -> None:
            """Send the page or a part."""
            # The page changes when the run is complete.
            type(self).page = run.html
            if not self.path.startswith("/stretch/"):
                super().do_GET()
            elif self.allowed():
                self._send_stretch(self.path.rpartition("/")[2])

        def _send_stretch(self, number: str) -> None:
            if not (number.isascii() and number.isdigit()) or len(number) > 9:
                self.send(b"not found\n", "text/plain", 404)
                return
            block = run.block(int(number))
            with contextlib.suppress(ConnectionError):
                # 205: reload the page; 204: no part yet.
                code = 205 if block is None else 200 if block else 204
                self.send(block or b"", "application/octet-stream", code)

    return GrowingRun
