"""A step of one agent that knows its own state late, and whether it decays for many factors (T9.5).

With what it hears as an input h it is s+ = A s + B y + E z, z = d o - h, o = F y + G s, where y is
its state some steps ago and o its deviation. With z = own * o it decays where no zero of
det(1 - own T(z)) lies outside of the unit circle, with T from z to o: those are counted by the
turns of the determinant along the circle (Nyquist), for all factors at once.
"""

from typing import NamedTuple

import numpy as np
import scipy.sparse as sp

from echelon.core.types import Array

EDGE = 1.0 - 1e-9
"""Of a spectral radius: what rounding leaves of 1."""
_DECAYED, _LONGEST = 1e-6, 50_000
"""Of a response, beyond which it is not summed, and after how many steps nothing is known of it."""
_ALONG, _NEAR = 1000, 40
"""Points of half a circle, twice, and beside each eigenvalue near it."""
_CLOSE = 0.1
"""To the circle; eigenvalues that are closer turn quickly."""
_TURN, _ROUNDS = 1.0, 6
"""rad from a point to the next; where it is more, points are added, so many times."""
_CHUNK = 32
"""Factors that are looked at together."""


class LateStep(NamedTuple):
    """A step of one agent at rest, linearized; y is its state some steps ago.

    Attributes:
        A, B, E: s+ = A s + B y + E z of s = (x, memory, motors).
        G, F: its deviation o = G s + F y.
        states: how many entries of s are x.
    """

    A: Array
    B: Array
    E: Array
    G: Array
    F: Array
    states: int

    def loop(self, own: complex, delay: int) -> Array:
        """Return the matrix of a step with z = own * o, for a delay in steps."""
        A, B = self.A + own * self.E @ self.G, self.B + own * self.E @ self.F
        n, size = self.states, len(A)
        whole = np.zeros((size + n * delay, size + n * delay), np.result_type(A, own))
        whole[:size, :size] = A
        if not delay:
            whole[:size, :n] += B
            return whole
        whole[:size, size + n * (delay - 1) :] = B
        whole[size : size + n, :n] = np.eye(n)
        whole[size + n :, size:-n] = np.eye(n * (delay - 1))
        return whole

    def radius(self, own: complex, delay: int) -> float:
        """Return the spectral radius of the same."""
        return float(np.abs(np.linalg.eigvals(self.loop(own, delay))).max())

    def passed_on(self, own: float, delay: int) -> float:
        """Return the largest sum over time of |o|, over what is heard as an impulse of size own.

        It is 1 where an agent follows what it hears without going beyond it.
        """
        whole = sp.csr_array(self.loop(own, delay))
        n, size, m = self.states, len(self.A), self.E.shape[1]
        x, total = np.zeros((size + n * delay, m)), np.zeros((m, m))
        x[:size] = -own * self.E
        first = 0.0
        for _ in range(_LONGEST):
            late = x[:n] if not delay else x[-n:]
            o = np.abs(self.G @ x[:size] + self.F @ late)
            largest = float(np.abs(x).max())
            first = max(first, largest)
            total, x = total + o, whole @ x
            if largest < _DECAYED * first:
                return float(total.sum(axis=1).max())
        return np.inf

    def response(self, delay: int, angles: Array) -> Array:
        """Return the eigenvalues (K, m) of T on the circle at angles (K,), rad."""
        z, n = EDGE * np.exp(1j * angles)[:, None, None], self.states
        late = z**-delay
        whole = z * np.eye(len(self.A)) - self.A
        whole[:, :, :n] -= late * self.B
        s = np.linalg.solve(whole, np.broadcast_to(self.E, (len(angles), *self.E.shape)))
        # In an order that is the same from point to point where they are apart.
        return np.sort(np.linalg.eigvals(self.G @ s + late * (self.F @ s[:, :n])), axis=1)


def all_decay(step: LateStep, own: Array, between: bool, delay: int) -> bool:
    """Tell whether a step decays for each of many factors.

    Args:
        step: of one agent.
        own: (K,) the factors, ascending by their real parts; of a conjugate pair one.
        between: whether those between the least and the largest count, all real.
        delay: in steps.
    """
    alone = np.linalg.eigvals(step.loop(0.0, delay))
    values = _resolved(step, own, delay, _angles(alone))
    turns, most = _turns(values, own)
    smooth = (most <= _TURN).all() and (turns == (np.abs(alone) >= EDGE).sum()).all()
    return bool(smooth and (not between or _joined(values, own)))


def _resolved(step: LateStep, own: Array, delay: int, angles: Array) -> Array:
    """Return T (K, m) at angles, and at more of them where a determinant turns quickly."""
    values = step.response(delay, angles)
    for _ in range(_ROUNDS):
        rough = np.flatnonzero(_turns(values, own)[1].max(axis=0) > _TURN)
        more = angles[rough, None] + np.diff(angles)[rough, None] * np.array([0.25, 0.5, 0.75])
        if not len(rough):
            break
        values = np.concatenate([values, step.response(delay, more.reshape(-1))])
        angles = np.concatenate([angles, more.reshape(-1)])
        order = np.argsort(angles)
        angles, values = angles[order], values[order]
    return values


def _angles(alone: Array) -> Array:
    """Return angles from 0 to pi, closer to each other near eigenvalues by the circle."""
    half = np.linspace(0.0, np.pi, _ALONG), np.geomspace(1e-12, np.pi, _ALONG)
    near = alone[(np.abs(np.abs(alone) - 1.0) < _CLOSE) & (np.imag(alone) >= 0.0)]
    widths = np.maximum(np.abs(np.abs(near) - 1.0), 1e-9)[:, None] * np.geomspace(0.01, 100, _NEAR)
    beside = (np.angle(near)[:, None] + np.hstack([-widths, widths])).reshape(-1)
    return np.unique(np.concatenate([*half, beside[(beside > 0.0) & (beside < np.pi)]]))


def _turns(values: Array, own: Array) -> tuple[Array, Array]:
    """Return the turns (K,) of the determinants along the circle, and the most of each step (K, T).

    Args:
        values: (T + 1, m) of T on half of the circle.
        own: (K,) factors.
    """
    turns, most = np.zeros(len(own)), np.zeros((len(own), len(values) - 1))
    for k in range(0, len(own), _CHUNK):
        # The other half is that of the conjugate factors.
        for factors in (own[k : k + _CHUNK], np.conj(own[k : k + _CHUNK])):
            each = 1.0 - factors[:, None, None] * values
            angle = np.angle(each[:, 1:] / each[:, :-1])
            turns[k : k + _CHUNK] += angle.sum(axis=(1, 2)) / (2.0 * np.pi)
            here = most[k : k + _CHUNK]
            np.maximum(here, np.abs(angle).max(axis=2), out=here)
    return np.round(turns), most


def _joined(values: Array, own: Array) -> bool:
    """Tell whether no factor between two neighbours of `own` puts a zero on the circle.

    Each 1 - own * value is linear in the factor, so that it passes 0 only in half a turn.
    """
    each = 1.0 - own[:, None, None] * values
    return bool((np.abs(np.angle(each[1:] / each[:-1])) < 0.5 * np.pi).all())
