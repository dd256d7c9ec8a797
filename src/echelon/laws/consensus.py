"""The paper's follower law, with the coupling, input weight and feed-forward that make it work."""

import equinox as eqx
import jax.numpy as jnp

from echelon._errors import LawError
from echelon._graph import Graph
from echelon._types import Input, Matrix, State
from echelon.gains.gain import Gain
from echelon.laws.law import Feedforward, Law, LocalView, Memory, check_gain_fits
from echelon.models.model import ControlAffine


class Consensus(Law):
    """u_i = u* + S (kappa(x_i) + v_ff - c R^-1 (g(x_i) S)'P (e_i + d_i)).

    It is the paper's law at c = 1, R = I, v_ff = 0. kappa is the gain's inner loop, if it has one.

    Args:
        gain: P, R and c.
        feedforward: `none`, or `relay`: the leader's normalized input of the same step, after its
            limits. The paper's network does not give this to followers that are not the leader's
            neighbours.
        trim: whether the trim input u* is applied; the paper's printed law has none (literal:
            False).
    """

    gain: Gain
    feedforward: Feedforward = eqx.field(default="none", static=True)
    trim: bool = eqx.field(default=True, static=True)

    def __check_init__(self) -> None:
        """Refuse what is no gain, and an unknown feed-forward."""
        if not isinstance(self.gain, Gain):
            raise LawError(
                f"`gain` of `Consensus` is {self.gain!r}, and must be a `Gain`, as `synthesize` "
                "returns it."
            )
        if self.feedforward not in ("none", "relay"):
            raise LawError(
                f"`feedforward` is `{self.feedforward}`, allowed are `none` and `relay`."
            )

    @property
    def needs(self) -> tuple[str, ...]:
        """Neighbours' states; the leader's input when relayed."""
        relayed = ("the leader's input of the same step",) if self.feedforward == "relay" else ()
        return ("neighbours' states", *relayed)

    def asks(self) -> Feedforward:
        """Return the chosen feed-forward."""
        return self.feedforward

    def metric(self, model: ControlAffine) -> Matrix:
        """Return the gain's P."""
        return self.gain.P

    def prepared(self, model: ControlAffine, graph: Graph) -> "Consensus":
        """Check that the gain fits the model."""
        check_gain_fits(self, model, self.gain.P.shape, self.gain.R.shape)
        return self

    def update(self, model: ControlAffine, view: LocalView, memory: Memory) -> tuple[Input, Memory]:
        """Return the input of one agent."""
        v = view.feedforward - feedback(self.gain, model, view.x, view.disagreement)
        return model.physical(v + self.gain.inner_loop(model, view.x), trim=self.trim), memory

    def message(self, model: ControlAffine, x: State, v: Input) -> Input:
        """Return the leader's input beyond the inner loop, v - kappa(x)."""
        return v - self.gain.inner_loop(model, x)

    def drift(self, model: ControlAffine, x: State) -> State:
        """Return the drift with the inner loop closed."""
        return model.velocity(x, model.physical(self.gain.inner_loop(model, x)))


def feedback(gain: Gain, model: ControlAffine, x: State, error: State) -> Input:
    """Return c R^-1 (g(x) S)'P error, a normalized input (m,)."""
    weighted = jnp.asarray(gain.P, x.dtype) @ error
    pulled = model.normalized_input_map(x).T @ weighted
    return gain.coupling * (jnp.asarray(gain.R_inverse, x.dtype) @ pulled)
