"""Labelled arrays as netCDF, without what labels can do beyond that and takes long to load."""

import io
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from echelon.core.types import Array

if TYPE_CHECKING:
    import h5netcdf
    import xarray as xr


class Labelled(NamedTuple):
    """What an `xarray.Dataset` is made of.

    Attributes:
        variables: name -> (dimensions, values) or (dimensions, values, attributes).
        coordinates: the same; what has its name for its one dimension may be values alone.
        attributes: of the whole.
    """

    variables: Mapping[str, Any]
    coordinates: Mapping[str, Any]
    attributes: Mapping[str, Any]

    def dataset(self) -> "xr.Dataset":
        """Return it with all that labels can do."""
        import xarray as xr

        return xr.Dataset(*self)

    def netcdf(self) -> bytes:
        """Return the file that `xarray` writes of the dataset, and reads as it."""
        # Here, since it takes long to load; `xarray` takes five times as long.
        import h5netcdf

        file = io.BytesIO()
        with h5netcdf.File(file, "w") as written:
            for name, dimensions, values, attributes in self._parts():
                _write(written, name, dimensions, values, attributes)
            for name, value in self.attributes.items():
                written.attrs[name] = value if isinstance(value, str) else np.atleast_1d(value)
        return file.getvalue()

    def _parts(self) -> Iterator[tuple[str, tuple[str, ...], Array, dict[str, Any]]]:
        """Yield name, dimensions, values and attributes of all, the variables first."""
        for name, part in {**self.variables, **self.coordinates}.items():
            dimensions, values, told = _whole(name, part)
            beside = [] if name in self.coordinates else self._beside(dimensions)
            yield (
                name,
                dimensions,
                values,
                told | {"coordinates": " ".join(beside)} if beside else told,
            )

    def _beside(self, dimensions: tuple[str, ...]) -> list[str]:
        """Return which coordinates label dimensions under another name."""
        return [
            name
            for name, part in self.coordinates.items()
            if name not in (own := _whole(name, part)[0]) and set(own) <= set(dimensions)
        ]


def _whole(name: str, part: Any) -> tuple[tuple[str, ...], Array, dict[str, Any]]:
    dimensions, values, *attributes = part if isinstance(part, tuple) else (name, part)
    names = (dimensions,) if isinstance(dimensions, str) else tuple(dimensions)
    return names, np.asarray(values), dict(*attributes)


def _write(
    file: "h5netcdf.File",
    name: str,
    dimensions: tuple[str, ...],
    values: Array,
    attributes: Mapping[str, Any],
) -> None:
    """Write one variable."""
    for dimension, size in zip(dimensions, values.shape, strict=True):
        if dimension not in file.dimensions:
            file.dimensions[dimension] = size
    # Of text no file knows the length beforehand, and what is NaN in a float is missing.
    text = values.dtype.kind in "UO"
    kind: Any = _text() if text else values.dtype
    missing = values.dtype.type(np.nan) if values.dtype.kind == "f" else None
    made = file.create_variable(name, dimensions, kind, fillvalue=missing)
    made[...] = values.astype(object) if text else values
    for key, value in attributes.items():
        made.attrs[key] = value


def _text() -> Any:
    import h5py

    return h5py.string_dtype()
