"""All gain methods on one scenario, side by side, and one of them recommended."""

import time
from typing import Any, NamedTuple

import numpy as np

from echelon import _registry
from echelon._build import Parts, resolve
from echelon._errors import EchelonError, MissingExtraError
from echelon._linearization import linearize
from echelon._numerics import precision
from echelon._scenario import Scenario
from echelon._synthesize import synthesize
from echelon.gains.gain import Gain

_NEEDS_DOMAIN = ("monotone", "robust-lqr", "contraction")
_RATE = 0.1
"""Rate that `contraction` is asked for where the scenario names none, 1/s."""
_ORDER = {"proof": 3, "vertices": 2, "samples": 1}


class Design(NamedTuple):
    """One method on the scenario: its gain, or why there is none."""

    method: str
    gain: Gain | None
    reason: str
    fastest: float | None
    seconds: float


def designs(scenario: Scenario, parts: Parts, only: str | None = None) -> tuple[Design, ...]:
    """Try the methods on a built scenario, or `only` one of them."""
    names = [only] if only else [name for name in _registry.METHODS if name != "given"]
    return tuple(_design(name, scenario, parts) for name in names)


def recommended(tried: tuple[Design, ...]) -> Design | None:
    """Return the stable design with the strongest promise, the fastest decay deciding a tie."""
    stable = [d for d in tried if d.gain is not None and d.gain.certificate.stable]
    return max(stable, key=_merit) if stable else None


def _merit(design: Design) -> tuple[int, float]:
    assert design.gain is not None
    certificate = design.gain.certificate
    region = certificate.region
    strength = _ORDER.get(region.kind, 0) if region is not None and region.rate > 0.0 else 0
    return strength, -certificate.abscissa


def _design(name: str, scenario: Scenario, parts: Parts) -> Design:
    """Try one method; an optional part that is missing is a reason like any other."""
    began = time.perf_counter()
    options = _options(name, scenario)
    if name in _NEEDS_DOMAIN and "domain" not in options:
        return Design(name, None, "give `follower.gain.domain` to try it", None, 0.0)
    try:
        gain = synthesize(parts.model, parts.graph, resolve(_registry.METHODS[name])(**options))
    except MissingExtraError as error:
        return Design(name, None, str(error), None, time.perf_counter() - began)
    except EchelonError as error:
        return Design(name, None, str(error), None, time.perf_counter() - began)
    return Design(name, gain, "", _fastest(parts, gain), time.perf_counter() - began)


def _options(name: str, scenario: Scenario) -> dict[str, Any]:
    """Return what the scenario says of this method, and its domain for those that need one."""
    spec = scenario.follower.gain
    given: dict[str, Any] = {}
    if spec.method == name and spec.file is None:
        fields = spec.model_dump().items()
        given = {key: value for key, value in fields if value is not None and key != "method"}
    elif name in _NEEDS_DOMAIN and spec.domain is not None:
        given["domain"] = spec.domain
    if name == "contraction":
        given.setdefault("rate", _RATE)
    return given


def _fastest(parts: Parts, gain: Gain) -> float:
    """Return the largest modulus of an eigenvalue of the linearized loop, 1/s."""
    with precision("float64"):
        A, B = linearize(parts.model)
    A = A if gain.inner is None else A - B @ gain.inner
    strength = gain.coupling * gain.certificate.lambda_max
    closed = A - strength * B @ np.linalg.solve(gain.R, B.T @ gain.P)
    return float(np.abs(np.linalg.eigvals(closed)).max())
