"""The ground station: hears every agent, starts the plan, says stop, and serves a page."""

import json
import math
import threading
import time
from collections.abc import Callable
from typing import Any, Final, final

from echelon.flight.air import Air
from echelon.flight.supervisor import Fault
from echelon.flight.wire import Drop, Report, Wire
from echelon.output.viewer.serve import Handler

_AGAIN: Final = 0.2
"""s between two commands that repeat: who restarts, or missed one, gets the next."""
_SILENT: Final = 1.0
"""s without a report, after which an agent counts as lost."""
_MODES: Final = ("ready", "flies", "descends")


@final
class Ground:
    """What the ground station knows and says; its thread ends with the process.

    Args:
        air: to the agents.
        wire: that signs for the ground.
        agents: how many there are.
        watch: called with the number of an agent and each of its reports.
    """

    def __init__(
        self,
        air: Air,
        wire: Wire,
        agents: int,
        watch: Callable[[int, Report], None] = lambda number, report: None,
    ) -> None:
        """Listen."""
        self._air, self._wire, self._agents, self._watch = air, wire, agents, watch
        self._reports = dict[int, tuple[float, Report]]()
        self._start: float | None = None
        self._stopped, self._said = False, -math.inf
        threading.Thread(target=self._run, daemon=True).start()

    def start(self, at: float) -> None:
        """Let the plan start at a time, s since 1970, once."""
        self._start = self._start or at

    def stop(self) -> None:
        """Let everybody level and descend."""
        self._stopped, self._said = True, -math.inf

    def report(self, number: int) -> Report | None:
        """Return the last report of an agent that is alive; None of one that is silent."""
        heard, report = self._reports.get(number, (-math.inf, None))
        return report if time.monotonic() - heard < _SILENT else None

    @property
    def ready(self) -> bool:
        """Whether all agents are alive, know their states, and have no fault."""
        reports = [self.report(k) for k in range(self._agents)]
        return all(x is not None and math.isfinite(x.x) and x.mode < 2 for x in reports)

    def _run(self) -> None:
        while True:
            for datagram in self._air.receive():
                opened = self._wire.open(datagram, None, time.time())
                if not isinstance(opened, Drop) and isinstance(opened.body, Report):
                    self._reports[opened.sender] = time.monotonic(), opened.body
                    self._watch(opened.sender, opened.body)
            if time.monotonic() > self._said + _AGAIN:
                self._said = time.monotonic()
                if self._start is not None and not self._stopped:
                    self._air.send(self._wire.start(time.time(), self._start))
                if self._stopped:
                    self._air.send(self._wire.stop(time.time()))
            time.sleep(0.01)

    def state(self) -> dict[str, Any]:
        """Return what the page shows."""
        return {
            "started": self._start is not None,
            "stopped": self._stopped,
            "agents": [self._row(k) for k in range(self._agents)],
            "dropped": [f"a datagram {why.value}: {n}" for why, n in self._dropped().items()],
        }

    def _dropped(self) -> dict[Drop, int]:
        # Letters are none of the ground's business: it has no time of the plan.
        return {why: n for why, n in self._wire.dropped.items() if why is not Drop.CLOCK}

    def _row(self, number: int) -> dict[str, Any]:
        heard, report = self._reports.get(number, (None, None))
        if heard is None or report is None:
            return {"agent": number, "mode": "not heard yet"}
        silent = time.monotonic() - heard
        fault = list(Fault)[report.fault] if report.fault < len(Fault) else Fault.NONE
        counts = zip(Drop, report.dropped, strict=True)
        return {
            "agent": number,
            "mode": _MODES[min(report.mode, 2)] if silent < _SILENT else "silent",
            "why": "" if fault is Fault.NONE else fault.sentence(report.amount),
            "silent": round(silent, 1),
            "time": _number(report.time, 2),
            "place": [_number(x, 2) for x in (report.x, report.y, report.z)],
            "heard": _number(report.heard, 3),
            "tick": _number(1e3 * report.tick, 2),
            "battery": _number(report.battery, 2),
            "dropped": [f"{n} {why.value}" for why, n in counts if n],
        }


def _number(value: float, digits: int) -> float | None:
    """Return a number that JSON has; None for others."""
    return round(value, digits) if math.isfinite(value) else None


def page_of(ground: Ground) -> type[Handler]:
    """Return the handler of the page of a ground station."""

    class Page(Handler):
        page = _PAGE.encode()

        def do_GET(self) -> None:
            """Send the page, or what it shows."""
            if self.path != "/state":
                super().do_GET()
            elif self.allowed():
                self.send(json.dumps(ground.state()).encode(), "application/json")

        def do_POST(self) -> None:
            """Start the plan, or stop everybody."""
            if not self.allowed():
                return
            actions = {"/start": lambda: ground.start(time.time() + 2.0), "/stop": ground.stop}
            action = actions.get(self.path)
            if action is not None:
                action()
            self.send(b"\n", "text/plain", 404 if action is None else 200)

    return Page


_PAGE: Final = """<!doctype html><html lang="en"><meta charset="utf-8"><title>Ground station</title>
<meta name="viewport" content="width=device-width">
<style>
body{font:16px/1.5 system-ui,sans-serif;margin:2em;max-width:70em}
table{border-collapse:collapse;width:100%}
th,td{text-align:left;padding:.3em .8em .3em 0;border-bottom:1px solid #ccc;vertical-align:top}
button{font:inherit;padding:.5em 1.5em;margin-right:1em}
#stop{background:#b00020;color:#fff;border:0;font-weight:bold}
.bad{color:#b00020;font-weight:bold}
</style>
<h1>Ground station</h1>
<p><button id="stop">Stop: all level and descend</button><button id="start">Start the plan</button>
<span id="note" role="status"></span></p>
<table><thead><tr><th>Agent<th>State<th>Plan, s<th>Place, m<th>Oldest letter, s<th>Tick, ms
<th>Battery<th>Dropped datagrams</tr></thead><tbody></tbody></table>
<script>
const say = text => document.getElementById("note").textContent = text;
const post = path => fetch(path, {method: "POST"}).catch(() => say("The ground station has ended."));
for (const name of ["start", "stop"])
  document.getElementById(name).onclick = () => post("/" + name);
const cell = (row, text, bad) => {
  const td = row.insertCell();
  td.textContent = text ?? "";
  if (bad) td.className = "bad";
};
async function show() {
  let state;
  try { state = await (await fetch("/state")).json(); }
  catch { return say("The ground station has ended."); }
  const body = document.querySelector("tbody");
  body.replaceChildren();
  for (const a of state.agents) {
    const row = body.insertRow(), silent = a.mode === "silent";
    cell(row, a.agent);
    cell(row, a.mode + (silent ? ` for ${a.silent} s` : "") + (a.why ? `: ${a.why}` : ""),
      silent || a.why);
    cell(row, a.time);
    cell(row, a.place?.map(x => x ?? "?").join(", "));
    cell(row, a.heard);
    cell(row, a.tick);
    cell(row, a.battery == null ? "" : Math.round(100 * a.battery) + " %");
    cell(row, a.dropped?.join("; "));
  }
  document.getElementById("start").disabled = state.started || state.stopped;
  const said = state.stopped ? "Stop was said." : state.started ? "The plan has started." : "";
  say([said, ...state.dropped].join(" "));
}
show();
setInterval(show, 500);
</script></html>"""
