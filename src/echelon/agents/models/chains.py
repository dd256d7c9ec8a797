"""Flat coordinates: an agent as chains of integrators, one chain for each flat output.

There are as many flat outputs as inputs. With integrators before some inputs, y_k^(r_k) is the
first derivative of each output that the inputs reach, y^(r) = alpha + beta w. Where beta is
invertible, feedback makes the agent linear, and if the r_k add up to the number of states, no
dynamics remain hidden (Isidori, Nonlinear Control Systems; for the quadrotor Mistler, Benallegue
and M'Sirdi, 2001).
"""

import itertools
import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from echelon.agents.models.declarations import is_by_user, undeclared
from echelon.agents.models.model import ControlAffine, FlatBound, FlatCoordinates
from echelon.core.cache import memoize
from echelon.core.errors import ModelError, listing
from echelon.core.numerics import precision
from echelon.core.types import Array, Input, State

_SAMPLES = 16
_RANK = 1e-8
"""Relative threshold of singular values and derivatives; what is smaller is rounding."""
_MATCHED = 1e-6
"""Relative; what rounding leaves between rates and what they are stated to be."""
_ANGLE = 1e-9
"""rad; what rounding leaves of a whole turn."""
_MAX_INTEGRATORS = 4
_MAX_CHOICES = 20
"""How many sets of outputs are tried."""


DECLARED = ("flat_chains", "flat_bounds", "to_flat", "initial_integrators")
"""What a model may declare of its flat coordinates."""


class Chains(NamedTuple):
    """The chains of integrators that feedback makes of an agent.

    Attributes:
        outputs: names of the m flat outputs y.
        degrees: r_k, the first derivative of each output that the inputs reach.
        integrators: number of integrators before each input.
        declared: which of `DECLARED` the model declares of its own motion; without `flat_chains`
            degrees and rank were computed at samples, or are those of another motion.
    """

    outputs: tuple[str, ...]
    degrees: tuple[int, ...]
    integrators: tuple[int, ...]
    declared: tuple[str, ...] = ()

    @property
    def size(self) -> int:
        """Total number of integrators."""
        return sum(self.integrators)

    @property
    def indices(self) -> tuple[tuple[int, ...], ...]:
        """Indices of the integrators of each input in the vector e of all."""
        ends = np.cumsum([0, *self.integrators]).tolist()
        return tuple(tuple(range(a, b)) for a, b in itertools.pairwise(ends))

    def acting_input(self, e: Float[jax.Array, " k"], w: Input) -> Input:
        """Return the normalized input that acts: integrator states where there are some, else w."""
        return jnp.stack([e[at[0]] if at else w[k] for k, at in enumerate(self.indices)])

    def rate(self, e: Float[jax.Array, " k"], w: Input) -> Float[jax.Array, " k"]:
        """Return edot under w, which the last integrator of each input integrates."""
        parts = [w[k] if i == at[-1] else e[i + 1] for k, at in enumerate(self.indices) for i in at]
        return jnp.stack(parts) if parts else e


def flat_output(model: ControlAffine, outputs: tuple[str, ...], x: State) -> jax.Array:
    """Return the flat outputs (m,) of a state."""
    return model.output(x)[np.array([model.output_names.index(name) for name in outputs])]


@memoize
def angles_among(model: ControlAffine, outputs: tuple[str, ...]) -> tuple[int, ...]:
    """Return which flat outputs are angles: states whose `difference` is 0 after a whole turn."""
    with precision("float64"):
        x = jnp.asarray(np.asarray(model.trim[0], float))
        found = list[int]()
        for k, name in enumerate(outputs):
            if name not in model.state_names:
                continue
            i = model.state_names.index(name)
            turned = x.at[i].add(2.0 * np.pi)
            moved = flat_output(model, outputs, turned) - flat_output(model, outputs, x)
            alone = np.abs(moved - 2.0 * np.pi * np.eye(len(outputs))[k]).max() < _ANGLE
            if alone and abs(float(model.difference(turned, x)[i])) < _ANGLE:
                found.append(k)
    return tuple(found)


def to_flat(
    model: ControlAffine, chains: Chains, x: State, e: Float[jax.Array, " k"]
) -> FlatCoordinates:
    """Return the flat coordinates of a state with its integrators, and the inverse for inputs."""
    stated = model.to_flat(x, e) if "to_flat" in chains.declared else None
    return differentiate(model, chains, x, e) if stated is None else stated


def differentiate(model: ControlAffine, chains: Chains, x: State, e: jax.Array) -> FlatCoordinates:
    """Return the same by automatic differentiation, without the model's own `to_flat`."""
    values, alphas, betas = derivatives_of(model, chains, x, e, max(chains.degrees))
    last, m = np.array(chains.degrees) - 1, np.arange(len(chains.degrees))
    alpha, beta = alphas[last, m], betas[:, last, m].T
    inside = np.arange(len(values))[:, None] <= last
    return FlatCoordinates(
        jnp.where(inside, values, 0.0), lambda tops: jnp.linalg.solve(beta, tops - alpha)
    )


def derivatives_of(
    model: ControlAffine, chains: Chains, x: State, e: jax.Array, order: int
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return y .. y^(order - 1), y' .. y^(order) at w = 0, both (order, m); d/dw (m, order, m)."""
    zero = jnp.zeros(len(model.input_names), x.dtype)

    def field(x: State, e: jax.Array, w: Input) -> tuple[State, jax.Array]:
        return model.velocity(x, model.physical(chains.acting_input(e, w))), chains.rate(e, w)

    def up_to(k: int) -> Callable[[State, jax.Array], tuple[jax.Array, ...]]:
        """Return y and its first k derivatives along the motion with w = 0."""
        if k == 0:
            return lambda x, e: (flat_output(model, chains.outputs, x),)
        lower = up_to(k - 1)

        def further(x: State, e: jax.Array) -> tuple[jax.Array, ...]:
            values, rates = jax.jvp(lower, (x, e), field(x, e, zero))
            return (*values, rates[-1])

        return further

    def at_input(w: Input) -> tuple[jax.Array, jax.Array]:
        values, rates = jax.jvp(up_to(order - 1), (x, e), field(x, e, w))
        return jnp.stack(values), jnp.stack(rates)

    values, alphas = at_input(zero)
    return values, alphas, jax.vmap(lambda w: at_input(w)[1] - alphas)(jnp.eye(len(zero)))


def initial_integrators(
    model: ControlAffine, chains: Chains, x: State, ahead: jax.Array
) -> jax.Array:
    """Return the initial states of the integrators, with which agents start level.

    Where the model bounds a derivative of a single flat output, the integrators start so that its
    derivatives are those of the path to follow, `ahead` (r, m); else they start at the trim.
    """
    stated = (
        model.initial_integrators(x, ahead) if "initial_integrators" in chains.declared else None
    )
    e = jnp.zeros(chains.size, x.dtype)
    bound = next((b for b in model.flat_bounds or () if len(b.outputs) == 1), None)
    if stated is not None or bound is None:
        return e if stated is None else stated
    k = chains.outputs.index(bound.outputs[0])
    for indices in chains.indices:
        for i, index in enumerate(indices):
            order = chains.degrees[k] - len(indices) + i

            def derivative(e: jax.Array) -> jax.Array:
                return to_flat(model, chains, x, e).values[order, k]

            # It is an affine function of e_i, and does not depend on later ones.
            one = jnp.zeros_like(e).at[index].set(1.0)
            value, slope = jax.jvp(derivative, (e,), (one,))
            e = e + one * (ahead[order, k] - value) / slope
    return e


def check_bounds(model: ControlAffine, chains: Chains) -> None:
    """Raise `ModelError` unless each flat bound of a model has a form for which proofs exist."""
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
    outputs, order = bound.outputs, bound.derivative
    named = isinstance(outputs, tuple | list) and all(n in chains.outputs for n in outputs)
    if not named or len(set(outputs)) != max(1, len(outputs)):
        allowed = listing(chains.outputs)
        return f"of {outputs!r}, and must name different outputs of the chains, {allowed}"
    degrees = [chains.degrees[chains.outputs.index(name)] for name in outputs]
    if len(set(degrees)) > 1:
        lengths = " and ".join(map(str, degrees))
        return f"of {listing(outputs)} with chains of {lengths} integrators, which must be equal"
    # The law bounds speeds and higher derivatives; it bounds neither positions nor inputs.
    if type(order) is not int or not 0 < order < degrees[0]:
        allowed = "none, since an input moves it directly" if degrees[0] == 1 else "1"
        allowed = f"1 to {degrees[0] - 1}" if degrees[0] > 2 else allowed
        return f"on a derivative of order {order} of {listing(outputs)}, and allowed is {allowed}"
    finite = isinstance(bound.above, int | float) and math.isfinite(bound.above)
    return "" if finite else f"above {bound.above}, which must be a finite number"


# ---- the chains of a model ----------------------------------------------------------------------


def declared_of(model: ControlAffine) -> tuple[str, ...]:
    """Return what a model declares of the flat coordinates of its own motion."""
    others = undeclared(model, *DECLARED)
    return tuple(name for name in DECLARED if name not in others)


@memoize
def chains_of(model: ControlAffine) -> Chains:
    """Return the chains of a model, as it states them or as computed at samples.

    Raises:
        ModelError: no chains were found, and the message names the condition that fails; or what
            the model declares of them does not fit its equations.
    """
    if model.flat_chains is not None:
        outputs = model.flat_outputs or model.output_names[: len(model.input_names)]
        chains = Chains(tuple(outputs), *model.flat_chains, declared_of(model))
        _check_size(model, chains)
        _check_map(model, chains)
        return chains
    with precision("float64"):
        failures = list[str]()
        for outputs in _candidates(model):
            chains = _extend(model, outputs)
            if isinstance(chains, Chains):
                return chains._replace(declared=declared_of(model))
            failures.append(chains)
    raise ModelError(
        f"`{type(model).__name__}` is not linearized by feedback, which the law `stopping-point` "
        f"needs: {failures[0]}; use `consensus`, or add suitable `flat_outputs` to the model."
    )


def _check_size(model: ControlAffine, chains: Chains) -> None:
    """Check that declared chains hold all states, so that no dynamics remain hidden."""
    n, m = len(model.state_names) + chains.size, len(model.input_names)
    each = {len(chains.outputs), len(chains.degrees), len(chains.integrators)}
    if each != {m} or sum(chains.degrees) != n:
        raise ModelError(
            f"`flat_chains` of `{type(model).__name__}` are {listing(chains.outputs)} with "
            f"{sum(chains.degrees)} integrators in all, and must be {m} chains, one for each "
            f"input, with {n}: the states and the integrators before inputs."
        )


def _check_map(model: ControlAffine, chains: Chains) -> None:
    if "to_flat" not in chains.declared or not is_by_user(model, "to_flat"):
        return
    n, m, draw = len(model.state_names), len(chains.outputs), np.random.default_rng(0)
    x = np.asarray(model.trim[0], float) + draw.uniform(-0.5, 0.5, (_SAMPLES, n))
    e, tops = draw.uniform(0.2, 0.8, (_SAMPLES, chains.size)), draw.normal(size=(_SAMPLES, m))
    with precision("float64"):
        moved, stated = jax.jit(jax.vmap(lambda *at: _rates_by_map(model, chains, *at)))(x, e, tops)
    off = np.abs(np.asarray(moved - stated)).max() / (1.0 + np.abs(np.asarray(moved)).max())
    if not off <= _MATCHED:
        raise ModelError(
            f"`to_flat` of `{type(model).__name__}` is not of its motion: its values and what they "
            f"change by under `invert` differ by {100.0 * float(off):.3g} % at samples."
        )


def _rates_by_map(
    model: ControlAffine, chains: Chains, x: State, e: jax.Array, tops: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Return outputs and the rates of flat coordinates, and the same as `to_flat` states them."""
    last = np.arange(max(chains.degrees))[:, None] == np.array(chains.degrees) - 1
    w = model.to_flat(x, e).invert(tops)  # pyright: ignore
    field = model.velocity(x, model.physical(chains.acting_input(e, w))), chains.rate(e, w)
    values, rates = jax.jvp(lambda x, e: model.to_flat(x, e).values, (x, e), field)  # pyright: ignore
    after = jnp.where(last, tops, jnp.concatenate([values[1:], 0.0 * values[:1]]))
    outputs = flat_output(model, chains.outputs, x)
    return jnp.concatenate([outputs[None], rates]), jnp.concatenate([values[:1], after])


def _candidates(model: ControlAffine) -> Iterator[tuple[str, ...]]:
    """Yield sets of as many outputs as inputs; only the model's flat outputs where it has them."""
    m, stated = len(model.input_names), tuple(model.flat_outputs)
    if len(stated) == m and set(stated) <= set(model.output_names):
        yield stated
        return
    yield from itertools.islice(itertools.combinations(model.output_names, m), _MAX_CHOICES)


def _extend(model: ControlAffine, outputs: tuple[str, ...]) -> Chains | str:
    """Return the chains of outputs, with integrators added, or the missing condition in words."""
    m = len(model.input_names)
    counts = [0] * m
    while True:
        result = look_for_chains(model, outputs, tuple(counts))
        if not isinstance(result, RankLoss):
            return result
        # An input that alone reaches low derivatives is delayed until the others reach them too.
        if len(result.early) != 1 or sum(counts) == _MAX_INTEGRATORS:
            return result.why
        counts[result.early[0]] += 1


class RankLoss(NamedTuple):
    """Why outputs with these integrators make no chains, and which inputs reach them too early."""

    why: str
    early: tuple[int, ...]


def look_for_chains(
    model: ControlAffine, outputs: tuple[str, ...], integrators: tuple[int, ...]
) -> Chains | RankLoss | str:
    """Return the chains of outputs at samples, or the condition that fails."""
    n, m = len(model.state_names) + sum(integrators), len(model.input_names)
    degrees = [0] * m
    for order in range(1, n + 1):
        for k in np.flatnonzero(_reach(model, outputs, integrators, order).any(axis=(0, 2))):
            degrees[k] = degrees[k] or order
        if all(degrees):
            break
    else:
        unreached = listing(name for name, d in zip(outputs, degrees, strict=True) if not d)
        return f"no input reaches {unreached} within {n} derivatives"
    rows = [_reach(model, outputs, integrators, d)[:, k] for k, d in enumerate(degrees)]
    values = np.linalg.svd(np.stack(rows, axis=1), compute_uv=False)
    rank = int((values > _RANK * values.max()).sum(axis=1).min())
    reached = listing(f"{name}^({d})" for name, d in zip(outputs, degrees, strict=True))
    if rank < m:
        first = np.array(degrees) == min(degrees)
        early = np.flatnonzero(np.stack(rows, axis=1)[:, first].any(axis=(0, 1)))
        why = f"the inputs reach {reached} first, and act on them with rank {rank} of {m}"
        return RankLoss(why, tuple(early.tolist()))
    if sum(degrees) < n:
        return f"the chains of {reached} hold {sum(degrees)} of {n} states"
    return Chains(outputs, tuple(degrees), integrators)


@memoize
def _reach(
    model: ControlAffine, outputs: tuple[str, ...], integrators: tuple[int, ...], order: int
) -> Array:
    """Return the effect of each input (last axis) on derivatives of the outputs, (S, m, m)."""
    chains = Chains(outputs, (order,) * len(outputs), integrators)
    n, draw = len(model.state_names), np.random.default_rng(0)
    x = np.asarray(model.trim[0], float) + draw.uniform(-0.5, 0.5, (_SAMPLES, n))
    e = draw.uniform(0.2, 0.8, (_SAMPLES, sum(integrators)))

    def at_sample(x: State, e: Float[jax.Array, " k"]) -> Float[jax.Array, "m m"]:
        return derivatives_of(model, chains, x, e, order)[2][:, -1].T

    effects = np.asarray(jax.jit(jax.vmap(at_sample))(jnp.asarray(x), jnp.asarray(e)))
    return np.where(np.abs(effects) > _RANK * np.abs(effects).max(initial=1.0), effects, 0.0)
