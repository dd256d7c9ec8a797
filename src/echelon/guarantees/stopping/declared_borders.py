"""What somebody's class declares of its flat coordinates, compared with its equations (T5).

A guarantee that rests on such a declaration is one of samples: between them nobody looked.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from echelon.agents.models.airframe import Airframe
from echelon.agents.models.chains import Chains, derivatives_of, flatten
from echelon.agents.models.model import ControlAffine
from echelon.agents.models.quadrotor import Quadrotor
from echelon.core.cache import memoize
from echelon.core.compiled import compiled_for_one_call
from echelon.core.digits import about
from echelon.core.numerics import precision
from echelon.core.types import Array, Input, State

_ENDS, _ALONG = 192, 24
"""Segments from one sample, and points of each."""
_SAME = 1e-6  # relative
_NEAR = 0.3  # of angles and normalized inputs of airframes


@memoize
def border_fault(model: ControlAffine, chains: Chains) -> str:
    """Return what a model's declared chains and borders get wrong at samples; empty for nothing.

    Along segments that begin near the trim, up to where they leave the borders, the inputs must
    reach no derivative below the declared ones, and these by a matrix that is never singular: one
    whose determinant has both signs is singular between.
    """
    name = f"`{type(model).__name__}`"
    with precision("float64"):
        x, e = _segments(model, chains)
        values, early, size = map(np.asarray, _on_segments(model, chains, x, e))
    within = np.logical_and.accumulate(_is_within(model, chains, x, values), axis=1)
    if not within.any():
        return f"no sample of the states of {name} is within its `flat_bounds`"
    if (early & within).any():
        return f"the inputs of {name} reach derivatives below those that its `flat_chains` state"
    if (within & ~(size * size[:, :1] > 0.0)).any():
        return f"`flat_bounds` of {name} leave out where its inputs lose their effect"
    return ""


def _segments(model: ControlAffine, chains: Chains) -> tuple[Array, Array]:
    """Return states (K, L, n) and integrators (K, L, k) on segments from near the trim to afar."""
    draw, n = np.random.default_rng(0), len(model.state_names)
    trim = np.concatenate([np.asarray(model.trim[0], float), np.zeros(chains.size)])
    near = draw.uniform(-0.5, 0.5, (_ENDS, len(trim)))
    # As where chains are searched for: a unicycle's speed is one, and is not 0.
    near[:, n:] = draw.uniform(0.2, 0.8, (_ENDS, chains.size))
    far = 10.0 ** draw.uniform(-1.0, 1.5, (_ENDS, 1)) * draw.uniform(-1.0, 1.0, (_ENDS, len(trim)))
    shares = np.linspace(0.0, 1.0, _ALONG)[:, None]
    points = trim + (1.0 - shares) * near[:, None] + shares * far[:, None]
    return points[..., :n], points[..., n:]


@compiled_for_one_call
def _on_segments(
    model: ControlAffine, chains: Chains, x: jax.Array, e: jax.Array
) -> tuple[jax.Array, Bool[jax.Array, "K L"], Float[jax.Array, "K L"]]:
    """Return flat coordinates (K, L, r, m), whether inputs act early, and det(beta)."""
    last, m = np.array(chains.degrees) - 1, np.arange(len(chains.degrees))
    below = np.arange(max(chains.degrees))[:, None] < last

    def one(x: State, e: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        values, _, betas = derivatives_of(model, chains, x, e, max(chains.degrees))
        largest = jnp.abs(betas[:, last, m]).max()
        early = jnp.abs(jnp.where(below, betas, 0.0)).max() > _SAME * largest
        return values, early, jnp.linalg.det(betas[:, last, m])

    return jax.vmap(jax.vmap(one))(x, e)


def _is_within(model: ControlAffine, chains: Chains, x: Array, values: Array) -> Bool[Array, "K L"]:
    """Return whether points of segments are within the borders and the chart."""
    within = np.asarray(np.isfinite(values).all(axis=(2, 3)))
    for bound in model.flat_bounds or ():
        entries = values[:, :, bound.derivative, [chains.outputs.index(n) for n in bound.outputs]]
        if len(bound.outputs) == 1:
            within &= entries[..., 0] > bound.above
            continue
        within &= np.linalg.norm(entries, axis=2) > bound.above
        # What turns about between two points may have been 0 there.
        within[:, 1:] &= (entries[:, 1:] * entries[:, :-1]).sum(axis=2) > 0.0
    for name, (low, high) in model.chart.items():
        here = x[..., model.state_names.index(name)]
        within &= (low < here) & (here < high)
    return within


@memoize
def airframe_fault(model: ControlAffine, chains: Chains, frame: Airframe) -> str:
    """Return how the motors of an airframe differ from those that equations and limits move.

    The motion of a model is inverted at samples of its flat coordinates, by its own equations and
    by those of a rigid body. Empty where each motor gives the same thrust.
    """
    limits, name = model.input_limits, f"`airframe` of `{type(model).__name__}`"
    if limits is None or np.shape(limits.matrix) != (4, 4):
        return f"{name} is of four motors, and `input_limits` are not of four rows"
    if {*limits.low} != {0.0} or {*limits.high} != {frame.motor_thrust}:
        most = about(frame.motor_thrust, 4)
        return f"{name} has motors of 0 to {most} N, `input_limits` have others"
    draw, n = np.random.default_rng(0), len(model.state_names)
    x = np.asarray(model.trim[0], float) + draw.uniform(-_NEAR, _NEAR, (_ENDS, n))
    e, tops = draw.uniform(-_NEAR, _NEAR, (_ENDS, chains.size)), draw.normal(size=(_ENDS, 4))
    with precision("float64"):
        own, paths = (np.asarray(part) for part in _inverted(model, chains, x, e, tops))
        body = Quadrotor(**frame._asdict())
        flown = np.asarray(_inputs_along(body, paths))
    mine = np.sort(own @ np.asarray(limits.matrix).T)
    theirs = np.sort(flown @ np.asarray(body.input_limits.matrix).T)
    off = float(np.abs(mine - theirs).max())
    if off <= _SAME * (frame.motor_thrust + np.abs(mine).max()):
        return ""
    return f"{name} is not of its motion: at a sample a motor's thrust is {about(off)} N off"


@compiled_for_one_call
def _inverted(
    model: ControlAffine, chains: Chains, x: jax.Array, e: jax.Array, tops: jax.Array
) -> tuple[Float[jax.Array, "K m"], Float[jax.Array, "K r m"]]:
    """Return the inputs at states, and the derivatives of the outputs that they make."""
    top = np.arange(max(chains.degrees) + 1)[:, None] == np.array(chains.degrees)

    def one(x: State, e: jax.Array, tops: jax.Array) -> tuple[Input, jax.Array]:
        flat = flatten(model, chains, x, e)
        u = model.physical(chains.acting_input(e, flat.invert(tops)))
        return u, jnp.where(top, tops, jnp.pad(flat.values, ((0, 1), (0, 0))))

    return jax.vmap(one)(x, e, tops)


@compiled_for_one_call
def _inputs_along(body: Quadrotor, paths: jax.Array) -> jax.Array:
    return jax.vmap(lambda path: body.flat(path)[1])(paths)
