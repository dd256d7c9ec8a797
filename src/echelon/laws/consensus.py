"""The paper's follower law, with the coupling, input weight and feed-forward that make it work."""

import dataclasses
from collections.abc import Callable
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from echelon.agents.models.heading_symmetry import heading_index, rest_heading, state_turn
from echelon.agents.models.linear_agent import SingleIntegrator
from echelon.agents.models.model import ControlAffine
from echelon.agents.models.relative_equilibrium import moves
from echelon.agents.network.graph import Graph
from echelon.agents.references.flatness import followed_states
from echelon.core.errors import LawError, check_name
from echelon.core.numerics import precision
from echelon.core.types import Array, Input, Scalar, State
from echelon.core.words import DEFAULT_FEEDFORWARD, Feedforward, Frame, Word
from echelon.laws.law import (
    Checks,
    Faces,
    Feeds,
    Law,
    LocalView,
    Memory,
    Proves,
    check_gain_fits,
    reference_of,
)
from echelon.synthesis.gains.gain import Gain
from echelon.synthesis.gains.integral import Integral
from echelon.synthesis.gains.strings import string_growth

_Word = TypeVar("_Word", bound=Word)
_WATCHED, _MOMENTS, _STRAIGHT = 600.0, 2048, 1e-6
"""s and times at which a path is looked at; sine of half an angle that is still straight."""


def _member(key: str, kind: type[_Word]) -> Callable[[object], _Word]:
    def named(name: object) -> _Word:
        check_name(f"`{key}` is", str(name), map(str, kind), LawError)
        return kind.named(name)

    return named


class Consensus(Law, Faces, Feeds, Proves, Checks):
    """u_i = u* + S (kappa(x_i) + v_ff - c R^-1 (g(x_i) S)'P (e_i + d_i)).

    It is the paper's law at c = 1, R = I, v_ff = 0. kappa is the gain's inner loop, if it has one.

    Args:
        gain: P, R and c.
        feedforward: what followers receive of others' inputs of the same step, after their limits,
            `relay` by default: `none`; `relay`, the leader's normalized input; `relay-velocity`,
            the velocity g S v of that input, of which each follower takes the input nearest in P;
            `parent`, on a tree, the normalized input of the neighbour nearer to the leader. The
            paper's network has none of this.
        trim: whether the trim input u* is applied; the paper's printed law has none (False).
        frame: `heading`, the gain turns with the heading that the leader follows, which everybody
            receives, if the model has one; `world`, it does not, as in the paper.
        turning: whether the gain turns; set by `following`.
        angle: that heading, rad; set by `facing`.
        integral: weights of the sums of outputs' errors, by `Integral.of`; None without sums.
    """

    gain: Gain
    # Static: what is sent decides the structure of a step, so each choice is compiled for itself.
    feedforward: Feedforward = eqx.field(
        default=DEFAULT_FEEDFORWARD, static=True, converter=_member("feedforward", Feedforward)
    )
    trim: bool = eqx.field(default=True, static=True)
    frame: Frame = eqx.field(default=Frame.HEADING, static=True, converter=_member("frame", Frame))
    turning: bool = eqx.field(default=False, static=True)
    angle: Scalar | None = None
    integral: Integral | None = eqx.field(default=None, kw_only=True, converter=Integral.of)

    def __check_init__(self) -> None:
        if not isinstance(self.gain, Gain):
            raise LawError(
                f"`gain` of `Consensus` is {self.gain!r}, and must be a `Gain`, as `synthesize` "
                "returns it."
            )

    @property
    def information(self) -> tuple[str, ...]:
        """Neighbours' states, the feed-forward, and the heading if the gain turns with it."""
        forward = () if self.feedforward is Feedforward.NONE else (self.feedforward.value,)
        return (
            "neighbours' states",
            *forward,
            *(("the heading that the leader follows",) * self.turning),
        )

    def facing(self, heading: Scalar) -> "Consensus":
        """Return the law with its gain in the axes of a heading (rad)."""
        return eqx.tree_at(lambda law: law.angle, self, heading, is_leaf=lambda part: part is None)

    def metric(self, model: ControlAffine) -> Array | None:
        """Return the gain's P; None with sums, of which no V of states is known."""
        return self.gain.P if self.integral is None else None

    def prepared(self, model: ControlAffine, graph: Graph) -> "Consensus":
        """Check that the gain fits the model, and the feed-forward the graph."""
        check_gain_fits(self, model, self.gain.P.shape, self.gain.R.shape)
        if self.feedforward is Feedforward.PARENT:
            # Raises where the graph is no tree; what it returns is computed again where it is used.
            graph.parents()
        if self.integral is None:
            return self
        integral = self.integral.prepared(model, self.gain, graph.spectrum())
        return dataclasses.replace(self, integral=integral)

    def following(self, leader: Law, model: ControlAffine) -> "Consensus":
        """Let the gain turn if it changes with the heading, and the leader may change its own."""
        turning = self.frame is Frame.HEADING and self.gain.turns(model)
        turning = turning and not Faces.of(leader).keeps_heading(model)
        if self.frame is Frame.WORLD and moves(model) and self.gain.turns(model):
            _check_straight(leader, model)
        return self if turning is self.turning else dataclasses.replace(self, turning=turning)

    def warnings(self, model: ControlAffine, graph: Graph) -> tuple[str, ...]:
        """Warn of branches that amplify errors, under `parent` or with one-way edges."""
        alone = graph.directed and graph.schedule is None
        alone = alone and len(graph.edges) == len(graph.followers)
        if self.integral is not None or self.feedforward is not Feedforward.PARENT and not alone:
            return ()
        return string_growth(self.gain, model, graph)

    def init(self) -> Memory:
        """Return the sums of outputs' errors, if there are any."""
        return None if self.integral is None else self.integral.begin()

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
        known = view.x, view.disagreement, view.period
        return self.integral.settle(model, known, memory, (desired, delivered), self.angle)

    def update(self, model: ControlAffine, view: LocalView, memory: Memory) -> tuple[Input, Memory]:
        """Return the input of one agent."""
        forward, known = view.feedforward, (view.x, view.disagreement)
        if self.feedforward is Feedforward.RELAY_VELOCITY:
            forward = _match_velocity(self, model, view.x, forward)
        if self.integral is None:
            v = forward - self.gain.feedback(model, *known, self.angle)
        else:
            v = forward - self.integral.feedback(model, *known, memory, self.angle)
        v = v + self.gain.inner_loop(model, view.x, self.angle)
        return model.physical(v, trim=self.trim), memory

    def broadcast(self, model: ControlAffine, x: State, v: Input) -> Float[jax.Array, " k"]:
        """Return the input beyond the inner loop, v - kappa(x), or the velocity that it makes."""
        # A follower closes its own inner loop and adds this; with the whole v the loop would count
        # twice wherever the two states differ.
        beyond = v - self.gain.inner_loop(model, x, self.angle)
        if self.feedforward is Feedforward.RELAY_VELOCITY:
            return model.normalized_input_map(x) @ beyond
        return beyond

    def drift(self, model: ControlAffine, x: State) -> State:
        """Return the drift with the inner loop closed."""
        # Assumption 5 is about this drift: the loop acts without any neighbour.
        return model.velocity(x, model.physical(self.gain.inner_loop(model, x, self.angle)))


def _check_straight(leader: Law, model: ControlAffine) -> None:
    """Raise `LawError` if a leader's path leaves the heading of a trim that moves."""
    reference = reference_of(leader)
    if reference is None:
        return
    times = np.linspace(0.0, _WATCHED, _MOMENTS)
    with precision("float64"):
        states = np.asarray(followed_states(model, reference, times))
    away = np.abs(np.sin(0.5 * (states[:, heading_index(model)] - rest_heading(model))))
    turned = np.flatnonzero(away > _STRAIGHT)
    if len(turned):
        raise LawError(
            f"`frame` of `Consensus` is `{Frame.WORLD}`, the trim of `{type(model).__name__}` "
            f"moves, and the leader's heading is {2.0 * np.arcsin(away[turned[0]]):.3g} rad off "
            f"the trim's at {times[turned[0]]:.3g} s; a gain for one heading leads agents apart "
            f"in others, so use `{Frame.HEADING}`."
        )


def _match_velocity(law: Consensus, model: ControlAffine, x: State, velocity: State) -> Input:
    """Return the normalized input (m,) whose g(x) S v is nearest to a velocity in the metric P."""
    G, P = model.normalized_input_map(x), jnp.asarray(law.gain.P, x.dtype)
    if law.angle is not None:
        turn, back = state_turn(model), -law.angle
        G, velocity = jax.vmap(turn, (1, None), 1)(G, back), turn(velocity, back)
    # Least |G v - velocity|_P: G'P G v = G'P velocity. The second sum of V' has just this P, so
    # that what no input can match pushes V least.
    weighted = G.T @ P
    return jnp.linalg.solve(weighted @ G, weighted @ velocity)


# ---- single integrators (Mesbahi and Egerstedt; paper, Theorem 1) --------------------------------


class Agreement(Law, Proves):
    """u_i = -sum_j A_ij ((x_i - x_j) - (xi_i - xi_j)).

    Run by all agents alike, it drives every x_i - xi_i to one common constant, the mean of their
    starts.
    """

    @property
    def information(self) -> tuple[str, ...]:
        """Neighbours' states."""
        return ("neighbours' states",)

    def metric(self, model: ControlAffine) -> Array:
        """Return the identity."""
        return np.eye(len(model.state_names))

    def prepared(self, model: ControlAffine, graph: Graph) -> "Agreement":
        """Check that the model is a single integrator."""
        # u = -z gives differences of states as velocities, which suits xdot = u and no other.
        if not isinstance(model, SingleIntegrator):
            raise LawError(
                f"the law `agreement` is made for `SingleIntegrator`, and the model is "
                f"`{type(model).__name__}`; use `consensus`."
            )
        return self

    def update(self, model: ControlAffine, view: LocalView, memory: Memory) -> tuple[Input, Memory]:
        """Return the velocity of one agent."""
        # The consensus law at f = 0, g = P = R = I and c = 1: z has the brackets.
        return -view.disagreement, memory
