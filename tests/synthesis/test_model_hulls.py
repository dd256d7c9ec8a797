"""Hulls of the slopes of a bundled model: what it contains, and what a user is told."""

import math

import numpy as np
import pytest
from hull_checks import about_zero, assert_supported, points_of, values

from echelon.agents.models import Quadrotor
from echelon.synthesis.certificates.jacobians import model_jacobian, velocity_of
from echelon_ranges import RangeError, slope_hull, value_hull


def test_the_hull_of_a_quadrotor_s_slopes_is_that_of_its_jacobians_and_holds_them():
    model = Quadrotor.crazyflie()
    jacobian, states = model_jacobian(model), about_zero(*[0] * 6, 0.5, 0.4, 0.3, 0, 0, 1)
    inputs = about_zero(3, 0, 0, 0)
    hull, found = (
        value_hull(jacobian, states, inputs),
        slope_hull(velocity_of(model), states, inputs),
    )
    np.testing.assert_array_equal(found.vertices, hull.vertices)
    np.testing.assert_array_equal(found.error, hull.error)
    assert_supported(hull, values(jacobian, states, inputs, points_of(states, inputs, seed=1)))
    assert len(hull.vertices) == 1536


@pytest.mark.parametrize("pitch", [math.pi / 2, 1.6])
def test_the_edge_of_the_chart_is_named(pitch):
    model = Quadrotor.crazyflie()
    box = about_zero(*[0] * 6, 0.1, pitch, 0, 0, 0, 0)
    with pytest.raises(RangeError) as caught:
        value_hull(
            model_jacobian(model),
            box,
            about_zero(0, 0, 0, 0),
            model.state_names + model.input_names,
        )
    low = 6.12323e-17 if pitch == math.pi / 2 else -0.0291995
    assert str(caught.value) == (
        "the model divides by an expression of `pitch`, which may be anything in "
        f"[{low:g}, 1] on the domain, and must keep well away from 0; make the domain smaller."
    )
