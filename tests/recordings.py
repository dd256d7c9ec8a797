"""Constructed recordings with chosen numbers, for tests of figures and pages."""

import dataclasses
import json

import numpy as np
import xarray as xr

from echelon.experiments.results.dataset import FORMAT
from echelon.experiments.results.metrics import Avoidance, Ellipsoid
from echelon.experiments.results.recording import InputBounds, LoopPoles, Recording, TrackingErrors

GUARANTEE = {
    "verdict": "guaranteed",
    "claim": "converges",
    "theorem": None,
    "kind": "linearization",
    "start": ["starts close to the goals"],
    "graphs": [],
    "premises": [],
    "notes": [],
    "numbers": {
        "rate": {"value": 0.5, "unit": "1/s", "rounding": "down"},
        "coupling": {"value": 2.0, "unit": "", "rounding": "nearest"},
    },
    "conditions": [],
    "ignores": [],
    "covers_start": None,
    "certified_set": None,
}
NAMES = ("x", "y", "z", "vx", "vy", "vz", "roll", "pitch", "yaw", "p", "q", "r")


def flown(agents=4, seconds=6.0, rate=50.0, leaders=(0,), **changes):
    """Quadrotors that spiral to their goals beside a leader on a circle; a tree by default."""
    times = np.arange(round(seconds * rate) + 1) / rate
    side = int(np.ceil(np.sqrt(agents)))
    offsets = np.zeros((agents, 12))
    offsets[:, 0], offsets[:, 1] = np.divmod(np.arange(agents), side)
    begin = np.random.default_rng(0).normal(size=(agents, 3))
    begin[list(leaders)] = 0.0
    turn = np.exp(-0.8 * times)[:, None, None]
    states = np.zeros((len(times), agents, 12))
    lead = np.stack([np.cos(times), np.sin(times), 1.5 + 0.2 * np.sin(2.0 * times)], axis=1)
    states[:, :, :3] = lead[:, None] + offsets[:, :3] + turn * begin
    states[:, :, 6:9] = 0.4 * np.sin(times)[:, None, None] * np.array([1.0, -0.5, 4.0])
    inputs = 0.3 + 0.2 * np.sin(3.0 * times)[:, None, None] * np.ones((1, agents, 4))
    return recorded(states, inputs, times, offsets, leaders=leaders, **changes)


def recorded(states, inputs, times, offsets, leaders=(0,), names=NAMES, position=(0, 1, 2), **more):
    agents = states.shape[1]
    nearest = np.array([max(k for k in leaders if k <= i) for i in range(agents)])
    y = states - offsets
    errors = y - y[:, nearest]
    inputs_count = inputs.shape[2]
    own = {
        "name": "made up",
        "model": "Quadrotor",
        "reference": None,
        "edges": np.array([[max(0, k - 2), k] for k in range(1, agents)]),
        "schedule": None,
        "state_units": tuple("m" if name in "xyz" else "" for name in names),
        "input_names": tuple(f"u{k}" for k in range(inputs_count)),
        "input_units": ("N",) * inputs_count,
        "bounds": InputBounds(np.eye(inputs_count), np.zeros(inputs_count), np.ones(inputs_count)),
        "lyapunov": 0.5 * (errors**2).sum(axis=(1, 2)),
        "lyapunov_rate": None,
        "metric": None,
        "saturated": np.zeros(agents),
        "tracking": None,
        "messages": None,
        "avoidance": None,
        "modes": LoopPoles(np.array([[-1.0 + 2.0j, -1.0 - 2.0j]]), np.array([1.0])),
        "guarantee": GUARANTEE,
        "horizon": float(times[-1]),
        "dt": 0.01,
        "attributes": {"outcome": "completed", "message": "The run reached its horizon."}
        | {"steady_window": 0.2 * float(times[-1])},
    } | more
    own.setdefault("weights", np.ones(len(own["edges"])))
    # Both ends hear each other, but for leaders.
    own.setdefault("heard", ~np.isin(own["edges"], leaders))
    return Recording(
        times=times,
        states=states,
        inputs=inputs,
        offsets=offsets,
        leaders=leaders,
        nearest=nearest,
        state_names=names,
        position=position,
        **own,
    )


def separated(run):
    """A recording of agents that keep .3 m apart, in ellipsoids three times as high as wide."""
    begins = np.arange(0.0, run.times[-1], 1.0)
    sizes = Ellipsoid(0.125, 0.375, 0.3)
    return dataclasses.replace(
        run, avoidance=Avoidance(begins, 0.3 + 0.1 * begins, 6.0 - begins, sizes)
    )


def with_errors(run, errors):
    return dataclasses.replace(run, states=errors, offsets=np.zeros_like(run.offsets))


def tracked(run):
    shrinks = np.exp(-run.times)[:, None, None] * np.ones((1, len(run.leaders), 2))
    return TrackingErrors(shrinks, ("x", "yaw"), ("m", "rad"))


def swinging(names, position, agents=3, n=2):
    """Agents whose states swing, and settle, for spaces without three axes."""
    times = np.linspace(0.0, 4.0, 101)
    states = np.exp(-times)[:, None, None] * np.ones((1, agents, n))
    states = states * np.arange(1, agents + 1)[None, :, None] + np.sin(times)[:, None, None]
    return recorded(
        states,
        np.zeros((101, agents, 1)),
        times,
        np.zeros((agents, n)),
        names=names,
        position=position,
        bounds=None,
        model="Own",
    )


def as_file(run):
    """A file of a recording, without V, limits and modes."""
    per_agent = ("time", "agent", "state")
    leads = np.isin(np.arange(run.agents), run.leaders).astype(np.int8)
    data = xr.Dataset(
        {
            "states": (per_agent, run.states),
            "error": (per_agent, run.errors),
            "inputs": (("time", "agent", "input"), run.inputs),
            "offset": (("agent", "state"), run.offsets),
            "saturated": ("agent", run.saturated),
            "is_leader": ("agent", leads),
            "nearest_leader": ("agent", run.nearest),
            "edge_agents": (("edge", "end"), run.edges),
            "edge_weight": ("edge", run.weights),
            "edge_heard": (("edge", "end"), run.heard.astype(np.int8)),
        },
        {
            "time": run.times,
            "state": list(run.state_names),
            "state_unit": ("state", list(run.state_units)),
            "input": list(run.input_names),
            "input_unit": ("input", list(run.input_units)),
        },
        {
            "model": "Own",
            "position": " ".join(run.state_names[k] for k in run.position),
            "format": FORMAT,
            "leader_needs": "nothing",
            "guarantee": json.dumps(run.guarantee),
            "horizon": run.horizon,
            "dt": run.dt,
            "outcome": "completed",
            "message": "The run reached its horizon.",
            "warnings": "",
            "computed_by": "jax",
            "provenance": "",
            "settings": json.dumps({"horizon": run.horizon, "dt": run.dt}),
        },
    )
    return bytes(data.to_netcdf(None, engine="h5netcdf"))
