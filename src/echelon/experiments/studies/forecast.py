"""What is promised of a run before it starts, and what would not grow where it will."""

import math
from collections.abc import Iterator

from echelon.core.errors import EchelonError
from echelon.core.statement import Hypothesis
from echelon.guarantees.promises.promise import promise
from echelon.laws.consensus import Consensus
from echelon.simulation.engine.law_drive import Laws
from echelon.simulation.engine.parts import Parts
from echelon.simulation.step.settings import Settings
from echelon.synthesis.gains.gain import synthesize
from echelon.synthesis.gains.inner_loop import InnerLoop

_ROOM = 0.9
"""Of the longest step with which the modes looked at decay, since others lie between them."""


def outlook(parts: Parts, settings: Settings) -> str:
    """Return what is promised of a run; where it will grow, with the options that would not.

    Raises:
        EchelonError: a part is malformed or does not fit the others.
    """
    found = promise(parts, settings)
    # A step that is too long for a moment only has no reason to say so.
    grows = any(
        found.hypotheses[each].reason
        for each in (Hypothesis.DISAGREEMENT_DECAY, Hypothesis.SAMPLING)
    )
    changes = " or ".join(f"`--set {change}`" for change in _changes(parts, settings) if grows)
    if not changes:
        return found.sentence()
    return f"{found.sentence()} It will grow; what would not: {changes}."


def _changes(parts: Parts, settings: Settings) -> Iterator[str]:
    """Yield the changes of a scenario, cheap to find, with which something is promised."""
    step = promise(parts, settings).hypotheses[Hypothesis.SAMPLING]
    if step.fails:
        longest = _ROOM * promise(parts, settings).longest_step(settings)
        # A whole part of the step keeps the horizon a whole number of steps.
        shorter = settings.dt / math.ceil(settings.dt / longest) if longest > 0.0 else settings.dt
        if promise(parts, settings._replace(dt=shorter)).promised:
            yield f"simulation.dt={shorter:.6g}"
    law = parts.drive.follower if isinstance(parts.drive, Laws) else None
    if not isinstance(law, Consensus):
        return
    try:
        # Any coupling and any graph keep an inner loop stable.
        gain = synthesize(parts.model, parts.graph, InnerLoop())
    except EchelonError:
        return
    drive = parts.drive.with_follower(Consensus(gain, law.feedforward, law.trim, law.frame))
    if promise(parts.replace(drive=drive), settings).promised:
        yield '"follower.gain={method: inner-loop}"'
