"""Compare the certificate stored in a gain with the one computed for this run."""

import numpy as np

from echelon.agents.models.linearization import at_trim
from echelon.core.digits import about
from echelon.core.statement import Hypothesis, Statement, fails, holds, unneeded
from echelon.core.words import Kind
from echelon.guarantees.promises.closed_loop import LinearLoop, grounded_slowest
from echelon.simulation.engine.parts import Parts
from echelon.synthesis.certificates.certificate import RegionCertificate
from echelon.synthesis.gains.gain import Gain

_SAME = 1e-6
"""Relative; less than that is rounding, or another library's eigenvalues."""
_ROUNDING = 1e-9  # of the fastest mode, in the slowest


def claims_line(parts: Parts, loop: LinearLoop, region: RegionCertificate | None) -> Statement:
    """Return whether the certificate that a gain carries is of what runs.

    Args:
        parts: what runs.
        loop: near the trim.
        region: what the gain's metric promises here where the leader's input is relayed.
    """
    gain, name, kind = parts.drive.gain, Hypothesis.CLAIMS, Kind.LINEARIZATION
    if gain is None:
        return unneeded(name, kind, "there is no gain")
    text = _difference(parts, gain, loop, region)
    if text:
        return fails(name, kind, text, remedy="the guarantee here is computed from what runs")
    return holds(name, kind, "they agree with this model, graph and coupling")


def _difference(
    parts: Parts, gain: Gain, loop: LinearLoop, region: RegionCertificate | None
) -> str:
    """Return the first difference in words; empty without any."""
    claim, low = gain.certificate, parts.graph.spectrum().low
    if abs(claim.lambda_min - low) > _SAME * low:
        ours, theirs = about(low, 4), about(claim.lambda_min, 4)
        return f"the gain was made for lambda_min {theirs}, and this graph has {ours}"
    slowest = grounded_slowest(gain, loop.linear, parts.graph)
    fastest = float(np.abs(np.linalg.eigvals(loop.linear.A - loop.linear.B @ loop.gains[-1])).max())
    bends = at_trim(parts.model).bends.any()
    if not bends and abs(claim.abscissa - slowest) > _SAME * abs(slowest) + _ROUNDING * fastest:
        text = f"the gain says that its slowest mode is {about(claim.abscissa, 4)} 1/s, and this "
        text += f"model at coupling {about(gain.coupling, 4)} has {about(slowest, 4)} 1/s"
        return text
    if claim.edge is not None and loop.certificate.edge is None:
        text = f"the gain says that every mode decays from coupling {about(claim.edge, 4)} on"
        return f"{text}, and here its argument does not hold"
    ours, theirs = _rate(region), _rate(claim.region)
    return "" if ours == theirs else f"the gain says {theirs} on its domain, and here it is {ours}"


def _rate(region: RegionCertificate | None) -> str:
    """Return a promise on a domain in words, with the digits that are compared."""
    if region is None:
        return "nothing"
    kind, theorem = region.kind, region.theorem
    return f"{about(region.rate, 5)} 1/s ({kind}, {theorem})"
