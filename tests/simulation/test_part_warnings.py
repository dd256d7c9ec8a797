"""Warnings of parts that are allowed and probably not intended."""

import numpy as np
import pytest

import echelon as ech
from echelon.simulation.engine.prepare import prepare

QUADROTOR, GRAPH = ech.models.Quadrotor.crazyflie(), ech.Graph.path(3)
APART = {1: (1.0, 0.0, 0.0), 2: (2.0, 0.0, 0.0)}


def warnings(offsets=APART, horizon=10.0, precision="float64", **parts):
    formation = ech.Formation.from_offsets(QUADROTOR, GRAPH, offsets)
    drive = ech.Laws(ech.laws.TrimInput(), ech.laws.TrimInput())
    given = ech.Parts(QUADROTOR, GRAPH, formation, drive, **parts)
    return prepare(given, ech.Settings(horizon, 0.1, precision=precision)).warnings


def test_goals_closer_than_two_radii_are_named_and_nothing_is_said_of_what_is_usual():
    (text,) = warnings({1: (1.0, 0.0, 0.0), 2: (1.1, 0.0, 0.0)})
    radius = QUADROTOR.radius
    assert text == (
        f"the goals of agents 1 and 2 are 0.1 m apart, and agents of radius {radius:.2g} m touch "
        f"below {2 * radius:.3g} m."
    )
    assert warnings({1: (1.0, 0.0, 0.0), 2: (1.0 + 2.01 * radius, 0.0, 0.0)}) == ()
    world = ech.World(actuator=ech.Actuator(lag=0.05))
    assert warnings(initial={"position": 1.0, "attitude": 0.3}, world=world) == ()


@pytest.mark.parametrize(("lag", "horizon", "slow"), [(30.0, 60.0, True), (2.0, 60.0, False)])
def test_a_lag_that_outlasts_the_run_is_named(lag, horizon, slow):
    world = ech.World(actuator=ech.Actuator(lag=lag))
    told = warnings(horizon=horizon, world=world)
    sentence = "the actuators need 90 s for 95 % of a command, since their lag is 30 s, and the "
    assert told == ((sentence + "horizon is 60 s.",) if slow else ())


def test_a_spread_beyond_half_a_turn_and_starts_outside_of_the_chart_are_named():
    outside, turn = warnings(initial={"attitude": 20.0})
    assert "starts with `pitch` at " in outside and "hold between -1.57 and 1.57 only." in outside
    assert turn == (
        "the initial spread of `roll`, `pitch`, `yaw` is 20 rad, and a difference of angles is at "
        "most half a turn, 3.14 rad."
    )
    assert warnings(initial={"yaw": 3.1}) == ()
    assert warnings(initial={"position": 20.0}) == ()
    state = np.zeros(12)
    state[7] = 2.0
    (text,) = warnings(initial={2: state})
    assert text.startswith("agent 2 starts with `pitch` at 2, and the equations of `Quadrotor` ")


@pytest.mark.parametrize(
    ("place", "precision", "named"),
    [(5.4e6, "float32", True), (100.0, "float32", False), (5.4e6, "float64", False)],
)
def test_coordinates_that_single_precision_does_not_resolve_are_named(place, precision, named):
    states = np.zeros((3, len(QUADROTOR.state_names)))
    states[:, 0] = place + np.arange(3)
    texts = warnings(initial=dict(enumerate(states)), precision=precision)
    assert any(text.startswith("single precision resolves 0.5 m") for text in texts) is named
