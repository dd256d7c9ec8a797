"""Errors for invalid input, and outcomes of simulation runs.

Invalid input raises at once, with one sentence: what was received and what is allowed. A numerical
event during a run is not an exception but an `Outcome`, stored with the computed data.
"""

import difflib
import enum
import numbers
from collections.abc import Iterable
from typing import TypeGuard


class EchelonError(Exception):
    """Base of every error that echelon raises on purpose.

    `exit_code` is what the command line returns.
    """

    exit_code = 2


class ModelError(EchelonError):
    """A model has a wrong shape, a non-finite value, a false trim or an impossible parameter."""


class GraphError(EchelonError):
    """A communication graph is malformed, disconnected or has no leader."""


class FormationError(EchelonError):
    """An offset has a wrong length, belongs to no agent or cannot be built."""


class ReferenceError(EchelonError):
    """A reference is malformed, or the model cannot track it."""


class GainError(EchelonError):
    """A gain cannot be synthesized or does not fit the model, the graph or the law."""


class LawError(EchelonError):
    """A control law does not fit the model or is given an option it lacks."""


class SimulationError(EchelonError):
    """The settings of a simulation are out of range."""


class PlanError(EchelonError):
    """An optimal control problem is malformed, or its data does not fit."""


class ScenarioError(EchelonError):
    """A scenario file is invalid; the message has one line per fault."""


class OutputError(EchelonError):
    """Results cannot be written where they were requested."""


class FlightError(EchelonError):
    """A flight cannot be prepared."""


class MissingExtraError(EchelonError):
    """An optional part of echelon is not installed."""

    exit_code = 4


class Outcome(enum.Enum):
    """How a run ended; the value is the sentence that a person reads."""

    COMPLETED = "The run reached its horizon."
    LEFT_CHART = "An agent left the chart of its equations, which hold inside alone."
    DIVERGED = "A state stopped being finite; everything computed before it is kept."
    INTERRUPTED = "The run was interrupted; everything computed before it is kept."
    STOPPED = "The run was ended from outside; everything until its last chunk is kept."

    @property
    def exit_code(self) -> int:
        """Exit code of the command line for a run that ended so."""
        # 130 is 128 + SIGINT, the exit code by which shells report an interrupted program.
        return {Outcome.COMPLETED: 0, Outcome.LEFT_CHART: 1, Outcome.DIVERGED: 3}.get(self, 130)

    @property
    def reached(self) -> bool:
        """Whether the run reached its horizon."""
        return self in (Outcome.COMPLETED, Outcome.LEFT_CHART)


def did_you_mean(got: object, allowed: Iterable[str], likeness: float = 0.6) -> str:
    """Return `` (did you mean `name`?)`` if an allowed name is close to `got`, otherwise ""."""
    close = difflib.get_close_matches(str(got), list(allowed), n=1, cutoff=likeness)
    return f" (did you mean `{close[0]}`?)" if close else ""


def listing(names: Iterable[str]) -> str:
    """Return names in back-ticks, separated by commas, for use inside a message."""
    return ", ".join(f"`{name}`" for name in names)


def check_name(
    what: str, name: object, allowed: Iterable[str], fault: type[EchelonError] = EchelonError
) -> None:
    """Raise `fault` unless a name is allowed; `what` begins the message, as in "`method` is"."""
    names = list(allowed)
    if name not in names:
        raise fault(f"{what} `{name}`, allowed are {listing(names)}{did_you_mean(name, names)}.")


def is_number(value: object) -> TypeGuard[float]:
    """Tell whether a value is a real number, of Python or NumPy; truth values are none."""
    return isinstance(value, numbers.Real) and not isinstance(value, bool)


def check_kind(
    place: str, part: object, kind: type, fault: type[EchelonError] = SimulationError
) -> None:
    """Raise `fault` unless a part is an instance of a class, and no subclass of a final one."""
    if type(part) is kind or isinstance(part, kind) and not getattr(kind, "__final__", False):
        return
    got = f"the class `{part.__name__}`" if isinstance(part, type) else f"a `{type(part).__name__}`"
    only = " itself, not a subclass" * isinstance(part, kind)
    raise fault(f"`{place}` is {got}, and must be a `{kind.__name__}`{only}.")
