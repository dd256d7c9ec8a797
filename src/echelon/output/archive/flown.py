"""A flight that took place: the logs of its agents, joined into what `run.nc` has of a run.

No code of the flight is executed. What does not depend on the logs (names, goals, the leader's
path) is in `plan.nc`, which `echelon fly` writes with the laws.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, final

import numpy as np

from echelon.core.errors import Outcome, OutputError
from echelon.core.types import Array, JsonObject
from echelon.experiments.results.dataset import digest_of, group_of, labelled_parts
from echelon.experiments.results.labelled import Labelled, Variables, read_labelled
from echelon.experiments.results.recording import Recording, recording
from echelon.simulation.engine.parts import Parts
from echelon.simulation.engine.prepare import Prepared, prepare
from echelon.simulation.engine.simulate import sample_reference
from echelon.simulation.step.settings import Settings
from echelon_flight import FlightError
from echelon_flight.flight_log import LogFile, Tick, find_logs, read_log
from echelon_flight.supervisor import Fault

PLAN = "plan.nc"
_FACTS = "flight.json"
_APART = 0.02
"""s; estimates of clocks that differ by less are within what a network does."""
_AT_LIMIT = 1e-9
"""Share of the range of an input from its limit within which it is at the limit."""


def plan_file(parts: Parts, settings: Settings, origin: Mapping[str, Any]) -> bytes:
    """Return `plan.nc`: what is known of a flight before it.

    Args:
        parts: of the scenario.
        settings: likewise.
        origin: its provenance and its files, as `origin_of` returns them.
    """
    prepared, settings = prepare(parts, settings), settings._replace(store_every=1)
    own, times = prepared.parts, settings.dt * np.arange(settings.steps + 1)
    fixed = labelled_parts(own, settings)
    variables = {**fixed.variables, **_over_plan(prepared, times)}
    provenance = origin["provenance"]
    attributes = {
        **provenance,
        "provenance": " ".join(provenance),
        "computed_by": "flight",
        "inputs": digest_of(origin["files"]),
        # A vehicle is not its model; law.json states what is guaranteed of that.
        "guarantee": "{}",
        **fixed.attributes,
    }
    coordinates = {"time": ("time", times, {"units": "s"}), **fixed.coordinates}
    return Labelled(variables, coordinates, attributes).netcdf(group_of)


def _over_plan(prepared: Prepared, times: Array) -> Variables:
    """Return what is known of all times of the plan (T,), and of its network."""
    own, variables = prepared.parts, Variables()
    reference = sample_reference(prepared, 0, len(times))
    if reference is not None:
        variables["reference"] = (("time", "state"), reference)
    if own.formation.motion is not None:
        variables["moving_offset"] = (("time", "agent", "state"), own.formation.offsets_at(times))
    if own.world.network is not None:
        variables["forget"] = ((), own.world.network.forget, {"units": "s"})
    return variables


def root_of(place: Path) -> Path | None:
    """Return the folder of the flight that a folder is, or that its logs are of; None if none."""
    folder = place.resolve()
    some = (place, folder.parent, folder.parent.parent)
    # A folder of runs inside that of a flight is none of its logs.
    inside = place.is_dir() and (place / _FACTS).is_file() or bool(find_logs(place))
    return next((x for x in some if (x / _FACTS).is_file()), None) if inside else None


def flight_data(place: Path) -> tuple[Path, Labelled]:
    """Return `plan.nc`, and the labelled arrays of the flight in a folder.

    Args:
        place: the folder of a flight, or one of `logs` in it, which has the number of a flight.

    Raises:
        OutputError: there are no logs or those of several flights, they are of another formation,
            none can be read, or the leader's is missing.
    """
    root = root_of(place)
    assert root is not None
    found = find_logs(place)
    if not found:
        raise OutputError(f"the flight in `{place}` has no logs yet; `echelon fly` writes them.")
    if len(found) > 1:
        one, *_ = sorted(found.values())
        raise OutputError(
            f"`{place}` has the logs of {len(found)} flights; give one, such as `{one[0].parent}`."
        )
    if not (root / PLAN).is_file():
        raise OutputError(
            f"`{root}` has no `{PLAN}`, which `echelon fly SCENARIO --out FOLDER` writes; "
            "`echelon_flight.flight_log.read_log` reads a log without it."
        )
    (number, files), plan = *found.items(), read_labelled(root / PLAN)
    facts = json.loads((root / _FACTS).read_text("utf-8"))
    logs, warnings = _logs(files, facts, root)
    return root / PLAN, _Join(plan, facts, logs, number, warnings).labelled()


def _logs(files: Sequence[Path], facts: JsonObject, root: Path) -> tuple[list[LogFile], list[str]]:
    """Return the logs that can be read, and what is wrong with any."""
    logs, warnings = list[LogFile](), list[str]()
    for file in files:
        try:
            log = read_log(file)
        except FlightError as error:
            warnings.append(f"The log was left out: {error}")
            continue
        if log.header["formation"] != facts["formation"]:
            raise OutputError(
                f"`{file}` is of another formation than its folder; put it into the folder that "
                "its process flew."
            )
        agent = log.header["agent"]
        law = root / f"law-{agent}" / "law.json"
        if law.is_file() and json.loads(law.read_bytes())["sha256"]["law.py"] != log.header["law"]:
            warnings.append(f"The law of agent {agent} in `{root}` is not the one that flew.")
        logs.append(log)
        warnings += [log.warning] if log.warning else []
    return logs, warnings


class FlownTrack(NamedTuple):
    """What K ticks of one agent's law say, of all its processes in the order of time.

    Attributes:
        times: of the plan on the agent's clock, s (K,).
        x, u: states (K, n) and inputs (K, m).
        leader: whose packet it used (K,).
        heard: by sender, when letters arrived and were sent, s (L, 2).
        sent: when it sent letters, s.
        missed: how many ticks were made up for.
        last: the last tick of all, that of a descent included; None without a log.
    """

    times: Array
    x: Array
    u: Array
    leader: Array
    heard: dict[int, Array]
    sent: Array
    missed: int
    last: Tick | None


def _track(logs: Sequence[LogFile], n: int, m: int, angles: Sequence[int]) -> FlownTrack:
    every = [tick for log in sorted(logs, key=lambda x: x.header["boot"]) for tick in log.ticks]
    ticks = [tick for tick in every if tick.mode == 1 and np.isfinite(tick.u).all()]
    heard = dict[int, list[tuple[float, float]]]()
    for letter in (letter for tick in every for letter in tick.received):
        heard.setdefault(letter.sender, []).append((letter.arrived, letter.row[0]))
    x = np.array([tick.x for tick in ticks], float).reshape(-1, n)
    x[:, angles] = np.unwrap(x[:, angles], axis=0)
    return FlownTrack(
        times=np.array([tick.time for tick in ticks], float),
        x=x,
        u=np.array([tick.u for tick in ticks], float).reshape(-1, m),
        leader=np.array([tick.leader for tick in ticks], int),
        heard={sender: np.array(rows) for sender, rows in heard.items()},
        sent=np.array([tick.time for tick in every if tick.sent], float),
        missed=sum(tick.missed for tick in every),
        last=every[-1] if every else None,
    )


@final
class _Join:
    """Joins the logs of a flight on the times of its plan."""

    def __init__(
        self,
        plan: Labelled,
        facts: JsonObject,
        logs: Sequence[LogFile],
        number: int,
        warnings: list[str],
    ) -> None:
        """Read what the ticks say."""
        self.plan, self.facts, self.number, self.warnings = plan, facts, number, warnings
        self.fixed = plan.arrays()
        units, inputs = self.fixed["state_unit"].tolist(), self.fixed["input"]
        self.angles = [k for k, unit in enumerate(units) if unit == "rad"]
        own = ([x for x in logs if x.header["agent"] == k] for k in range(facts["agents"]))
        self.tracks = [_track(each, len(units), len(inputs), self.angles) for each in own]
        self.stale = max((x.header["parameters"]["stale_state"] for x in logs), default=0.0)
        self._check_tracks()
        self.frames = self._frames()
        self.times = self.fixed["time"][self.frames]
        self.rows = [np.searchsorted(x.times, self.times + 1e-9, "right") - 1 for x in self.tracks]

    def _check_tracks(self) -> None:
        leaders = np.flatnonzero(self.fixed["is_leader"])
        for k, track in enumerate(self.tracks):
            if not len(track.times):
                self.warnings.append(f"Agent {k} has no log of this flight, or it never flew.")
        if not any(len(self.tracks[k].times) for k in leaders):
            raise OutputError(
                f"flight {self.number} has no log of its leader, agent {leaders[0]}; copy the "
                "folder `logs` from its computer."
            )

    def _frames(self) -> slice:
        """Return the frames of the plan that were flown, but for a ragged start and end."""
        flown = [track.times for track in self.tracks if len(track.times)]
        starts, ends = (np.array([times[k] for times in flown]) for k in (0, -1))
        first = starts[starts <= starts.min() + self.stale].max()
        last = ends[ends >= ends.max() - self.stale].min()
        plan = self.fixed["time"]
        frames = slice(*np.searchsorted(plan, [first - 1e-9, last + 1e-9]).tolist())
        if last > plan[-1] + self.stale:
            self.warnings.append(f"What was flown after the plan, {plan[-1]:g} s, is left out.")
        if frames.stop <= frames.start:
            raise OutputError(f"flight {self.number} is shorter than a period of its law.")
        return frames

    def labelled(self) -> Labelled:
        """Return the arrays of the flight, with its report in the attributes."""
        per_agent = "time", "agent", "state"
        present = np.stack([self._present(k) for k in range(len(self.tracks))], axis=1)
        states, inputs = (np.stack([*part], axis=1) for part in zip(*map(self._at, self._all())))
        variables: Variables = {
            **self.plan.variables,
            "states": (per_agent, states),
            "inputs": (("time", "agent", "input"), inputs),
            "saturated": ("agent", self._saturated()),
            **self._ages(),
            **self._schedule(present),
        }
        for name in {"reference", "moving_offset"} & {*variables}:
            over, values, *_ = variables[name]
            variables[name] = (over, values[self.frames])
        variables |= self._tracking(states)
        coordinates = self.plan.coordinates | {"time": ("time", self.times, {"units": "s"})}
        self._compare_clocks()
        whole = Labelled(variables, coordinates, {**self.plan.attributes, **self._outcome()})
        flown = recording(whole.arrays(), whole.attributes)
        whole = whole._replace(variables=variables | {"error": (per_agent, flown.errors)})
        return whole._replace(attributes=self._with_report(whole.attributes, flown))

    def _with_report(self, attributes: JsonObject, flown: Recording) -> JsonObject:
        return attributes | {"flight_report": "\n".join(self._report(flown))}

    def _all(self) -> range:
        return range(len(self.tracks))

    def _present(self, agent: int) -> Array:
        """Return in which frames an agent's law acted (T,)."""
        times, row = self.tracks[agent].times, self.rows[agent]
        if not len(times):
            return np.zeros(len(row), bool)
        after = np.append(times[1:], times[-1] + 1e-6)
        span = after - times <= self.stale + 1e-9
        return (row >= 0) & span[row] & (self.times < after[row])

    def _at(self, agent: int) -> tuple[Array, Array]:
        """Return states (T, n), linear between ticks, and inputs (T, m), which hold, in frames."""
        track, present = self.tracks[agent], self._present(agent)
        if not len(track.times):
            shapes = (len(self.times), track.x.shape[1]), (len(self.times), track.u.shape[1])
            return np.zeros(shapes[0]), np.zeros(shapes[1])
        row = self.rows[agent].clip(0)
        between = [np.interp(self.times, track.times, column) for column in track.x.T]
        # Where an agent was lost it is shown where it was.
        states = np.where(present[:, None], np.stack(between, axis=1), track.x[row])
        return states, track.u[row]

    def _saturated(self) -> Array:
        """Return the share of its ticks in which each agent's input was at a limit (N,)."""
        if "limit_matrix" not in self.fixed:
            return np.zeros(len(self.tracks))
        matrix, low, high = (self.fixed[f"limit_{name}"] for name in ("matrix", "low", "high"))
        near = _AT_LIMIT * np.where(np.isfinite(high - low), high - low, 1.0)
        rows = [track.u @ matrix.T for track in self.tracks]
        at = [((v <= low + near) | (v >= high - near)).any(axis=1) for v in rows]
        return np.array([np.sum(each) / max(1, np.size(each)) for each in at])

    def _tracking(self, states: Array) -> Variables:
        """Return the leaders' outputs minus the reference's, where outputs are states."""
        names, outputs = self.fixed["state"].tolist(), self.fixed["output"].tolist()
        if "reference" not in self.fixed or not {*outputs} <= {*names}:
            return {}
        leaders, columns = (
            np.flatnonzero(self.fixed["is_leader"]),
            [names.index(x) for x in outputs],
        )
        goals = self.fixed["offset"][None]
        if "moving_offset" in self.fixed:
            goals = self.fixed["moving_offset"][self.frames]
        desired = self.fixed["reference"][self.frames, None] + goals[:, leaders]
        error = (states[:, leaders] - desired)[:, :, columns]
        turns = [k for k, column in enumerate(columns) if column in self.angles]
        error[:, :, turns] = (error[:, :, turns] + np.pi) % (2.0 * np.pi) - np.pi
        return {"tracking_error": (("time", "leader", "output"), error)}

    def _ages(self) -> Variables:
        """Return ages of the newest letters by the receiver's clock, and which were not used."""
        edges, heard = self.fixed["edge_agents"].astype(int), self.fixed["edge_heard"].astype(bool)
        shape = len(self.times), len(edges), 2
        ages, lost = np.full(shape, np.nan), np.zeros(shape, int)
        own = np.full((len(self.times), len(self.tracks)), np.nan)
        for e, end in np.argwhere(heard).tolist():
            receiver, sender = int(edges[e, end]), int(edges[e, 1 - end])
            letters = self.tracks[receiver].heard.get(sender, np.zeros((0, 2)))
            row = np.searchsorted(letters[:, 0], self.times + 1e-9, "right") - 1
            stamps = np.append(letters[:, 1], np.nan)
            ages[:, e, end] = self.times - stamps[row]
            own[:, receiver] = np.fmax(own[:, receiver], ages[:, e, end])
            unused = np.setdiff1d(self.tracks[sender].sent, letters[:, 1])
            frame = np.searchsorted(self.times, unused)
            np.add.at(lost[:, e, end], frame[frame < len(self.times)], 1)
        link = ("time", "edge", "end")
        return {
            "age": (("time", "agent"), own, {"units": "s"}),
            "edge_age": (link, ages, {"units": "s"}),
            "edge_lost": (link, lost),
        }

    def _schedule(self, present: Array) -> Variables:
        """Return who flew when, and after whom, where that changes."""
        nearest = np.tile(self.fixed["nearest_leader"].astype(int), (len(self.times), 1))
        if self.facts["leadership"]:
            for k, track in enumerate(self.tracks):
                if len(track.times):
                    leader = track.leader[self.rows[k].clip(0)]
                    nearest[:, k] = np.where(leader < len(self.tracks), leader, nearest[:, k])
        both = np.concatenate([present, nearest], axis=1)
        if present.all() and (nearest == nearest[0]).all():
            return {}
        first = np.append(0, 1 + np.flatnonzero((both[1:] != both[:-1]).any(axis=1)))
        starts, edges = self.times[first].copy(), self.fixed["edge_agents"].astype(int)
        starts[0] = 0.0
        over, linked = ("stretch", "agent"), present[first][:, edges].all(axis=2)
        return {
            "stretch_start": ("stretch", starts, {"units": "s"}),
            "edge_weight_then": (("stretch", "edge"), linked * self.fixed["edge_weight"]),
            "graph_period": ((), np.inf, {"units": "s"}),
            "present_then": (over, present[first].astype(np.int8)),
            "nearest_leader_then": (over, nearest[first]),
        }

    # ---- in words --------------------------------------------------------------------------------

    def _compare_clocks(self) -> None:
        """Warn of clocks that differ, by the youngest letters; no time is corrected."""
        least = {
            (k, sender): float((rows[:, 0] - rows[:, 1]).min())
            for k, track in enumerate(self.tracks)
            for sender, rows in track.heard.items()
        }
        for (k, sender), age in least.items():
            back = least.get((sender, k))
            if back is not None and k < sender and abs(age - back) > 2.0 * _APART:
                ahead, behind = (k, sender) if age > back else (sender, k)
                self.warnings.append(
                    f"By letters both ways, the clock of agent {ahead} is {abs(age - back) / 2:.3f}"
                    f" s ahead of agent {behind}'s; no time was corrected."
                )
            elif back is None and age < -_APART:
                self.warnings.append(
                    f"By its letters, the clock of agent {sender} is at least {-age:.3f} s ahead "
                    f"of agent {k}'s; no time was corrected."
                )

    def _outcome(self) -> JsonObject:
        ends = [(k, track.last) for k, track in enumerate(self.tracks) if track.last is not None]
        early = [(k, x) for k, x in ends if _fault(x) is not Fault.END]
        span = f"from {self.times[0]:.3f} to {self.times[-1]:.3f} s of its plan"
        message = (
            f"Flight {self.number}, {span}; {len(early)} of {len(self.tracks)} agents ended early."
        )
        outcome = Outcome.STOPPED if early else Outcome.COMPLETED
        return {
            "outcome": outcome.name.lower(),
            "message": message
            if early
            else f"Flight {self.number}, {span}; all agents completed it.",
            "warnings": "\n".join(self.warnings),
            "flight": str(self.number),
        }

    def _report(self, flown: Recording) -> Iterator[str]:
        """Yield the lines of the report: what the logs show, and nothing else."""
        unit = f", {flown.length_unit}" if flown.length_unit else ""
        names = ("agent", "flew, s", "ticks", "made up", f"RMS error{unit}", f"largest{unit}",
                 "at a limit, %", "oldest letter, s", "end")  # fmt: skip
        errors = flown.while_present(flown.formation_errors[:, :, None], self._all())[:, :, 0]
        rows = [names, *(self._row(k, flown, errors[:, k]) for k in self._all())]
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        for row in rows:
            yield "  ".join(x.ljust(w) for x, w in zip(row, widths, strict=True)).rstrip()
        yield f"- {flown.attributes['message']}"
        if (pair := flown.closest_pair()) is not None:
            one, other = pair.agents
            yield (
                f"- Smallest distance in the {len(flown.times)} frames: {pair.distance:.3g} m, "
                f"agents {one} and {other} at {pair.time:.4g} s."
            )
        if flown.messages is not None:
            received = sum(len(x) for track in self.tracks for x in track.heard.values())
            yield (
                f"- Letters used: {received}; sent to a neighbour and not used: "
                f"{int(flown.messages.lost.sum())}."
            )
        yield (
            "- No guarantee is stated: vehicles, radio and estimates are not the model. law.json "
            "states what is guaranteed of the model."
        )
        yield from (f"- Warning: {text}" for text in self.warnings)

    def _row(self, agent: int, flown: Recording, errors: Array) -> tuple[str, ...]:
        track = self.tracks[agent]
        if not len(track.times):
            return (str(agent), *["-"] * 7, "no log")
        some = errors[np.isfinite(errors)]
        share = 100.0 * float(flown.saturated[agent])
        ages = np.zeros(0) if flown.messages is None else flown.messages.agents[:, agent]
        ages = ages[np.isfinite(ages)]
        last = track.last
        assert last is not None
        fault = _fault(last)
        end = "the log ends in flight" if fault is Fault.NONE else fault.sentence(last.amount)
        return (
            *(str(agent), f"{track.times[0]:.3f} to {track.times[-1]:.3f}", str(len(track.times))),
            *(str(track.missed), f"{np.sqrt((some**2).mean()):.3g}" if len(some) else "-"),
            *(f"{some.max():.3g}" if len(some) else "-", f"{share:.3g}"),
            *(f"{ages.max():.3g}" if len(ages) else "-", end),
        )


def _fault(tick: Tick) -> Fault:
    return [*Fault][tick.fault]
