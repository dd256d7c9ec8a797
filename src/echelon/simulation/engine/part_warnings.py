"""Warnings of parts that are allowed and probably not intended: goals, starts, slow actuators."""

from collections.abc import Iterator, Mapping

import jax.numpy as jnp
import numpy as np

from echelon.agents.models.model import ControlAffine
from echelon.agents.network.formation import Formation
from echelon.agents.network.formation_motion import FormationMotion
from echelon.core.errors import listing
from echelon.core.numerics import precision
from echelon.core.types import Array
from echelon.simulation.engine.closest_pair import ClosestPair
from echelon.simulation.engine.parts import Parts
from echelon.simulation.step.settings import Settings

_HALF_TURN = 3.0
"""Below half a turn in rad: no smaller spread is looked at, since `difference` is compiled."""
_MET = 1e-9
"""m; agents without a radius that come so near to each other meet."""
_COARSE = 1e-3
"""m; a run whose positions are not resolved to this is warned of."""
_SETTLES = 3.0
"""Time constants after which an actuator has made 95 % of a step."""


def part_warnings(parts: Parts, states: Array, settings: Settings) -> Iterator[str]:
    """Yield a sentence for each thing that is probably not intended.

    Args:
        parts: checked.
        states: (N, n) at time zero.
        settings: of the run.
    """
    for shape in parts.formation.shapes:
        yield from _goals(parts.model, shape)
    motion = parts.formation.motion
    if motion is not None and parts.drive.safety is None:
        yield from _meetings(parts.model, motion)
    yield from _starts(parts.model, states)
    yield from _spreads(parts)
    yield from _coarse(parts.model, states, settings)
    actuator, horizon = parts.world.actuator, settings.horizon
    if actuator is not None and _SETTLES * actuator.lag > horizon:
        yield (
            f"the actuators need {_SETTLES * actuator.lag:.3g} s for 95 % of a command, since "
            f"their lag is {actuator.lag:.3g} s, and the horizon is {horizon:g} s."
        )


def _coarse(model: ControlAffine, states: Array, settings: Settings) -> Iterator[str]:
    """Yield that positions (N, n) are too large for the digits of single precision."""
    if settings.precision != "float32" or not model.position:
        return
    farthest = np.abs(states[:, list(model.position_indices())]).max()
    with np.errstate(over="ignore"):
        step = float(np.spacing(np.float32(farthest)))
    if _COARSE < step < np.inf:
        yield (
            f"single precision resolves {step:.2g} m at the coordinate {farthest:.3g} m; "
            "`float64` resolves a billionth of that."
        )


def _goals(model: ControlAffine, formation: Formation) -> Iterator[str]:
    """Yield offsets that break a symmetry of the model, and goals that are equal or too close."""
    broken = formation.broken_symmetries(model)
    # One warning is enough: the other offsets mostly break the same symmetry.
    for agent, reason in list(broken.items())[:1]:
        yield (
            f"the offset of agent {agent} is no symmetry of `{type(model).__name__}`: {reason}, "
            "so the agents settle off their goals."
        )
    if not model.position:
        return
    pairs = formation.coincident()
    for i, j in pairs[:3]:
        yield f"agents {i} and {j} have the same goal, and would collide there."
    if len(pairs) > 3:
        yield f"{len(pairs) - 3} more pairs of agents have the same goal."
    if not pairs and model.radius is not None:
        closest = ClosestPair.of(formation.offsets[:, list(model.position_indices())], 0.0)
        if closest.touch(model.radius):
            i, j = closest.agents
            yield (
                f"the goals of agents {i} and {j} are {closest.distance:.3g} m apart, and agents "
                f"of radius {model.radius:.2g} m touch below {2.0 * model.radius:.3g} m."
            )


def _meetings(model: ControlAffine, motion: FormationMotion) -> Iterator[str]:
    """Yield the reshapes in which agents touch on their straight ways."""
    for begin, i, j, apart in motion.meetings():
        if apart <= 2.0 * (model.radius or 0.0) + _MET:
            yield (
                f"in the reshape at {begin:g} s agents {i} and {j} come within {apart:.3g} m of "
                "each other; add `safety`, or choose other places."
            )


def _starts(model: ControlAffine, states: Array) -> Iterator[str]:
    """Yield the first agent that starts where the equations do not hold, for each state."""
    for name, (low, high) in model.chart.items():
        values = states[:, model.state_names.index(name)]
        outside = np.flatnonzero(~((low < values) & (values < high)))
        for agent in outside[:1]:
            yield (
                f"agent {agent} starts with `{name}` at {values[agent]:.3g}, and the equations of "
                f"`{type(model).__name__}` hold between {low:.3g} and {high:.3g} only."
            )


def _spreads(parts: Parts) -> Iterator[str]:
    """Yield the states whose spread is larger than a difference of theirs can be."""
    model, initial = parts.model, parts.initial
    own = type(model).difference is not ControlAffine.difference
    if not own or not isinstance(initial, Mapping):
        return
    spread = model.per_state({k: v for k, v in initial.items() if isinstance(k, str)})  # type: ignore[misc]
    trim = np.asarray(model.trim[0], float)
    large = [
        k for k in np.flatnonzero(spread > _HALF_TURN).tolist() if _wraps(model, trim, k, spread[k])
    ]
    if large:
        names, sizes = (model.state_names[k] for k in large), {f"{spread[k]:g}" for k in large}
        yield (
            f"the initial spread of {listing(names)} is {' or '.join(sorted(sizes))} rad, and a "
            "difference of angles is at most half a turn, 3.14 rad."
        )


def _wraps(model: ControlAffine, trim: Array, k: int, size: float) -> bool:
    """Tell whether states that differ by a size in one state are closer to the model."""
    step = size * np.eye(len(trim))[k]
    with precision("float64"):
        difference = model.difference(jnp.asarray(trim + step), jnp.asarray(trim))
    return abs(float(difference[k])) < 0.999 * size
