"""What `check` says of a gain beyond the trim: its region, its certified set, what g does."""

from collections.abc import Iterator

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from echelon.certificates.domain import Domain
from echelon.certificates.jacobians import has_constant_input_map
from echelon.core.types import Array, States
from echelon.core.words import Kind, Theorem, Verdict
from echelon.models.model import ControlAffine
from echelon.promises.certified_set import CertifiedSet
from echelon.promises.closed_loop import CheckedLoop
from echelon.studies.lines import Line

_SAMPLES = 400


_NEAR = 0.5  # without a domain, g is looked at this far about the trim


def region_lines(loop: CheckedLoop, found: CertifiedSet | None) -> Iterator[Line]:
    """Yield the region that the gain carries, the certified set, and the Killing residual of g."""
    yield _region_line(loop)
    yield _set_line(loop, found)
    yield _killing_line(loop)


def _region_line(loop: CheckedLoop) -> Line:
    region = loop.region
    if region is None:
        text = "a gain by `robust-lqr` or `contraction` with a `domain` has one"
        return Line("region of the gain", Verdict.NOT_NEEDED, Kind.PROOF, "none", text)
    theorem, number = region.theorem, f"{region.rate:.3g} 1/s"
    holds = region.rate > 0.0 or theorem is Theorem.A5
    text = f"{theorem}: {theorem.value} {region.domain.in_words(loop.parts.model)}"
    text += "" if holds else "; shrink the `domain`"
    return Line("region of the gain", Verdict.of(holds), region.kind, number, text)


def _set_line(loop: CheckedLoop, found: CertifiedSet | None) -> Line:
    statement = "certified set"
    if found is None:
        local = loop.region is not None and loop.region.theorem is Theorem.T2
        text = "T2 is local and certifies no set" if local else "needs a region"
        return Line(statement, Verdict.NOT_NEEDED, Kind.PROOF, "", text)
    number = f"radius {found.radius:.3g}" if found.radius else "empty"
    return Line(statement, Verdict.of(found.radius > 0.0), found.kind, number, found.why)


def _killing_line(loop: CheckedLoop) -> Line:
    """Say how much the inputs themselves stretch distances, and so which theorem is to be had."""
    model, region = loop.parts.model, loop.region
    domain = _near(model) if region is None else region.domain
    where = f"within {_NEAR:g} of the trim" if region is None else "on the domain"
    residual, kind = killing_residual(model, loop.closed.P, domain)
    number = f"{residual:.3g} 1/s"
    statement = "Killing residual of g"
    if kind is Kind.PROOF:
        text = f"g is constant {where}: a region is nonlocal (T1)"
        return Line(statement, Verdict.HOLDS, kind, number, text)
    text = f"per unit of input, {where}: g varies, so a region is local (T2)"
    text += "; a model with its inputs as states has constant g"
    return Line(statement, Verdict.FAILS, kind, number, text)


def killing_residual(model: ControlAffine, P: Array, domain: Domain) -> tuple[float, Kind]:
    """Return how fast one unit of an input stretches or shrinks distances in P, 1/s, and the kind.

    It is half the largest eigenvalue, in size, of P^-1/2 (P dg_k + dg_k'P) P^-1/2 over the inputs k
    and states of the domain, dg_k the derivative of column k of g S: the Lie derivative of the
    metric, zero where that column is a Killing field. It is 0 by proof where a hull shows g to be
    constant, and is else read off 400 states.
    """
    states, _ = domain.sample(_SAMPLES)
    base = np.asarray(model.trim[0], float)
    slopes = np.asarray(_input_slopes(model, jnp.asarray(base + states)))
    # A hull takes a second, and one slope that is not zero says what it would.
    if not slopes.any() and has_constant_input_map(model, domain):
        return 0.0, Kind.PROOF
    weighted = P @ np.moveaxis(slopes, 2, 1)
    root = np.linalg.inv(np.linalg.cholesky(P))
    values = np.linalg.eigvalsh(root @ (weighted + weighted.swapaxes(-1, -2)) @ root.T)
    return 0.5 * float(np.abs(values).max()), Kind.SAMPLES


@eqx.filter_jit
def _input_slopes(model: ControlAffine, states: States) -> jax.Array:
    """Return the derivatives of g S, (S, n, m, n)."""
    return jax.vmap(jax.jacfwd(model.normalized_input_map))(states)


def _near(model: ControlAffine) -> Domain:
    """Return a box about the trim, inside the model's chart."""
    n, m = len(model.state_names), len(model.input_names)
    reach, trim = np.full(n, _NEAR), np.asarray(model.trim[0], float)
    for name, (low, high) in model.chart.items():
        k = model.state_names.index(name)
        reach[k] = min(_NEAR, 0.5 * (trim[k] - low), 0.5 * (high - trim[k]))
    return Domain(-reach, reach, np.zeros(m), np.zeros(m))
