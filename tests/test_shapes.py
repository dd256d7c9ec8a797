"""The import hook of tests/shapes.py finds values whose shapes are not the declared ones."""

import jax.numpy as jnp
import pytest

from echelon.agents.models import DoubleIntegrator


def test_a_state_of_another_shape_is_noticed():
    model = DoubleIntegrator()
    assert model.difference(jnp.ones(4), jnp.zeros(4)).shape == (4,)
    with pytest.raises(TypeError, match="Type-check error"):
        model.difference(jnp.ones((4, 1)), jnp.zeros((4, 1)))
    # Letters hold for a whole call.
    with pytest.raises(TypeError, match="Type-check error"):
        model.difference(jnp.ones(4), jnp.zeros(3))
