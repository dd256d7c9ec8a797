"""The observer of what the model lacks: an acceleration, and the scale of the thrust."""

import dataclasses

import jax
import numpy as np
import pytest

import echelon as ech
from echelon.core.errors import EchelonError
from echelon.laws.flat_loop import Observer


def planar(observer, factor=1.0, horizon=6.0):
    """A follower in the plane behind a leader, whose mass is another one than the model says."""
    model = ech.models.PlanarQuadrotor()
    graph = ech.Graph([(0, 1)])
    drive = ech.Laws(
        ech.laws.StoppingLeader(observer=observer, reference=ech.references.Circle()),
        ech.laws.StoppingPoint(observer=observer),
    )
    parts = ech.Parts(
        model,
        graph,
        ech.Formation.from_offsets(model, graph, {1: [1.0, 0.0]}),
        drive,
        world=ech.World(plants={1: dataclasses.replace(model, mass=factor * model.mass)}),
    )
    settings = ech.Settings(horizon=horizon, dt=0.01, engine="jax")
    return ech.simulate(parts, settings)


def error(result):
    y = (result.states - result.formation.offsets)[-50:, :, :2]
    return np.linalg.norm(y[:, 1] - y[:, 0], axis=1).max()


@pytest.mark.slow
@pytest.mark.parametrize("factor", [1.25])
def test_the_scale_of_the_thrust_finds_the_mass(factor):
    pushed = error(planar(Observer(push=8.0), factor))
    scaled = error(planar(Observer(push=8.0, scale=2.0), factor))
    assert scaled < 1e-4 and scaled < 0.1 * pushed


@pytest.mark.study
def test_with_an_exact_model_the_observer_changes_nothing():
    plain = planar(False, horizon=2.0)
    for observer in (True, Observer(push=16.0), Observer(push=8.0, scale=2.0)):
        np.testing.assert_allclose(planar(observer, horizon=2.0).states, plain.states, atol=1e-7)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Observer(push=-1.0), "`push` of the observer is -1.0"),
        (lambda: Observer(push=0.0, scale=1.0), "`scale` of the observer needs its `push`"),
        (
            lambda: ech.laws.StoppingPoint(observer={"push": 8.0, "scale": 2.0}).prepared(
                ech.models.DoubleIntegrator(), ech.Graph([(0, 1)])
            ),
            "no input of `DoubleIntegrator` holds it at rest",
        ),
    ],
)
def test_an_observer_that_cannot_be_is_refused(make, message):
    with jax.enable_x64(True), pytest.raises(EchelonError, match=message):
        make()
