"""What the hull filter guarantees: agents never touch, from these starts (T10)."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from echelon.core.claim import Claim, ClaimKind, Number, Rounding
from echelon.core.digits import at_least, at_most
from echelon.core.statement import Hypothesis, Statement, holds, left_to_run
from echelon.core.types import Array
from echelon.core.words import Kind, Theorem
from echelon.guarantees.stopping.stopping_run import StoppingRun, flat_states_of
from echelon.guarantees.stopping.tube import Tube
from echelon.laws.safety import AXES, Safety
from echelon.laws.safety_check import hulls_at, separations

_EXACT = (
    "the model is exact",
    "time is continuous",
    "no input is at a limit",
    "all is known at the same instant",
)


class Separation(NamedTuple):
    """What is guaranteed of the distances between the agents of a run.

    Attributes:
        least: the smallest distance of two hulls at the start, scaled, m.
        gap: (r, d) the points of the first one's hull less those of the other, m.
        scales: (d,) of the coordinates.
        speeds: (d,) of the followers in them.
        step: for which inputs are held, s.
        ideal: whether the run is one that the theorem covers.
        kind: of the argument: that of the tube, or weaker.
    """

    safety: Safety
    least: float
    pair: tuple[int, int]
    gap: Float[Array, "r d"]
    scales: Float[Array, " d"]
    speeds: Float[Array, " d"]
    axes: tuple[str, ...]
    step: float
    ideal: bool
    tube: Tube
    kind: Kind

    @property
    def theorem(self) -> Theorem:
        """T10."""
        return Theorem.T10

    @property
    def line(self) -> Statement:
        """The line of a check."""
        name, number = Hypothesis.SEPARATION, (self.least, f"{at_most(self.least)} m at the start")
        if self.ideal:
            kept, exact = at_most(self.safety.distance), ", ".join(_EXACT)
            text = f"{kept} m are kept, scaled, while {exact} (T10)"
            return holds(name, self.kind, text, *number)
        text = f"observed, not proved: T10 rests on it that {', '.join(_EXACT)}"
        remedy = "allow for the rest by `safety.margin`"
        return left_to_run(name, "the world is ideal", text, *number, remedy, self.kind)

    def claim(self) -> Claim:
        """Return what is claimed."""
        radii = " x ".join(at_most(self.safety.size[AXES.index(x)], 4) for x in self.axes)
        tube, changing = self.tube, self.tube.offsets is not None
        why = "offsets change" if changing else "agents hold each other back"
        notes = (
            f"ellipsoids of {radii} m about the agents never overlap",
            f"inputs are held for {at_least(self.step)} s, which `safety.margin` has to allow for",
            f"convergence is not guaranteed while {why}",
        )
        numbers = {"kept_distance": Number(self.safety.distance, "m", Rounding.DOWN)}
        if not changing:
            numbers["rate_alone"] = Number(tube.rate, "1/s", Rounding.DOWN)
        if tube.motor_load is not None:
            numbers |= tube.motor_load.numbers()
            notes += tube.motor_load.notes()
        graphs = "any number of agents", "any graph"
        premises = (*_EXACT, "each agent stays in its tube (T5)")
        return Claim(ClaimKind.APART, ("these starts",), graphs, premises, numbers, notes)

    def as_mapping(self) -> dict[str, object]:
        """Return it ready for JSON."""
        numbers = {name: getattr(self.safety, name) for name in ("gain", "margin", "reach")}
        return {
            "radii": list(self.safety.size),
            **numbers,
            "distance": self.safety.distance,
            "least": self.least,
            "pair": list(self.pair),
            "gap": self.gap.tolist(),
            "axes": list(self.axes),
            "speeds": self.speeds.tolist(),
            "step": self.step,
            "ideal": self.ideal,
        }


def separation_of(run: StoppingRun, tube: Tube | None, disturbed: bool) -> Separation | None:
    """Return what is guaranteed of distances; None without `safety`, or without a tube."""
    safety, model = run.law.safety, run.parts.model
    if safety is None or tube is None:
        return None
    scales = safety.scales(model)
    hulls = hulls_at(run.law, model, run.leader, run.parts.graph, run.states)
    apart = separations(hulls * scales) + np.diag(np.full(len(hulls), np.inf))
    i, j = sorted(np.unravel_index(apart.argmin(), apart.shape))
    speeds = np.array([run.law.speed_of(k) for k in run.law.places(model)])
    rows = (int(i), int(j)), hulls[i] - hulls[j], scales, speeds, tuple(model.position)
    # That outputs are the position follows from the equations, or the law has seen it at samples.
    exact = {*model.position} <= {*flat_states_of(model, run.law.ready.chains).outputs}
    kind = min(tube.kind, tube.kind if exact else Kind.SAMPLES, key=lambda kind: kind.strength)
    step, ideal = run.settings.dt, not disturbed
    return Separation(safety, float(apart[i, j]), *rows, step, ideal, tube, kind)
