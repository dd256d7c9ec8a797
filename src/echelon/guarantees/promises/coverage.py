"""Whether a finished run kept to the conditions of a guarantee."""

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from echelon.agents.models.model import ControlAffine
from echelon.agents.models.model_check import is_limited
from echelon.core.digits import about
from echelon.core.types import Array, JsonObject
from echelon.core.words import Kind, Theorem
from echelon.guarantees.promises.promise import Guarantee, kept_on_disk
from echelon.guarantees.promises.region import entered
from echelon.simulation.engine.parts import Parts
from echelon.simulation.engine.result import Result
from echelon.simulation.step.settings import Settings

_EDGE = 1e-9  # relative; a state that rests on a bound has not left it


class Exit(NamedTuple):
    """Who was outside of the domain first, when (s), in which state or input.

    The time is that of a stored frame; infinite where no stored frame shows it.
    """

    time: float
    agent: int
    name: str


def coverage(result: Result, promise: Guarantee) -> Iterator[str]:
    """Say of a theorem's claim whether a run kept to what it rests on."""
    if promise.theorem is None or not len(result.times):
        return
    what = "proof" if promise.kind is Kind.PROOF else "guarantee on the domain"
    what = "conditional claim" if promise.conditions else what
    against, inside = _against(result, promise), _inside_from(result, promise)
    if against:
        yield f"The {what} does not cover this run: {against}."
    elif inside:
        when = about(inside, 4)
        yield f"The {what} covers this run: all agents were in the certified set at {when} s."
    else:
        yield f"The {what} covers this run: {promise.why_covered()}."


def covered(result: Result, promise: Guarantee) -> bool | None:
    """Return whether a run kept, in every step, to what a theorem's claim rests on.

    None where no theorem claims anything.
    """
    if promise.theorem is None or not len(result.times):
        return None
    return not _against(result, promise)


def _against(result: Result, promise: Guarantee) -> str:
    """Return why a claim does not cover a run; empty where it does."""
    left = None if promise.region is None else first_exit(result, promise)
    limited = float(result.saturated.max())
    if _inside_from(result, promise) is not None:
        # What happened before is what the run did; from here on nothing leaves, and no limit acts.
        return " and ".join(promise.ignores)
    if left is not None:
        when = f"at {about(left.time, 4)} s" if np.isfinite(left.time) else "in some step"
        return f"agent {left.agent} left the domain {when} (`{left.name}`)"
    if limited:
        return f"a limit acted on an agent in {about(100.0 * limited)} % of the steps"
    return " and ".join(promise.ignores)


def _inside_from(result: Result, promise: Guarantee) -> float | None:
    """Return from when (s) a run was in the certified set by its stored frames; None for never."""
    certified = promise.certified
    if certified is None or not certified.entered_for_good or result.presence is not None:
        return None
    return entered(result, certified.radius)


def first_exit(result: Result, promise: Guarantee) -> Exit | None:
    """Return who leaves the domain in a step, its offset aside; None where nobody does.

    It is the first in the stored frames, else one of those between them. T1 and A5 ask it of all
    agents. T2 asks it of the leaders, and of their inputs, with which the slopes of a varying g
    count.
    """
    region, model, graph = promise.region, result.model, result.graph
    assert region is not None
    domain, leads, local = region.domain, list(graph.leaders), promise.theorem is Theorem.T2
    who = leads if local else list(range(graph.agents))
    n, rows, here = len(model.state_names), _extremes(result), result.presence
    x = result.states - result.offsets_in()
    x = x if here is None else np.where(here[:, :, None], x, np.nan)
    x = np.concatenate([x[:, who], rows[:, who, :n]]) - np.asarray(model.trim[0], float)
    exits = [_outside(result, x, (domain.lower, domain.upper), who, model.state_names)]
    if local:
        v = np.concatenate([model.normalized(result.inputs[:, leads]), rows[:, leads, n:]])
        box = (domain.input_lower, domain.input_upper)
        exits.append(_outside(result, v, box, leads, model.input_names))
    return min((one for one in exits if one is not None), default=None)


def watched_by(parts: Parts, settings: Settings, agent: int) -> list[JsonObject] | None:
    """Return what one agent can watch of the conditions that `covered` asks of a run.

    Each is a `row` of the vector `of` (`x` or `u`), whose value is between `low` and `high` (None:
    unbounded) while the condition that `text` denies is met. None without a theorem, and of a model
    whose own `limit` states no rows.
    """
    box, model = kept_on_disk(_box_of, parts, settings), parts.model
    if box is None or (settings.limits and is_limited(model) and model.input_limits is None):
        return None
    watched = list(_limits_of(model)) if settings.limits else []
    trim, scale = model.trim, np.linalg.inv(np.asarray(model.input_scale, float))
    # No domain is claimed of a formation whose offsets change.
    about = {
        "x": (np.eye(len(trim[0])), np.asarray(parts.formation.offsets[agent] + trim[0], float)),
        "u": (scale, scale @ np.asarray(trim[1], float)),
    }
    names = {"x": model.state_names, "u": model.input_names}
    for of, sides in box.items() if agent in parts.graph.leaders or "u" not in box else ():
        rows, at = about[of]
        low, high = (np.asarray(side, float) for side in sides)
        texts = [f"`{name}` is outside of the domain" for name in names[of]]
        watched += _rows(of, texts, rows, low + at, high + at)
    return watched


def _limits_of(model: ControlAffine) -> Iterator[JsonObject]:
    if model.input_limits is not None:
        rows, low, high = (np.asarray(part, float) for part in model.input_limits)
        near = _EDGE * np.where(np.isfinite(high - low), high - low, 1.0)
        texts = ["an input is at a limit"] * len(rows)
        yield from _rows("u", texts, rows, low + near, high - near)


def _box_of(promise: Guarantee) -> JsonObject | None:
    """Return the domain of a claim, of states less their trim and of normalized inputs.

    Without a domain it is empty, without a theorem None. One with inputs binds leaders alone.
    """
    if promise.theorem is None or promise.region is None:
        return None if promise.theorem is None else {}
    domain, local = promise.region.domain, promise.theorem is Theorem.T2
    sides = {"x": (domain.lower, domain.upper)}
    sides |= {"u": (domain.input_lower, domain.input_upper)} if local else {}
    return {of: [x.tolist() for x in _widened(box)] for of, box in sides.items()}


def _widened(box: tuple[Array, Array]) -> list[Array]:
    """Return the bounds that a state at rest on one of them does not leave."""
    return [bound + _EDGE * sign * np.abs(bound) for bound, sign in zip(box, (-1.0, 1.0))]


def _rows(
    of: str, texts: Sequence[str], rows: Array, low: Array, high: Array
) -> Iterator[JsonObject]:
    for text, row, *sides in zip(texts, rows.tolist(), low.tolist(), high.tolist(), strict=True):
        bounds = [side if math.isfinite(side) else None for side in sides]
        if bounds != [None, None]:
            yield {"text": text, "of": of, "row": row, "low": bounds[0], "high": bounds[1]}


def _extremes(result: Result) -> Float[Array, "E N k"]:
    """Return the lowest and highest states and inputs over all steps; none if all are stored."""
    low, high = result.sums.lowest, result.sums.highest
    if not low.size:
        return np.zeros((0, *low.shape[:1], result.states.shape[2] + result.inputs.shape[2]))
    # A number that is not finite is outside; of an agent that never was there is none.
    rows = np.nan_to_num([low, high], nan=np.inf, posinf=np.inf, neginf=-np.inf)
    return np.where(low > high, np.nan, rows)


def _outside(
    result: Result, values: Array, box: tuple[Array, Array], who: list[int], names: tuple[str, ...]
) -> Exit | None:
    """Return the first of values (T + E, K, k), of frames and then of all steps, outside a box."""
    low, high = _widened(box)
    out = np.argwhere((values < low) | (values > high))
    if not len(out):
        return None
    frame, place, k = out[0]
    return Exit(float([*result.times, np.inf, np.inf][frame]), who[place], names[k])
