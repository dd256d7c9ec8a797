"""Modes of laws that sum errors: at the trim, along a path, in turns, and in steps.

In a mode of the graph the error delta and its sum sigma, sigma' = C delta, obey delta' = (A - c
lambda B K) delta - c lambda B K L sigma: as many matrices as without sums, each larger by q.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from echelon.agents.models.heading_symmetry import state_turn
from echelon.agents.models.linearization import Linearization, linearize
from echelon.agents.models.model import ControlAffine
from echelon.core.digits import about, at_least, at_most
from echelon.core.errors import listing
from echelon.core.linear import discretize, longest_decay, spectral_radii
from echelon.core.statement import Statement, Topic, holds, unneeded
from echelon.core.types import Array
from echelon.core.words import Kind
from echelon.guarantees.promises.closed_loop import LinearLoop, telling
from echelon.laws.integral_check import sums_of
from echelon.laws.law import Law, gain_of
from echelon.simulation.engine.law_drive import Laws
from echelon.simulation.engine.parts import Parts
from echelon.simulation.step.settings import Settings
from echelon.synthesis.gains.gain import Gain
from echelon.synthesis.gains.integral import Integral

_MODES = 32
_OWN = np.ones(1)
"""The eigenvalue of a leader by itself."""


# ---- matrices with sums --------------------------------------------------------------------------


def with_sums(
    model: ControlAffine, law: Law, A: Array, B: Array, rates: Array
) -> tuple[Array, Array]:
    """Return A (K, n + q, n + q) and B (K, n + q, m) with the sums of a law.

    Args:
        model: the agent.
        law: without sums, the matrices stay as they are.
        A: (K, n, n).
        B: (K, n, m).
        rates: (K,) at which the axes of these matrices turn, rad/s.
    """
    sums = sums_of(law)
    if sums is None:
        return A, B
    (count, n), rows = A.shape[:2], list(sums.outputs)
    whole = np.zeros((count, n + len(rows), n + len(rows)))
    whole[:, :n, :n], whole[:, n:, :n] = A, np.eye(n)[rows]
    # In axes that turn, what is summed in the world's turns the other way.
    whole[:, n:, n:] = -rates[:, None, None] * state_turn(model).slope[np.ix_(rows, rows)]
    return whole, np.concatenate([B, np.zeros((count, len(rows), B.shape[2]))], axis=1)


def gains_with_sums(law: Law, gains: Array, turns: Array | None = None) -> Array:
    """Return gains (.., m, n) with what a law does by its sums, (.., m, n + q).

    `turns` (.., n, n) turn states from the axes of the trim into those of the gains.
    """
    sums = sums_of(law)
    if sums is None or sums.lift is None:
        return gains
    lift = sums.lift if turns is None else turns @ sums.lift @ np.swapaxes(turns, -1, -2)
    return np.concatenate([gains, (gains @ lift)[..., list(sums.outputs)]], axis=-1)


def gain_in_use(law: Law) -> Gain | None:
    """Return the gain of a law, or the one that its sums go with; None without either."""
    sums = sums_of(law)
    return gain_of(law) if sums is None else sums.gain


def slowest_in_axes(parts: Parts, loop: LinearLoop, linear: Linearization, rate: float) -> float:
    """Return the slowest mode (1/s) of all under A, B in axes that turn at a rate (rad/s)."""
    assert isinstance(parts.drive, Laws)
    slowest, (A, B) = -np.inf, linear
    pairs = (parts.drive.follower, loop.eigenvalues), (parts.drive.leader, _OWN)
    for law, eigenvalues in pairs:
        gain = gain_in_use(law)
        if gain is None:
            continue
        K = gain.coupling * gain.R_inverse @ B.T @ gain.P
        gains = gains_with_sums(law, eigenvalues[:, None, None] * K)
        inner = 0.0 if gain.inner is None or law is parts.drive.leader else gain.inner
        gains[..., : len(A)] += inner
        whole = with_sums(parts.model, law, A[None], B[None], np.array([rate]))
        slowest = max(slowest, float(np.linalg.eigvals(whole[0] - whole[1] @ gains).real.max()))
    return slowest


# ---- what sums cost ------------------------------------------------------------------------------


class SumCost(NamedTuple):
    """The slowest modes of a law without and with its sums, 1/s, and the fastest with them."""

    whose: str
    sums: Integral
    plain: float
    slowest: float
    fastest: float

    @property
    def lost(self) -> float:
        """Which part of the rate sums cost; below 0 where they gain some."""
        return 1.0 - self.slowest / self.plain


def sum_costs(parts: Parts, loop: LinearLoop) -> Iterator[SumCost]:
    """Yield what sums cost the followers and the leader; nothing of laws of a user's own."""
    laws = parts.drive
    if not isinstance(laws, Laws) or laws.unknown:
        return
    own = getattr(laws.leader, "regulator", None), _OWN
    each = {"followers": (getattr(laws.follower, "gain", None), loop.eigenvalues), "leader": own}
    for (whose, (gain, values)), law in zip(each.items(), (laws.follower, laws.leader)):
        sums = sums_of(law)
        if sums is None or gain is None:
            continue
        strengths = gain.coupling * values
        A, B = linearize(parts.model).with_inner(gain.inner)
        K = gain.R_inverse @ B.T @ gain.P
        plain = np.linalg.eigvals(A - strengths[:, None, None] * (B @ K)).real.max()
        modes = np.linalg.eigvals(sums.loops(parts.model, strengths))
        yield SumCost(whose, sums, float(plain), float(modes.real.max()), float(abs(modes).max()))


def sum_lines(parts: Parts, loop: LinearLoop, decays: bool) -> Iterator[Statement]:
    """Yield what sums do and cost, as lines of a check; what they do where the loop decays."""
    names = parts.model.state_names
    for cost in sum_costs(parts, loop):
        listed = listing(names[k] for k in cost.sums.outputs)
        weights = ", ".join(about(weight) for weight in cost.sums.used)
        who = "the leader sums" if cost.whose == "leader" else "the followers sum"
        text = f"{who} errors of {listed}, weights {weights}"
        if not decays:
            yield unneeded(Topic.INTEGRAL, Kind.LINEARIZATION, f"{text}; errors do not decay")
            continue
        rates = at_least(cost.slowest), at_least(cost.plain)
        text += (
            f": slowest mode {rates[0]} 1/s, {rates[1]} 1/s without; constant pushes that the "
            "inputs can hold leave no error behind a leader at constant velocity, and a lag on "
            "curves"
        )
        change = f"{about(100.0 * abs(cost.lost))} % {'slower' if cost.lost > 0.0 else 'faster'}"
        yield holds(Topic.INTEGRAL, Kind.LINEARIZATION, text, cost.lost, change)


def sum_sentence(parts: Parts, loop: LinearLoop) -> str:
    """Return what sums cost the followers, in a sentence; empty without any."""
    for cost in sum_costs(parts, loop):
        if cost.whose == "followers":
            rate = f"{at_most(-cost.slowest)} 1/s, and {at_most(-cost.plain)} 1/s without"
            return f"With `integral` the slowest mode decays at {rate}."
    return ""


def longest_step_with_sums(parts: Parts, loop: LinearLoop, settings: Settings) -> float | None:
    """Return the longest step (s) with which the followers' modes decay; None without sums."""
    assert isinstance(parts.drive, Laws)
    law = parts.drive.follower
    sums, gain = sums_of(law), gain_in_use(law)
    if sums is None or gain is None:
        return None
    values = loop.eigenvalues[telling(loop.eigenvalues, _MODES)]
    strengths, linear = gain.coupling * values, linearize(parts.model)
    gains = gains_with_sums(law, strengths[:, None, None] * (gain.R_inverse @ linear.B.T @ gain.P))
    gains[..., : len(linear.A)] += 0.0 if gain.inner is None else gain.inner
    rows = np.eye(len(linear.A))[list(sums.outputs)]

    def decays(dt: float) -> bool:
        F, G = (part[None] for part in discretize(*linear, dt, *settings.held[1:]))
        whole, pushed = with_sums(parts.model, law, F, G, np.zeros(1))
        whole[:, len(F[0]) :] = np.hstack([dt * rows, np.eye(len(rows))])
        return float(spectral_radii(whole - pushed @ gains).max()) < 1.0

    return longest_decay(decays, np.linalg.eigvals(sums.loops(parts.model, strengths)))
