"""The numbers of a run, each with its name, unit, labels and computation.

A further number is one more entry of `RUN_NUMBERS`, or of `AGENT_NUMBERS` for one of each follower.
Tables, JSON, data sets, figures and the glossary take it from here.
"""

import enum
from collections.abc import Callable, Mapping, Sequence
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    NamedTuple,
    TypeVar,
    final,
    get_args,
    get_type_hints,
)

import numpy as np

if TYPE_CHECKING:
    # Loads JAX, without which `echelon explain` needs this table at once.
    from echelon.simulation.engine.frame_numbers import ClosestPair

ERROR = "error"
"""In place of a unit: that of the formation errors."""


def settling_bound(unit: str) -> str:
    """Return the error below which a follower has settled, for errors in m or without a unit."""
    return "1 cm" if unit else "0.01"


@final
class Appearance(enum.Flag):
    """Where a number of a run appears, besides the glossary."""

    SWEEP = enum.auto()
    """In the dataset of a sweep."""
    DISTRIBUTION = enum.auto()
    """In the report and the figures of a sweep, as a distribution over its runs."""
    COMPARISON = enum.auto()
    """In the JSON of a comparison, and in its table of costs if the number has a column."""
    SUMMARY = enum.auto()
    """In the summary of a run."""
    SEEDS = enum.auto()
    """In a comparison over many seeds, as a distribution and as paired differences."""


class Quantity(NamedTuple):
    """A number of a run or of an agent.

    Attributes:
        meaning: in data sets and the glossary.
        unit: `ERROR` for the unit of formation errors; empty without one.
        label: of an axis.
        column: of a table; `{unit}`, `{window}` (s) and `{settled}` stand for those of the run.
        of: computes it from the `RunNumbers` of a run, for an agent's number those of all
            followers, (F,); None for what `metrics` computes of each agent.
        key: in JSON; its name by default.
        scale: of the number in tables: 100 for a percentage.
        digits: most digits in tables.
        absent: in tables, if the number does not exist.
        more_is_better: whether a larger number is the better one.
    """

    meaning: str
    unit: str = ""
    label: str = ""
    column: str = ""
    of: Callable[[Any], Any] | None = None
    shown: Appearance = Appearance.SWEEP
    key: str = ""
    scale: float = 1.0
    digits: int = 4
    absent: str = "-"
    more_is_better: bool = False

    def cell(self, value: float | None, digits: int = 4) -> str:
        """Return the number as a cell of a table."""
        if value is None:
            return self.absent
        return f"{self.scale * value:.{min(digits, self.digits)}g}"


def quantities(numbers: type) -> dict[str, Quantity]:
    """Return the quantities among the fields of a tuple of numbers, by name."""
    hints = get_type_hints(numbers, include_extras=True)
    marks = ((name, mark) for name, hint in hints.items() for mark in get_args(hint)[1:])
    return {name: mark for name, mark in marks if isinstance(mark, Quantity)}


class LeaderMetrics(NamedTuple):
    """Root-mean-square deviation of a leader from its reference; None without a reference.

    `saturated` is the fraction of steps in which a limit changed the input.
    """

    rmse: float | None
    steady_rmse: float | None
    rmse_by_output: dict[str, float | None]
    agent: int = 0
    saturated: float = 0.0


class FollowerMetrics(NamedTuple):
    """One follower's formation error: the length of the vector to its goal relative to its leader.

    `settling_time` (s) is the time after which the error stays below 1 cm. `effort` is the
    root-mean-square of the normalized input about the trim. `saturated` is the fraction of steps in
    which a limit changed the input. A further number is one more field with its `Quantity`.
    """

    agent: int
    rmse: Annotated[
        float | None,
        Quantity("root mean square of the formation error", ERROR, column="RMSE{unit}\n(all)"),
    ]
    steady_rmse: Annotated[
        float | None,
        Quantity(
            "root mean square of the formation error in the steady window",
            ERROR,
            column="steady{unit}\n(last {window:.3g} s)",
        ),
    ]
    settling_time: Annotated[
        float | None,
        Quantity(
            "time after which the error stays below 1 cm, or 0.01 without a position",
            "s",
            column="within {settled}\nfrom, s",
            key="settling_time_s",
            absent="never",
        ),
    ]
    effort: Annotated[
        float | None, Quantity("root mean square of the normalized input", column="effort")
    ]
    saturated: Annotated[
        float,
        Quantity(
            "fraction of steps in which a limit changed the input",
            column="saturated,\n% steps",
            scale=100.0,
            digits=3,
        ),
    ]


class EdgeMetrics(NamedTuple):
    """Root-mean-square of (actual minus desired distance) on one edge."""

    edge: tuple[int, int]
    distance_rmse: float | None


class Metrics(NamedTuple):
    """All numbers of a run; what does not exist is None, never NaN.

    Errors are of the position (m) where the model has one, else of the whole state. A run that
    diverged has no errors. The closest pair is that of all steps, or of the stored `frames`.
    """

    leaders: tuple[LeaderMetrics, ...]
    followers: tuple[FollowerMetrics, ...]
    edges: tuple[EdgeMetrics, ...]
    closest: "ClosestPair | None"
    saturation_fraction: float
    steady_window: float

    @property
    def leader(self) -> LeaderMetrics:
        """The numbers of the first leader."""
        return self.leaders[0]

    @property
    def minimum_distance(self) -> float | None:
        """The smallest distance between two agents, m; `closest` says over what."""
        return None if self.closest is None else self.closest.distance

    @property
    def settled_from(self) -> float:
        """The time after which the errors of all followers stay below 1 cm, s; NaN if never."""
        times = [f.settling_time for f in self.followers]
        return float(np.max(np.array(times, float), initial=0.0))

    @property
    def worst_steady(self) -> float | None:
        """The largest steady error of a follower."""
        values = [f.steady_rmse for f in self.followers if f.steady_rmse is not None]
        return max(values) if values else None


_Row = TypeVar("_Row")


def representatives(rows: Sequence[_Row], error: Callable[[_Row], float]) -> list[_Row]:
    """Return the best, the median and the worst of some rows, which have errors."""
    ordered = sorted(rows, key=error)
    return [ordered[0], ordered[len(ordered) // 2], ordered[-1]]


def steady_error(row: LeaderMetrics | FollowerMetrics) -> float:
    """Return the steady error of an agent."""
    # An agent without one did not reach the steady window, and counts as the worst.
    return np.inf if row.steady_rmse is None else row.steady_rmse


AGENT_NUMBERS: Mapping[str, Quantity] = quantities(FollowerMetrics) | {
    "start_error": Quantity(
        "formation error at the start",
        ERROR,
        column="error at the start{unit}",
        of=lambda run: run.first_and_last[0],
        shown=Appearance(0),
    ),
    "final_error": Quantity(
        "formation error at the end",
        ERROR,
        column="at the end{unit}",
        of=lambda run: run.first_and_last[1],
    ),
}
_OF_NETWORK = Appearance.SWEEP | Appearance.COMPARISON | Appearance.SUMMARY
RUN_NUMBERS: Mapping[str, Quantity] = {
    "formation_rmse": Quantity(
        "root mean square of the followers' errors, over all steps and followers",
        ERROR,
        "formation RMSE",
        of=lambda run: run.root_mean("rmse"),
        shown=Appearance.SWEEP | Appearance.DISTRIBUTION | Appearance.SEEDS,
    ),
    "formation_steady_rmse": Quantity(
        "root mean square of the followers' errors in the steady window",
        ERROR,
        "steady RMSE",
        of=lambda run: run.root_mean("steady_rmse"),
        shown=Appearance.SWEEP | Appearance.SEEDS,
    ),
    "worst_rmse": Quantity(
        "largest RMSE of a follower", ERROR, of=lambda run: run.worst("rmse"), shown=Appearance(0)
    ),
    "worst_steady_rmse": Quantity(
        "largest RMSE of a follower in the steady window",
        ERROR,
        of=lambda run: run.metrics.worst_steady,
        shown=Appearance(0),
    ),
    "worst_final_error": Quantity(
        "error of the follower that is farthest from its goal at the end",
        ERROR,
        "worst final error",
        of=lambda run: run.worst("final_error"),
        shown=Appearance.SWEEP | Appearance.DISTRIBUTION,
    ),
    "worst_settling_time": Quantity(
        "time after which the errors of all followers stay below 1 cm, or 0.01 without a position",
        "s",
        "settling time",
        of=lambda run: run.metrics.settled_from,
        shown=Appearance.SWEEP | Appearance.DISTRIBUTION | Appearance.COMPARISON | Appearance.SEEDS,
        key="settling_time_s",
        absent="never",
    ),
    "leader_rmse": Quantity(
        "root mean square of the first leader's error",
        ERROR,
        of=lambda run: run.metrics.leader.rmse,
        shown=Appearance.SWEEP | Appearance.COMPARISON,
    ),
    "leader_steady_rmse": Quantity(
        "root mean square of the first leader's error in the steady window",
        ERROR,
        of=lambda run: run.metrics.leader.steady_rmse,
        shown=Appearance.SWEEP | Appearance.COMPARISON,
    ),
    "effort": Quantity(
        "root mean square of the followers' normalized inputs about the trim",
        label="effort",
        column="effort",
        # The mean of the squares: the root mean square of all inputs together.
        of=lambda run: run.root_mean("effort"),
        shown=Appearance.COMPARISON | Appearance.SEEDS,
    ),
    "saturation_fraction": Quantity(
        "mean over all agents of `saturated`",
        column="saturated,\n% steps",
        of=lambda run: run.metrics.saturation_fraction,
        shown=Appearance.SWEEP | Appearance.COMPARISON | Appearance.SUMMARY,
        scale=100.0,
        digits=3,
    ),
    "minimum_distance": Quantity(
        "smallest distance between any two agents, over all steps",
        "m",
        "smallest distance",
        column="smallest\ndistance",
        of=lambda run: run.metrics.minimum_distance,
        shown=Appearance.COMPARISON | Appearance.SUMMARY | Appearance.SEEDS,
        more_is_better=True,
    ),
    "minimum_distance_time": Quantity(
        "time at which two agents were closest to each other",
        "s",
        of=lambda run: getattr(run.metrics.closest, "time", None),
        shown=Appearance.SUMMARY,
        key="minimum_distance_time_s",
    ),
    "minimum_distance_frames": Quantity(
        "in how many stored frames that distance was found; null: over all steps",
        of=lambda run: getattr(run.metrics.closest, "frames", None),
        shown=Appearance.SUMMARY,
    ),
    "closest_agents": Quantity(
        "the two agents that were closest to each other",
        of=lambda run: getattr(run.metrics.closest, "agents", None),
        shown=Appearance.SUMMARY,
    ),
    "vehicle_radius": Quantity(
        "radius of an agent; closer than twice of it, two agents touch",
        "m",
        of=lambda run: run.result.radius,
        shown=Appearance.SUMMARY,
    ),
    "computing": Quantity(
        "computing time for one agent and one second of the run",
        "s",
        column="computing,\nms per agent s",
        of=lambda run: run.computing,
        shown=Appearance.COMPARISON,
        key="computing_s_per_agent_s",
        scale=1e3,
    ),
    "largest_age": Quantity(
        "largest age of a message in use, over all steps and links",
        "s",
        column="oldest message\nin use, s",
        of=lambda run: run.of_network("largest"),
        shown=_OF_NETWORK,
        key="largest_age_s",
    ),
    "mean_age": Quantity(
        "mean age of the messages in use, over all steps and links",
        "s",
        of=lambda run: run.of_network("mean"),
        shown=_OF_NETWORK,
        key="mean_age_s",
    ),
    "messages_sent": Quantity(
        "messages sent, each counted for every agent that uses it",
        of=lambda run: run.of_network("sent"),
        shown=_OF_NETWORK,
    ),
    "messages_lost": Quantity(
        "messages that were lost",
        column="messages\nlost",
        of=lambda run: run.of_network("lost"),
        shown=_OF_NETWORK,
    ),
    "messages_late": Quantity(
        "messages that arrived after a newer one of the same sender",
        of=lambda run: run.of_network("late"),
        shown=_OF_NETWORK,
    ),
    "scaled_distance": Quantity(
        "smallest scaled distance between two agents that keep apart, over all steps",
        "m",
        column="scaled\ndistance",
        of=lambda run: None if run.avoidance is None else run.avoidance.least,
        shown=Appearance.SWEEP | Appearance.SUMMARY,
    ),
    "held_back_until": Quantity(
        "time until which agents that keep apart held each other back",
        "s",
        of=lambda run: None if run.avoidance is None else run.avoidance.last,
        shown=Appearance.SWEEP | Appearance.SUMMARY,
    ),
    "promise_rate": Quantity(
        "rate at which errors are guaranteed to decay",
        "1/s",
        column="guaranteed,\n1/s",
        of=lambda run: run.promise.rate if run.promise.promised else None,
    ),
    "covered": Quantity(
        "whether every step of the run kept to what its theorem rests on, limits included",
        of=lambda run: run.covered,
        shown=Appearance.SWEEP | Appearance.SUMMARY,
    ),
    "certified_radius": Quantity(
        "r of the certified set: sum_i delta_i'P delta_i <= r^2",
        of=lambda run: run.certified_radius,
    ),
    "start_size": Quantity(
        "the r of the certified set's inequality at the start of the run",
        of=lambda run: run.start_size,
    ),
    "alternations": Quantity(
        "how many times an input of an agent jumped from one limit to the opposite one, at most",
        of=lambda run: int(run.result.chatter.max()),
        shown=Appearance.SUMMARY,
    ),
}


def shown_in(table: Mapping[str, Quantity], where: Appearance) -> dict[str, Quantity]:
    """Return the numbers of a table that appear somewhere."""
    return {name: quantity for name, quantity in table.items() if where in quantity.shown}
