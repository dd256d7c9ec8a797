"""Certified set: starts from which no follower leaves the domain of a guarantee."""

from typing import NamedTuple

import numpy as np

from echelon.core.digits import about, at_least, at_most
from echelon.core.statement import Hypothesis, Statement, fails, holds, unneeded
from echelon.core.types import Array
from echelon.core.words import Kind, Theorem
from echelon.guarantees.promises.leaders import Leaders, excursion, own_paths
from echelon.simulation.engine.parts import Parts
from echelon.simulation.step.settings import Settings
from echelon.synthesis.certificates.certificate import RegionCertificate
from echelon.synthesis.certificates.jacobians import has_constant_input_map


class CertifiedSet(NamedTuple):
    """{sum_i delta_i'P delta_i <= radius^2}, from which no follower leaves the domain.

    Attributes:
        radius: 0 where the set is empty, infinite where the domain bounds nothing.
        kind: of the argument; samples where the leader's excursion is read off a run of its own.
        why: what limits the radius, or why there is none.
        remedy: what would make one; empty where there is one.
    """

    radius: float
    kind: Kind
    why: str
    remedy: str = ""

    def as_mapping(self) -> dict[str, object]:
        """Return it ready for JSON, where an infinite radius is None."""
        radius = self.radius if self.radius < float("inf") else None
        return {"radius": radius, "kind": str(self.kind), "why": self.why}


def certified_set(
    parts: Parts, settings: Settings, leaders: Leaders, region: RegionCertificate | None
) -> CertifiedSet | None:
    """Return the set that a region of theorem T1 or A5 certifies, less the leader's excursion.

    r^2 = min_j (margin_j - excursion_j)^2 / W_jj, W = P^-1. Where only the drift is known (A5) and
    g varies, what cannot rise is V = delta'(L kron P) delta, which costs the factor
    lambda_min / lambda_max.
    """
    if region is None or region.theorem is Theorem.T2:
        return None
    kind, free = region.kind, region.theorem is Theorem.A5
    if free and not leaders.rest and not _constant(parts, region):
        text = "g varies, and a moving leader then adds to V"
        return CertifiedSet(0.0, kind, text, "use a model whose g is constant")
    trim = np.asarray(parts.model.trim[0], float)
    if leaders.rest and (leaders.starts == trim).all():
        return _less(parts, region, kind, np.zeros(len(trim)))
    if leaders.answer:
        text = "the leader reacts to followers, so its excursion depends on them"
        return CertifiedSet(0.0, kind, text, "set `leader.reacts: false`")
    paths = own_paths(parts, settings, leaders.starts)
    if paths is None:
        text = "the leader alone diverges"
        return CertifiedSet(0.0, kind, text, "give `leader.gain` another method")
    return _less(parts, region, Kind.SAMPLES, excursion(parts, paths))


def _less(parts: Parts, region: RegionCertificate, kind: Kind, away: Array) -> CertifiedSet:
    """Return the set that is left when the leader goes so far from the trim, (n,)."""
    gain, model = parts.drive.gain, parts.model
    assert gain is not None
    margins = region.domain.margins()
    radii = np.maximum(margins - away, 0.0) / np.sqrt(np.diag(np.linalg.inv(gain.P)))
    if not np.isfinite(radii).any():
        return CertifiedSet(np.inf, region.kind, "everywhere: the domain bounds no state")
    j = int(np.argmin(radii))
    name, wide = model.state_names[j], margins[j]
    if radii[j] == 0.0:
        text = (
            f"the leader alone reaches {about(away[j])} in `{name}`, and the domain {about(wide)}"
        )
        return CertifiedSet(0.0, kind, text, "widen the domain, or slow the reference")
    # On a directed graph a sum with weights falls, which one agent's share may exceed so much.
    shrink = 1.0 / np.sqrt(parts.graph.spectrum().skew)
    if region.theorem is Theorem.A5 and not _constant(parts, region):
        shrink = np.sqrt(parts.graph.spectrum().proved / parts.graph.spectrum().high)
    text = f"of sum_i delta_i'P delta_i <= r^2, limited by `{name}`: {at_most(wide)}"
    text += f" less {at_least(away[j])} of the leader" if away.any() else ", leader at the trim"
    return CertifiedSet(float(shrink * radii[j]), kind, text)


def _constant(parts: Parts, region: RegionCertificate) -> bool:
    return has_constant_input_map(parts.model, region.domain)


def size_of(parts: Parts, states: Array) -> float:
    """Return r of the set {sum_i delta_i'P delta_i = r^2} on which states (N, n) lie."""
    gain = parts.drive.gain
    assert gain is not None
    y = states - parts.formation.offsets
    delta = y - y[list(parts.graph.nearest_leader())]
    return float(np.sqrt(np.einsum("ia,ab,ib->", delta, gain.P, delta)))


def set_line(region: RegionCertificate | None, certified: CertifiedSet | None) -> Statement:
    """Say which set of starts is certified."""
    if certified is None:
        return unneeded(Hypothesis.SET, Kind.PROOF, _no_set(region))
    if certified.radius > 0.0:
        number = certified.radius, f"radius {at_most(certified.radius)}"
        return holds(Hypothesis.SET, certified.kind, certified.why, *number)
    return fails(
        Hypothesis.SET,
        certified.kind,
        certified.why,
        certified.radius,
        "empty",
        remedy=certified.remedy,
    )


def starts_line(
    parts: Parts, states: Array, region: RegionCertificate | None, certified: CertifiedSet | None
) -> Statement:
    """Say whether starts (N, n) lie in the set."""
    if certified is None:
        return unneeded(Hypothesis.STARTS, Kind.PROOF, _no_set(region))
    size = size_of(parts, states)
    number = size, f"{at_least(size)} of {at_most(certified.radius)}"
    if size <= certified.radius:
        text = "no follower leaves the domain from these starts"
        return holds(Hypothesis.STARTS, certified.kind, text, *number)
    text, remedy = "the starts are outside the certified set", "start nearer to the goals"
    return fails(Hypothesis.STARTS, certified.kind, text, *number, remedy=remedy)


def _no_set(region: RegionCertificate | None) -> str:
    local = region is not None and region.theorem is Theorem.T2
    return "T2 is local and certifies no set" if local else "needs a region"
