"""Checks of laws that sum errors: whether somebody holds the formation in its place."""

from echelon.agents.models.model import ControlAffine
from echelon.core.errors import LawError
from echelon.laws.consensus import Consensus
from echelon.laws.law import Law, Proves
from echelon.synthesis.gains.integral import Integral


def sums_of(law: Law | None) -> Integral | None:
    """Return the integral action of a law; None without any."""
    sums = getattr(law, "integral", None)
    return sums if isinstance(sums, Integral) else None


def check_sums(leader: Law, follower: Law, model: ControlAffine) -> None:
    """Check that nobody's sums act against another's, and that a leader anchors the formation.

    Raises:
        LawError: they do, or nobody does.
    """
    if sums_of(leader) is None and sums_of(follower) is None:
        return
    if Proves.of(leader).metric(model) is not None or isinstance(leader, Consensus):
        raise LawError(
            "`integral` needs a leader that holds the formation in its place, and a leader under "
            f"`{type(leader).__name__}` follows its neighbours: the mean of all agents would drift."
        )
    if sums_of(leader) is not None and getattr(leader, "reaction", None) is not None:
        raise LawError(
            "a leader that reacts to its neighbours and has `integral` sums errors against its "
            "followers' feedback; leave out `reacts` or its `integral`."
        )
