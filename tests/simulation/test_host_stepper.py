"""Steps with inputs that are computed on the host."""

import jax.numpy as jnp
import numpy as np

import echelon as ech
from echelon.core.numerics import precision
from echelon.simulation.engine.prepare import prepare
from echelon.simulation.optimal.drives import HostStepper


def test_no_plan_is_made_from_a_state_that_is_not_finite():
    model, graph = ech.models.SingleIntegrator(dimension=1), ech.Graph.path(2)
    laws = ech.Laws(ech.laws.TrimInput(), ech.laws.TrimInput())
    parts = ech.Parts(model, graph, ech.Formation(np.zeros((2, 1))), laws)
    seen = []

    def push(step, states):
        seen.append(states)
        return jnp.full((2, 1), 2e307)

    with precision("float64"):
        problem = prepare(parts, ech.Settings(horizon=10.0, dt=1.0)).problem
        stepper = HostStepper(problem, push, 1, lambda: None)
        chunk = stepper.advance(stepper.start(), np.ones(10, int), None)
    # Nine steps of 2e307 are beyond all numbers.
    assert len(seen) == 9 and np.isfinite(seen).all() and chunk.stopped is None
    assert np.isfinite(chunk.states).all(axis=(1, 2)).tolist() == [*[True] * 9, False]
