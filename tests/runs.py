"""Helper that builds and runs a closed loop from keywords, for tests that vary one part of it."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

import echelon as ech
from echelon.core.numerics import precision
from echelon.simulation.step.meter import RunStatistics, on_host

OWN_PENDULUM = """
import jax.numpy as jnp
import echelon as ech

class Pendulum(ech.ControlAffine):
    damping: float = 0.5
    state_names = ("angle", "rate")
    input_names = ("torque",)
    def drift(self, x):
        return jnp.stack([x[1], -9.81 * jnp.sin(x[0]) - self.damping * x[1]])
    def input_map(self, x):
        return jnp.array([[0.0], [1.0]])
"""
"""A user's file with a model of their own, a pendulum."""


def run(model, graph, formation, drive, **more):
    """Simulate under a drive; settings, starts and world stand among the keywords."""
    world = ech.World(more.pop("plant", None), more.pop("disturbance", None))
    starts = {
        "initial": more.pop("initial", None),
        "start_error": more.pop("start_error", None) or {},
    }
    progress = more.pop("progress", None)
    parts = ech.Parts(model, graph, formation, drive, **starts, world=world)
    return ech.simulate(parts, ech.Settings(**more), progress)


def simulate(model, graph, formation, *, leader, follower, **more):
    return run(model, graph, formation, ech.Laws(leader, follower), **more)


def simulate_plans(model, graph, formation, *, reference=None, planning=None, **more):
    """Simulate plans replayed open loop."""
    options = {} if planning is None else {"options": planning}
    return run(model, graph, formation, ech.optimal.Plans(reference, **options), **more)


def simulate_mpc(model, graph, formation, *, reference=None, mpc=None, **more):
    """Simulate plans over a receding horizon."""
    options = {} if mpc is None else {"mpc": mpc}
    return run(model, graph, formation, ech.optimal.RecedingHorizon(reference, **options), **more)


def made_up(
    states, model, graph, offsets=None, reference=None, inputs=None, outcome=None, window=None
):
    """Return a result with the given states (T, N, n) at one-second frames, each a step."""
    states = np.asarray(states, float)
    frames, agents, n = states.shape
    shape = (frames, agents, len(model.input_names))
    inputs = np.broadcast_to(np.asarray(model.trim[1], float), shape) if inputs is None else inputs
    formation = ech.Formation(np.zeros((agents, n)) if offsets is None else offsets)
    drive = ech.Laws(ech.laws.TrimInput(), ech.laws.TrimInput())
    settings = ech.Settings(max(1.0, frames - 1.0), 1.0, steady_window=window)
    outcome = ech.Outcome.COMPLETED if outcome is None else outcome
    return ech.Result(
        times=np.arange(frames, dtype=float),
        states=states,
        inputs=inputs,
        reference=reference,
        sums=metered(
            RunStatistics.of(model, graph, formation, settings), states, inputs, reference
        ),
        outcome=outcome,
        message=outcome.value,
        warnings=(),
        parts=ech.Parts(model, graph, formation, drive),
        settings=settings,
        wall_time=0.0,
    )


def metered(meter, states, inputs, reference=None):
    """Return the sums over the steps that begin at all frames but the last."""
    with precision("float64"):
        sums, limited = on_host(meter.zero_sums()), jnp.zeros(states.shape[1], bool)
        for k in range(len(states) - 1):
            followed = None if reference is None else jnp.asarray(reference[k])
            x, u = jnp.asarray(states[k]), jnp.asarray(inputs[k])
            read = _read(meter, jnp.asarray(k), x, u, limited, limited, followed)
            sums = sums.plus(on_host(read))
    return sums


@eqx.filter_jit
def _read(meter, *moment):
    return meter.read(*moment)
