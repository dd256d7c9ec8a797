"""What a gain carries beyond the trim: its region, the set certified there, and what g does."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from echelon.certificates.certificate import RegionCertificate
from echelon.certificates.domain import Domain
from echelon.certificates.jacobians import has_constant_input_map
from echelon.core.errors import Outcome
from echelon.core.types import Array, States
from echelon.core.words import Kind, Theorem
from echelon.engine.initial import initial_states
from echelon.engine.parts import Parts
from echelon.engine.simulate import simulate
from echelon.laws.trim_input import TrimInput
from echelon.models.model import ControlAffine
from echelon.network.formation import Formation
from echelon.network.graph import Graph
from echelon.promises.closed_loop import CheckedLoop


class CertifiedSet(NamedTuple):
    """{sum_i delta_i'P delta_i <= radius^2}, from which no follower leaves the domain.

    Attributes:
        radius: 0 where the set is empty, infinite where the domain bounds nothing.
        kind: of the argument; samples where the leader's excursion is read off a run of its own.
        why: what limits the radius, or why there is none.
    """

    radius: float
    kind: Kind
    why: str


def certified_set(loop: CheckedLoop) -> CertifiedSet | None:
    """Return the set that a region of theorem T1 or A5 certifies, less the leader's excursion.

    r^2 = min_j (margin_j - excursion_j)^2 / W_jj, W = P^-1. Where only the drift is known (A5) and
    g varies, what cannot rise is V = delta'(L kron P) delta, which costs the factor
    lambda_min / lambda_max.
    """
    region = loop.region
    if region is None or not _certifies(region):
        return None
    if region.theorem is Theorem.A5 and loop.moving and not _constant(loop, region.domain):
        text = "g varies, and a leader that moves then adds to V; needs a constant g"
        return CertifiedSet(0.0, region.kind, text)
    kind, excursion, why = _excursion(loop)
    if excursion is None:
        return CertifiedSet(0.0, region.kind, why)
    return _less(loop, region, region.kind if kind is None else kind, excursion)


def certified_at_rest(loop: CheckedLoop) -> float | None:
    """Return the radius of the certified set for a leader that rests at the trim."""
    region = loop.region
    if region is None or not _certifies(region):
        return None
    nowhere = np.zeros(len(loop.parts.model.state_names))
    return _less(loop, region, region.kind, nowhere).radius


def _certifies(region: RegionCertificate) -> bool:
    return region.theorem is Theorem.A5 or region.theorem is Theorem.T1 and region.rate > 0.0


def _less(
    loop: CheckedLoop, region: RegionCertificate, kind: Kind, excursion: Array
) -> CertifiedSet:
    """Return the set that is left when the leader goes so far from the trim, (n,)."""
    margins = region.domain.margins()
    radii = np.maximum(margins - excursion, 0.0) / np.sqrt(np.diag(np.linalg.inv(loop.closed.P)))
    if not np.isfinite(radii).any():
        return CertifiedSet(np.inf, region.kind, "everywhere: the domain bounds no state")
    j = int(np.argmin(radii))
    name, wide = loop.parts.model.state_names[j], margins[j]
    if radii[j] == 0.0:
        text = f"the leader alone reaches {excursion[j]:.3g} in `{name}`, and the domain {wide:.3g}"
        return CertifiedSet(0.0, kind, f"{text}; widen the domain, or slow the reference")
    shrink = 1.0
    if region.theorem is Theorem.A5 and not _constant(loop, region.domain):
        shrink = np.sqrt(loop.certificate.lambda_min / loop.certificate.lambda_max)
    text = f"of sum_i delta_i'P delta_i <= r^2, limited by `{name}`: {wide:.3g}"
    text += f" less {excursion[j]:.3g} of the leader" if excursion.any() else ", leader at the trim"
    return CertifiedSet(float(shrink * radii[j]), kind, text)


def _constant(loop: CheckedLoop, domain: Domain) -> bool:
    return has_constant_input_map(loop.parts.model, domain)


def _excursion(loop: CheckedLoop) -> tuple[Kind | None, Array | None, str]:
    """Return how far the leaders go from the trim, (n,), and the kind of that; or why not known.

    A leader that starts and stays at the trim goes nowhere, which needs no run.
    """
    model = loop.parts.model
    if loop.parts.drive.reacts:
        return None, None, "the leader reacts, so its excursion is not its own; `reacts: false`"
    trim = np.asarray(model.trim[0], float)
    if not loop.moving and (_leader_starts(loop) == trim).all():
        return None, np.zeros(len(trim)), ""
    paths = _leader_paths(loop)
    if paths is None:
        return None, None, "the leader alone diverges; see Assumption 4"
    away = np.abs(np.asarray(_differences(model, jnp.asarray(paths), jnp.asarray(trim))))
    return Kind.SAMPLES, away.max(axis=0), ""


def _leader_starts(loop: CheckedLoop) -> Array:
    """Return the states (L, n) in which the leaders start, less their offsets."""
    parts = loop.parts
    states = initial_states(parts, loop.settings.seed)
    return (states - parts.formation.offsets)[list(parts.graph.leaders)]


def _leader_paths(loop: CheckedLoop) -> Array | None:
    """Return the states (K, n) of the leaders in a run of their own, or None if it diverges."""
    parts, starts = loop.parts, _leader_starts(loop)
    count = len(starts)
    graph = Graph([(k, count) for k in range(count)], leaders=range(count))
    states = np.concatenate([starts, np.asarray(parts.model.trim[0], float)[None]])
    goals = Formation(np.zeros_like(states))
    alone = Parts(parts.model, graph, goals, parts.drive.with_follower(TrimInput()), initial=states)
    result = simulate(alone, loop.settings._replace(store_every=1, seed=0, precision="float64"))
    if result.outcome is not Outcome.COMPLETED:
        return None
    return result.states[:, :count].reshape(-1, states.shape[1])


@eqx.filter_jit
def _differences(model: ControlAffine, states: States, base: jax.Array) -> jax.Array:
    return jax.vmap(lambda x: model.difference(x, base))(states)
