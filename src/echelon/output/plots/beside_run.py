"""The figure of a flight beside a run: how far apart agents are, and their positions over both."""

from typing import TYPE_CHECKING

from echelon.experiments.results.beside import Beside
from echelon.output.plots import style as draw
from echelon.output.plots.style import name_of, pen_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def beside_figure(both: Beside, page: draw.FigureSize = draw.SCREEN) -> "Figure":
    """Return panels of the distance and of each coordinate: flown in colour, the run dotted."""
    run, agents = both.of, draw.drawn(both.of)
    keep, columns = draw.thin(len(both.times), 2 * len(agents)), run.measured[:3]
    times = both.times[keep]
    with draw.style(page):
        height = 1.7 * (1 + len(columns)) * (page.letters / 10.0 if page.narrow else 1.0)
        figure, axes = draw.sheet(min(height, draw.HIGHEST), 1 + len(columns), 1, sharex="col")
        first, *rest = (row[0] for row in axes)
        for agent in draw.leaders_first(run, agents):
            look = pen_of(run, agent)
            draw.plot(first, times, both.away[keep, agent], label=name_of(run, agent), **look)
            for k, ax in zip(columns, rest, strict=True):
                draw.plot(ax, times, both.flown[keep, agent, k], **look)
                dotted = look | {"linestyle": ":", "color": draw.EDGE, "zorder": 3}
                draw.plot(ax, times, both.run[keep, agent, k], **dotted)
        first.set_ylabel(draw.label("apart", run.length_unit))
        first.set_title("flown: in colour; run: grey dots")
        for k, ax in zip(columns, rest, strict=True):
            ax.set_ylabel(draw.label(run.state_names[k], run.state_units[k]))
        axes[-1][0].set_xlabel("time (s)")
        return draw.finish(figure)
