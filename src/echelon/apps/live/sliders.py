"""The sliders of the live page: their ranges, labels, units and scenario keys."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from echelon.apps.live.attendance import RESHAPE
from echelon.apps.live.knobs import Knobs, LiveParts
from echelon.core.types import JsonObject
from echelon.synthesis.gains.gain import FixedGain
from echelon.synthesis.gains.riccati import Riccati


class Range(NamedTuple):
    """The values of a slider, whose scale may be logarithmic."""

    low: float
    high: float
    logarithmic: bool = False


class Slider(NamedTuple):
    """A control of one number.

    Attributes:
        label: on the page.
        unit: of the number; of the wind that of its state's rate.
        range: None if the parts have no such number.
        write: writes the scenario keys that have the effect of the knobs.
    """

    label: str
    unit: str
    range: Callable[[LiveParts], Range | None]
    write: Callable[[LiveParts, Knobs, JsonObject], None]


def _coupling_range(live: LiveParts) -> Range | None:
    c = live.start.coupling
    return None if c is None else Range(0.02 * c, 8.0 * c, True)


def _write_coupling(live: LiveParts, knobs: Knobs, data: JsonObject) -> None:
    # On another graph a method would choose another coupling, so it is written there too.
    if knobs.coupling is None or (not knobs.cut and knobs.coupling == live.start.coupling):
        return
    follower, gain = data.setdefault("follower", {}), live.parts.drive.gain
    if gain is None:
        follower["coupling"] = knobs.coupling
        return
    section = follower.setdefault("gain", {})
    if "file" in section:
        section = {"method": FixedGain.name, "P": gain.P.tolist(), "R": gain.R.tolist()}
    follower["gain"] = section | {"coupling": knobs.coupling}


def _weight_range(live: LiveParts) -> Range | None:
    gain, section = live.parts.drive.gain, (live.data().get("follower") or {}).get("gain") or {}
    computed = gain is not None and gain.method == Riccati.name and "file" not in section
    return Range(0.02, 50.0, True) if computed else None


def _write_weight(live: LiveParts, knobs: Knobs, data: JsonObject) -> None:
    gain = live.unweighted_gain(knobs)
    if knobs.weight != 1.0 and gain is not None:
        section = data.setdefault("follower", {}).setdefault("gain", {})
        section |= {"method": Riccati.name, "R": (knobs.weight * gain.R).tolist()}


def _feedforward_range(live: LiveParts) -> Range | None:
    return Range(0.0, 1.0) if str(live.parts.drive.feedforward.name) != "NONE" else None


def _write_feedforward(live: LiveParts, knobs: Knobs, data: JsonObject) -> None:
    if not knobs.feedforward:
        data.setdefault("follower", {})["feedforward"] = "none"


def _size_range(live: LiveParts) -> Range | None:
    if live.parts.formation.motion is not None:
        return None
    apart = bool(live.axes) and live.parts.formation.offsets[:, live.axes].any()
    return Range(0.3, 3.0, True) if live.shapes or apart else None


def _turn_range(live: LiveParts) -> Range | None:
    in_plane = len(live.axes) > 1 and _size_range(live) is not None
    return Range(-180.0, 180.0) if in_plane else None


def _write_formation(live: LiveParts, knobs: Knobs, data: JsonObject) -> None:
    def places(knobs: Knobs) -> JsonObject:
        offsets = live.offsets(knobs)
        agents = np.flatnonzero(offsets.any(axis=1))
        return {"offsets": {i: offsets[i, live.axes].tolist() for i in agents}}

    if knobs.reshaping is not None:
        change = {"reshape": places(knobs), "at": knobs.reshaping.at, "over": RESHAPE}
        data["formation"] = {**places(knobs.before), "motion": [change]}
    elif (knobs.size, knobs.turn, knobs.shape) != (1.0, 0.0, None):
        data["formation"] = places(knobs)


def _wind_range(live: LiveParts) -> Range | None:
    return None if live.wind_state is None else Range(-3.0, 3.0)


def _write_wind(live: LiveParts, knobs: Knobs, data: JsonObject) -> None:
    if knobs.wind and live.wind_state is not None:
        name = live.parts.model.state_names[live.wind_state]
        constant = data.setdefault("disturbance", {}).setdefault("constant", {})
        constant[name] = constant.get(name, 0.0) + knobs.wind


# ---- the world -----------------------------------------------------------------------------------


def _delay_range(live: LiveParts) -> Range | None:
    most = live.longest_delay
    return None if most is None else Range(0.0, most)


def _loss_range(live: LiveParts) -> Range | None:
    return None if live.parts.world.network is None else Range(0.0, 1.0)


def _outages_range(live: LiveParts) -> Range | None:
    return None if live.parts.world.network is None else Range(0.0, 0.9)


def _write_network(live: LiveParts, knobs: Knobs, data: JsonObject) -> None:
    now, start = ((x.delay, x.loss, x.outages) for x in (knobs, live.start))
    if live.parts.world.network is not None and now != start:
        length = live.parts.world.network.bursts.length
        data["network"] |= {"delay": knobs.delay, "loss": knobs.loss}
        data["network"]["bursts"] = {"share": knobs.outages, "length": length}


def _gusts_range(live: LiveParts) -> Range | None:
    disturbance = live.parts.world.disturbance
    return Range(0.0, 5.0) if disturbance is not None and any(disturbance.rms.values()) else None


def _write_gusts(live: LiveParts, knobs: Knobs, data: JsonObject) -> None:
    if knobs.gusts != 1.0:
        rms = data["disturbance"]["rms"]
        data["disturbance"]["rms"] = {name: knobs.gusts * x for name, x in rms.items()}


def _lag_range(live: LiveParts) -> Range | None:
    return None if live.start.lag is None else Range(0.001, 0.2, True)


def _write_lag(live: LiveParts, knobs: Knobs, data: JsonObject) -> None:
    if knobs.lag != live.start.lag:
        data["actuator"]["lag"] = knobs.lag


def _noise_range(live: LiveParts) -> Range | None:
    sensing = live.parts.world.sensing
    return Range(0.0, 10.0) if sensing is not None and any(sensing.noise.values()) else None


def _write_noise(live: LiveParts, knobs: Knobs, data: JsonObject) -> None:
    if knobs.noise != 1.0:
        noise = data["sensing"]["noise"]
        data["sensing"]["noise"] = {name: knobs.noise * x for name, x in noise.items()}


SLIDERS = {
    "coupling": Slider("coupling c", "", _coupling_range, _write_coupling),
    "weight": Slider("input weight R", "\u00d7", _weight_range, _write_weight),
    "feedforward": Slider("feed-forward", "", _feedforward_range, _write_feedforward),
    "size": Slider("formation size", "\u00d7", _size_range, _write_formation),
    "turn": Slider("formation turn", "\u00b0", _turn_range, _write_formation),
    "wind": Slider("wind", "{rate}", _wind_range, _write_wind),
    "delay": Slider("delay", "s", _delay_range, _write_network),
    "loss": Slider("messages lost", "", _loss_range, _write_network),
    "outages": Slider("links out", "", _outages_range, _write_network),
    "gusts": Slider("gusts", "\u00d7", _gusts_range, _write_gusts),
    "lag": Slider("motor lag", "s", _lag_range, _write_lag),
    "noise": Slider("noise", "\u00d7", _noise_range, _write_noise),
}
