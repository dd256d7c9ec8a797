"""Independent check of a tube of T5 stored by a run or a check.

The certificate encloses polynomials by Bernstein coefficients. Here sign changes are isolated by
Sturm sequences and the integrals between them computed by Gauss quadrature; the response to a start
and a bounded disturbance is evaluated over time. No code of the certificate is used.
"""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from fractions import Fraction

import numpy as np

from echelon.core.digits import at_most
from echelon.core.types import Array, JsonObject
from echelon.guarantees.verifier.findings import Finding, compare, decide
from echelon.guarantees.verifier.motor_claims import motor_findings
from echelon.guarantees.verifier.offset_claims import offset_findings
from echelon.guarantees.verifier.separation_claims import separation_findings

FORMAT = "echelon tube 1"
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(40)
_FINE = Fraction(1, 2**50)
_CELLS = 6000
"""Cells of the time grid, which ends where the slowest mode has decayed by e^-30."""


def tube_of(promise: JsonObject) -> JsonObject | None:
    """Return the tube in a stored promise; None if there is none."""
    tube = promise.get("anywhere")
    return tube if isinstance(tube, dict) and tube.get("format") == FORMAT else None


def tube_findings(tube: JsonObject) -> Iterator[Finding]:
    """Yield a finding for each claim of a tube."""
    for border in tube["borders"]:
        roots = _as_fractions(border["roots"])
        name = ", ".join(f"`{output}`" for output in border["outputs"])
        for order, stored in enumerate(border["gains"]):
            result = _gain(roots, order)
            yield compare(
                f"gain {order} of {name}", stored, result, 1e-8, "quadrature between roots"
            )
        yield from _check_margin(border, roots, name)
    if tube.get("motors") is not None:
        yield from motor_findings(tube["motors"])
    if tube.get("offsets") is not None:
        yield from offset_findings(tube["offsets"])
    if tube.get("separation") is not None:
        yield from separation_findings(tube["separation"])


def _check_margin(border: JsonObject, roots: Sequence[Fraction], name: str) -> Iterator[Finding]:
    """Yield findings on the margin to a border and on the steepest admissible start."""
    order = int(border["derivative"]) - 1
    allowed = float(border["path"]) - float(border["above"])
    total = float(border["speed"]) + float(border["leader_speed"])
    if len(border["outputs"]) > 1:
        left = min(allowed - _length(roots, order, np.array(s), total) for s in border["starts"])
    else:
        pairs = itertools.product(border["leader_starts"], border["starts"])
        both = [np.add(_pad_start(a, len(roots)), _pad_start(b, len(roots))) for a, b in pairs]
        left = min(allowed - _fall(roots, order, start, total) for start in both)
    stored = float(border["left"])
    fine = 0.0 < stored <= left + 1e-9
    yield decide(f"margin to {name}", fine, stored, left, "evaluated over time")
    steep = np.eye(len(roots))[0] * float(border["steepest"])
    worst = min(
        allowed - _fall(roots, order, sign * steep, float(border["speed"])) for sign in (-1.0, 1.0)
    )
    shown, text = f"{at_most(worst, 4)} left", "margin from this start"
    yield decide(f"steepest start of {name}", worst >= -1e-9, border["steepest"], shown, text)


def _as_fractions(roots: Sequence[float]) -> list[Fraction]:
    return [Fraction(str(root)) for root in roots]


def _pad_start(start: Sequence[float], size: int) -> Array:
    """Return a start padded with zeros to one entry per root."""
    return np.pad(np.asarray(start, float), (0, size - len(start)))


# ---- by modes, in floats -------------------------------------------------------------------------


def _residues(roots: Sequence[Fraction]) -> Array:
    """Return c with h = sum c_i exp(-rho_i t) for k0 / q(s)."""
    rho = np.array([float(root) for root in roots])
    differences = [np.prod([b - a for j, b in enumerate(rho) if j != i]) for i, a in enumerate(rho)]
    return np.prod(rho) / np.array(differences)


def _fall(roots: Sequence[Fraction], order: int, start: Array, speed: float) -> float:
    """Return the largest decrease of v^(order) from a start under |w| <= speed, on a fine grid."""
    free, driven = _simulate_response(roots, order, start[None])
    return float((speed * driven - free[0]).max())


def _length(roots: Sequence[Fraction], order: int, starts: Array, speed: float) -> float:
    """Return the largest norm of v^(order) of m outputs from starts (m, p)."""
    free, driven = _simulate_response(roots, order, starts)
    return float((speed * driven + np.linalg.norm(free, axis=0)).max())


def _simulate_response(roots: Sequence[Fraction], order: int, starts: Array) -> tuple[Array, Array]:
    """Return the free response v^(order) from starts (m, p) and int_0^t |h^(order)| on a grid."""
    rho = np.array([float(root) for root in roots])
    times = np.linspace(0.0, 30.0 / rho.min(), _CELLS)
    modes = np.linalg.solve(np.vander(-rho, increasing=True).T, starts.T).T
    free = (modes * (-rho) ** order) @ np.exp(-np.outer(rho, times))
    kernel = _residues(roots) * (-rho) ** order
    # Simpson's rule: its error in smooth cells is far below `left + 1e-9`.
    step = times[1]
    ends = np.abs(kernel @ np.exp(-np.outer(rho, times)))
    middles = np.abs(kernel @ np.exp(-np.outer(rho, times[:-1] + 0.5 * step)))
    cells = step / 6.0 * (ends[:-1] + 4.0 * middles + ends[1:])
    return free, np.concatenate([[0.0], np.cumsum(cells)])


def _gain(roots: Sequence[Fraction], order: int) -> float:
    """Return the integral of |h^(order)| over all time, plus k0 at the highest order."""
    rho, c = np.array([float(root) for root in roots]), _residues(roots)
    kernel = c * (-rho) ** order
    # In s = exp(-unit t): dt = -ds / (unit s), and the powers are whole numbers.
    unit = _unit(roots)
    powers = [int(root / unit) for root in roots]
    exact = _modes(roots, order)
    cuts = [0.0, *map(float, _sign_changes(dict(zip(powers, exact, strict=True)))), 1.0]
    total = 0.0
    for a, b in itertools.pairwise(cuts):
        s = 0.5 * (b - a) * _NODES + 0.5 * (a + b)
        values = sum(k * s ** (n - 1) for k, n in zip(kernel, powers, strict=True)) / float(unit)
        total += abs(float(0.5 * (b - a) * (_WEIGHTS @ values)))
    return total + (float(np.prod(rho)) if order == len(roots) else 0.0)


def _modes(roots: Sequence[Fraction], order: int) -> list[Fraction]:
    """Return the exact coefficients of h^(order) in the modes exp(-root t)."""
    k0, result = Fraction(1), list[Fraction]()
    for root in roots:
        k0 *= root
    for root in roots:
        differences = Fraction(1)
        for other in roots:
            differences *= other - root if other != root else 1
        result.append(k0 / differences * (-root) ** order)
    return result


def _unit(roots: Sequence[Fraction]) -> Fraction:
    """Return the greatest common divisor of the roots (Euclid)."""
    unit = roots[0]
    for root in roots[1:]:
        a, b = unit, root
        while b:
            a, b = b, a % b
        unit = a
    return unit


# ---- sign changes by Sturm -----------------------------------------------------------------------


def _sign_changes(p: Mapping[int, Fraction]) -> list[Fraction]:
    """Return the roots of a polynomial in (0, 1), each to 2^-50 (Sturm's theorem)."""
    low = min(p)
    dense = [p.get(n, Fraction(0)) for n in range(low, max(p) + 1)]
    chain = _sturm(dense)
    result, pieces = list[Fraction](), [(Fraction(0), Fraction(1))]
    while pieces:
        a, b = pieces.pop()
        count = _variations(chain, a) - _variations(chain, b)
        if not count:
            continue
        if b - a <= _FINE:
            result.append((a + b) / 2)
            continue
        middle = (a + b) / 2
        pieces += [(a, middle), (middle, b)]
    return sorted(result)


def _sturm(p: list[Fraction]) -> list[list[Fraction]]:
    """Return the Sturm sequence of a polynomial; coefficients start at the lowest power."""
    chain = [p, [n * c for n, c in enumerate(p)][1:]]
    while len(chain[-1]) > 1:
        rest = [-c for c in _remainder(chain[-2], chain[-1])]
        if not any(rest):
            break
        chain.append(rest)
    return [part for part in chain if part]


def _remainder(a: list[Fraction], b: list[Fraction]) -> list[Fraction]:
    a = list(a)
    while len(a) >= len(b):
        share, gap = a[-1] / b[-1], len(a) - len(b)
        for k, c in enumerate(b):
            a[gap + k] -= share * c
        a.pop()
    while a and not a[-1]:
        a.pop()
    return a


def _variations(chain: list[list[Fraction]], x: Fraction) -> int:
    """Return the number of sign changes of the sequence at x."""
    signs = []
    for part in chain:
        total = Fraction(0)
        for c in reversed(part):
            total = total * x + c
        if total:
            signs.append(total > 0)
    return sum(a != b for a, b in itertools.pairwise(signs))
