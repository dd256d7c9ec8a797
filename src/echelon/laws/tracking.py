"""The leader's law: follow a reference by flatness feed-forward and state feedback.

It serves the paper's Assumption 4.
"""

import equinox as eqx
import numpy as np

from echelon.agents.models.model import ControlAffine
from echelon.agents.network.graph import Graph
from echelon.agents.network.spectrum import Spectrum
from echelon.agents.references.demand import follow_at, without_heading
from echelon.agents.references.reference import check_reference
from echelon.core.errors import LawError, ReferenceError
from echelon.core.types import Input, Scalar, State
from echelon.laws.law import Law, LocalView, Memory, check_gain_fits
from echelon.laws.path_leader import PathLeader
from echelon.synthesis.gains.gain import Gain
from echelon.synthesis.gains.riccati import Riccati


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
    """

    gain: Gain | None = None
    reaction: Gain | None = None
    turns: bool = eqx.field(default=False, static=True)
    regulator: Gain | None = None

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
        if still or not all(np.isfinite(part).all() for part in begin):
            raise ReferenceError(
                f"the reference `{type(self.reference).__name__}` cannot be followed by "
                f"`{type(model).__name__}`: "
                f"{still or 'its flat state and input are not finite at t = 0 s'}."
            )
        turns = model.heading is not None and not self.keeps_heading(model)
        return Tracking(self.reference, self.gain, self.reaction, turns, regulator)

    def target(self, model: ControlAffine, t: Scalar) -> tuple[State, Input]:
        """Return (x_r, u_r) at time t."""
        return self.reference.follow(model, t)

    def update(self, model: ControlAffine, view: LocalView, memory: Memory) -> tuple[Input, Memory]:
        """Return the leader's input."""
        if self.regulator is None:
            raise LawError("`Tracking` has no gain yet; call `prepared(model, graph)` first.")
        state, u = self.target(model, view.t)
        heading = self.heading(model, view.t, view.x) if self.turns else None
        # With several leaders each follows the reference at an offset of its own.
        error = model.difference(view.x, state + view.offset)
        v = self.regulator.feedback(model, view.x, error, heading)
        # Normalized inputs are added, and the trim once: it is in u already.
        if self.reaction is not None:
            v = v + self.reaction.feedback(model, view.x, view.disagreement, heading)
        return u - model.physical(v, trim=False), memory


def tracking_gain(law: Law, model: ControlAffine, gain: Gain | None) -> Gain:
    """Return a leader's own gain with coupling 1, the model's Riccati gain where it is None.

    Raises:
        LawError: it does not fit the model.
    """
    # The coupling compensates lambda_min of a network; a leader knows its reference directly.
    if gain is None:
        gain = Riccati(coupling=1.0).solve(model, Spectrum(np.ones(1), 1, 1.0))
    check_gain_fits(law, model, gain.P.shape, gain.R.shape)
    return gain if gain.coupling == 1.0 else eqx.tree_at(lambda g: g.coupling, gain, 1.0)
