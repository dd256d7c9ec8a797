"""Figures as files: PNG, PDF and SVG, whole or not at all."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from echelon.core.files import make_atomic
from echelon.output.plots.style import style

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def save(
    figures: "Mapping[str, Figure]",
    folder: Path,
    kinds: Sequence[str] = ("png", "pdf"),
    dpi: int = 150,
) -> list[Path]:
    """Write each figure as PNG and PDF into a folder, made if need be; return the paths.

    Raises:
        OSError: the folder or a file cannot be written.
    """
    paths = []
    folder.mkdir(parents=True, exist_ok=True)
    # Without its date, the same run writes the same file.
    dates: dict[str, dict[str, Any]] = {"pdf": {"CreationDate": None}, "svg": {"Date": None}}
    for name, figure in figures.items():
        for kind in kinds:
            path, told = folder / f"{name}.{kind}", dates.get(kind)
            with style():
                make_atomic(
                    path, lambda part: figure.savefig(part, format=kind, dpi=dpi, metadata=told)
                )
            paths.append(path)
    return paths
