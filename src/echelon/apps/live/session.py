"""A loop in real time, what was done to it, and the latest picture for who watches."""

import json
import struct
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any, final

import numpy as np

from echelon.apps.live.choices import under
from echelon.apps.live.guarantee_status import GuaranteeStatus, lost
from echelon.apps.live.header import drawn
from echelon.apps.live.knobs import Knobs, Panel, check_choice
from echelon.apps.live.promiser import Promiser
from echelon.apps.live.swarm import LiveLoop, Picture
from echelon.core.errors import EchelonError, SimulationError
from echelon.experiments.results.foreseen import heard_in
from echelon.experiments.scenario.scenario import Scenario
from echelon.output.viewer.replay import heard_by

_PICTURE, _WORDS = 0, 1
_NOTHING = struct.pack("<I", _WORDS) + b"{}"
_TURN = 2.399963  # the golden angle, rad: kicks go all ways
_KICK_SPEED, _KICK_PLACE = 2.0, 0.5  # m/s where there is a velocity, else of the first state


@final
class Session:
    """Steps a swarm by the clock in a thread, as long as someone watches.

    Args:
        scenario: as it was given; what it holds under `live` is done again.
        panel: of its knobs.
        swarm: that runs.
    """

    def __init__(self, scenario: Scenario, panel: Panel, swarm: LiveLoop) -> None:
        """Make ready; nothing runs before `start`."""
        self.scenario, self.panel, self.swarm = scenario, panel, swarm
        self.knobs, self.paused, self.watchers, self.ended = panel.start, False, 0, False
        self.space, self.bounds = drawn(swarm, swarm.settings)
        self.todo: list[Callable[[], None]] = []
        self.events: list[dict[str, Any]] = []
        self.future = sorted((_plain(each) for each in scenario.live), key=lambda e: e["at"])
        self.frame, self.number, self.words = b"", 0, list[bytes]()
        self.changed, self.lost, self.factor = threading.Condition(), False, 1.0
        # Laws that were chosen; what is saved is saved of the first.
        self.first, self.loops = panel, {panel.law: (panel, swarm)}
        self.origin = swarm.states
        self._check()
        self.reach = GuaranteeStatus(swarm.parts.model, swarm.parts.graph, self.say_promise)
        self.promiser = Promiser(self.reach.hear)

    def _check(self) -> None:
        """Check what the scenario does live, and compile the laws that it takes.

        Raises:
            SimulationError: something cannot be done, and when.
        """
        panel = self.panel
        for event in self.future:
            try:
                panel = self._check_event(panel, event)
            except EchelonError as error:
                said = _without_place(error)
                raise SimulationError(f"`live` at {event['at']:g} s: {said}") from error

    def _check_event(self, panel: Panel, event: Mapping[str, Any]) -> Panel:
        """Check one thing that is done under the law of a panel; return that of the law then."""
        panel = self.loops[self.prepare(str(event["law"]))][0] if "law" in event else panel
        agents, n = self.swarm.states.shape
        for name, value in event.items():
            if name in ("cut", "restore"):
                self._edge(value)
            elif name in _CHOSEN:
                _CHOSEN[name](panel, panel.start, value)
            elif name == "kick":
                for agent, by in value.items():
                    if not 0 <= agent < agents or len(by) != n:
                        raise SimulationError(
                            f"`kick` got agent {agent} with {len(by)} numbers, and must be of "
                            f"agents 0 to {agents - 1} with {n}."
                        )
            elif name not in ("at", "law"):
                panel.turned(panel.start, name, value)
        return panel

    # ---- the loop -------------------------------------------------------------------------------

    def start(self) -> None:
        """Begin to step in a thread."""
        self.thread = threading.Thread(target=self._run, daemon=True)
        self.thread.start()

    def end(self) -> None:
        """Step no more, and wait for the threads, which hold XLA."""
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
                # Too late to be caught up with: the clock starts anew, and the page is told.
                due = time.perf_counter()
            time.sleep(max(0.0, -late))
            took = time.perf_counter() - before
            self.factor += 0.1 * (min(1.0, self.swarm.span / max(took, 1e-6)) - self.factor)

    def settle(self) -> None:
        """Do what was asked since the last picture, and what the scenario says is due."""
        with self.changed:
            todo, self.todo = self.todo, []
        now = self.swarm.steps * self.swarm.settings.dt
        while self.future and self.future[0]["at"] <= now + 1e-9:
            event = self.future.pop(0)
            todo.append(lambda event=event: self.apply(event))
        for act in todo:
            try:
                act()
            except EchelonError as error:
                # What could be done when it was asked, and no more, as under another law.
                self.say({"note": _without_place(error)})

    def show(self, picture: Picture) -> None:
        """Make a picture the latest one."""
        if picture.beyond.any():
            self.lost = True
            self.say({"note": lost(picture)})
            self.reach.lose()
            return
        self.reach.look(picture)
        frame = self._packed(picture)
        with self.changed:
            self.frame, self.number = frame, self.number + 1
            self.changed.notify_all()

    def _packed(self, picture: Picture) -> bytes:
        space, swarm = self.space, self.swarm
        followers = list(swarm.parts.graph.followers)
        errors = picture.errors[followers]
        loads = self._loads(picture)
        ends = (loads.max(), loads.min()) if loads.size else (np.nan, np.nan)
        goals = (picture.states[swarm.nearest] - picture.offsets[swarm.nearest]) + picture.offsets
        parts = [
            np.array([errors.max(), np.median(errors), *ends, picture.lyapunov]),
            np.array([self.factor, self.knobs.wind]),
            picture.states[:, list(space.axes)],
            goals[:, list(space.axes)],
            space.sign * picture.states[:, list(space.angles)],
            np.clip(loads, 0.0, 1.0),
        ]
        numbers = np.concatenate([part.ravel() for part in parts]).astype("<f4")
        return struct.pack("<I4xd", _PICTURE, picture.time) + numbers.tobytes()

    def _loads(self, picture: Picture) -> np.ndarray:
        """Return what motors give as parts of their limits (N, k); nothing without limits."""
        if self.bounds is None or not np.isfinite([self.bounds.low, self.bounds.high]).all():
            return np.zeros((len(picture.states), 0))
        matrix, low, high = self.bounds
        # What a limit cut is at it but for rounding.
        return np.round((picture.inputs @ matrix.T - low) / (high - low), 9)

    # ---- who watches ----------------------------------------------------------------------------

    def say(self, told: Mapping[str, Any]) -> None:
        """Tell all pages something in words."""
        block = struct.pack("<I", _WORDS) + json.dumps(told).encode()
        with self.changed:
            self.words.append(block)
            self.changed.notify_all()

    def say_promise(self, badge: Mapping[str, Any]) -> None:
        """Tell all pages what is promised."""
        self.say({"promise": badge})

    def watch(self, send: Callable[[bytes], None]) -> None:
        """Send each latest picture and all words, until sending fails or the session ends."""
        with self.changed:
            self.watchers += 1
            # The first picture has number 1, and there may be none yet.
            seen, heard = 0, len(self.words)
        # A page that comes later hears how things stand.
        self.promiser.ask(self.panel, self.knobs)
        if self.panel is not self.first:
            self.say(self._law_told())
        self.say(self.standing())
        try:
            while not self.ended:
                with self.changed:
                    self.changed.wait_for(
                        lambda: self.ended or self.number > seen or len(self.words) > heard, 1.0
                    )
                    blocks = self.words[heard:] + [self.frame] * (self.number > seen)
                    seen, heard = self.number, len(self.words)
                # A page that is gone is noticed only by what cannot be sent to it.
                for block in blocks or [_NOTHING]:
                    send(struct.pack("<I", len(block)) + block)
        finally:
            with self.changed:
                self.watchers -= 1

    def standing(self) -> dict[str, Any]:
        """Return how knobs and links stand."""
        graph = self.swarm.parts.graph
        knobs = {name: getattr(self.knobs, name) for name in self.panel.ranges}
        cut = [graph.edges[k].tolist() for k in sorted(self.knobs.cut)]
        chosen = {"law": self.panel.law, "method": self.knobs.method, "shape": self.knobs.shape}
        return {"knobs": knobs, "chosen": chosen, "cut": cut, "paused": self.paused}

    def _law_told(self) -> dict[str, Any]:
        """Return what another law brings: its knobs, and who hears whom."""
        heard = heard_by(heard_in(self.swarm.parts))
        return {"panel": self.panel.told(), "choices": self.panel.choices(), "heard": heard}

    # ---- what is done ---------------------------------------------------------------------------

    def ask(self, told: Mapping[str, Any]) -> dict[str, Any]:
        """Do what a page asks before the next picture, and return what is done.

        Raises:
            SimulationError: it is none of what can be done.
        """
        name, value = told.get("name"), told.get("value")
        if name == "save":
            return {"text": self.first.saved(self.events)}
        if name in ("pause", "reset"):
            self._later(lambda: self._pause(bool(value)) if name == "pause" else self._reset())
            return {}
        try:
            event = {name: self.prepare(str(value))} if name == "law" else None
        except EchelonError as error:
            # Asked well, and nothing that these agents can do.
            return {"fault": _without_place(error)}
        event = event or self._event(str(name), value)
        self._later(lambda: self.apply(event))
        return event

    def _later(self, act: Callable[[], None]) -> None:
        with self.changed:
            self.todo.append(act)

    def _event(self, name: str, value: Any) -> dict[str, Any]:
        if name in ("cut", "restore"):
            self._edge(value)
            return {name: [int(k) for k in value]}
        if name == "kick":
            if type(value) is not int or not 0 <= value < self.swarm.parts.graph.agents:
                raise SimulationError(f"`kick` got `{value}`, and must be the number of an agent.")
            return {"kick": {value: self._kick()}}
        if name in _CHOSEN:
            _CHOSEN[name](self.panel, self.knobs, value)
            return {name: value}
        stands = getattr(self.panel.turned(self.knobs, name, value), name)
        span = self.panel.ranges[name]
        if not span.low <= value <= span.high:
            text = f"`{name}` got {value:g}, and stands at {stands:g}, the end of its range."
            self.say({"note": text})
        return {name: stands}

    def _edge(self, pair: Any) -> int:
        graph = self.swarm.parts.graph
        for place, edge in enumerate(graph.edges.tolist()):
            turned = [] if graph.directed else edge[::-1]
            if isinstance(pair, list | tuple) and list(pair) in (edge, turned):
                return place
        # As a file writes it, which a checked scenario holds as a tuple.
        told = list(pair) if isinstance(pair, tuple) else pair
        raise SimulationError(f"`{told}` is no link of the graph.")

    def _kick(self) -> list[float]:
        """Return what a kick adds to a state: another way each time."""
        model, turn = self.swarm.parts.model, _TURN * len(self.events)
        by = np.zeros(len(model.state_names))
        velocity = [model.state_names.index(x) for x in model.state_groups.get("velocity", ())]
        where, size = (velocity, _KICK_SPEED) if velocity else (self.panel.axes or [0], _KICK_PLACE)
        way = [np.cos(turn), np.sin(turn), 0.3][: len(where)] if len(where) > 1 else [1.0]
        by[where[: len(way)]] = size * np.array(way)
        return [round(float(x), 6) for x in by]

    def apply(self, event: Mapping[str, Any]) -> None:
        """Do one thing, and note it with its time."""
        now = round(self.swarm.steps * self.swarm.settings.dt, 9)
        knobs = self.knobs
        for name, value in event.items():
            if name == "kick":
                self.reach.begin()
                for agent, by in value.items():
                    self.swarm.kick(int(agent), np.asarray(by, float))
            elif name in ("cut", "restore"):
                cut = {self._edge(value)}
                knobs = knobs._replace(cut=knobs.cut | cut if name == "cut" else knobs.cut - cut)
            elif name == "law":
                knobs = self._obey(str(value), knobs)
            elif name in _CHOSEN:
                knobs = _CHOSEN[name](self.panel, knobs, value)
            elif name != "at":
                knobs = self.panel.turned(knobs, name, value)
        # What is refused on the way is not done again by the scenario that is saved.
        self.events.append({"at": now, **{k: v for k, v in event.items() if k != "at"}})
        if knobs != self.knobs:
            self._stand(knobs)

    def _stand(self, knobs: Knobs) -> None:
        self.knobs = knobs
        self.reach.begin()
        self.swarm.turn(knobs)
        self.promiser.ask(self.panel, knobs)
        self.say(self.standing())

    def prepare(self, law: str) -> str:
        """Compile the loop under another law, while this one goes on, and return the law.

        Raises:
            EchelonError: the law does not fit these agents, or there is none of that name.
        """
        if law in self.loops:
            return law
        check_choice("law", law, self.panel.laws)
        self.say({"note": f"The law `{law}` is being compiled; the loop goes on meanwhile."})
        try:
            scenario, built = under(self.first.scenario, law)
            panel = Panel(scenario, built)
            self.loops[law] = panel, LiveLoop(*built, panel)
            # Whatever is compiled only when it is first used.
            self.loops[law][1].advance()
        finally:
            self.say({"note": ""})
        return law

    def _obey(self, law: str, knobs: Knobs) -> Knobs:
        """Go on from here under another law, whose agents remember nothing of the one before."""
        self.prepare(law)
        before, self.swarm = self.swarm, self.loops[law][1]
        self.panel = self.loops[law][0]
        self.swarm.restart(np.asarray(before.now.states, float), before.steps)
        self.reach.begin()
        self.say(self._law_told())
        kept = {name for name in self.panel.ranges if name not in ("coupling",)}
        told = {name: getattr(knobs, name) for name in {"shape", "cut", *kept}}
        return self.panel.start._replace(**told)

    def _pause(self, paused: bool) -> None:
        self.paused = paused
        self.say(self.standing())

    def _reset(self) -> None:
        """Begin again, with the knobs as they stand."""
        self.swarm.restart(self.origin)
        self.reach.restart()
        self.lost, self.events, self.future = False, [], []
        names = [name for name in (*_CHOSEN, *self.panel.ranges) if _stands(self, name)]
        told: dict[str, Any] = {} if self.panel is self.first else {"law": self.panel.law}
        told |= {name: getattr(self.knobs, name) for name in names}
        self.events += [{"at": 0.0, **told}] if told else []
        graph = self.swarm.parts.graph
        for edge in sorted(self.knobs.cut):
            self.events.append({"at": 0.0, "cut": graph.edges[edge].tolist()})
        self.say({"reset": True, "note": ""})
        self.show(self.swarm.advance(still=True))


_CHOSEN: dict[str, Callable[[Panel, Knobs, object], Knobs]] = {
    "method": Panel.with_method,
    "shape": Panel.with_shape,
}
"""What is chosen from a list, and how."""


def _stands(session: Session, name: str) -> bool:
    return getattr(session.knobs, name) != getattr(session.panel.start, name)


def _plain(spec: Any) -> dict[str, Any]:
    """Return an event of a scenario as what was noted."""
    return {name: value for name, value in spec.model_dump().items() if value is not None}


def _without_place(error: EchelonError) -> str:
    """Return what was refused without the file's name, of which there is none here."""
    return str(error).removeprefix("mapping: ")
