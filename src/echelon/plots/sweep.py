"""The figures of a sweep."""

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import xarray as xr


def save_sweep_figures(data: "xr.Dataset", folder: Path) -> None:
    """Write the figures of a sweep."""
