"""The paper's assumptions and lemmas on a scenario of one's own, and what is promised of it."""

from collections.abc import Iterator

from echelon.core.numerics import precision
from echelon.core.words import Theorem
from echelon.engine.parts import Parts
from echelon.engine.settings import Settings
from echelon.promises.certified_set import CertifiedSet, certified_set
from echelon.promises.closed_loop import CheckedLoop, checked_loop, step_radius
from echelon.studies.assumptions import drift_lines, graph_lines
from echelon.studies.lines import Checked, Line
from echelon.studies.margins import law_lines, margin_lines
from echelon.studies.region import region_lines

__all__ = ["Checked", "Line", "check"]


def check(parts: Parts, settings: Settings) -> Checked:
    """Walk through the paper's statements on built parts, the region of the gain, and margins."""
    with precision("float64"):
        loop = checked_loop(parts, settings)
        found = certified_set(loop)
        lines = (
            *graph_lines(loop),
            *drift_lines(loop),
            *law_lines(loop),
            *region_lines(loop, found),
            *margin_lines(loop),
        )
        reasons = list(_reasons(loop))
    if reasons:
        return Checked(lines, False, f"Nothing is promised: {'; '.join(reasons)}.")
    without = f" This is said without what the scenario adds: {loop.disturbed}."
    promise = _promise(loop, found) + (without if loop.disturbed else "")
    return Checked(lines, True, promise)


def _reasons(loop: CheckedLoop) -> Iterator[str]:
    """Yield what stands against any promise; each has its line, with what to change."""
    if not loop.governed:
        yield "the followers' law does not act on the disagreement"
        return
    if not loop.trimmed:
        yield "the law leaves out the trim input"
    if loop.broken:
        yield "an offset is no symmetry of the dynamics"
    if not loop.every:
        yield "the disagreement does not decay"
    elif step_radius(loop, loop.settings.dt) >= 1.0:
        yield "with the input held over the step `dt` it grows"


def _promise(loop: CheckedLoop, found: CertifiedSet | None) -> str:
    """Return what is promised, in sentences, and no more than that."""
    condition = "" if loop.matched else ", once the leader's input rests at its trim"
    local = (
        "Promised, by linearization: followers that start near enough to their goals, with the "
        f"leader near enough to the trim, converge to them{condition}"
    )
    region = loop.region
    if region is None or region.theorem is not Theorem.A5 and not region.rate > 0.0:
        return f"{local}; no region is proved."
    return f"{local}. {_regional(loop, found, condition)}"


def _regional(loop: CheckedLoop, found: CertifiedSet | None, condition: str) -> str:
    """Return what the region adds, as strong as its own argument and no stronger."""
    region = loop.region
    assert region is not None
    by, where = f"{region.kind.value}: ", region.domain.in_words(loop.parts.model)
    theorem, what = region.theorem, f"errors shrink at {region.rate:.3g} 1/s or faster"
    if theorem is Theorem.A5:
        what = "V does not rise"
    if found is None:
        return f"{by}small {what}{condition}, while the leader stays in {where} ({theorem})."
    if not found.radius:
        return (
            f"{by}{what}{condition}, for as long as all agents stay in {where} ({theorem}), and no "
            f"start is certified to stay: {found.why}."
        )
    read = "" if found.kind is region.kind else ", the leader going as in a run of its own"
    start = f"any start with sum_i delta_i'P delta_i <= {found.radius:.3g}^2"
    start = "everywhere" if found.radius == float("inf") else start
    return f"{by}from {start}, {what}{condition}{read} ({theorem})."
