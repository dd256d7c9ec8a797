"""The closed loop that `check` looks at, and the lines in which it says what it found."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from echelon.certificates.certificate import (
    Certificate,
    RegionCertificate,
    certify,
)
from echelon.certificates.margins import ClosedLoop, decays_between
from echelon.core.linear import held_radius
from echelon.core.types import Array
from echelon.core.words import Feedforward
from echelon.engine.parts import Parts
from echelon.engine.settings import Settings
from echelon.gains.gain import Gain
from echelon.models.linearization import Linearization, linearize
from echelon.network.spectrum import Spectrum

SHOWN = 32
"""Of more eigenvalues of the graph than these, so many stand for all in the margins."""


class CheckedLoop(NamedTuple):
    """What every line reads: the parts, and their closed loop near the trim.

    Attributes:
        parts: what runs.
        settings: how it is computed.
        linear: A (with the inner loop closed) and B at the trim.
        closed: the modes that margins are taken of.
        where: which eigenvalues of the graph those are, in words.
        every: whether the modes of all eigenvalues of the graph decay, not only of those.
        certificate: of the linearization.
        broken: offsets that are no symmetries, by agent.
    """

    parts: Parts
    settings: Settings
    linear: Linearization
    closed: ClosedLoop
    where: str
    every: bool
    certificate: Certificate
    broken: dict[int, str]

    @property
    def gain(self) -> Gain | None:
        """The followers' gain, where their law has one."""
        return self.parts.drive.gain

    @property
    def region(self) -> RegionCertificate | None:
        """What the gain promises on a domain; nothing where parents' inputs are fed forward.

        The modes are then no longer those of a symmetric matrix, which its proof rests on.
        """
        if self.gain is None or self.fed_by_parents:
            return None
        return self.gain.certificate.region

    @property
    def fed_by_parents(self) -> bool:
        """Whether each follower is told the input of its parent."""
        return self.parts.drive.feedforward is Feedforward.PARENT

    @property
    def inner(self) -> Array:
        """The inner loop K (m, n) that is closed in A; zero without one."""
        gain = self.gain
        shape = self.linear.B.T.shape
        return np.zeros(shape) if gain is None or gain.inner is None else gain.inner

    @property
    def governed(self) -> bool:
        """Whether the followers run a law that this page speaks of, u = u_ff - c R^-1 g'P z."""
        return self.parts.drive.metric(self.parts.model) is not None

    @property
    def trimmed(self) -> bool:
        """Whether the law applies the trim input, or there is none."""
        trim = np.asarray(self.parts.model.trim[1], float)
        return self.parts.drive.trimmed or not trim.any()

    @property
    def disturbed(self) -> str:
        """What the scenario adds that no promise covers, in words; empty without any."""
        told = []
        if self.parts.world.disturbance is not None:
            told.append("wind or noise acts on the agents")
        if self.parts.world.plant is not None:
            told.append("the agents differ from the model")
        return " and ".join(told)

    @property
    def moving(self) -> bool:
        """Whether the leader has a reference to follow."""
        return self.parts.drive.reference_states(self.parts.model, jnp.zeros(1)) is not None

    @property
    def matched(self) -> bool:
        """Whether the followers are told an input, or the leader has none beyond the trim."""
        return self.parts.drive.feedforward is not Feedforward.NONE or not self.moving


def checked_loop(parts: Parts, settings: Settings) -> CheckedLoop:
    """Return the closed loop of built parts, in float64."""
    model, graph = parts.model, parts.graph
    gain = parts.drive.gain
    n, m = len(model.state_names), len(model.input_names)
    linear = linearize(model)
    P, R, c, edge = parts.drive.metric(model), np.eye(m), 1.0, None
    if gain is not None:
        R, c, edge = gain.R, gain.coupling, gain.certificate.edge
        linear = linear.with_inner(gain.inner)
    P = np.eye(n) if P is None else P
    spectrum, kind = graph.spectrum(), "eigenvalues"
    if parts.drive.feedforward is Feedforward.PARENT:
        edge = None if edge is None else edge * spectrum.low
        spectrum, kind = graph.parent_spectrum(), "edges' weights"
        edge = None if edge is None else edge / spectrum.low
    certificate = certify(linear, spectrum, P, R, c, edge)
    values, where = _looked_at(spectrum, kind)
    closed = ClosedLoop(*linear, P, R, c, values)
    whole = certificate.modes == spectrum.total
    every = certificate.stable and (whole or decays_between(closed))
    broken = parts.formation.broken_symmetries(model)
    return CheckedLoop(parts, settings, linear, closed, where, every, certificate, broken)


def _looked_at(spectrum: Spectrum, kind: str) -> tuple[Array, str]:
    """Return the eigenvalues that stand for a spectrum in the margins, and say which they are."""
    values, count = spectrum
    if len(values) < count:
        between = np.geomspace(spectrum.low, spectrum.high, SHOWN)
        return between, f"lambda_min, lambda_max and {SHOWN - 2} values between them"
    if count <= SHOWN:
        return values, f"all {kind} of the graph"
    places = np.linspace(0, count - 1, SHOWN).round().astype(int)
    return values[places], f"{SHOWN} of {count} {kind}, the extreme ones among them"


def step_radius(loop: CheckedLoop, dt: float) -> float:
    """Return the largest spectral radius of a step, over the eigenvalues looked at."""
    A, B = loop.linear.A + loop.linear.B @ loop.inner, loop.linear.B
    gains = loop.inner + loop.closed.strengths[:, None, None] * loop.closed.K
    return max(held_radius(A, B, K, dt) for K in gains)
