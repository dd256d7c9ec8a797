"""The paper's follower law, with the coupling, input weight and feed-forward that make it work."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Float

from echelon.core.errors import LawError, did_you_mean, listing
from echelon.core.types import Array, Input, State
from echelon.core.words import DEFAULT_FEEDFORWARD, Feedforward
from echelon.gains.gain import Gain
from echelon.gains.strings import string_growth
from echelon.laws.law import Law, LocalView, Memory, check_gain_fits
from echelon.models.model import ControlAffine
from echelon.network.graph import Graph


def _feedforward(name: object) -> Feedforward:
    try:
        return Feedforward.named(name)
    except KeyError:
        names = list(map(str, Feedforward))
        raise LawError(
            f"`feedforward` is `{name}`, allowed are {listing(names)}"
            f"{did_you_mean(str(name), names)}."
        ) from None


class Consensus(Law):
    """u_i = u* + S (kappa(x_i) + v_ff - c R^-1 (g(x_i) S)'P (e_i + d_i)).

    It is the paper's law at c = 1, R = I, v_ff = 0. kappa is the gain's inner loop, if it has one.

    Args:
        gain: P, R and c.
        feedforward: what is sent of others' inputs of the same step, after their limits, `relay`
            unless given: `none`; `relay`, the leader's normalized input; `relay-velocity`, the
            velocity g S v that it makes, of which each follower takes the input nearest in P;
            `parent`, on a tree, the normalized input of the neighbour nearer to the leader. The
            paper's network gives none of this.
        trim: whether the trim input u* is applied; the paper's printed law has none (literal:
            False).
    """

    gain: Gain
    # Static: what is sent decides the structure of a step, so each choice is compiled for itself.
    feedforward: Feedforward = eqx.field(
        default=DEFAULT_FEEDFORWARD, static=True, converter=_feedforward
    )
    trim: bool = eqx.field(default=True, static=True)

    def __check_init__(self) -> None:
        """Refuse what is no gain."""
        if not isinstance(self.gain, Gain):
            raise LawError(
                f"`gain` of `Consensus` is {self.gain!r}, and must be a `Gain`, as `synthesize` "
                "returns it."
            )

    @property
    def information(self) -> tuple[str, ...]:
        """Neighbours' states, and what is fed forward."""
        silent = self.feedforward is Feedforward.NONE
        return ("neighbours' states", *(() if silent else (self.feedforward.value,)))

    def metric(self, model: ControlAffine) -> Array:
        """Return the gain's P."""
        return self.gain.P

    def prepared(self, model: ControlAffine, graph: Graph) -> "Consensus":
        """Check that the gain fits the model, and the feed-forward the graph."""
        check_gain_fits(self, model, self.gain.P.shape, self.gain.R.shape)
        if self.feedforward is Feedforward.PARENT:
            # Raises where the graph is no tree; what it returns is computed again where it is used.
            graph.parents()
        return self

    def warnings(self, model: ControlAffine, graph: Graph) -> tuple[str, ...]:
        """Tell by how much a branch amplifies, fed its parent's input or heard one way."""
        alone = graph.directed and graph.schedule is None
        alone = alone and len(graph.edges) == len(graph.followers)
        if self.feedforward is not Feedforward.PARENT and not alone:
            return ()
        return string_growth(self.gain, model, graph)

    def update(self, model: ControlAffine, view: LocalView, memory: Memory) -> tuple[Input, Memory]:
        """Return the input of one agent."""
        sent = view.feedforward
        if self.feedforward is Feedforward.RELAY_VELOCITY:
            sent = _match_velocity(self.gain, model, view.x, sent)
        v = sent - feedback(self.gain, model, view.x, view.disagreement)
        return model.physical(v + self.gain.inner_loop(model, view.x), trim=self.trim), memory

    def broadcast(self, model: ControlAffine, x: State, v: Input) -> Float[jax.Array, " k"]:
        """Return the input beyond the inner loop, v - kappa(x), or the velocity that it makes."""
        # A follower closes its own loop about its own state, and adds this; with the whole v the
        # loop would count twice wherever the two states differ.
        beyond = v - self.gain.inner_loop(model, x)
        if self.feedforward is Feedforward.RELAY_VELOCITY:
            return model.normalized_input_map(x) @ beyond
        return beyond

    def drift(self, model: ControlAffine, x: State) -> State:
        """Return the drift with the inner loop closed."""
        # What Assumption 5 must hold of under this law: the loop is there without any neighbour.
        return model.velocity(x, model.physical(self.gain.inner_loop(model, x)))


def _match_velocity(gain: Gain, model: ControlAffine, x: State, velocity: State) -> Input:
    """Return the normalized input (m,) whose g(x) S v is nearest to a velocity in the metric P."""
    G = model.normalized_input_map(x)
    # Least |G v - velocity|_P: G'P G v = G'P velocity. The second sum of V' has just this P, so
    # that what no input can match pushes V least.
    weighted = G.T @ jnp.asarray(gain.P, x.dtype)
    return jnp.linalg.solve(weighted @ G, weighted @ velocity)


def feedback(gain: Gain, model: ControlAffine, x: State, error: State) -> Input:
    """Return c R^-1 (g(x) S)'P error, a normalized input (m,)."""
    # From the right: vectors only, and in the precision of the states.
    weighted = jnp.asarray(gain.P, x.dtype) @ error
    pulled = model.normalized_input_map(x).T @ weighted
    return gain.coupling * (jnp.asarray(gain.R_inverse, x.dtype) @ pulled)
