"""Members of a user's own in a loop: a sensor, a medium or motors that echelon does not know."""

import dataclasses
from collections.abc import Iterator

import equinox as eqx
import jax

from echelon.agents.models.model import ControlAffine
from echelon.agents.network.formation_motion import FormationMotion
from echelon.agents.part import WorldPart
from echelon.core.errors import SimulationError
from echelon.core.trace import form_in_words, form_of, place_of
from echelon.simulation.step.drive import Problem
from echelon.simulation.step.loop import Loop
from echelon.simulation.step.records import ComponentMemory
from echelon.simulation.step.sequence import begin, step

_COMPONENTS = {"near": "surroundings", "plant": "motion"}
"""The components whose memory has another name."""
_LAWS = {"model", "laws", "meter"}
"""What is checked and judged elsewhere."""


def with_own_members(loop: Loop, problem: Problem) -> Loop:
    """Return a loop with the members that the parts of a world replace.

    Raises:
        SimulationError: a part returns no loop, or one whose members fail or change the form of
            their memory.
    """
    for part in problem.parts:
        loop = _with_members_of(part, loop, problem)
    return loop


def _with_members_of(part: WorldPart, loop: Loop, problem: Problem) -> Loop:
    kind = type(part)
    where = f"{place_of(kind)}: `member` of `{kind.__name__}`"
    try:
        changed = part.member(loop)
        if not isinstance(changed, Loop):
            raise SimulationError(
                f"{where} returns a `{type(changed).__name__}`, and must return the loop: "
                "`return loop.replace(..)`."
            )
        begun = jax.eval_shape(lambda states: begin(changed, states), problem.states)
        moved = jax.eval_shape(lambda now: step(changed, now), begun)
    except SimulationError:
        raise
    # It is anyone's code: whatever it raises is its own fault, and stays attached as the cause.
    except Exception as error:
        words = (str(error).splitlines() or ["no message"])[0].rstrip(".")
        raise SimulationError(
            f"{where} fails, or its loop cannot take a step ({type(error).__name__}: {words})."
        ) from error
    names = ComponentMemory._fields
    for name, first, last in zip(names, begun.memory, moved.memory, strict=True):
        if form_of(first) != form_of(last):
            member = getattr(changed, _COMPONENTS.get(name, name))
            kind = next(own_classes(member), type(member))
            raise SimulationError(
                f"{place_of(kind)}: the memory of `{kind.__name__}` is {form_in_words(first)} at "
                f"first and {form_in_words(last)} after a step, and must keep its form."
            )
    return changed


def own_members(loop: Loop, but: frozenset[str] = frozenset()) -> str:
    """Return the class of a member that is not echelon's, `but` for some; empty without any."""
    names = {field.name for field in dataclasses.fields(loop)} - _LAWS - but
    found = (kind.__name__ for name in sorted(names) for kind in own_classes(getattr(loop, name)))
    return next(found, "")


def own_classes(member: object) -> Iterator[type]:
    """Yield the classes in a member that are not echelon's, but for models and paths of places."""
    if isinstance(member, ControlAffine | FormationMotion):
        return
    if isinstance(member, tuple):
        for part in member:
            yield from own_classes(part)
    elif isinstance(member, eqx.Module):
        if not type(member).__module__.startswith("echelon."):
            yield type(member)
        for field in dataclasses.fields(member):
            yield from own_classes(getattr(member, field.name, None))
