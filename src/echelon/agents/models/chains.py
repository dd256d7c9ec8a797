"""Flat coordinates: an agent as chains of integrators, one for each of as many outputs as inputs.

With integrators put before some inputs, the derivative y_k^(r_k) of each output is the first that
the inputs reach, y^(r) = alpha + beta w, and beta can be inverted: then feedback makes the agent
linear, and if the r_k add up to all states nothing is left out (Isidori, Nonlinear Control Systems;
of the quadrotor Mistler, Benallegue and M'Sirdi, 2001).
"""

import itertools
import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from echelon.agents.models.model import ControlAffine, FlatBound, Flattened
from echelon.core.errors import ModelError, listing
from echelon.core.memoize import memoize
from echelon.core.numerics import precision
from echelon.core.types import Array, Input, State

_SAMPLES = 16
_RANK = 1e-8
"""Relative; a singular value below is none, and a derivative below is rounding."""
_MOST, _TRIED = 4, 20
"""Integrators before all inputs together, and choices of them or of outputs, that are tried."""


class Chains(NamedTuple):
    """What makes an agent linear by feedback.

    Attributes:
        outputs: names of the m flat outputs y.
        degrees: r_k, the derivative of each that the inputs reach first.
        integrators: how many stand before each input.
        sampled: whether degrees and rank were tried at samples, and not stated by the model.
    """

    outputs: tuple[str, ...]
    degrees: tuple[int, ...]
    integrators: tuple[int, ...]
    sampled: bool

    @property
    def size(self) -> int:
        """How many integrators there are."""
        return sum(self.integrators)

    @property
    def places(self) -> tuple[tuple[int, ...], ...]:
        """Where the integrators of each input stand in their vector e."""
        ends = np.cumsum([0, *self.integrators]).tolist()
        return tuple(tuple(range(a, b)) for a, b in itertools.pairwise(ends))

    def held(self, e: jax.Array, w: Input) -> Input:
        """Return the normalized input (m,) that acts now: what integrators hold, else w."""
        return jnp.stack([e[at[0]] if at else w[k] for k, at in enumerate(self.places)])

    def rate(self, e: jax.Array, w: Input) -> jax.Array:
        """Return edot under w, which the last integrator of each input integrates."""
        parts = [w[k] if i == at[-1] else e[i + 1] for k, at in enumerate(self.places) for i in at]
        return jnp.stack(parts) if parts else e


def flat_output(model: ControlAffine, outputs: tuple[str, ...], x: State) -> jax.Array:
    """Return the flat outputs (m,) of a state."""
    return model.output(x)[np.array([model.output_names.index(name) for name in outputs])]


def flatten(model: ControlAffine, chains: Chains, x: State, e: jax.Array) -> Flattened:
    """Return the flat coordinates of a state with its integrators, and what inverts the rest."""
    known = model.flatten(x, e)
    return differentiate(model, chains, x, e) if known is None else known


def differentiate(model: ControlAffine, chains: Chains, x: State, e: jax.Array) -> Flattened:
    """Return the same by automatic differentiation alone, whatever the model knows of itself."""
    values, alphas, betas = derivatives_of(model, chains, x, e, max(chains.degrees))
    last, m = np.array(chains.degrees) - 1, np.arange(len(chains.degrees))
    alpha, beta = alphas[last, m], betas[:, last, m].T
    inside = np.arange(len(values))[:, None] <= last
    return Flattened(
        jnp.where(inside, values, 0.0), lambda tops: jnp.linalg.solve(beta, tops - alpha)
    )


def derivatives_of(
    model: ControlAffine, chains: Chains, x: State, e: jax.Array, order: int
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return y .. y^(order - 1), y' .. y^(order) at w = 0, and what each entry of w adds to these.

    Their shapes are (order, m), (order, m) and (m, order, m).
    """
    nothing = jnp.zeros(len(model.input_names), x.dtype)

    def field(x: State, e: jax.Array, w: Input) -> tuple[State, jax.Array]:
        return model.velocity(x, model.physical(chains.held(e, w))), chains.rate(e, w)

    def up_to(k: int) -> Callable[[State, jax.Array], tuple[jax.Array, ...]]:
        """Return y and its first k derivatives along the motion with w = 0."""
        if k == 0:
            return lambda x, e: (flat_output(model, chains.outputs, x),)
        lower = up_to(k - 1)

        def further(x: State, e: jax.Array) -> tuple[jax.Array, ...]:
            values, rates = jax.jvp(lower, (x, e), field(x, e, nothing))
            return (*values, rates[-1])

        return further

    def pushed(w: Input) -> tuple[jax.Array, jax.Array]:
        values, rates = jax.jvp(up_to(order - 1), (x, e), field(x, e, w))
        return jnp.stack(values), jnp.stack(rates)

    values, alphas = pushed(nothing)
    return values, alphas, jax.vmap(lambda w: pushed(w)[1] - alphas)(jnp.eye(len(nothing)))


def switch_on(model: ControlAffine, chains: Chains, x: State, ahead: jax.Array) -> jax.Array:
    """Return what the integrators hold first, so that agents begin level.

    Where the model has a bound on one flat output, those of its derivatives that the integrators
    decide are those of what the agent follows, `ahead` (r, m); else the integrators begin at the
    trim.
    """
    known = model.switch_on(x, ahead)
    e = jnp.zeros(chains.size, x.dtype)
    bound = next((b for b in model.flat_bounds or () if len(b.outputs) == 1), None)
    if known is not None or bound is None:
        return e if known is None else known
    k = chains.outputs.index(bound.outputs[0])
    for at in chains.places:
        for i, place in enumerate(at):
            order = chains.degrees[k] - len(at) + i

            def derivative(e: jax.Array) -> jax.Array:
                return flatten(model, chains, x, e).values[order, k]

            # Of e_i it is an affine function, and later ones are not in it.
            one = jnp.zeros_like(e).at[place].set(1.0)
            value, slope = jax.jvp(derivative, (e,), (one,))
            e = e + one * (ahead[order, k] - value) / slope
    return e


def check_bounds(model: ControlAffine, chains: Chains) -> None:
    """Check that each of the model's bounds is one of which something can be proved.

    Raises:
        ModelError: its outputs are no ends of chains that are alike, its derivative is the output
            itself or one that the inputs reach, or it is no number.
    """
    name, bounds = f"`{type(model).__name__}`", model.flat_bounds
    if bounds is None:
        return
    if not isinstance(bounds, tuple | list) or not all(isinstance(b, FlatBound) for b in bounds):
        raise ModelError(
            f"`flat_bounds` of {name} is {bounds!r}, and must be a tuple of `FlatBound`."
        )
    for bound in bounds:
        fault = _fault_of(bound, chains)
        if fault:
            raise ModelError(f"`flat_bounds` of {name} has a bound {fault}.")


def _fault_of(bound: FlatBound, chains: Chains) -> str:
    """Return what is wrong with a bound, in words; empty where nothing is."""
    outputs, order = bound.outputs, bound.derivative
    known = isinstance(outputs, tuple | list) and all(n in chains.outputs for n in outputs)
    if not known or len(set(outputs)) != max(1, len(outputs)):
        told = f"of {outputs!r}, and must name different outputs of the chains, "
        return told + listing(chains.outputs)
    degrees = [chains.degrees[chains.outputs.index(name)] for name in outputs]
    if len(set(degrees)) > 1:
        told = " and ".join(map(str, degrees))
        return f"of {listing(outputs)} with chains of {told} integrators, which must be alike"
    # The law bounds speeds and what follows from them, of places and of inputs nothing.
    if type(order) is not int or not 0 < order < degrees[0]:
        allowed = "none, as an input moves it at once" if degrees[0] == 1 else "1"
        allowed = f"1 to {degrees[0] - 1}" if degrees[0] > 2 else allowed
        return f"on a derivative of order {order} of {listing(outputs)}, and allowed is {allowed}"
    finite = isinstance(bound.above, int | float) and math.isfinite(bound.above)
    return "" if finite else f"above {bound.above}, which must be a finite number"


# ---- which models have them ----------------------------------------------------------------------


@memoize
def chains_of(model: ControlAffine) -> Chains:
    """Return what makes a model linear by feedback, as it states or as it is found at samples.

    Raises:
        ModelError: nothing was found; it says which output misses what.
    """
    if model.flat_chains is not None:
        outputs = model.flat_outputs or model.output_names[: len(model.input_names)]
        return Chains(tuple(outputs), *model.flat_chains, sampled=False)
    with precision("float64"):
        failures = list[str]()
        for outputs in _candidates(model):
            found = _extend(model, outputs)
            if isinstance(found, Chains):
                return found
            failures.append(found)
    raise ModelError(
        f"`{type(model).__name__}` is not made linear by feedback, as the law `stopping-point` "
        f"needs: {failures[0]}; use `consensus`, or give the model `flat_outputs` that do it."
    )


def _candidates(model: ControlAffine) -> Iterator[tuple[str, ...]]:
    """Yield choices of as many outputs as there are inputs; the model's own, where it has them."""
    m, own = len(model.input_names), tuple(model.flat_outputs)
    if len(own) == m and set(own) <= set(model.output_names):
        yield own
        return
    yield from itertools.islice(itertools.combinations(model.output_names, m), _TRIED)


def _extend(model: ControlAffine, outputs: tuple[str, ...]) -> Chains | str:
    """Return the chains of outputs behind integrators, or what is missing in words."""
    m = len(model.input_names)
    counts = [0] * m
    while True:
        found = look_for_chains(model, outputs, tuple(counts))
        if not isinstance(found, Stuck):
            return found
        # The input that alone reaches what others should reach too is made to wait for them.
        if len(found.early) != 1 or sum(counts) == _MOST:
            return found.why
        counts[found.early[0]] += 1


class Stuck(NamedTuple):
    """Why outputs with these integrators make no chains, and which inputs come too early."""

    why: str
    early: tuple[int, ...]


def look_for_chains(
    model: ControlAffine, outputs: tuple[str, ...], integrators: tuple[int, ...]
) -> Chains | Stuck | str:
    """Return the chains that outputs make at samples, or what is missing."""
    n, m = len(model.state_names) + sum(integrators), len(model.input_names)
    degrees = [0] * m
    for order in range(1, n + 1):
        for k in np.flatnonzero(_reach(model, outputs, integrators, order).any(axis=(0, 2))):
            degrees[k] = degrees[k] or order
        if all(degrees):
            break
    else:
        unmoved = listing(name for name, d in zip(outputs, degrees, strict=True) if not d)
        return f"no input reaches {unmoved} within {n} derivatives"
    rows = [_reach(model, outputs, integrators, d)[:, k] for k, d in enumerate(degrees)]
    values = np.linalg.svd(np.stack(rows, axis=1), compute_uv=False)
    rank = int((values > _RANK * values.max()).sum(axis=1).min())
    told = listing(f"{name}^({d})" for name, d in zip(outputs, degrees, strict=True))
    if rank < m:
        first = np.array(degrees) == min(degrees)
        early = np.flatnonzero(np.stack(rows, axis=1)[:, first].any(axis=(0, 1)))
        why = f"the inputs reach {told} first, and move them with rank {rank} of {m}"
        return Stuck(why, tuple(early.tolist()))
    if sum(degrees) < n:
        return f"the chains of {told} hold {sum(degrees)} of {n} states"
    return Chains(outputs, tuple(degrees), integrators, sampled=True)


@memoize
def _reach(
    model: ControlAffine, outputs: tuple[str, ...], integrators: tuple[int, ...], order: int
) -> Array:
    """Return how each input (last axis) moves the outputs' derivatives of an order, (S, m, m)."""
    chains = Chains(outputs, (order,) * len(outputs), integrators, sampled=True)
    n, draw = len(model.state_names), np.random.default_rng(0)
    x = np.asarray(model.trim[0], float) + draw.uniform(-0.5, 0.5, (_SAMPLES, n))
    e = draw.uniform(0.2, 0.8, (_SAMPLES, sum(integrators)))

    def one(x: State, e: jax.Array) -> jax.Array:
        return derivatives_of(model, chains, x, e, order)[2][:, -1].T

    found = np.asarray(jax.jit(jax.vmap(one))(jnp.asarray(x), jnp.asarray(e)))
    return np.where(np.abs(found) > _RANK * np.abs(found).max(initial=1.0), found, 0.0)
