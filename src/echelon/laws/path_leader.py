"""Laws of leaders that follow a path of states: by flatness, or by feedback that varies in time."""

import math
from typing import Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg

from echelon.agents.models.model import ControlAffine
from echelon.agents.network.graph import Graph
from echelon.agents.network.spectrum import Spectrum
from echelon.agents.references.flatness import (
    first_state,
    follow_at,
    followed_states,
    moving,
    without_heading,
)
from echelon.agents.references.reference import LeaderPath, check_kind_of, check_reference
from echelon.core.cache import BoundedCache
from echelon.core.compiled import cached_jit
from echelon.core.errors import LawError, ReferenceError
from echelon.core.identity import process_key
from echelon.core.linear import symmetric_part
from echelon.core.numerics import precision
from echelon.core.types import Array, Input, Scalar, State
from echelon.laws.law import Expected, Faces, Law, LocalView, Memory, Travels, check_gain_fits
from echelon.synthesis.gains.gain import Gain
from echelon.synthesis.gains.integral import Integral
from echelon.synthesis.gains.riccati import Riccati

# ---- the path, and how others predict it ---------------------------------------------------------


class PathLeader(Law, Travels, Faces):
    """A leader that follows the states of a reference.

    Args:
        reference: the path to follow.
        fading: the rate (1/s) at which others expect its deviation to fade; set by `predictable`.
    """

    reference: LeaderPath
    fading: Array | None = eqx.field(default=None, kw_only=True)

    def __check_init__(self) -> None:
        check_kind_of(self.reference)

    def start(self, model: ControlAffine) -> State:
        """Return the reference's state at time zero."""
        return first_state(model, self.reference)

    def reference_states(self, model: ControlAffine, times: jax.Array) -> jax.Array:
        """Return x_r at each of `times`, (T, n)."""
        return followed_states(model, self.reference, times)

    @property
    def plans(self) -> bool:
        """Whether others can predict it: they know the path."""
        return True

    def predictable(self, model: ControlAffine) -> Self:
        """Find the slowest mode of the leader about the beginning of its path."""
        mode = self.own_mode(model)
        if mode is None:
            with precision("float64"):
                mode = _slowest(self, model)
        fading = np.asarray(max(-mode, 0.0))
        return eqx.tree_at(lambda law: law.fading, self, fading, is_leaf=lambda x: x is None)

    def deviation(
        self, model: ControlAffine, t: Scalar, x: State, offset: State, memory: Memory
    ) -> State:
        """Return x - x_r, (n,)."""
        return model.difference(x, self.reference.follow(model, t)[0] + offset)

    def expected(
        self, model: ControlAffine, t: Scalar, deviation: State, age: Scalar, period: Scalar | float
    ) -> Expected:
        """Return the path with what is left of the deviation, at the leader's slowest mode."""
        left = deviation * jnp.exp(-jnp.asarray(self.fading, deviation.dtype) * age)
        return Expected(self.reference.follow(model, t)[0] + left)


def _slowest(law: PathLeader, model: ControlAffine) -> float:
    """Return the largest real part (1/s) of the modes about the beginning of the path."""
    x, _ = follow_at(model, law.reference, np.zeros(1))
    start = jnp.asarray(x[0])
    rest, silence = jnp.zeros_like(start), jnp.zeros(len(model.input_names))

    def velocity(x: State) -> State:
        view = LocalView(jnp.zeros(()), x, rest, rest, silence)
        return model.velocity(x, law.update(model, view, law.begin(model, x))[0])

    slope = np.asarray(jax.jit(jax.jacfwd(velocity))(start))
    return float(np.linalg.eigvals(slope).real.max())


# ---- flatness feed-forward and state feedback ----------------------------------------------------
# It serves the paper's Assumption 4.


class Tracking(PathLeader):
    """u_L = u_r(t) - S R^-1 (g S)'P (x - x_r(t)) [- S c R^-1 (g S)'P (e_L + d_L)].

    (x_r, u_r) is the reference's, by the model's flatness map or as given. The last term is the
    paper's reaction of the leader to its neighbours (its leader law), present when `reaction` is
    given.

    Args:
        reference: the path to follow.
        gain: the tracking gain, used with coupling 1; the model's Riccati gain when left out.
        reaction: the followers' gain, when the leader reacts to them.
        turns: whether the gains turn with the reference's heading; set by `prepared`.
        regulator: the tracking gain in use; set by `prepared`.
        integral: weights of the sums of outputs' errors, by `Integral.of`; None without sums.
    """

    gain: Gain | None = None
    reaction: Gain | None = None
    turns: bool = eqx.field(default=False, static=True)
    regulator: Gain | None = None
    integral: Integral | None = eqx.field(default=None, kw_only=True, converter=Integral.of)

    @property
    def information(self) -> tuple[str, ...]:
        """The reference; neighbours' states when the leader reacts."""
        return ("the reference", *(("neighbours' states",) if self.reaction is not None else ()))

    def prepared(self, model: ControlAffine, graph: Graph) -> "Tracking":
        """Complete the gain, and check that the model can follow the reference."""
        check_reference(self.reference)
        self.reference.fit(model)
        if self.reaction is not None:
            check_gain_fits(self, model, self.reaction.P.shape, self.reaction.R.shape)
        regulator = tracking_gain(self, model, self.gain)
        # Checked here, since a run would only say that the leader diverged at once.
        start = np.zeros(1)
        begin, still = follow_at(model, self.reference, start), ""
        if without_heading(model, self.reference, start).any():
            still = "its speed is 0 at t = 0 s, and the model has no heading at rest"
            still += moving(model, self.reference, start)
        if still or not all(np.isfinite(part).all() for part in begin):
            raise ReferenceError(
                f"the reference `{type(self.reference).__name__}` cannot be followed by "
                f"`{type(model).__name__}`: "
                f"{still or 'its flat state and input are not finite at t = 0 s'}."
            )
        turns = model.heading is not None and not self.keeps_heading(model)
        sums = self.integral and self.integral.prepared(model, regulator, OWN)
        return Tracking(self.reference, self.gain, self.reaction, turns, regulator, integral=sums)

    def init(self) -> Memory:
        """Return the sums of outputs' errors, if there are any."""
        return None if self.integral is None else self.integral.begin()

    def own_mode(self, model: ControlAffine) -> float | None:
        """Return the slowest mode with sums, 1/s; None without, where it is that of the gain."""
        return None if self.integral is None else self.integral.slowest(model, np.ones(1))

    def target(self, model: ControlAffine, t: Scalar) -> tuple[State, Input]:
        """Return (x_r, u_r) at time t."""
        return self.reference.follow(model, t)

    def update(self, model: ControlAffine, view: LocalView, memory: Memory) -> tuple[Input, Memory]:
        """Return the leader's input."""
        if self.regulator is None:
            raise LawError("`Tracking` has no gain yet; call `prepared(model, graph)` first.")
        error, u, heading = self._error(model, view)
        if self.integral is None:
            v = self.regulator.feedback(model, view.x, error, heading)
        else:
            v = self.integral.feedback(model, view.x, error, memory, heading)
        # Normalized inputs are added, and the trim once: it is in u already.
        if self.reaction is not None:
            v = v + self.reaction.feedback(model, view.x, view.disagreement, heading)
        return u - model.physical(v, trim=False), memory

    def settle(
        self,
        model: ControlAffine,
        view: LocalView,
        desired: Input,
        delivered: Input,
        memory: Memory,
    ) -> Memory:
        """Return the sums after a step."""
        if self.integral is None:
            return memory
        error, _, heading = self._error(model, view)
        known = view.x, error, view.period
        return self.integral.settle(model, known, memory, (desired, delivered), heading)

    def _error(self, model: ControlAffine, view: LocalView) -> tuple[State, Input, Scalar | None]:
        """Return the error (n,), the reference's input, and the heading of the gain's axes."""
        state, u = self.target(model, view.t)
        heading = self.heading(model, view.t, view.x) if self.turns else None
        # With several leaders each follows the reference at an offset of its own.
        return model.difference(view.x, state + view.offset), u, heading


OWN = Spectrum(np.ones(1), 1, 1.0)
"""The eigenvalue of a leader that knows its reference directly."""


def tracking_gain(law: Law, model: ControlAffine, gain: Gain | None) -> Gain:
    """Return a leader's own gain with coupling 1, the model's Riccati gain where it is None.

    Raises:
        LawError: it does not fit the model.
    """
    # The coupling compensates lambda_min of a network; a leader knows its reference directly.
    if gain is None:
        gain = Riccati(coupling=1.0).solve(model, OWN)
    check_gain_fits(law, model, gain.P.shape, gain.R.shape)
    return gain if gain.coupling == 1.0 else eqx.tree_at(lambda g: g.coupling, gain, 1.0)


# ---- linear-quadratic feedback -------------------------------------------------------------------
# The gain is swept backward along the path, about which the model is linearized; so it also leads
# models that no feedback stabilizes at their trim, such as a unicycle, and models without flat
# outputs.

_SPAN = 0.02
"""Between two gains, s; A and B are taken in the middle, an error of second order in it."""
_MOST = 50_000
"""Gains of a path; a longer one has them farther apart, so that a quadrotor's take 20 MB."""

_HELD = 1500
"""Intervals (of 0.02 s: 30 s) for which the end is held at least, so that a short path has the gain
of a long one: what the beginning leaves of P falls at twice the slowest mode."""
_SWEEPS = BoundedCache[tuple[Array, Array]](4, lambda swept: swept[0].nbytes, 2**26)
"""Gains that were swept last, and their slowest decay."""


class PathLQR(PathLeader):
    """u_L = u_r(t) - S K(t) (x - x_r(t)), with K = R^-1 B'P of the Riccati differential equation.

    -Pdot = A'P + P A - P B R^-1 B'P + Q along the reference (x_r, u_r), where A is the slope of
    f + g u_r and B = g S; Q and R are the model's weights. P is swept backward from zero, a
    time after the end that is as long as the path, and 30 s at least. For that time the end is
    held, and P comes to the steady solution there, if there is one.

    Args:
        reference: a path by the model's flatness map, or given as states and inputs (`StatePath`).
        horizon: how long it is followed, s; afterwards the last gain holds.
    """

    horizon: float = eqx.field(default=10.0, static=True)
    gains: Array | None = None
    decay: Array | None = None

    @property
    def information(self) -> tuple[str, ...]:
        """The whole reference, along which the gain is swept backward."""
        return ("the reference, all of it before the start",)

    def prepared(self, model: ControlAffine, graph: Graph) -> "PathLQR":
        """Sweep the gain, once for a model and a path.

        Raises:
            LawError: the model cannot follow the reference, or no feedback stabilizes it there.
        """
        check_reference(self.reference)
        self.reference.fit(model)
        about = model, self.reference, self.horizon
        gains, decay = _SWEEPS.get_or_make(process_key(about), lambda: sweep(*about))
        return PathLQR(self.reference, self.horizon, gains, decay)

    def own_mode(self, model: ControlAffine) -> float | None:
        """Return the slowest rate (1/s, below 0) at which errors shrink, by e'P e."""
        return None if self.decay is None else float(self.decay)

    def update(self, model: ControlAffine, view: LocalView, memory: Memory) -> tuple[Input, Memory]:
        """Return the leader's input."""
        if self.gains is None:
            raise LawError("`PathLQR` has no gain yet; call `prepared(model, graph)` first.")
        state, u = self.reference.follow(model, view.t)
        gains = jnp.asarray(self.gains, view.x.dtype)
        last = len(gains) - 1
        place = jnp.clip(view.t * (last / self.horizon), 0.0, last)
        k = jnp.minimum(jnp.floor(place).astype(jnp.int32), last - 1)
        K = gains[k] + (place - k) * (gains[k + 1] - gains[k])
        # With several leaders each follows the reference at an offset of its own.
        v = K @ model.difference(view.x, state + view.offset)
        return u - model.physical(v, trim=False), memory


def sweep(model: ControlAffine, reference: LeaderPath, horizon: float) -> tuple[Array, Array]:
    """Return the gains K (N + 1, m, n) at equal times over a horizon (s), and the slowest decay.

    Along the linearization V = e'P e falls as V' = -e'(Q + K'R K) e, so that errors shrink at
    half the least eigenvalue of P^-1 (Q + K'R K) or faster, in the metric P.

    Raises:
        LawError: P grows beyond all numbers, as where an unstable mode is out of the inputs' reach.
    """
    Q, R = (np.diag(np.asarray(part, float)) for part in model.weights)
    count = min(max(1, math.ceil(horizon / _SPAN)), _MOST)
    # Ends and middles of the intervals, and the end once more, where it is held.
    times = jnp.linspace(0.0, horizon, 2 * count + 1)
    A, B = (np.asarray(part, np.float64) for part in _slopes(model, reference, times))
    name, path = type(model).__name__, type(reference).__name__
    if not (np.isfinite(A).all() and np.isfinite(B).all()):
        raise LawError(
            f"the reference `{path}` cannot be followed by `{name}`: its states, inputs or slopes "
            "are not finite."
        )
    held = np.append(np.arange(1, 2 * count, 2), 2 * count)
    push = B[held] @ np.linalg.solve(R, B[held].swapaxes(1, 2))
    P = _backward(A[held], push, Q, horizon / count)
    if not np.isfinite(P).all():
        raise LawError(
            f"`lqr` cannot hold `{name}` on the reference `{path}`: no feedback keeps its "
            "linearization there bounded."
        )
    K = np.linalg.solve(R, B[::2].swapaxes(1, 2) @ P)
    return K, _decay(P, Q + K.swapaxes(1, 2) @ R @ K)


def _backward(A: Array, G: Array, Q: Array, span: float) -> Array:
    """Return P (N + 1, n, n) at the ends of N intervals, from A and G in them and at the end."""
    # [X; Y]' = H [X; Y] has P = Y X^-1 for the solution of the Riccati equation. With A and G held
    # this is exact, where a Runge-Kutta step of fast modes would not be stable.
    H = np.block([[A, -G], [np.broadcast_to(-Q, A.shape), -A.swapaxes(1, 2)]])
    flows, P = scipy.linalg.expm(-span * H), [np.zeros(Q.shape)]
    # What overflows is rejected afterwards, by its NaN.
    with np.errstate(all="ignore"):
        for _ in range(max(len(flows) - 1, _HELD)):
            P[0] = _before(P[0], flows[-1])
        for flow in flows[-2::-1]:
            P.append(_before(P[-1], flow))
    return np.array(P[::-1])


def _before(P: Array, flow: Array) -> Array:
    n = len(P)
    X, Y = flow[:n, :n] + flow[:n, n:] @ P, flow[n:, :n] + flow[n:, n:] @ P
    # Rounding alone makes it asymmetric, and would grow with every interval.
    return symmetric_part(np.linalg.solve(X.T, Y.T).T)


def _decay(P: Array, W: Array) -> Array:
    """Return minus half the least eigenvalue of P^-1 W over P (N, n, n) and W (N, n, n)."""
    root = np.linalg.inv(np.linalg.cholesky(P))
    # An array, since a float would be a constant of the compiled step, and another one of another.
    return np.asarray(-0.5 * np.linalg.eigvalsh(root @ W @ root.swapaxes(1, 2)).min())


@cached_jit
def _slopes(
    model: ControlAffine, reference: LeaderPath, times: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Return A (T, n, n) and B (T, n, m) of the deviation from a reference at times (T,)."""

    def one(t: jax.Array) -> tuple[jax.Array, jax.Array]:
        x, u = reference.follow(model, t)
        slope = jax.jacfwd(lambda x: model.velocity(x, u))(x)
        return slope, model.normalized_input_map(x)

    return jax.vmap(one)(times)
