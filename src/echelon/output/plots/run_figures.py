"""The figures of a run, ready for screen and print."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from echelon.core.errors import OutputError, did_you_mean, listing
from echelon.experiments.results.dataset import recording_of
from echelon.experiments.results.recording import Recording
from echelon.output.plots import curves, network, trajectories
from echelon.output.plots import style as draw
from echelon.output.plots.figure_files import save
from echelon.simulation.engine.result import Result

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_MAKERS: "dict[str, Callable[[Recording], Figure | None]]" = {
    "leader_3d": trajectories.leader,
    "trajectories": trajectories.trajectories,
    "top_view": trajectories.top_view,
    "tracking": curves.tracking,
    "formation": curves.formation,
    "inputs": curves.inputs,
    "states": curves.states,
    "distances": curves.distances,
    "lyapunov": curves.lyapunov,
    "modes": network.modes,
    "network": network.network,
}
NAMES = tuple(_MAKERS)
"""All figures of a run."""
USUAL = ("leader_3d", "trajectories", "tracking", "formation", "inputs", "lyapunov")
"""Those that a run leaves in its folder."""


def figures(
    run: Result | Recording, what: Sequence[str] = USUAL, page: draw.FigureSize = draw.SCREEN
) -> "dict[str, Figure]":
    """Return the figures that make sense for a run, by name.

    `leader_3d` is the leaders with their references: in space or in the plane where the model has a
    position, else in the phase plane or over time. `trajectories` are all agents, with the graph
    drawn at a few times, and `top_view` the same from above. `tracking` is each output of the
    leaders minus the reference's, and exists with a reference. `formation` is each follower's
    distance from its goal, with gaps where it is 0, and with the slope and the bound that are
    promised. `inputs` are what actuators give, with their limits. `states` are all of them over
    time. `distances` are those of linked agents and the least of any two. `lyapunov` is V with its
    derivative, and exists where the law has one. `modes` are the poles of the loop, and `network`
    who hears whom.

    A run without a stored frame has no figures. Where agents run a million times farther off
    than their start and the reference reach, that is left out, and the figure says so.

    Args:
        run: a result, or a recording of one.
        what: names of figures.
        page: where they will stand: `echelon.output.plots.style.ONE_COLUMN`, for one.

    Raises:
        OutputError: there is no figure of a name.
    """
    for name in what:
        if name not in _MAKERS:
            raise OutputError(
                f"there is no figure `{name}`{did_you_mean(name, NAMES)}; a run has "
                f"{listing(NAMES)}."
            )
    if not len(run.times):
        return {}
    shown = recording_of(run) if isinstance(run, Result) else run
    with draw.style(page):
        made = {name: make(shown) for name, make in _MAKERS.items() if name in what}
    return {name: figure for name, figure in made.items() if figure is not None}


def save_figures(
    run: Result | Recording, folder: str | Path, what: Sequence[str] = USUAL
) -> list[Path]:
    """Write figures of a run as PNG (150 dpi) and PDF under `folder`/figures; return the paths.

    Args:
        run: a result, or a recording of one.
        folder: where `figures` is made, unless it is there.
        what: names of figures, as `figures` has them.

    Raises:
        OSError: the folder or a file cannot be written.
        OutputError: there is no figure of a name.
    """
    return save(figures(run, what), Path(folder) / "figures")
