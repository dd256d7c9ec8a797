"""The figure of agents that keep apart: how near they came, and when they held each other back."""

from typing import TYPE_CHECKING

from echelon.core.types import Array
from echelon.experiments.results.recording import Recording
from echelon.output.plots import style as draw
from echelon.output.plots.over_time import over_time

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def avoidance(run: Recording) -> "Figure | None":
    """Return the smallest scaled distance with its limits, and the active rows, over all steps.

    None of agents that do not keep apart.
    """
    numbers = run.avoidance
    if numbers is None:
        return None

    def show_distance(ax: "Axes", frames: Array) -> None:
        draw.plot(ax, numbers.times, numbers.distance, color=draw.LEADER, label="any two")
        look = {"color": draw.EDGE, "linewidth": 0.9}
        ax.axhline(numbers.kept, label="hulls keep", linestyle=":", **look)
        ax.axhline(numbers.touching, label="agents touch", linestyle=(0, (6, 2)), **look)
        ax.set_ylabel(draw.label("scaled distance", "m"))
        ax.set_ylim(bottom=0.0)

    def show_rows(ax: "Axes", frames: Array) -> None:
        ax.step(numbers.times, numbers.active, where="post", color=draw.LEADER)
        ax.set_ylabel("active rows")
        ax.set_ylim(bottom=0.0)

    figure, axes = over_time(run, [show_distance, show_rows], 1.9)
    return draw.finish(figure, legends=[row[-1] for row in axes])
