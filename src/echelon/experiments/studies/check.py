"""Checks parts against the paper's assumptions and lemmas, and computes what is guaranteed."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from echelon.agents.models.linearization import trim_slopes
from echelon.agents.models.model import ControlAffine
from echelon.core.digits import about, at_least, at_most
from echelon.core.files import notebook_page
from echelon.core.numerics import precision
from echelon.core.statement import Statement, Topic, fails, holds, unneeded, vacuous
from echelon.core.types import Array, JsonObject
from echelon.core.words import Feedforward, Kind, amount
from echelon.experiments.studies.assumptions import drift_lines, graph_lines
from echelon.experiments.studies.observed_region import ObservedRegion
from echelon.guarantees.local.spectra import Split
from echelon.guarantees.local.step_margins import delay_margin, gain_margin
from echelon.guarantees.promises.closed_loop import LinearLoop
from echelon.guarantees.promises.integral_modes import sum_costs, sum_lines
from echelon.guarantees.promises.promise import AgreementModes, Guarantee, guarantee
from echelon.simulation.engine.parts import Parts
from echelon.simulation.engine.prepare import prepare
from echelon.simulation.step.settings import Settings
from echelon.synthesis.certificates import margins
from echelon.synthesis.certificates.margins import invariant_ellipsoid, peak_gain

# ---- stability margins of the linearized loop ----------------------------------------------------

_KIND = Kind.LINEARIZATION
_WIDE = 4
"""Ratio of lambda_max to lambda_min above which the delay margin is reduced much."""
_STIFF = 1e10
"""Ratio of modes above which the slowest one has fewer than six digits."""


def margin_lines(parts: Parts, settings: Settings, promise: Guarantee) -> Iterator[Statement]:
    """Yield the margins of a stable loop."""
    loop = promise.loop
    yield from sum_lines(parts, loop, promise.decays)
    if parts.graph.schedule is not None:
        yield from _switching_lines(promise)
        return
    if promise.agreement is not None:
        text = "any coupling; the delay margin depends only on c and the graph"
        yield unneeded(Topic.MARGINS, _KIND, text)
        yield from _agreement_lines(promise.agreement)
        return
    if promise.decays and any(sum_costs(parts, loop)):
        yield from _step_lines(promise.steps, settings.dt)
        return
    if not promise.governed:
        yield unneeded(Topic.MARGINS, _KIND, "no modes of this loop are known")
        return
    if not promise.linear:
        text = "the model is not smooth at the trim, and has no modes there"
        yield vacuous(Topic.MARGINS, _KIND, text)
        return
    if not loop.every:
        yield unneeded(Topic.MARGINS, _KIND, "the loop is not stable")
        return
    stiffness = margins.stiffness(loop.closed)
    if stiffness > _STIFF:
        ratio = about(stiffness, 2)
        text = f"the fastest mode is {ratio} times the slowest, which is lost in rounding"
        yield unneeded(Topic.MARGINS, _KIND, text, stiffness)
        return
    yield from _step_lines(promise.steps, settings.dt)
    yield _scaling_line(parts.model, loop)
    # The bound for the network needs a symmetric matrix.
    yield from _disturbance_lines(parts.model, loop) if loop.symmetric else ()
    yield from _string_line(parts, loop)


def _step_lines(steps: Split | None, dt: float) -> Iterator[Statement]:
    """Yield by how much z may be scaled or late, in the steps that run."""
    factors = None if steps is None else gain_margin(steps)
    if steps is None or factors is None:
        text = "the steps that run do not split into modes of the graph that decay"
        yield from (unneeded(name, _KIND, text) for name in (Topic.GAIN, Topic.DELAY))
        return
    text = "factors on the disagreement, as on the coupling, in the steps that run"
    shown = f"{at_least(factors.low)} to {at_most(factors.high)}"
    yield holds(Topic.GAIN, _KIND, text, factors.low, shown)
    delay, low = delay_margin(steps), np.real(steps.eigenvalues).min()
    if delay.last:
        text = f"z late by {amount(delay.steps, 'step')} of {dt:g} s, and no more were tried"
    else:
        text = f"z late by whole steps, up to {amount(delay.steps, 'step')} of {dt:g} s; one more"
        late = delay.eigenvalue
        text += " is undecided" if late is None else f" is too late for lambda = {about(late)}"
        text += "" if delay.each else "; beyond 20 steps every tenth part was tried"
    yield holds(Topic.DELAY, _KIND, text, delay.steps * dt, f"{about(1e3 * delay.steps * dt)} ms")
    best = delay_margin(steps._replace(eigenvalues=np.array([low]), between=False))
    high = np.abs(steps.eigenvalues).max()
    yield _spread_line(float(low), float(high), delay.steps * dt, best.steps * dt)


def _switching_lines(promise: Guarantee) -> Iterator[Statement]:
    """Yield that no margins are known of graphs that switch."""
    text = "any coupling; " if promise.agreement is not None else ""
    text += "delay margins are known for one graph only, not for switching graphs"
    yield unneeded(Topic.MARGINS, _KIND, text)


def _spread_line(low: float, high: float, delay: float, best: float) -> Statement:
    """Couplings are chosen for lambda_min; the delay margin of a mode decreases with c lambda."""
    ratio = high / low
    if not ratio > _WIDE:
        text = f"at most {_WIDE}, so the fastest mode reduces the delay margin little"
        return holds(Topic.EIGENVALUE_RATIO, _KIND, text, ratio, about(ratio))
    text = f"delay margin {at_most(1e3 * delay)} ms; it would be {at_most(1e3 * best)} ms if all "
    text += f"eigenvalues of the graph were equal (their ratio is {about(ratio)})"
    remedy = "let agents send only away from the leader, by `graph.directed: true`"
    return fails(Topic.EIGENVALUE_RATIO, _KIND, text, ratio, about(ratio), remedy=remedy)


def _agreement_lines(agreement: AgreementModes) -> Iterator[Statement]:
    """A root s = i w of s + c lambda e^(-s tau) has w = c |lambda|, and a phase of pi/2."""
    c, values = agreement
    delays = (0.5 * np.pi - np.abs(np.angle(values))) / (c * np.abs(values))
    at, sizes = int(delays.argmin()), np.abs(values)
    text = f"uniform delay of z, critical mode lambda = {about(values[at])}"
    yield holds(Topic.DELAY, _KIND, text, float(delays[at]), f"{at_most(1e3 * delays[at])} ms")
    best = 0.5 * np.pi / (c * float(np.real(values).min()))
    yield _spread_line(float(np.real(values).min()), float(sizes.max()), float(delays[at]), best)


def _scaling_line(model: ControlAffine, loop: LinearLoop) -> Statement:
    # The factors also scale the trim input and the inner loop.
    slopes = trim_slopes(model) - loop.linear.B.T[:, :, None] * loop.inner[:, None, :]
    worst = margins.input_scaling(loop.closed, slopes=slopes).abscissa
    text = "each input 30 % weaker or stronger (checked only at these corners), as by a wrong mass "
    text += "or inertia"
    number = worst, f"{at_least(worst)} 1/s"
    if worst < 0.0:
        return holds(Topic.SCALING, _KIND, text, *number)
    remedy = "identify them better, or raise `coupling`"
    return fails(Topic.SCALING, _KIND, text, *number, remedy=remedy)


class _DisturbanceInput(NamedTuple):
    """A disturbance w that enters by E, and the states whose deviation is bounded."""

    E: Float[Array, "n q"]
    where: str
    bounded: tuple[int, ...]


def _disturbance_input(model: ControlAffine) -> _DisturbanceInput:
    """Return a disturbance of velocities, or of all states, and the states that it affects."""
    n, groups = len(model.state_names), model.state_groups
    # Wind is a force, and enters a vehicle's equations only as an acceleration.
    disturbed = model.states_called("velocity") if "velocity" in groups else tuple(range(n))
    names = ", ".join(f"`{model.state_names[k]}`" for k in disturbed)
    units = {model.state_units[k] for k in disturbed}
    unit = units.pop() if len(units) == 1 else ""
    per = {"m/s": " m/s^2", "": ""}.get(unit, f" {unit}/s")
    bounded = model.position_indices() or disturbed
    return _DisturbanceInput(np.eye(n)[:, disturbed], f"1{per} on {names}", bounded)


def _disturbance_lines(model: ControlAffine, loop: LinearLoop) -> Iterator[Statement]:
    E, where, bounded = _disturbance_input(model)
    units = {model.state_units[k] for k in bounded}
    unit = f"{units.pop()} " if len(units) == 1 and "" not in units else ""

    def line(name: Topic, bounds: Float[Array, " n"], text: str) -> Statement:
        sizes = ", ".join(f"{model.state_names[k]} {at_least(bounds[k])}" for k in bounded)
        worst, text = float(bounds[list(bounded)].max()), f"{unit}per {where}: {text}; {loop.where}"
        # Of an interval of eigenvalues, so many values are tried.
        kind = Kind.SAMPLES if loop.closed.between else _KIND
        return holds(name, kind, text, worst, sizes)

    text = "bound for any disturbance of that norm on all followers together"
    yield line(Topic.DISTURBANCE_NETWORK, invariant_ellipsoid(loop.closed, E), text)
    text = "exact peak, for a disturbance along the worst eigenvector"
    yield line(Topic.DISTURBANCE_MODE, peak_gain(loop.closed, E), text)


def _string_line(parts: Parts, loop: LinearLoop) -> Iterator[Statement]:
    """Yield, on a tree with unit weights, the amplification along a chain of parents' inputs."""
    graph = parts.graph
    tree = len(graph.edges) == graph.agents - 1 and len(graph.leaders) == 1
    tree = tree and graph.schedule is None
    if not tree or not (graph.weights == 1.0).all() or loop.closed.coupling < 0.5:
        return
    gain = margins.string_gain(loop.closed).gain
    depth = int(graph.depths().max())
    number = gain**depth, f"{at_least(gain)}, {at_least(gain**depth)} over {amount(depth, 'link')}"
    # On a directed graph a branch is such a chain under any feed-forward.
    if parts.drive.feedforward is Feedforward.PARENT or graph.directed:
        text = (
            "largest amplification of a disturbance along a branch; fewer links or more `coupling` "
        )
        text += "reduce it"
        yield holds(Topic.STRING, _KIND, text, *number)
    else:
        text = "amplification if the parent's input were fed forward, which is not used here"
        yield unneeded(Topic.STRING, _KIND, text, *number)


# ---- the check -----------------------------------------------------------------------------------

__all__ = ["CheckResult", "check"]


class CheckResult(NamedTuple):
    """All lines, including the hypotheses of the promise; the promise; warnings of the parts.

    `region` is what was observed of random starts; None if none were simulated.
    """

    lines: tuple[Statement, ...]
    promise: Guarantee
    warnings: tuple[str, ...] = ()
    region: ObservedRegion | None = None

    def _repr_html_(self) -> str:
        return notebook_page("report", self)

    @property
    def promised(self) -> bool:
        """Whether anything is guaranteed."""
        return self.promise.promised

    def as_mapping(self) -> JsonObject:
        """Return it ready for JSON."""
        lines = [line.as_mapping() for line in self.lines]
        warnings = list(self.warnings)
        stated = {"guarantee": self.promise.as_mapping(), "lines": lines, "warnings": warnings}
        region = {} if self.region is None else {"region": self.region.as_mapping()}
        return stated | region


def check(parts: Parts, settings: Settings) -> CheckResult:
    """Check the paper's statements for parts, the hypotheses of their promise, and margins.

    Raises:
        EchelonError: a part is malformed or does not fit the others.
    """
    parts, _, warnings = prepare(parts, settings)
    stated = guarantee(parts, settings)
    with precision("float64"):
        lines = (
            *graph_lines(parts),
            *drift_lines(parts, settings, stated),
            *stated.hypotheses.values(),
            *margin_lines(parts, settings, stated),
        )
    return CheckResult(lines, stated, warnings)
