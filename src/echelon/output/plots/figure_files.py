"""Figures as PNG, PDF and SVG files, written completely or not at all."""

import base64
import io
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from echelon.core.errors import OutputError, check_name
from echelon.core.files import make_atomic

if TYPE_CHECKING:
    from matplotlib.figure import Figure


NAMES = (
    *("leader_3d", "trajectories", "top_view", "tracking", "formation", "inputs"),
    *("states", "distances", "lyapunov", "modes", "network", "ages", "avoidance"),
)
"""All figures of a run."""


def check_names(what: str | Sequence[str]) -> tuple[str, ...]:
    """Return the names of figures, of one or several.

    Raises:
        OutputError: there is no figure of a name.
    """
    names = (what,) if isinstance(what, str) else tuple(what)
    for name in names:
        check_name("the figure is", name, NAMES, OutputError)
    return names


def html_image(figure: "Figure", name: str, dpi: int) -> str:
    """Return a figure as an element of an HTML page."""
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=dpi)
    data = base64.b64encode(content.getvalue()).decode("ascii")
    return f'<img alt="{name}" src="data:image/png;base64,{data}">'


def save(
    figures: "Mapping[str, Figure]",
    folder: Path,
    kinds: Sequence[str] = ("png", "pdf"),
    dpi: int = 150,
    progress: Callable[[int, int], None] = lambda done, files: None,
) -> list[Path]:
    """Write each figure as PNG and PDF into a folder, and return the paths.

    `progress` is called with how many files are written, and of how many.

    Raises:
        OSError: the folder or a file cannot be written.
    """
    from echelon.output.plots.style import style  # which loads what draws

    paths = []
    folder.mkdir(parents=True, exist_ok=True)
    # Without the date, so that the same run writes the same file.
    dates: dict[str, dict[str, Any]] = {"pdf": {"CreationDate": None}, "svg": {"Date": None}}
    for name, figure in figures.items():
        for kind in kinds:
            path, metadata = folder / f"{name}.{kind}", dates.get(kind)
            look: dict[str, Any] = {"format": kind, "dpi": dpi, "metadata": metadata}
            with style():
                make_atomic(path, lambda part: figure.savefig(part, **look))
            paths.append(path)
            progress(len(paths), len(figures) * len(kinds))
    return paths
