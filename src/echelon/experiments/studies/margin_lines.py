"""How far the loop near the trim is from losing what it promises."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from echelon.agents.models.linearization import trim_slopes
from echelon.agents.models.model import ControlAffine
from echelon.core.statement import (
    Hypothesis,
    Statement,
    Topic,
    fails,
    holds,
    unneeded,
    vacuous,
)
from echelon.core.types import Array
from echelon.core.words import Feedforward, Kind
from echelon.guarantees.promises.closed_loop import LinearLoop
from echelon.guarantees.promises.promise import AgreementModes, Promise
from echelon.simulation.engine.parts import Parts
from echelon.synthesis.certificates import margins
from echelon.synthesis.certificates.bounds import invariant_ellipsoid, peak_gain

_KIND = Kind.LINEARIZATION
_WIDE = 4
"""Of lambda_max by lambda_min; beyond it little is left of the delay that could be borne."""
_STIFF = 1e10
"""Beyond it the slowest mode has less than six digits, since rounding is of the fastest."""


def margin_lines(parts: Parts, promise: Promise) -> Iterator[Statement]:
    """Yield the margins of a loop that decays."""
    loop = promise.loop
    if parts.graph.schedule is not None:
        yield from _turns_lines(promise)
        return
    if promise.agreement is not None:
        text = "any coupling; what delay is left depends on c and the graph alone"
        yield unneeded(Topic.MARGINS, _KIND, text)
        yield from _agreement_lines(promise.agreement)
        return
    if not promise.linear:
        text = "the model bends at the trim, and has no modes there"
        yield vacuous(Topic.MARGINS, _KIND, text)
        return
    if promise.hypotheses[Hypothesis.DISAGREEMENT_DECAY].fails:
        yield unneeded(Topic.MARGINS, _KIND, "there is nothing to lose")
        return
    stiffness = margins.stiffness(loop.closed)
    if stiffness > _STIFF:
        text = f"the fastest mode is {stiffness:.2g} times the slowest, which rounding hides"
        yield unneeded(Topic.MARGINS, _KIND, text, stiffness)
        return
    low, high = margins.gain_margin(loop.closed)
    yield holds(Topic.GAIN, _KIND, "factors on the coupling", low, f"{low:.3g} to {high:.3g}")
    delay = margins.delay_margin(loop.closed)
    time = f"{1e3 * delay.delay:.3g} ms" if np.isfinite(delay.delay) else "any"
    text = f"uniform delay of z, lost at lambda = {delay.eigenvalue:.3g}; {loop.where}"
    yield holds(Topic.DELAY, _KIND, text, delay.delay, time)
    low, high = loop.certificate.lambda_min, loop.certificate.lambda_max
    alike = margins.delay_margin(loop.closed._replace(eigenvalues=np.array([low]))).delay
    yield _spread_line(low, high, delay.delay, alike)
    yield _scaling_line(parts.model, loop)
    # The bound of the network rests on a symmetric matrix.
    yield from _push_lines(parts.model, loop) if loop.symmetric else ()
    yield from _string_line(parts, loop)


def _turns_lines(promise: Promise) -> Iterator[Statement]:
    """Yield what is known of graphs that take turns: how weak the coupling may get (T8)."""
    edge, lines = promise.edge, promise.hypotheses
    anywhere = promise.agreement is not None
    if not anywhere and edge is not None and not lines[Hypothesis.DISAGREEMENT_DECAY].fails:
        low = edge / promise.loop.closed.coupling
        what = "factors on the coupling with which one P serves all graphs, whenever they switch"
        yield holds(Topic.GAIN, _KIND, what, low, f"{low:.3g} to inf")
    text = "any coupling; " if anywhere else ""
    text += "what delay is left is of one graph, and none is known for graphs that take turns"
    yield unneeded(Topic.MARGINS, _KIND, text)


def _spread_line(low: float, high: float, delay: float, best: float) -> Statement:
    """Warn where the graph makes its fastest mode many times as strong as its slowest.

    Couplings are chosen for lambda_min, and what delay a mode bears falls with c lambda; `best` is
    the delay that is left at lambda_min alone.
    """
    ratio = high / low
    if not ratio > _WIDE:
        text = f"no more than {_WIDE}, so that the fastest mode costs little of the delay"
        return holds(Topic.EIGENVALUE_RATIO, _KIND, text, ratio, f"{ratio:.3g}")
    text = f"lambda_max is {ratio:.3g} times lambda_min, for which c is chosen: "
    text += f"z may be {1e3 * delay:.3g} ms old, and could be {1e3 * best:.3g} ms if all were equal"
    remedy = "let agents hear one way, from the leader outward, by `graph.directed: true`"
    return fails(Topic.EIGENVALUE_RATIO, _KIND, text, ratio, f"{ratio:.3g}", remedy=remedy)


def _agreement_lines(agreement: AgreementModes) -> Iterator[Statement]:
    """Yield what delay agreement bears where zeta' = -c L zeta: pi/2 - |arg lambda| by c |lambda|.

    A root s = i w of s + c lambda e^(-s tau) has w = c |lambda|, and reaches the axis first at that
    delay.
    """
    c, values = agreement
    delays = (0.5 * np.pi - np.abs(np.angle(values))) / (c * np.abs(values))
    at, sizes = int(delays.argmin()), np.abs(values)
    text = f"uniform delay of z, lost at lambda = {values[at]:.3g}"
    yield holds(Topic.DELAY, _KIND, text, float(delays[at]), f"{1e3 * delays[at]:.3g} ms")
    best = 0.5 * np.pi / (c * float(np.real(values).min()))
    yield _spread_line(float(np.real(values).min()), float(sizes.max()), float(delays[at]), best)


def _scaling_line(model: ControlAffine, loop: LinearLoop) -> Statement:
    # The trim input, and an inner loop's, weaken with the rest.
    slopes = trim_slopes(model) - loop.linear.B.T[:, :, None] * loop.inner[:, None, :]
    worst = margins.input_scaling(loop.closed, slopes=slopes).abscissa
    text = "each input 30 % weaker or stronger (at these corners, not between them), as by a wrong "
    text += "mass or inertia"
    number = worst, f"{worst:.3g} 1/s"
    if worst < 0.0:
        return holds(Topic.SCALING, _KIND, text, *number)
    remedy = "identify them better, or raise `coupling`"
    return fails(Topic.SCALING, _KIND, text, *number, remedy=remedy)


class _Push(NamedTuple):
    """A disturbance w that enters by E (n, q), and the states that are watched."""

    E: Array
    where: str
    watched: tuple[int, ...]


def _push(model: ControlAffine) -> _Push:
    """Return accelerations of a vehicle, or else of all states; positions, or else all states."""
    n, groups = len(model.state_names), model.state_groups
    # Wind is a force, and enters a vehicle's equations as an acceleration alone.
    pushed = model.states_called("velocity") if "velocity" in groups else tuple(range(n))
    names = ", ".join(f"`{model.state_names[k]}`" for k in pushed)
    units = {model.state_units[k] for k in pushed}
    unit = units.pop() if len(units) == 1 else ""
    per = {"m/s": " m/s^2", "": ""}.get(unit, f" {unit}/s")
    return _Push(np.eye(n)[:, pushed], f"1{per} on {names}", model.position_indices() or pushed)


def _push_lines(model: ControlAffine, loop: LinearLoop) -> Iterator[Statement]:
    E, where, watched = _push(model)
    units = {model.state_units[k] for k in watched}
    unit = f"{units.pop()} " if len(units) == 1 and "" not in units else ""

    def line(name: Topic, bounds: Array, text: str) -> Statement:
        each = ", ".join(f"{model.state_names[k]} {bounds[k]:.3g}" for k in watched)
        worst, text = float(bounds[list(watched)].max()), f"{unit}per {where}: {text}; {loop.where}"
        return holds(name, _KIND, text, worst, each)

    text = "no push of that norm on all followers together takes any farther"
    yield line(Topic.DISTURBANCE_NETWORK, invariant_ellipsoid(loop.closed, E), text)
    text = "the exact peak, for a push shaped like the worst eigenvector"
    yield line(Topic.DISTURBANCE_MODE, peak_gain(loop.closed, E), text)


def _string_line(parts: Parts, loop: LinearLoop) -> Iterator[Statement]:
    """On a tree with unit weights: what a chain of parents' inputs would amplify."""
    graph = parts.graph
    tree = len(graph.edges) == graph.agents - 1 and len(graph.leaders) == 1
    tree = tree and graph.schedule is None
    if not tree or not (graph.weights == 1.0).all() or loop.closed.coupling < 0.5:
        return
    gain = margins.string_gain(loop.closed).gain
    depth = int(graph.depths().max())
    number = gain**depth, f"{gain:.3g}, {gain**depth:.3g} over {depth} links"
    # Heard one way, a branch is such a chain whatever is fed forward.
    if parts.drive.feedforward is Feedforward.PARENT or graph.directed:
        text = "by so much a push may grow along a branch; fewer links or more `coupling` help"
        yield holds(Topic.STRING, _KIND, text, *number)
    else:
        text = "what feeding forward the parent's input would amplify; it is not used here"
        yield unneeded(Topic.STRING, _KIND, text, *number)
