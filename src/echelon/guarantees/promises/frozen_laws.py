"""Linearizations away from the trim: along the leader's path, and where agents start.

Behind a leader at x(t) small errors obey delta' = (A - lambda B K) delta with A, B and K those of
x(t), and split by the eigenvalues of the graph as they do at the trim. What these do in turn, each
for as long as it is the nearest sample, is a sign and no proof.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from echelon.agents.models.heading_symmetry import (
    heading_index,
    input_turn,
    rest_heading,
    rotate_state,
    state_turn,
)
from echelon.agents.models.model import ControlAffine
from echelon.core.compiled import cached_jit
from echelon.core.digits import about
from echelon.core.linear import matrix_exponential
from echelon.core.types import Array, Input, State, States
from echelon.core.words import Feedforward
from echelon.guarantees.promises.closed_loop import LinearLoop, telling
from echelon.guarantees.promises.integral_modes import (
    gain_in_use,
    gains_with_sums,
    with_sums,
)
from echelon.guarantees.promises.leaders import Leaders, own_paths
from echelon.laws.integral_check import sums_of
from echelon.laws.law import Faces, Feeds, Law, LocalView, without_certificates
from echelon.simulation.engine.law_drive import Laws
from echelon.simulation.engine.parts import Parts
from echelon.simulation.step.settings import Settings

# ---- the leader's path, in the axes in which the followers' law works ----------------------------

MOMENTS = 192
"""States of the path that are looked at."""
_SHORT = 1e-6  # s, over which a path's velocity is taken


class PathSamples(NamedTuple):
    """What K agents are asked with: times, their leader's states and inputs, their own states."""

    times: Array
    leaders: Array
    inputs: Array
    states: Array
    rates: Array


class LeaderRun(NamedTuple):
    """Moments (K,), the leader's states (K, n) then, its normalized inputs (K, m), and its trim.

    A law that turns sees them in the axes of the headings (K,), which turn at rates (K,).
    """

    times: Array
    states: Array
    inputs: Array
    trim: Array
    headings: Array
    rates: Array

    @property
    def rows(self) -> PathSamples:
        """What followers at the leader's own states are asked with."""
        return PathSamples(self.times, self.states, self.inputs, self.states, self.rates)

    def own_headings(self, parts: Parts) -> Array:
        """Return how far a leader's own gain is turned in these axes, (K,)."""
        turns = getattr(getattr(parts.drive, "leader", None), "turns", False)
        if not turns or self.headings.any():
            return np.zeros(len(self.times))
        return self.states[:, heading_index(parts.model)] - rest_heading(parts.model)


def leader_run_of(parts: Parts, settings: Settings, leaders: Leaders) -> LeaderRun:
    """Return where the leader goes: its reference, or by itself where its input rests."""
    model, times = parts.model, np.linspace(0.0, settings.horizon, MOMENTS)
    trim, m = np.asarray(model.trim[0], float), len(model.input_names)
    twice = jax.device_put(np.concatenate([times, times + _SHORT]))
    desired = parts.drive.reference_states(model, twice)
    if desired is not None:
        states, soon = np.split(np.asarray(desired), 2)
        v = _inputs(model, states, soon)
        finite = np.isfinite(states).all(axis=1) & np.isfinite(v).all(axis=1)
        return _as_sensed(parts, times[finite], states[finite], v[finite])
    paths = None
    if leaders.rest and not (leaders.starts == trim).all():
        paths = own_paths(parts, settings, leaders.starts[:1])
    if paths is None:
        return _as_sensed(parts, np.zeros(0), np.zeros((0, len(trim))), np.zeros((0, m)))
    frames = np.linspace(0, len(paths) - 1, MOMENTS).round().astype(int)
    return _as_sensed(parts, times, paths[frames, 0], np.zeros((MOMENTS, m)))


def _as_sensed(parts: Parts, times: Array, states: Array, inputs: Array) -> LeaderRun:
    assert isinstance(parts.drive, Laws)
    model, still = parts.model, np.zeros(len(times))
    path = LeaderRun(times, states, inputs, np.asarray(model.trim[0], float), still, still)
    if not (parts.drive.follower.turning and len(times)):
        return path
    away = states[:, heading_index(model)] - rest_heading(model)
    found = _in_heading(model, states, inputs, away)
    back, sent, rates = map(np.asarray, found)
    return path._replace(states=back, inputs=sent, headings=away, rates=rates)


@cached_jit
def _in_axes(model: ControlAffine, states: States, angles: jax.Array) -> States:
    """Return states (K, n) in axes that are turned by angles (K,)."""
    return jax.vmap(lambda x, angle: rotate_state(model, x, -angle))(states, angles)


@cached_jit
def _in_heading(
    model: ControlAffine, states: States, inputs: jax.Array, angles: jax.Array
) -> tuple[States, jax.Array, jax.Array]:
    """Return states (K, n) and normalized inputs (K, m) in turned axes, and how fast these turn."""

    def rate(x: State, v: Input) -> jax.Array:
        return model.velocity(x, model.physical(v))[heading_index(model)]

    sent = jax.vmap(input_turn(model))(inputs, -angles)
    return _in_axes(model, states, angles), sent, jax.vmap(rate)(states, inputs)


def _inputs(model: ControlAffine, now: Array, soon: Array) -> Array:
    """Return the normalized inputs that take agents from states to others _SHORT later."""
    velocities, maps = map(np.asarray, _pushes(model, now, soon))
    finite = np.isfinite(velocities).all(axis=1) & np.isfinite(maps).all(axis=(1, 2))
    inputs = np.full((len(maps), maps.shape[2]), np.nan)
    inputs[finite] = np.einsum("kmn,kn->km", np.linalg.pinv(maps[finite]), velocities[finite])
    return inputs


@cached_jit
def _pushes(model: ControlAffine, now: States, soon: States) -> tuple[States, jax.Array]:
    """Return what inputs add to the drift there (K, n), and their maps (K, n, m)."""

    def one(x: State, later: State) -> tuple[State, jax.Array]:
        moved = model.difference(later, x) / _SHORT - model.normalized_drift(x)
        return moved, model.normalized_input_map(x)

    return jax.vmap(one)(now, soon)


# ---- linearizations ------------------------------------------------------------------------------

_STARTS = 64
"""Starts that are looked at, with the moments of the path one shape for the compiler."""
_MODES = 32  # of the graph, the extreme ones among them
_HARDEST = 8  # states with the fastest modes, which a longest step is sought with
_TENFOLD = float(np.log(10.0))


class Growth(NamedTuple):
    """What small errors do along a path.

    Attributes:
        rate: at which they grow over all of it, 1/s; below 0 where they shrink.
        most: ln of how often they multiply in the part of it that is worst for them.
        when: s, where they grow fastest.
    """

    rate: float
    most: float
    when: float
    whose: str

    @property
    def lost(self) -> bool:
        """Whether they grow over all of it, or tenfold in a part."""
        return not (self.rate < 0.0 and self.most < _TENFOLD)


class ModeMatrices(NamedTuple):
    """An agent's motion about K states, and what its law feeds back there in L modes.

    Attributes:
        A: (K, n, n), with the input held.
        B: (K, n, m), of physical inputs.
        gains: (K, L, m, n).
    """

    A: Array
    B: Array
    gains: Array

    def modes(self) -> Array:
        """Return the eigenvalues of all loops, (K, L, n); infinite where slopes overflow."""
        loops = self.A[:, None] - self.B[:, None] @ self.gains
        finite: Array = np.isfinite(loops).all(axis=(2, 3))  # pyright: ignore
        modes = np.linalg.eigvals(np.where(finite[..., None, None], loops, 0.0))
        return np.where(finite[..., None], modes, np.inf)

    def growth(self) -> Array:
        """Return the slowest mode about each state, (K,), 1/s."""
        return np.real(self.modes()).max(axis=(1, 2))

    def along(self, times: Array, whose: str) -> Growth:
        """Return what errors do where these follow each other at times (K,)."""
        span, slowest = float(times[-1] - times[0]) / max(1, len(times) - 1), self.growth()
        # The largest sum of neighbours (Kadane): what grows before and shrinks after is left out.
        most = sums = 0.0
        for each in span * slowest:
            sums = max(0.0, sums + float(each))
            most = max(most, sums)
        when = float(times[slowest.argmax()])
        return Growth(self._exponent(span), most, when, whose)

    def _exponent(self, span: float) -> float:
        """Return ln rho of the product of all flows over `span` (s), by the time that they take."""
        J = self.A[:, None] - self.B[:, None] @ self.gains
        if not np.isfinite(J).all():
            return np.inf
        # Without its slowest decay no flow becomes 0, however long its span is.
        slowest = np.real(np.linalg.eigvals(J)).max(axis=2)
        each = matrix_exponential(span * (J - slowest[..., None, None] * np.eye(J.shape[-1])))
        product, logs = each[0], span * slowest.sum(axis=0)
        for flow in each[1:]:
            # A flow that is 0 stays 0, and so does its size.
            sizes = np.maximum(np.linalg.norm(product, axis=(1, 2)), np.finfo(float).tiny)
            # Sizes apart, since a product of two hundred would be beyond all numbers.
            logs += np.log(sizes)
            product = flow @ (product / sizes[:, None, None])
        radii = np.abs(np.linalg.eigvals(product)).max(axis=1)
        radii = np.maximum(radii, np.finfo(float).tiny)
        return float((logs + np.log(radii)).max() / (span * len(J)))


class FrozenLaws(NamedTuple):
    """The laws frozen away from the trim.

    Attributes:
        path: the leader's; without any states where it rests at its trim or follows none that is
            known.
        leader: the leader's own law there; None where it is not known.
        culprit: what takes the law out of where it stabilizes, in words; empty where nothing does.
    """

    path: LeaderRun
    along: ModeMatrices
    leader: ModeMatrices | None
    culprit: str = ""

    @property
    def times(self) -> Array:
        """Of the path, (K,) s."""
        return self.path.times

    @property
    def turns(self) -> tuple[float, ...]:
        """The least and the largest rate of the heading, rad/s, once where they are one; no zero.

        All slopes are in its axes; none where it does not turn, or the law does not.
        """
        rates = self.path.rates
        # Flatness maps round: a heading that stays seems to turn at 1e-17.
        known = np.round([rates.min(), rates.max()], 9).tolist() if len(rates) else ()
        return tuple(rate for rate in dict.fromkeys(known) if rate)

    @property
    def on_path(self) -> tuple[ModeMatrices, ...]:
        """The laws along the path; none where there is no path."""
        both = (self.along, self.leader)
        return tuple(each for each in both if each is not None) if len(self.times) else ()

    def growth(self) -> Growth:
        """Return what errors do along the path, of those who do worse."""
        growths = (
            each.along(self.times, who)
            for each, who in zip(self.on_path, ("followers'", "leader's"))
        )
        return max(growths, key=lambda one: (one.lost, one.rate))


def frozen_of(
    parts: Parts, settings: Settings, loop: LinearLoop, leaders: Leaders
) -> FrozenLaws | None:
    """Return the laws of prepared parts frozen along the leader's path.

    None without a path, and of a law that remembers something else than sums of errors.
    """
    assert isinstance(parts.drive, Laws)
    follower = parts.drive.follower
    if jax.tree.leaves(follower.init()) and sums_of(follower) is None:
        return None
    path = leader_run_of(parts, settings, leaders)
    if not len(path.times):
        return None
    along = _followers(parts, loop, path.rows)
    own = _leader(parts, path.own_headings(parts), along, path.rates)
    frozen = FrozenLaws(path, along, own)
    if not frozen.growth().lost:
        return frozen
    return frozen._replace(culprit=_culprit(parts, loop, path, frozen))


# ---- the laws there -----------------------------------------------------------------------------


def _followers(parts: Parts, loop: LinearLoop, rows: PathSamples) -> ModeMatrices:
    """Return the followers' law about each agent's state, in a few modes of the graph."""
    assert isinstance(parts.drive, Laws)
    count = len(rows.times)
    more = MOMENTS - count
    # Rows of one number, so that every path and every swarm is compiled once.
    full = (np.concatenate([part, np.repeat(part[-1:], more, axis=0)]) for part in rows)
    law = without_certificates(parts.drive.follower)
    found = _about(parts.model, law, *[*full][:4])
    A, B, alone, felt = (np.asarray(part)[:count] for part in found)
    if rows.rates.any():
        # In axes that turn, delta turns the other way by itself.
        A = A - rows.rates[:, None, None] * state_turn(parts.model).slope
    values = loop.closed.eigenvalues
    few = values[telling(values, _MODES)]
    felt = few[:, None, None] * gains_with_sums(law, felt)[:, None]
    felt[..., : A.shape[1]] += alone[:, None]
    return ModeMatrices(*with_sums(parts.model, law, A, B, rows.rates), felt)


@cached_jit
def _about(
    model: ControlAffine, law: Law, t: jax.Array, x: States, v: jax.Array, y: States
) -> tuple[jax.Array, ...]:
    """Return A, B, and what the law feeds back of the state and of the disagreement (K, m, n)."""
    # Rows stand in the axes of the heading already.
    law = Faces.of(law).facing(jnp.zeros((), x.dtype)) if law.turning else law

    def one(t: jax.Array, x: State, v: Input, y: State) -> tuple[jax.Array, ...]:
        silent, sent = law.feedforward is Feedforward.NONE, jnp.zeros_like(v)
        sent = sent if silent else Feeds.of(law).broadcast(model, x, v)

        def act(s: State, strength: jax.Array) -> tuple[Input, Input]:
            view = LocalView(t, s, jnp.zeros_like(y), strength * model.difference(s, y), sent)
            u = law.update(model, view, law.init())[0]
            return u, u

        # Both strengths by one trace, which is most of what this costs.
        slope = jax.vmap(jax.jacfwd(act, has_aux=True), (None, 0))
        (alone, both), (u, _) = slope(y, jnp.arange(2.0))
        A = jax.jacfwd(lambda s: model.velocity(s, u))(y)
        return A, model.input_map(y), -alone, alone - both

    return jax.vmap(one)(t, x, v, y)


def _leader(
    parts: Parts, headings: Array, along: ModeMatrices, rates: Array
) -> ModeMatrices | None:
    assert isinstance(parts.drive, Laws)
    model, law = parts.model, parts.drive.leader
    gain, n = gain_in_use(law), len(model.state_names)
    if gain is None:
        return None
    # Without the followers' sums.
    A, B = along.A[:, :n, :n], along.B[:, :n]
    S, P, D = np.asarray(model.input_scale, float), gain.P, None
    if headings.any():
        D = matrix_exponential(headings[:, None, None] * state_turn(model).slope)
        P = D @ P @ np.swapaxes(D, 1, 2)
    fed_back = gain.coupling * S @ gain.R_inverse @ S.T @ np.swapaxes(B, 1, 2) @ P
    fed_back = gains_with_sums(law, fed_back, D)[:, None]
    return ModeMatrices(*with_sums(model, law, A, B, rates), fed_back)


def _culprit(parts: Parts, loop: LinearLoop, path: LeaderRun, frozen: FrozenLaws) -> str:
    assert isinstance(parts.drive, Laws)
    model, trim = parts.model, np.asarray(parts.model.trim[0], float)
    n, k = len(trim), int(np.flatnonzero(path.times == frozen.growth().when)[0])
    there = np.tile(path.states[k], (n, 1))
    np.fill_diagonal(there, trim)
    here = PathSamples(*(np.repeat(part[k : k + 1], n, axis=0) for part in path.rows))
    slopes = _followers(parts, loop, here._replace(leaders=there, states=there))
    there = np.repeat(path.own_headings(parts)[k], n), slopes, here.rates
    leader = _leader(parts, *there)
    growth = slopes.growth() if leader is None else np.maximum(slopes.growth(), leader.growth())
    j = int(growth.argmin())
    return f"`{model.state_names[j]}` {about(path.states[k, j])} {model.state_units[j]}".rstrip()
