"""Whether a finished run kept to the conditions of a guarantee."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from echelon.core.digits import about
from echelon.core.statement import Hypothesis
from echelon.core.types import Array
from echelon.core.words import Kind, Theorem
from echelon.guarantees.promises.promise import Guarantee
from echelon.simulation.engine.result import Result

_EDGE = 1e-9  # relative; a state that rests on a bound has not left it


class Exit(NamedTuple):
    """Who was outside of the domain first, at which stored time (s), in which state or input."""

    time: float
    agent: int
    name: str


def coverage(result: Result, promise: Guarantee) -> Iterator[str]:
    """Say of a theorem's claim whether a run kept to what it rests on."""
    if promise.theorem is None or not len(result.times):
        return
    what = "proof" if promise.kind is Kind.PROOF else "guarantee on the domain"
    what = "conditional claim" if promise.conditions else what
    against = _against(result, promise)
    if not against and _unseen(result, promise):
        text = f"Whether the {what} covers this run is not known: agents may have left the domain "
        yield f"{text}between the stored frames."
    elif against:
        yield f"The {what} does not cover this run: {against}."
    else:
        yield f"The {what} covers this run: {promise.why_covered()}."


def covered(result: Result, promise: Guarantee) -> bool | None:
    """Return whether a run kept, in every step, to what a theorem's claim rests on.

    None where no theorem claims anything, and where the stored frames do not show it.
    """
    if promise.theorem is None or not len(result.times):
        return None
    against = _against(result, promise)
    return None if not against and _unseen(result, promise) else not against


def _against(result: Result, promise: Guarantee) -> str:
    """Return why a claim does not cover a run; empty where it does."""
    left = None if promise.region is None else first_exit(result, promise)
    limited = float(result.saturated.max())
    if left is not None:
        return f"agent {left.agent} left the domain at {about(left.time, 4)} s (`{left.name}`)"
    if limited:
        return f"a limit acted on an agent in {about(100.0 * limited)} % of the steps"
    return " and ".join(promise.ignores)


def _unseen(result: Result, promise: Guarantee) -> bool:
    """Tell whether stored frames alone show that agents stayed in the domain."""
    certified = not promise.hypotheses[Hypothesis.STARTS].fails and promise.theorem != Theorem.T2
    return promise.region is not None and not certified and result.settings.store_every > 1


def first_exit(result: Result, promise: Guarantee) -> Exit | None:
    """Return who leaves the domain first, its offset aside; None where nobody does.

    T1 and A5 ask it of all agents. T2 asks it of the leaders, and of their inputs, with which the
    slopes of a varying g count.
    """
    region, model, graph = promise.region, result.model, result.graph
    assert region is not None
    domain, leads, local = region.domain, list(graph.leaders), promise.theorem is Theorem.T2
    who = leads if local else list(range(graph.agents))
    x = (result.states - result.formation.offsets)[:, who] - np.asarray(model.trim[0], float)
    exits = [_outside(result, x, (domain.lower, domain.upper), who, model.state_names)]
    if local:
        v = model.normalized(result.inputs[:, leads])
        box = (domain.input_lower, domain.input_upper)
        exits.append(_outside(result, v, box, leads, model.input_names))
    return min((one for one in exits if one is not None), default=None)


def _outside(
    result: Result, values: Array, box: tuple[Array, Array], who: list[int], names: tuple[str, ...]
) -> Exit | None:
    """Return the first of values (T, K, k) outside of a box."""
    low, high = (bound + _EDGE * sign * np.abs(bound) for bound, sign in zip(box, (-1.0, 1.0)))
    out = np.argwhere((values < low) | (values > high))
    if not len(out):
        return None
    frame, place, k = out[0]
    return Exit(float(result.times[frame]), who[place], names[k])
