"""What the numbers of an agent's message are, in words."""

from collections.abc import Sequence

from echelon.agents.models.model import ControlAffine
from echelon.core.words import Feedforward
from echelon.laws.consensus import Consensus
from echelon.laws.flat_law import FlatLaw
from echelon.laws.law import Feeds, Law
from echelon.simulation.engine.agent import OwnLaw


def normalized_equation(model: ControlAffine) -> str:
    """Return how inputs u and normalized inputs v belong together, with the numbers of a model."""
    scale = "; ".join(map(_row, model.input_scale))
    return f"u = u* + S v, where u* is ({_row(model.trim[1])}) and S has the rows ({scale})"


def _row(numbers: Sequence[float]) -> str:
    return ", ".join(f"{float(number):.9g}" for number in numbers)


def message_meaning(own: OwnLaw) -> str:
    """Return what a message and a feed-forward are."""
    follower, turning = own.loop.laws.follower, own.loop.laws.follower.turning
    more = ", and the heading that the leader follows (rad)" if turning else ""
    return _meaning(follower) + more


def _meaning(follower: Law) -> str:
    if follower.feedforward is Feedforward.NONE:
        return "zeros, since no agent uses others' inputs"
    if isinstance(follower, FlatLaw):
        return "rates zeta' of the stopping point, in units of the outputs per second"
    if _is_own(follower):
        return f"as the law `{type(follower).__name__}` defines them"
    if follower.feedforward is Feedforward.RELAY_VELOCITY:
        return "rates of the states that the normalized inputs v of u = u* + S v make"
    less = isinstance(follower, Consensus) and follower.gain.inner is not None
    less = ", less those of the inner loop" if less else ""
    return f"normalized inputs v of u = u* + S v{less}, and no physical inputs u"


def _is_own(follower: Law) -> bool:
    """Tell whether a law sends something that echelon does not know."""
    broadcast = getattr(type(follower), "broadcast", Feeds.broadcast)
    others = broadcast not in (Feeds.broadcast, Consensus.broadcast)
    return others or Feeds.may(follower, "message")


def message_words(own: OwnLaw) -> list[str]:
    """Return the names of the numbers of a message, none of which is that of a physical input."""
    model, follower, names = own.loop.model, own.loop.laws.follower, list(own.forward_names)
    heading = names[len(names) - follower.turning :]
    names = names[: len(names) - follower.turning]
    if isinstance(follower, FlatLaw):
        names = [f"rate of {name}" for name in names]
    elif follower.feedforward is Feedforward.RELAY_VELOCITY:
        names = [f"rate of {name}" for name in model.state_names]
    elif names == [*model.input_names] and not _is_own(follower):
        names = [f"normalized {name}" for name in names]
    return [*names, *heading]
