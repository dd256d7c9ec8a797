"""Bad input from Python: what a refusal leaves behind, and what is not bad at all.

The sentences themselves are in sentences.txt.
"""

import numpy as np
import pytest
from sentences import run

import echelon as ech
from echelon.core.errors import FormationError, SimulationError


def test_rigidity_has_no_meaning_without_a_position():
    formation = ech.Formation.from_offsets(ech.models.Pendulum(), ech.Graph.path(4), {})
    with pytest.raises(FormationError, match="has no position"):
        formation.is_rigid(ech.models.Pendulum(), ech.Graph.path(4))


def test_nothing_is_lost_by_a_refusal():
    graph, start = ech.Graph.path(2), np.array([[0.0], [np.nan]])
    with pytest.raises(SimulationError):
        run(graph=graph, initial=start)
    start[1] = 1.0
    again = run(graph=graph, initial=start)
    assert again.states[-1].tolist() == [[0.0], [1.0]]


def test_a_disturbance_that_outlasts_every_run_is_one_draw():
    winds = [ech.Disturbance(rms={"x": 1.0}, hold=hold) for hold in (1.0, 1e308)]
    short, long = (run(horizon=0.5, disturbance=wind) for wind in winds)
    assert np.array_equal(short.states, long.states)


def test_what_are_no_parts_is_refused_by_its_kind():
    for use in (lambda: ech.simulate(3, ech.Settings(1.0, 0.1)), lambda: ech.Agent(3, 0)):
        with pytest.raises(SimulationError, match="^`parts` is a `int`, and must be a `Parts`.$"):
            use()
