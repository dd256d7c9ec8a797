"""The forecast of a run: its guarantee, or changes under which something is guaranteed."""

import math
from collections.abc import Iterator

from echelon.core.digits import at_most
from echelon.core.errors import EchelonError
from echelon.core.statement import Hypothesis
from echelon.guarantees.promises.promise import promise
from echelon.laws.consensus import Consensus
from echelon.simulation.engine.law_drive import Laws
from echelon.simulation.engine.parts import Parts
from echelon.simulation.step.settings import Settings
from echelon.synthesis.gains.gain import synthesize
from echelon.synthesis.gains.inner_loop import InnerLoop

_SHARE = 0.9
"""Share of the longest stable step for the checked modes, since further modes lie between them."""


def forecast(parts: Parts, settings: Settings) -> str:
    """Return the guarantee of a run; without one, with options under which there is one.

    Raises:
        EchelonError: a part is malformed or does not fit the others.
    """
    guarantee = promise(parts, settings)
    hypotheses = Hypothesis.DISAGREEMENT_DECAY, Hypothesis.SAMPLING
    # A step that is too long for a short time only has no reason.
    grows = any(guarantee.hypotheses[hypothesis].reason for hypothesis in hypotheses)
    changes = " or ".join(f"`--set {change}`" for change in _changes(parts, settings) if grows)
    if not changes:
        return guarantee.sentence()
    return f"{guarantee.sentence()} There is a guarantee with {changes}."


def _changes(parts: Parts, settings: Settings) -> Iterator[str]:
    """Yield the changes of a scenario, quickly computed, under which something is guaranteed."""
    step = promise(parts, settings).hypotheses[Hypothesis.SAMPLING]
    if step.fails:
        longest = _SHARE * promise(parts, settings).longest_step(settings)
        # With an integer fraction of the step, the horizon remains a whole number of steps.
        shorter = settings.dt / math.ceil(settings.dt / longest) if longest > 0.0 else settings.dt
        if promise(parts, settings._replace(dt=shorter)).promised:
            yield f"simulation.dt={at_most(shorter, 6)}"
    law = parts.drive.follower if isinstance(parts.drive, Laws) else None
    if not isinstance(law, Consensus):
        return
    try:
        # An inner loop is stable with any coupling on any graph.
        gain = synthesize(parts.model, parts.graph, InnerLoop())
    except EchelonError:
        return
    drive = parts.drive.with_follower(Consensus(gain, law.feedforward, law.trim, law.frame))
    if promise(parts.replace(drive=drive), settings).promised:
        yield '"follower.gain={method: inner-loop}"'
