"""Independent check of the distances that a run's guarantee states (T10)."""

from collections.abc import Iterator

import numpy as np
import scipy.optimize

from echelon.core.types import Array, JsonObject
from echelon.guarantees.verifier.findings import Finding, compare, decide

_SLACK = 1e-9


def separation_findings(claim: JsonObject) -> Iterator[Finding]:
    """Yield a finding for each condition of the theorem."""
    width, _, height = claim["radii"]
    scales = np.array([width / height if axis == "z" else 1.0 for axis in claim["axes"]])
    kept = 2.0 * width + claim["margin"]
    yield compare("distance of the hulls", claim["distance"], kept, _SLACK, "2 radius + margin")
    least = _distance(np.array(claim["gap"]) * scales)
    text = "by a plane between the nearest two"
    yield compare("distance at the start", claim["least"], least, _SLACK, text)
    yield decide("they start apart", least >= kept - _SLACK, kept, least)
    share = claim["gain"] * claim["step"]
    yield decide("gain times step", share <= 1.0 + _SLACK, "at most 1", share)
    speed = float(np.linalg.norm(scales * np.array(claim["speeds"])))
    needed = kept + 2.0 * speed / claim["gain"]
    fine = claim["reach"] >= needed - _SLACK
    yield decide("agents are regarded in time", fine, claim["reach"], needed)


def _distance(points: Array) -> float:
    """Return how far the hull of points (r, d) is from 0, by the plane that separates both."""
    # min |C'l| with l >= 0 and sum l = 1, the last as a heavy equation of least squares.
    heavy = 1e6 * max(1.0, float(np.abs(points).max()))
    target = np.append(np.zeros(points.shape[1]), heavy)
    shares = scipy.optimize.nnls(np.vstack([points.T, np.full(len(points), heavy)]), target)[0]
    nearest = shares @ points / shares.sum()
    size = float(np.linalg.norm(nearest))
    # What is proved: all points are beyond a plane so far from 0.
    return float((points @ nearest).min()) / size if size > 0.0 else 0.0
