"""The motion that a leader follows: a state and an input of a model at each time."""

import abc

from echelon.agents.models.heading_symmetry import heading_index
from echelon.agents.models.model import ControlAffine
from echelon.core.types import Declared, Input, Scalar, State


class Guide(Declared):
    """The motion that a leader follows: a path in space, or one of states and inputs."""

    @abc.abstractmethod
    def follow(self, model: ControlAffine, t: Scalar) -> tuple[State, Input]:
        """Return the state (n,) and the input (m,) that follow it exactly at time t (s)."""

    def heading(self, model: ControlAffine, t: Scalar) -> Scalar:
        """Return the heading (rad) at time t of a model that states one."""
        return self.follow(model, t)[0][heading_index(model)]

    def turns(self, model: ControlAffine) -> bool:
        """Tell whether the heading may differ from the trim's at some time."""
        return True

    def special_at(self, t: float) -> str:
        """Return what is special about a path at a time (s), in words; empty for nothing."""
        return ""

    def remarks(self) -> tuple[str, ...]:
        """Return what is probably not meant, a sentence each."""
        return ()

    @abc.abstractmethod
    def check(self) -> None:
        """Check the values that the reference returns.

        Raises:
            ReferenceError: it is malformed.
        """

    @abc.abstractmethod
    def fit(self, model: ControlAffine) -> None:
        """Check that a model can be led along it.

        Raises:
            LawError: it cannot; the message says why.
        """
