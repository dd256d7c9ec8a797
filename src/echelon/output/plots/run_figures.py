"""The figures of a run, ready for screen and print."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from echelon.core.errors import OutputError
from echelon.experiments.results.recording import Recording, recording_of
from echelon.output.plots import network, over_time, trajectories
from echelon.output.plots import style as draw
from echelon.output.plots.figure_files import NAMES, check_names, save
from echelon.simulation.engine.result import Result

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_MAKERS: "dict[str, Callable[[Recording], Figure | None]]" = dict(
    zip(
        NAMES,
        (
            *(trajectories.leader, trajectories.trajectories, trajectories.top_view),
            *(over_time.tracking, over_time.formation, over_time.inputs),
            *(over_time.states, over_time.distances, over_time.lyapunov),
            *(network.modes, network.network, over_time.ages, over_time.avoidance),
        ),
        strict=True,
    )
)
DEFAULT = (
    *("leader_3d", "trajectories", "tracking", "formation", "inputs", "lyapunov"),
    *("ages", "avoidance"),
)
"""Figures that a run writes into its folder."""


def figures(
    run: Result | Recording,
    what: str | Sequence[str] = DEFAULT,
    page: draw.FigureSize = draw.SCREEN,
    ax: "Axes | None" = None,
) -> "dict[str, Figure]":
    """Return figures of a run, by name; those that do not apply to it are missing.

    - `leader_3d`: the leaders with their references, in space, in the plane, or over time
    - `trajectories`: all agents, with the graph at a few times; `top_view`: the same from above
    - `tracking`: each output of the leaders minus its reference
    - `formation`: each follower's distance from its goal, with the guaranteed slope and bound
    - `inputs`: actuator loads with their limits
    - `states`: all states over time
    - `distances`: those of linked agents, and the smallest of any two
    - `lyapunov`: V with its derivative
    - `modes`: the closed-loop poles
    - `network`: the communication graph
    - `ages`: of the oldest message of each follower, over a network
    - `avoidance`: how near agents came that keep apart, and how many held each other back

    A run without a stored frame has no figures. Parts of a diverging run a million times beyond its
    start and reference are not drawn, and the figure says so.

    Args:
        run: a result, or a recording of one.
        what: the name of a figure, or names.
        page: size of the figures, such as `echelon.output.plots.style.ONE_COLUMN`.
        ax: axes of matplotlib into which the one named figure is drawn, such as `formation`,
            `modes`, or the paths of agents in the plane; the figure returned is then theirs.

    Raises:
        OutputError: a name is unknown; or `ax` is given, and `what` are several figures or one that
            has several axes or is in space.
    """
    names = check_names(what)
    if ax is not None and len(names) != 1:
        raise OutputError(f"`ax` takes one figure, and `what` has {len(names)} names.")
    if ax is not None and not hasattr(ax, "figure"):
        raise OutputError(f"`ax` is a `{type(ax).__name__}`, and must be axes of matplotlib.")
    data = recording_of(run)
    if not len(data.times):
        return {}
    with draw.style(page, ax):
        drawings = {name: make(data) for name, make in _MAKERS.items() if name in names}
    return {name: figure for name, figure in drawings.items() if figure is not None}


def save_figures(
    run: Result | Recording, folder: str | Path, what: str | Sequence[str] = DEFAULT
) -> list[Path]:
    """Write figures of a run as PNG (150 dpi) and PDF under `folder`/figures; return the paths.

    Args:
        run: a result, or a recording of one.
        folder: that gets a folder `figures`.
        what: the name of a figure, or names, as `figures` has them.

    Raises:
        OSError: the folder or a file cannot be written.
        OutputError: a name is unknown.
    """
    return save(figures(run, what), Path(folder) / "figures")
