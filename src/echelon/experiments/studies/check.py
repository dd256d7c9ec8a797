"""The paper's assumptions and lemmas on parts of one's own, and what is promised of them."""

from typing import NamedTuple

from echelon.core.numerics import precision
from echelon.core.statement import Statement
from echelon.experiments.studies.assumptions import drift_lines, graph_lines
from echelon.experiments.studies.killing_residual import killing_line
from echelon.experiments.studies.margin_lines import margin_lines
from echelon.guarantees.promises.promise import Promise, promise
from echelon.simulation.engine.parts import Parts
from echelon.simulation.engine.prepare import prepare
from echelon.simulation.step.settings import Settings

__all__ = ["CheckResult", "check"]


class CheckResult(NamedTuple):
    """All lines, the hypotheses of the promise among them, and the promise."""

    lines: tuple[Statement, ...]
    promise: Promise

    @property
    def promised(self) -> bool:
        """Whether anything is promised."""
        return self.promise.promised


def check(parts: Parts, settings: Settings) -> CheckResult:
    """Walk through the paper's statements on parts, the hypotheses of their promise, and margins.

    Raises:
        EchelonError: a part is malformed or does not fit the others.
    """
    parts = prepare(parts, settings).parts
    found = promise(parts, settings)
    with precision("float64"):
        lines = (
            *graph_lines(parts),
            *drift_lines(parts, settings, found),
            *found.hypotheses.values(),
            killing_line(parts, found),
            *margin_lines(parts, found),
        )
    return CheckResult(lines, found)
