"""Observed region of attraction of a scenario as it runs: random starts at a ladder of scales.

It is not a proof. Of each scale it states how many runs failed, and a bound on the probability.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.special
from jaxtyping import Float

from echelon.core.errors import EchelonError, Outcome, SimulationError
from echelon.core.files import notebook_page
from echelon.core.numerics import precision
from echelon.core.types import Array, JsonObject
from echelon.experiments.results.metrics import arrived, metrics
from echelon.simulation.engine.batch import Batch
from echelon.simulation.engine.law_drive import Laws
from echelon.simulation.engine.parts import Parts, initial_states
from echelon.simulation.engine.prepare import prepare
from echelon.simulation.engine.result import Result
from echelon.simulation.step.settings import Settings

SCALES = (0.25, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0)
"""Factors on the spreads; all are tried, since success need not be monotone in them."""
SEEDS = 200
_CONFIDENCE = 0.95
_AGENTS = 100_000
"""Agents of runs that are stepped together, which bounds the memory."""
LATE, OUTSIDE, REFUSED = "late", "outside", "refused"
"""Failures besides the outcomes that end a run early."""


def failure_bound(failed: int, runs: int) -> float:
    """Return the upper bound at 95 % of the probability of failure, from `failed` of `runs`.

    It is exact and one-sided (Clopper and Pearson, 1934): with a larger probability, so few
    failures or fewer occur in at most 5 % of all experiments.
    """
    if failed >= runs:
        return 1.0
    return float(scipy.special.betaincinv(failed + 1.0, runs - failed, _CONFIDENCE))


class ScaleTrial(NamedTuple):
    """The runs from starts at one scale.

    Attributes:
        scale: the factor on the spreads.
        runs: how many were simulated.
        failures: how many did not arrive, by what happened: the name of an `Outcome`, `late` for a
            run that reached its horizon, `outside` for a start outside of the model's chart, or
            `refused` for one that the laws do not allow.
    """

    scale: float
    runs: int
    failures: Mapping[str, int]

    @property
    def failed(self) -> int:
        """How many runs did not arrive."""
        return sum(self.failures.values())

    @property
    def bound(self) -> float:
        """The upper bound at 95 % of the probability that a run fails."""
        return failure_bound(self.failed, self.runs)


class ObservedRegion(NamedTuple):
    """What was observed of random starts about the goals.

    Attributes:
        spreads: half-width of the starts at scale 1 by state, without zeros, in the states' units.
        units: of these states.
        drawn: whether the scenario draws its starts by these; else they contain its given starts.
        within: from when on all followers must stay within 1 cm (0.01 without a position), s.
        unit: of the errors: m, or empty.
        limits: whether the inputs' limits acted.
        trials: one for each scale, ascending.
    """

    spreads: Mapping[str, float]
    units: Mapping[str, str]
    drawn: bool
    within: float
    unit: str
    limits: bool
    trials: tuple[ScaleTrial, ...]

    def _repr_html_(self) -> str:
        return notebook_page("report", self)

    @property
    def reached(self) -> ScaleTrial | None:
        """The largest scale such that no run failed at it or below; None if there is none.

        Its bound holds at 95 % although it was chosen after the runs: scales are judged in a fixed
        order, up to the first failure.
        """
        best = None
        for trial in self.trials:
            if trial.failed:
                break
            best = trial
        return best

    def as_mapping(self) -> JsonObject:
        """Return it ready for JSON."""
        rows = [
            {**x._asdict(), "failures": {**x.failures}, "failed": x.failed, "bound": x.bound}
            for x in self.trials
        ]
        whole = {**self._asdict(), "spreads": {**self.spreads}, "units": {**self.units}}
        reached = None if self.reached is None else self.reached.scale
        return {**whole, "trials": rows, "reached": reached, "confidence": _CONFIDENCE}


def observed_region(
    parts: Parts,
    settings: Settings,
    scales: Sequence[float] = SCALES,
    seeds: int = SEEDS,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> ObservedRegion:
    """Simulate random starts at several scales, with all else as the scenario has it.

    A run succeeds if it reaches the horizon and all followers stay within 1 cm of their goals from
    the beginning of the steady window on.

    Args:
        parts: of the scenario.
        settings: of its runs; the seed is replaced.
        scales: factors on the spreads of the starts.
        seeds: runs for each scale, with the seeds from 0 on.
        progress: called with the number of runs that are done, and of all.

    Raises:
        SimulationError: all starts are at the goals, or no laws drive the agents.
        EchelonError: a part is malformed, or no run can start at any scale.
        KeyboardInterrupt: Ctrl-C.
    """
    if not isinstance(parts.drive, Laws):
        raise SimulationError("a region is observed of laws only, and plans drive these agents.")
    parts = prepare(parts, settings).parts
    widths, drawn = start_widths(parts)
    names = parts.model.state_names
    spreads = {name: float(w) for name, w in zip(names, widths, strict=True) if w > 0.0}
    if not spreads:
        raise SimulationError(
            "a region needs starts that are off the goals: set `initial.spread`, "
            "such as `{position: 1}`."
        )
    within = settings.horizon - settings.window
    batch, trials = Batch(), list[ScaleTrial]()
    errors = list[EchelonError]()
    for scale in sorted(scales):
        here, counts = parts.replace(initial=_scaled(parts, spreads, scale)), Counter[str]()
        for what in _failures(batch, here, settings, within, seeds, errors):
            counts[what] += 1
            progress(len(trials) * seeds + counts.total(), len(scales) * seeds)
        del counts[""]
        trials.append(ScaleTrial(scale, seeds, dict(counts)))
    if all(trial.failures.get(REFUSED) == seeds for trial in trials):
        raise errors[0]
    units = dict(zip(names, parts.model.state_units, strict=True))
    return ObservedRegion(
        spreads=spreads,
        units={name: units[name] for name in spreads},
        drawn=drawn,
        within=within,
        unit="m" if parts.model.position else "",
        limits=settings.limits,
        trials=tuple(trials),
    )


def start_widths(parts: Parts) -> tuple[Float[Array, " n"], bool]:
    """Return the half-widths (n,) about the goals that contain the scenario's starts.

    And whether these are the spreads by which the scenario draws them, without given starts.
    """
    initial, model = parts.initial, parts.model
    named = dict(initial) if isinstance(initial, Mapping) else {}
    spreads: dict[str, Any] = {key: x for key, x in named.items() if isinstance(key, str)}
    widths = np.abs(model.per_state(spreads))
    given = [*parts.graph.followers] if isinstance(initial, np.ndarray) else []
    given += [k for k in named if not isinstance(k, str) and k in parts.graph.followers]
    if given:
        goals = initial_states(parts.replace(initial=None), 0)[given]
        starts = initial_states(parts, 0)[given]
        # By the model, so that angles a turn apart are equal.
        with precision("float64"):
            off = jax.vmap(model.difference)(jnp.asarray(starts), jnp.asarray(goals))
        widths = np.maximum(widths, np.abs(np.asarray(off)).max(axis=0))
    return widths, not given


def _scaled(
    parts: Parts, spreads: Mapping[str, float], scale: float
) -> dict[str | int, float | Sequence[float]]:
    """Return random starts of all followers; a given start of a leader stays."""
    initial: dict[str | int, float | Sequence[float]] = {
        name: scale * width for name, width in spreads.items()
    }
    given = parts.initial
    for k in parts.graph.leaders:
        if isinstance(given, np.ndarray) or (isinstance(given, Mapping) and k in given):
            initial[k] = given[k]  # type: ignore[index]
    return initial


def _failures(
    batch: Batch,
    parts: Parts,
    settings: Settings,
    within: float,
    seeds: int,
    errors: list[EchelonError],
) -> Iterator[str]:
    """Yield what happened in the run of each seed, "" for success; errors are added to a list."""
    # The last frame alone is stored; errors are measured at every step.
    settings = settings._replace(store_every=settings.steps)
    size = max(1, _AGENTS // parts.graph.agents)
    for first in range(0, seeds, size):
        block = range(first, min(first + size, seeds))
        for result in batch.fly([(parts, settings._replace(seed=seed)) for seed in block]):
            if not isinstance(result, Result):
                errors.append(result)
                yield REFUSED
                continue
            if result.outcome in (Outcome.INTERRUPTED, Outcome.STOPPED):
                raise KeyboardInterrupt
            yield _failure(result, within)


def _failure(result: Result, within: float) -> str:
    completed = result.outcome is Outcome.COMPLETED
    if arrived(completed, metrics(result).settled_from, within):
        return ""
    # Such a start is no state of the model, and says nothing of the loop.
    if (result.sums.inside == 0.0).any():
        return OUTSIDE
    return LATE if completed else result.outcome.name.lower()
