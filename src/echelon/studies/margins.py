"""What `check` says of the law near the trim: whether it works, and by how much."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import scipy.sparse.csgraph as csgraph

from echelon.certificates import margins
from echelon.certificates.bounds import invariant_ellipsoid, peak_gain
from echelon.core.types import Array
from echelon.core.words import Kind, Verdict
from echelon.models.linearization import trim_slopes
from echelon.models.model import ControlAffine
from echelon.promises.closed_loop import CheckedLoop, step_radius
from echelon.studies.lines import Line

_KIND = Kind.LINEARIZATION


def law_lines(loop: CheckedLoop) -> Iterator[Line]:
    """Yield what the law needs to work at all."""
    model, certificate = loop.parts.model, loop.certificate
    n, rank = len(model.state_names), certificate.observable
    hidden = margins.detectability(loop.linear.A, loop.linear.B.T @ loop.closed.P)
    names = sorted({k for mode in hidden for k in np.flatnonzero(np.abs(mode.direction) > 0.1)})
    along = ", ".join(f"`{model.state_names[k]}`" for k in names)
    text = f"never felt by the input: {along}; choose another P" if hidden else "z = 0 is reached"
    verdict = Verdict.of(not hidden)
    yield Line("detectability of (A, g'P)", verdict, _KIND, f"rank {rank} of {n}", text)
    yield _matched_line(loop)
    edge, c = certificate.edge, loop.closed.coupling
    text = "no edge known"
    if edge is not None:
        text = "guaranteed for linear agents from the edge on"
        text += "" if c >= edge else "; raise `coupling` to it"
    number = f"c {c:.4g}" + ("" if edge is None else f", edge {edge:.4g}")
    fine = edge is None or c >= edge
    yield Line("coupling", Verdict.of(fine), Kind.PROOF, number, text)
    yield _decay_line(loop)
    yield _step_line(loop)


def _matched_line(loop: CheckedLoop) -> Line:
    text = "the leader has no input beyond its trim, so there is nothing to tell"
    if loop.moving:
        text = "the leader's input reaches every follower, which the paper's network does not give"
        text = "each follower is told its parent's input" if loop.fed_by_parents else text
    if not loop.matched:
        text = "followers lag behind a moving leader; `feedforward: relay` removes it"
    return Line("leader's motion is matched", Verdict.of(loop.matched), Kind.PROOF, "", text)


def _decay_line(loop: CheckedLoop) -> Line:
    """Whether every mode of the network decays; `every` covers what lies between extremes."""
    certificate, followers = loop.certificate, len(loop.parts.graph.followers)
    text = f"over {certificate.modes} eigenvalues of the graph"
    if loop.fed_by_parents:
        text = "over the edges' weights, as parents' inputs are fed forward"
    elif certificate.modes < followers:
        text = f"at lambda_min and lambda_max; {'all' if loop.every else 'not all'} between decay"
    if not loop.governed:
        text = "the followers' law does not use the disagreement; use `consensus`"
    elif not loop.every:
        text += "; raise `coupling`, or use `riccati` or `inner-loop`"
    verdict = Verdict.of(loop.every and loop.governed)
    return Line("disagreement decays", verdict, _KIND, f"{certificate.abscissa:.3g} 1/s", text)


def _step_line(loop: CheckedLoop) -> Line:
    """Whether it still decays with the input held over the scenario's step."""
    statement, dt = "step, input held", loop.settings.dt
    number = f"dt {dt:g} s"
    if not loop.every:
        return Line(statement, Verdict.NOT_NEEDED, _KIND, number, "there is nothing to lose")
    radius = step_radius(loop, dt)
    text = f"spectral radius {radius:.4g} a step, {loop.where}"
    text += "" if radius < 1.0 else "; shorten `simulation.dt` or lower the gain"
    return Line(statement, Verdict.of(radius < 1.0), _KIND, number, text)


def margin_lines(loop: CheckedLoop) -> Iterator[Line]:
    """Yield how far the loop is from losing what it promises."""
    if not (loop.every and loop.governed):
        yield Line("margins", Verdict.NOT_NEEDED, _KIND, "", "there is nothing to lose")
        return
    factors, delay = margins.gain_margin(loop.closed), margins.delay_margin(loop.closed)
    number = f"{factors.low:.3g} to {factors.high:.3g}"
    yield Line("gain margin", Verdict.HOLDS, _KIND, number, "factors on the coupling")
    number = f"{1e3 * delay.delay:.3g} ms" if np.isfinite(delay.delay) else "any"
    text = f"uniform delay of z, lost at lambda = {delay.eigenvalue:.3g}; {loop.where}"
    yield Line("delay margin", Verdict.HOLDS, _KIND, number, text)
    yield _scaling_line(loop)
    # The bound of the network rests on a symmetric matrix, which parents' inputs take away.
    yield from () if loop.fed_by_parents else _push_lines(loop)
    yield from _string_line(loop)


def _scaling_line(loop: CheckedLoop) -> Line:
    # The trim input, and an inner loop's, weaken with the rest.
    slopes = trim_slopes(loop.parts.model)
    slopes = slopes - loop.linear.B.T[:, :, None] * loop.inner[:, None, :]
    worst = margins.input_scaling(loop.closed, slopes=slopes)
    text = "inputs 30 % weaker or stronger, as by a wrong mass or inertia"
    text += "" if worst.abscissa < 0.0 else "; identify them better, or raise `coupling`"
    number = f"{worst.abscissa:.3g} 1/s"
    return Line("input scaling", Verdict.of(worst.abscissa < 0.0), _KIND, number, text)


class _Push(NamedTuple):
    """A disturbance w that enters by E (n, q), and the states that are watched."""

    E: Array
    where: str
    watched: tuple[int, ...]


def _push(model: ControlAffine) -> _Push:
    """Return accelerations of a vehicle, or else of all states; positions, or else all states."""
    n, groups = len(model.state_names), model.state_groups
    pushed = model.states_called("velocity") if "velocity" in groups else tuple(range(n))
    names = ", ".join(f"`{model.state_names[k]}`" for k in pushed)
    units = {model.state_units[k] for k in pushed}
    unit = units.pop() if len(units) == 1 else ""
    per = {"m/s": " m/s^2", "": ""}.get(unit, f" {unit}/s")
    return _Push(np.eye(n)[:, pushed], f"1{per} on {names}", model.position_indices() or pushed)


def _push_lines(loop: CheckedLoop) -> Iterator[Line]:
    model = loop.parts.model
    E, where, watched = _push(model)
    units = {model.state_units[k] for k in watched}
    unit = f"{units.pop()} " if len(units) == 1 and "" not in units else ""

    def number(bounds: Array) -> str:
        return ", ".join(f"{model.state_names[k]} {bounds[k]:.3g}" for k in watched)

    text = f"{unit}per {where}: no push of that norm on all followers together takes any farther"
    text, outer = f"{text}; {loop.where}", invariant_ellipsoid(loop.closed, E)
    yield Line("disturbance, network", Verdict.HOLDS, _KIND, number(outer), text)
    text = f"{unit}per {where}: the exact peak, for a push shaped like the worst eigenvector"
    text, exact = f"{text}; {loop.where}", peak_gain(loop.closed, E)
    yield Line("disturbance, one mode", Verdict.HOLDS, _KIND, number(exact), text)


def _string_line(loop: CheckedLoop) -> Iterator[Line]:
    """On a tree with unit weights: what a chain of parents' inputs would amplify."""
    graph = loop.parts.graph
    tree = len(graph.edges) == graph.agents - 1 and len(graph.leaders) == 1
    if not tree or not (graph.weights == 1.0).all() or loop.closed.coupling < 0.5:
        return
    gain = margins.string_gain(loop.closed).gain
    hops = csgraph.dijkstra(graph.adjacency(), indices=graph.leaders[0], unweighted=True)
    depth = int(hops.max())
    number = f"{gain:.3g}, {gain**depth:.3g} over {depth} links"
    used = loop.fed_by_parents
    text = "by so much a push may grow along a branch; fewer links or more `coupling` help"
    if not used:
        text = "what feeding forward the parent's input would amplify; it is not used here"
    yield Line("string gain", Verdict.HOLDS if used else Verdict.NOT_NEEDED, _KIND, number, text)
