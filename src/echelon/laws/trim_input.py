"""The law that does nothing: the trim input alone."""

from echelon.agents.models.model import ControlAffine
from echelon.core.types import Input
from echelon.laws.law import Law, LocalView, Memory


class TrimInput(Law):
    """u = u* + S v_ff, where v_ff = 0 since the law uses no feed-forward.

    The agent moves freely about its trim.
    """

    def update(self, model: ControlAffine, view: LocalView, memory: Memory) -> tuple[Input, Memory]:
        """Return the trim input."""
        return model.physical(view.feedforward), memory
