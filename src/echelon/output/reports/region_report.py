"""The text of an observed region of attraction: its statement, and a line for each scale."""

import textwrap
from collections.abc import Iterator

from echelon.core.digits import about, at_least
from echelon.core.errors import Outcome
from echelon.experiments.results.run_numbers import settling_bound
from echelon.experiments.studies.observed_region import (
    LATE,
    OUTSIDE,
    REFUSED,
    ObservedRegion,
    ScaleTrial,
)

_WIDTH = 80
_FAILURES = {
    OUTSIDE: "started outside the chart",
    Outcome.LEFT_CHART.name.lower(): "left the chart",
    Outcome.DIVERGED.name.lower(): "diverged",
    REFUSED: "could not start",
}


def region_report(region: ObservedRegion) -> str:
    """Return an observed region in at most 80 columns."""
    lines = ["observed region of attraction (simulated, no proof):"]
    for sentence in region_sentences(region):
        lines += textwrap.wrap(sentence, _WIDTH, initial_indent=" ", subsequent_indent=" ")
    rows = region_rows(region)
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)][:3]
    for row in rows:
        cells = [f"{row[0]:>{widths[0]}}", *(f"{x:<{w}}" for x, w in zip(row[1:3], widths[1:]))]
        first = f" {'  '.join(cells)}  "
        lines += textwrap.wrap(
            row[3], _WIDTH, initial_indent=first, subsequent_indent=" " * len(first)
        ) or [first.rstrip()]
    return "\n".join(line.rstrip() for line in lines)


def region_rows(region: ObservedRegion) -> list[tuple[str, ...]]:
    """Return the trials of a region as rows of a table, after its heads."""
    rows = [
        (f"{x.scale:g}", f"{x.failed} of {x.runs}", _bound(x), _why(x, region))
        for x in region.trials
    ]
    return [("scale", "failed", "probability (95 %)", "how they failed"), *rows]


def region_sentences(region: ObservedRegion) -> Iterator[str]:
    """Yield what was observed, how starts were drawn, and when a run counts as successful."""
    best, first = region.reached, region.trials[0]
    if best is None:
        yield (
            f"No scale without failures: {first.failed} of {first.runs} runs failed even from "
            f"starts at {first.scale:g} times the spreads."
        )
    else:
        yield (
            f"Starts at up to {best.scale:g} times the spreads: {best.failed} of {best.runs} "
            f"failed at each scale, {_bound(best)} at 95 %."
        )
    units = region.units
    texts = (f"{name} {about(w)} {units[name]}".rstrip() for name, w in region.spreads.items())
    source = "the scenario's" if region.drawn else "containing the scenario's given starts"
    yield f"Spreads, {source}: +-({', '.join(texts)}), drawn uniformly for each follower."
    yield (
        f"A run succeeds if all followers stay within {settling_bound(region.unit)} of their goals "
        f"from {region.within:g} s on; limits are {'on' if region.limits else 'off'}."
    )


def _bound(trial: ScaleTrial) -> str:
    if trial.failed == trial.runs:
        return "not bounded"
    return f"below {at_least(100.0 * trial.bound, 2)} %"


def _why(trial: ScaleTrial, region: ObservedRegion) -> str:
    texts = _FAILURES | {LATE: f"not within {settling_bound(region.unit)}"}
    most = sorted(trial.failures.items(), key=lambda item: -item[1])
    return ", ".join(f"{n} {texts.get(kind, kind)}" for kind, n in most)
