"""The linearization at the trim: computed once for each model and never confused between models."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from model_family import MODELS

from echelon.agents.models import ControlAffine, Linear, PlanarQuadrotor
from echelon.agents.models.linearization import (
    Linearization,
    at_trim,
    linearize,
    trim_slopes,
)
from echelon.core.numerics import precision


def slopes(model):
    """A and B by JAX's reverse mode, of f + g (u* + S v)."""
    x, u = (jnp.asarray(np.asarray(part, float)) for part in model.trim)
    S = jnp.asarray(np.asarray(model.input_scale, float))

    def velocity(x, v):
        return model.velocity(x, u + S @ v)

    return jax.jacrev(velocity, (0, 1))(x, jnp.zeros(len(u)))


@pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
def test_it_is_the_slope_of_the_motion_whatever_the_caller_s_precision(model):
    # In float32 first: what a caller without 64 bits keeps must serve the others.
    with precision("float32"):
        found = linearize(model)
    with precision("float64"):
        wanted = slopes(model)
        assert linearize(model) is found
    for got, there in zip(found, wanted, strict=True):
        assert got.dtype == np.float64 and got == pytest.approx(np.asarray(there), abs=1e-13)


@pytest.mark.parametrize("of", [lambda m: linearize(m).A, lambda m: linearize(m).B, trim_slopes])
def test_what_is_shared_cannot_be_written_to(of):
    with pytest.raises(ValueError, match="read-only"):
        of(PlanarQuadrotor())[:] = 0.0


def test_an_array_that_is_changed_in_place_is_noticed():
    model = Linear([[-1.0]], [[1.0]])
    before = linearize(model)
    model.A[0, 0] = -2.0
    assert (before.A.item(), linearize(model).A.item()) == (-1.0, -2.0)


def test_an_inner_loop_is_closed_in_the_drift_alone():
    A, B, K = np.diag([1.0, 2.0]), np.array([[0.0], [1.0]]), np.array([[3.0, 4.0]])
    linear = Linearization(A, B)
    assert linear.with_inner(None) is linear
    closed = linear.with_inner(K)
    assert closed.A.tolist() == [[1.0, 0.0], [-3.0, -2.0]] and closed.B is B


SMOOTH = {
    "pendulum": lambda x: jnp.stack([x[1], -9.81 * jnp.sin(x[0]) - 0.5 * x[1]]),
    "even": lambda x: jnp.stack([x[1], 1.0 - jnp.cos(x[0]) - 0.5 * x[1] + x[0] ** 2]),
    "cubic": lambda x: jnp.stack([x[1] * jnp.abs(x[1]), -(x[0] ** 3) + jnp.tanh(x[1])]),
    "exponential": lambda x: jnp.stack([x[1], jnp.exp(x[0]) - 1.0 - x[1] / (1.0 + x[0] ** 2)]),
}
BENT = {
    "one side": lambda x: jnp.stack([x[1], -x[0] + jnp.where(x[1] > 0.0, 6.0 * x[1], 0.0)]),
    "size": lambda x: jnp.stack([x[1], -jnp.abs(x[0]) - x[1]]),
    "slow": lambda x: 1e-4 * jnp.stack([x[1], -jnp.abs(x[0]) - x[1]]),
    "jump": lambda x: jnp.stack([x[1], -jnp.sign(x[0]) - x[1]]),
    "between axes": lambda x: jnp.stack(
        [x[1], jnp.where(x[0] * x[1] > 0.0, 6.0 * x[1], 0.0) - x[0] - x[1]]
    ),
    "lesser of both": lambda x: jnp.stack(
        [x[1], jnp.minimum(jnp.abs(x[0]), jnp.abs(x[1])) - x[0] - x[1]]
    ),
}


def in_units(drift, sizes, weigh):
    """A drift of two states whose usual deviations have these sizes, with weights that say so."""
    scale = np.asarray(sizes)

    class Scaled(ControlAffine):
        state_names, input_names = ("a", "b"), ("u",)

        def drift(self, x):
            return drift(x / scale) * scale

        def input_map(self, x):
            return jnp.zeros((2, 1), x.dtype).at[1, 0].set(scale[1])

    if weigh:
        Scaled.weights = (tuple(1.0 / scale**2), (1.0,))
    return Scaled()


@pytest.mark.parametrize("place", [0, 1])
@pytest.mark.parametrize(
    "size", [1e-8, *(pytest.param(10.0**k, marks=pytest.mark.study) for k in (-4, -2, 2, 4)), 1e8]
)
def test_a_bend_at_the_trim_is_seen_in_any_units_and_nothing_else(size, place):
    sizes = (size, 1.0) if place == 0 else (1.0, size)
    for name, drift in BENT.items():
        assert at_trim(in_units(drift, sizes, False)).kinks.any(), name
    for name, drift in SMOOTH.items():
        found = at_trim(in_units(drift, sizes, True))
        assert not found.kinks.any() and found.gap is None, name
