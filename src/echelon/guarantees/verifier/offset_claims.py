"""Independent check of the bounds of offsets that change with time, by samples of Taylor series."""

import math
from collections.abc import Iterator

import numpy as np

from echelon.core.types import Array, JsonObject
from echelon.guarantees.verifier.findings import Finding, decide

_CLOSE = 1e-6
"""Relative; by how much less than a bound samples of it may be."""
_BLEND = np.polynomial.Polynomial([0, 0, 0, 0, 0, 0, 462, -1980, 3465, -3080, 1386, -252])


def offset_findings(claim: JsonObject) -> Iterator[Finding]:
    """Yield whether the bounds of offsets and their derivatives are those of their motion."""
    if claim["sizes"] is None:
        return
    stored, value = np.array(claim["sizes"], float), _sizes(claim)
    fine = stored.shape == value.shape and bool((stored >= value * (1.0 - 1e-12)).all())
    fine &= bool((stored <= value * (1.0 + _CLOSE) + 1e-12).all()) if fine else False
    text = "by factorials of Taylor coefficients"
    yield decide("bounds of offsets", fine, stored.max(initial=0.0), value.max(initial=0.0), text)


def _sizes(claim: JsonObject) -> Array:
    """Return the bounds [order][coordinate] of a motion."""
    orders = np.arange(6)
    factorials = np.array([math.factorial(k) for k in orders], float)
    u = np.linspace(0.0, 1.0, 40_001)
    blends = [np.abs((_BLEND.deriv(k) if k else _BLEND)(u)).max() for k in orders]
    sizes = np.zeros((6, len(claim["lengths"])))
    for way, span in zip(claim["ways"], claim["over"], strict=True):
        each = np.outer(blends / np.array(span, float) ** orders, way)
        sizes = np.maximum(sizes, each)
    sizes[0] = claim["lengths"]
    # Coefficients of Taylor series, which multiply like polynomials.
    series = sizes / factorials[:, None]
    for motion in claim["motions"]:
        rate, scales = abs(motion["rate"]), motion["kind"] == "Scale"
        factor = rate**orders * (abs(motion["amplitude"]) if scales else 1.0) / factorials
        factor[0] += float(scales)
        for axis in range(series.shape[1] if scales else 2):
            series[:, axis] = np.convolve(series[:, axis], factor)[:6]
    return series * factorials[:, None]
