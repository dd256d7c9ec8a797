"""The Killing residual of the input map: how fast inputs stretch distances in the metric P."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from echelon.agents.models.model import ControlAffine
from echelon.core.compiled import cached_jit
from echelon.core.digits import at_least
from echelon.core.statement import Statement, Topic, fails, holds, unneeded
from echelon.core.types import Array
from echelon.core.words import Kind
from echelon.guarantees.promises.promise import Promise
from echelon.simulation.engine.parts import Parts
from echelon.synthesis.certificates.domain import Domain
from echelon.synthesis.certificates.jacobians import has_constant_input_map

_SAMPLES = 400
_RADIUS = 0.5  # half-width about the trim on which g is checked without a domain


def killing_line(parts: Parts, promise: Promise) -> Statement:
    """Return the Killing residual of g, on the domain of the gain if it has one."""
    if not (promise.governed or promise.paper_lines):
        return unneeded(Topic.KILLING, Kind.PROOF, "no P of the law is known")
    gain = parts.drive.gain
    claim = None if gain is None else gain.certificate.region
    domain = _box(parts.model) if claim is None else claim.domain
    where = f"within {_RADIUS:g} of the trim" if claim is None else "on the domain"
    residual, kind = killing_residual(parts.model, promise.loop.closed.P, domain)
    number = residual, f"{at_least(residual)} 1/s"
    if kind is Kind.PROOF:
        text = f"g is constant {where}: guarantees on a region are not local (T1)"
        return holds(Topic.KILLING, kind, text, *number)
    text = f"per unit of input, {where}: g varies, so guarantees are local (T2)"
    remedy = "use a model with its inputs as states, which has constant g"
    return fails(Topic.KILLING, kind, text, *number, remedy=remedy)


def killing_residual(
    model: ControlAffine, P: Float[Array, "n n"], domain: Domain
) -> tuple[float, Kind]:
    """Return the rate (1/s) at which one unit of an input changes distances in P, and its kind.

    It is half the largest eigenvalue, in size, of P^-1/2 (P dg_k + dg_k'P) P^-1/2 over the inputs k
    and states of the domain, dg_k the derivative of column k of g S: the Lie derivative of the
    metric, zero where that column is a Killing field. It is 0 by proof where a hull shows that g is
    constant, otherwise the largest of 400 states.
    """
    states, _ = domain.sample(_SAMPLES)
    base = np.asarray(model.trim[0], float)
    slopes = np.asarray(_input_slopes(model, jnp.asarray(base + states)))
    # A hull takes a second, and is not needed where a slope is not zero.
    if not slopes.any() and has_constant_input_map(model, domain):
        return 0.0, Kind.PROOF
    # P is symmetric, so dg'P is the transpose of P dg.
    weighted = P @ np.moveaxis(slopes, 2, 1)
    # Any root of P^-1 gives the eigenvalues of P^-1 (P dg + dg'P), and Cholesky's costs least.
    root = np.linalg.inv(np.linalg.cholesky(P))
    values = np.linalg.eigvalsh(root @ (weighted + weighted.swapaxes(-1, -2)) @ root.T)
    return 0.5 * float(np.abs(values).max()), Kind.SAMPLES


@cached_jit
def _input_slopes(
    model: ControlAffine, states: Float[jax.Array, "S n"]
) -> Float[jax.Array, "S n m n"]:
    """Return the derivatives of g S."""
    return jax.vmap(jax.jacfwd(model.normalized_input_map))(states)


def _box(model: ControlAffine) -> Domain:
    """Return a box about the trim, inside the model's chart."""
    n, m = len(model.state_names), len(model.input_names)
    radius, trim = np.full(n, _RADIUS), np.asarray(model.trim[0], float)
    for name, (low, high) in model.chart.items():
        k = model.state_names.index(name)
        # Half way to the border of the chart, near which slopes may grow without bound.
        radius[k] = min(_RADIUS, 0.5 * (trim[k] - low), 0.5 * (high - trim[k]))
    return Domain(-radius, radius, np.zeros(m), np.zeros(m))
