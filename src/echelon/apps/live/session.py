"""A live session: the loops of its laws, what pages ask for, and what they are sent."""

import json
import struct
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any, final

import numpy as np
from jaxtyping import Float

from echelon.apps.live.attendance import ROOMY, moments_of
from echelon.apps.live.guarantee_status import GuaranteeStatus, Promiser, lost
from echelon.apps.live.knobs import Knobs
from echelon.apps.live.panel import Panel, check_choice, under
from echelon.apps.live.swarm import LiveLoop, Picture
from echelon.core.errors import EchelonError, GraphError, LawError, ScenarioError, SimulationError
from echelon.core.types import Array, JsonObject
from echelon.core.words import amount
from echelon.experiments.results.recording import Recording, empty_recording
from echelon.experiments.scenario.scenario import Scenario
from echelon.output.plots.space import Space, space_of
from echelon.output.viewer.charts import distance_chart
from echelon.output.viewer.replay import header, heard_by, motor_loads
from echelon.simulation.engine.frame_numbers import ClosestPair


@final
class LoopsByLaw:
    """Loops by the followers' law, each also with agents that can be lost and join."""

    def __init__(self, panel: Panel, swarm: LiveLoop, send: Callable[[JsonObject], None]) -> None:
        self.first, self.send = panel, send
        self.ready = {(panel.law, swarm.eventful): (panel, swarm)}

    def prepare(self, law: str, eventful: bool) -> tuple[Panel, LiveLoop]:
        """Return the loop under a law with its panel, compiled if it is not yet.

        Raises:
            EchelonError: the law is unknown, or does not fit these agents.
        """
        key = law, eventful
        for usable in (key, (law, True)):
            if usable in self.ready:
                return self.ready[usable]
        check_choice("law", law, self.first.laws)
        what = "room for events" if eventful else f"the law `{law}`"
        self.send({"note": f"Compiling {what}; the loop continues meanwhile."})
        try:
            same = (panel for (name, _), (panel, _) in self.ready.items() if name == law)
            panel = next(same, None) or Panel(*under(self.first.scenario, law))
            loop = LiveLoop(*panel.experiment, panel.live, eventful)
            # The first step compiles the rest.
            loop.advance()
            self.ready[key] = panel, loop
        finally:
            self.send({"note": ""})
        return self.ready[key]


_AHEAD, _APART = 60.0, 0.1
"""Seconds of the reference that are drawn, and seconds between two places of it."""


def live_header(swarm: LiveLoop, panel: Panel, name: str, badge: JsonObject) -> JsonObject:
    """Return the header of a loop's page."""
    run = foreseen_of(swarm, name)
    space = space_of(run)
    loads = motor_loads(run, space)
    return {
        **header(run, space),
        "promise": badge,
        "stream": True,
        "knobs": panel.sliders(),
        "choices": panel.choices(),
        "lyapunov": swarm.potential is not None,
        "clock": {"start": 0.0, "step": swarm.span, "last": run.times[-1]},
        "axes": len(space.axes),
        "turns": len(space.angles),
        "loads": 0 if loads is None else loads.shape[2],
        "thrust": loads is not None,
        "path": _path(swarm, space),
        "unit": run.length_unit,
        "limited": run.loads is not None,
        "near": distance_chart(run, []) if run.ellipsoid and run.agents > 1 else None,
        "messages": swarm.parts.world.network is not None,
    }


def _path(swarm: LiveLoop, space: Space) -> list[list[float]]:
    """Return places along the reference as they are drawn; none without a reference."""
    times = swarm.first * swarm.settings.dt + np.arange(0.0, _AHEAD, _APART)
    states = swarm.reference_at(times)
    if states is None:
        return []
    places = np.zeros((len(times), 3))
    if space.kind == "time":
        places[:, :2] = np.column_stack([times, states[:, space.axes[0]]])
    else:
        places[:, : len(space.axes)] = states[:, list(space.axes)]
    places[:, :2] *= space.stretch
    return np.round(places, 4).tolist()


def foreseen_of(swarm: LiveLoop, name: str) -> Recording:
    """Return a recording with all of a loop but its frames."""
    return empty_recording(swarm.parts, swarm.settings, np.asarray(swarm.states), name)


_PICTURE, _MESSAGE = 0, 1
_EMPTY = struct.pack("<I", _MESSAGE) + b"{}"
_GOLDEN_ANGLE = 2.399963  # rad: kicks point in all directions in turn
_KICK_SPEED, _KICK_DISTANCE = 2.0, 0.5  # m/s of a velocity, else of the first position


@final
class Session:
    """A loop that runs in a thread by the clock, as long as a page watches.

    The events of the scenario's `live` section are repeated.
    """

    def __init__(self, scenario: Scenario, panel: Panel, swarm: LiveLoop) -> None:
        self.scenario, self.panel, self.swarm = scenario, panel, swarm
        self.knobs, self.paused, self.watchers, self.ended = panel.start, False, 0, False
        self.run = foreseen_of(swarm, "")
        self.space, self.bounds = space_of(self.run), self.run.bounds
        self.pending: list[Callable[[], None]] = []
        self.events: list[JsonObject] = []
        future = (spec.model_dump(exclude_none=True) for spec in scenario.live)
        self.future = sorted(future, key=lambda event: event["at"])
        self.picture, self.number, self.messages = b"", 0, list[bytes]()
        self.changed, self.lost, self.factor = threading.Condition(), False, 1.0
        self.closest: ClosestPair | None = None
        # Changes are saved for the scenario of the first law.
        self.first, self.loops = panel, LoopsByLaw(panel, swarm, self.send)
        self._check()
        model, graph = swarm.parts.model, swarm.parts.graph
        self.status = GuaranteeStatus(model, graph, lambda badge: self.send({"promise": badge}))
        self.promiser = Promiser(self.status.update)

    def _check(self) -> None:
        """Check the events of the scenario, and compile the laws that they choose."""
        panel, happened = self.panel, ()
        for event in self.future:
            try:
                if "law" in event:
                    panel = self.loops.prepare(str(event["law"]), bool(happened))[0]
                for name, value in event.items():
                    if name == "kick":
                        self._check_kick(value)
                    elif name not in ("at", "law"):
                        start = panel.start._replace(events=happened)
                        happened = panel.change(start, name, value, event["at"]).events
                if happened or "reshape" in event:
                    self.loops.prepare(panel.law, True)
            except EchelonError as error:
                message = _without_place(error)
                raise SimulationError(f"`live` at {event['at']:g} s: {message}") from error

    def _check_kick(self, kicks: Mapping[int, tuple[float, ...]]) -> None:
        agents, n = self.swarm.states.shape
        for agent, jump in kicks.items():
            if not 0 <= agent < agents or len(jump) != n:
                raise SimulationError(
                    f"`kick` got agent {agent} with {amount(len(jump), 'number')}, and "
                    f"must be of agents 0 to {agents - 1} with {n}."
                )

    # ---- the loop -------------------------------------------------------------------------------

    def start(self) -> None:
        """Start the loop in a thread."""
        self.thread = threading.Thread(target=self._run, daemon=True)
        self.thread.start()

    def end(self) -> None:
        """End the loop, and wait for its threads, which use XLA."""
        with self.changed:
            self.ended = True
            self.changed.notify_all()
        self.thread.join()
        self.promiser.end()

    def _run(self) -> None:
        self.show(self.swarm.advance(still=True))
        due = time.perf_counter()
        while not self.ended:
            before = time.perf_counter()
            self.settle()
            if self.watchers and not self.paused and not self.lost:
                self.show(self.swarm.advance())
            due += self.swarm.span
            late = time.perf_counter() - due
            if late > self.swarm.span:
                # Too late to catch up, so the clock starts anew; the page shows the factor.
                due = time.perf_counter()
            time.sleep(max(0.0, -late))
            elapsed = time.perf_counter() - before
            self.factor += 0.1 * (min(1.0, self.swarm.span / max(elapsed, 1e-6)) - self.factor)

    def settle(self) -> None:
        """Apply the changes since the last picture, and the events of the scenario that are due."""
        with self.changed:
            pending, self.pending = self.pending, []
        now = self.swarm.steps * self.swarm.settings.dt
        under_way = self.knobs.reshaping
        if under_way is not None and under_way.end <= now:
            pending.insert(0, lambda: self._set(self.knobs._replace(reshaping=None)))
        while self.future and self.future[0]["at"] <= now + 1e-9:
            event = self.future.pop(0)
            pending.append(lambda event=event: self.apply(event))
        for action in pending:
            try:
                action()
            except EchelonError as error:
                # Possible when it was requested, and no longer, as under another law.
                self.send({"note": _without_place(error)})

    def show(self, picture: Picture) -> None:
        """Make a picture the latest one."""
        if picture.beyond.any():
            self.lost = True
            self.send({"note": lost(picture)})
            self.status.lose()
            return
        self.status.look(picture)
        block = self._packed(picture, self._closest_now(picture))
        with self.changed:
            self.picture, self.number = block, self.number + 1
            self.changed.notify_all()

    def _closest_now(self, picture: Picture) -> ClosestPair | None:
        """Return the closest two agents, and remember the closest so far."""
        axes = self.panel.live.axes
        here = np.arange(len(picture.states)) if picture.here is None else picture.here.nonzero()[0]
        if not axes or len(here) < 2:
            return None
        pair = ClosestPair.of(picture.states[here][:, axes] * self.run.scales, picture.time)
        pair = pair._replace(agents=tuple(here[list(pair.agents)].tolist()))
        if self.closest is None or pair.distance < self.closest.distance:
            self.closest = pair
        return pair

    def _packed(self, picture: Picture, now: ClosestPair | None) -> bytes:
        space, swarm, pair = self.space, self.swarm, self.closest
        here = np.ones(len(picture.states), bool) if picture.here is None else picture.here
        followers = [k for k in swarm.parts.graph.followers if here[k]]
        errors = picture.errors[followers] if followers else np.full(1, np.nan)
        loads = self._loads(picture)
        places = np.where(here[:, None], picture.states[:, list(space.axes)], np.nan)
        ends = (loads[here].max(), loads[here].min()) if loads.size else (np.nan, np.nan)
        goals = swarm.goals(picture)
        parts = [
            np.array([errors.max(), np.median(errors), swarm.off_reference(picture)]),
            np.array([*ends, picture.lyapunov, self.factor, self.knobs.wind]),
            np.array([np.nan if now is None else now.distance, swarm.active]),
            np.array(4 * [np.nan] if pair is None else [pair.time, pair.distance, *pair.agents]),
            places,
            goals[:, list(space.axes)],
            space.sign * picture.states[:, list(space.angles)],
            np.clip(loads, 0.0, 1.0),
            picture.shades,
        ]
        numbers = np.concatenate([part.ravel() for part in parts]).astype("<f4")
        return struct.pack("<I4xd", _PICTURE, picture.time) + numbers.tobytes()

    def _loads(self, picture: Picture) -> Float[Array, "N k"]:
        """Return the loads of motors as fractions of their limits; no columns without limits."""
        loads = None if self.bounds is None else self.bounds.loads(picture.inputs)
        if loads is None:
            return np.zeros((len(picture.states), 0))
        # A saturated motor is at its limit but for rounding.
        return np.round(loads, 9)

    # ---- pages ----------------------------------------------------------------------------------

    def send(self, message: JsonObject) -> None:
        """Send a message to all pages."""
        block = struct.pack("<I", _MESSAGE) + json.dumps(message).encode()
        with self.changed:
            self.messages.append(block)
            self.changed.notify_all()

    def watch(self, write: Callable[[bytes], None]) -> None:
        """Write each latest picture and all messages, until that fails or the session ends."""
        with self.changed:
            self.watchers += 1
            # The first picture has number 1, and there may be none yet.
            number, count = 0, len(self.messages)
        # A page that opens later needs the present state.
        self.promiser.ask(self.panel, self.knobs)
        if self.panel is not self.first:
            self.send(self._panel_message())
        self.send(self.state())
        try:
            while not self.ended:
                with self.changed:
                    self.changed.wait_for(
                        lambda: self.ended or self.number > number or len(self.messages) > count,
                        1.0,
                    )
                    blocks = self.messages[count:] + [self.picture] * (self.number > number)
                    number, count = self.number, len(self.messages)
                # A closed page is noticed only when writing to it fails.
                for block in blocks or [_EMPTY]:
                    write(struct.pack("<I", len(block)) + block)
        finally:
            with self.changed:
                self.watchers -= 1

    def state(self) -> JsonObject:
        """Return the positions of all controls."""
        graph = self.swarm.parts.graph
        knobs = {name: getattr(self.knobs, name) for name in self.panel.ranges}
        cut = [graph.edges[k].tolist() for k in sorted(self.knobs.cut)]
        chosen = {"law": self.panel.law, "method": self.knobs.method, "shape": self.knobs.shape}
        state = {"knobs": knobs, "chosen": chosen, "cut": cut, "paused": self.paused}
        moments = moments_of(self.knobs.events, self.events)
        return {**state, "moments": moments, "nearest": self.swarm.nearest.tolist()}

    def _panel_message(self) -> JsonObject:
        panel, heard = self.panel, heard_by(self.swarm.parts.receives)
        return {"panel": panel.sliders(), "choices": panel.choices(), "heard": heard}

    # ---- changes --------------------------------------------------------------------------------

    def ask(self, request: JsonObject) -> JsonObject:
        """Apply the request of a page before the next picture, and return the event.

        Raises:
            SimulationError: the request is not possible.
        """
        name, value = request.get("name"), request.get("value")
        if name == "save":
            text = "A scenario begins at 0 s, so a continued run is not saved as one."
            return {"fault": text} if self.swarm.first else {"text": self.first.saved(self.events)}
        if name in ("pause", "reset"):
            self._later(lambda: self._pause(bool(value)) if name == "pause" else self._reset())
            return {}
        try:
            if name == "law":
                event = {name: self.loops.prepare(str(value), self.knobs.roomy)[0].law}
            else:
                event = self._event(str(name), value)
                if name in ROOMY:
                    self.loops.prepare(self.panel.law, True)
        except (ScenarioError, GraphError, LawError, SimulationError) as error:
            if name not in ("law", *ROOMY):
                raise
            # A valid request, but it is not possible for these agents.
            return {"fault": _without_place(error)}
        self._later(lambda: self.apply(event))
        return event

    def _later(self, action: Callable[[], None]) -> None:
        with self.changed:
            self.pending.append(action)

    def _event(self, name: str, value: Any) -> JsonObject:
        if name == "kick":
            if type(value) is not int or not 0 <= value < self.swarm.parts.graph.agents:
                raise SimulationError(f"`kick` got `{value}`, and must be the number of an agent.")
            return {"kick": {value: self._kick()}}
        now = self.swarm.steps * self.swarm.settings.dt
        knobs = self.panel.change(self.knobs, name, value, now)
        if name not in self.panel.ranges:
            return {name: list(map(int, value)) if name in ("cut", "restore") else value}
        clamped, span = getattr(knobs, name), self.panel.ranges[name]
        if not span.low <= value <= span.high:
            limits = f"must be from {span.low:g} to {span.high:g}"
            self.send({"note": f"`{name}` got {value:g}, {limits}, and is now {clamped:g}."})
        return {name: clamped}

    def _kick(self) -> list[float]:
        """Return the jump of a state, in another direction each time."""
        model, angle = self.swarm.parts.model, _GOLDEN_ANGLE * len(self.events)
        jump = np.zeros(len(model.state_names))
        axes, size = self.panel.live.axes or [0], _KICK_DISTANCE
        velocity = [model.state_names.index(x) for x in model.state_groups.get("velocity", ())]
        if velocity:
            axes, size = velocity, _KICK_SPEED
        direction = [np.cos(angle), np.sin(angle), 0.3][: len(axes)] if len(axes) > 1 else [1.0]
        jump[axes[: len(direction)]] = size * np.array(direction)
        return [round(float(x), 6) for x in jump]

    def apply(self, event: JsonObject) -> None:
        """Apply an event, and record it with its time."""
        now = round(self.swarm.steps * self.swarm.settings.dt, 9)
        knobs = self.knobs
        for name, value in event.items():
            if name == "kick":
                self.status.begin()
                for agent, jump in value.items():
                    self.swarm.kick(int(agent), np.asarray(jump, float))
            elif name == "law":
                knobs = self._switch_law(str(value), knobs)
            elif name != "at":
                knobs = self.panel.change(knobs, name, value, now)
                if name in ROOMY:
                    self._make_room()
        # After the changes, so that a refused event is not saved.
        self.events.append({"at": now, **{k: v for k, v in event.items() if k != "at"}})
        if knobs != self.knobs:
            self._set(knobs)

    def _set(self, knobs: Knobs) -> None:
        self.knobs = knobs
        self.status.begin()
        self.swarm.apply(knobs)
        self.promiser.ask(self.panel, knobs)
        self.send(self.state())

    def _make_room(self) -> None:
        """Continue from here in the loop in which agents can be lost and join."""
        before = self.swarm
        self.panel, self.swarm = self.loops.prepare(self.panel.law, True)
        if self.swarm is not before:
            self.swarm.states, self.swarm.first = before.states, before.first
            self.swarm.take_over(before)

    def _switch_law(self, law: str, knobs: Knobs) -> Knobs:
        """Continue from here under another law, with its initial memory."""
        before = self.swarm
        self.panel, self.swarm = self.loops.prepare(law, knobs.roomy)
        self.swarm.states, self.swarm.first = before.states, before.first
        self.swarm.proceed(np.asarray(before.now.states, float), before.steps)
        self.status.begin()
        self.send(self._panel_message())
        names = {"shape", "cut", "events", "reshaping", *self.panel.ranges} - {"coupling"}
        return self.panel.start._replace(**{name: getattr(knobs, name) for name in names})

    def _pause(self, paused: bool) -> None:
        self.paused = paused
        self.send(self.state())

    def _reset(self) -> None:
        # At the start nobody has been lost.
        self.knobs = self.knobs._replace(events=(), reshaping=None)
        self.swarm.apply(self.knobs)
        self.swarm.restart()
        self.status.restart()
        self.closest = None
        self.lost, self.events, self.future = False, [], []
        start: JsonObject = {} if self.panel is self.first else {"law": self.panel.law}
        for name in ("method", "shape", *self.panel.ranges):
            if getattr(self.knobs, name) != getattr(self.panel.start, name):
                start[name] = getattr(self.knobs, name)
        self.events += [{"at": 0.0, **start}] if start else []
        graph = self.swarm.parts.graph
        for edge in sorted(self.knobs.cut):
            self.events.append({"at": 0.0, "cut": graph.edges[edge].tolist()})
        self.send({"reset": True, "note": "", **self.state()})
        self.show(self.swarm.advance(still=True))


def _without_place(error: EchelonError) -> str:
    """Return the message without a file's name, of which there is none here."""
    return str(error).removeprefix("mapping: ")
