"""Checks parts against the paper's assumptions and lemmas, and computes what is guaranteed."""

from typing import NamedTuple

from echelon.core.numerics import precision
from echelon.core.statement import Statement
from echelon.core.types import JsonObject
from echelon.experiments.studies.assumptions import drift_lines, graph_lines
from echelon.experiments.studies.margin_lines import margin_lines
from echelon.guarantees.promises.promise import Promise, promise
from echelon.simulation.engine.parts import Parts
from echelon.simulation.engine.prepare import prepare
from echelon.simulation.step.settings import Settings

__all__ = ["CheckResult", "check"]


class CheckResult(NamedTuple):
    """All lines, including the hypotheses of the promise; the promise; warnings of the parts."""

    lines: tuple[Statement, ...]
    promise: Promise
    warnings: tuple[str, ...] = ()

    @property
    def promised(self) -> bool:
        """Whether anything is guaranteed."""
        return self.promise.promised

    def as_mapping(self) -> JsonObject:
        """Return it ready for JSON."""
        lines = [line.as_mapping() for line in self.lines]
        warnings = list(self.warnings)
        return {"promise": self.promise.as_mapping(), "lines": lines, "warnings": warnings}


def check(parts: Parts, settings: Settings) -> CheckResult:
    """Check the paper's statements for parts, the hypotheses of their promise, and margins.

    Raises:
        EchelonError: a part is malformed or does not fit the others.
    """
    parts, _, warnings = prepare(parts, settings)
    guarantee = promise(parts, settings)
    with precision("float64"):
        lines = (
            *graph_lines(parts),
            *drift_lines(parts, settings, guarantee),
            *guarantee.hypotheses.values(),
            *margin_lines(parts, guarantee),
        )
    return CheckResult(lines, guarantee, warnings)
