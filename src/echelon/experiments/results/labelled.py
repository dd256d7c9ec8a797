"""Labelled arrays: as plain arrays, as netCDF, or as an `xarray.Dataset`, which is slow to load."""

import io
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import numpy as np

from echelon.core.types import Array, JsonObject

if TYPE_CHECKING:
    import h5netcdf
    import xarray as xr


Variables: TypeAlias = dict[str, Any]
"""Arrays with the names of their dimensions, by name."""


class Labelled(NamedTuple):
    """The arguments of `xarray.Dataset`.

    Attributes:
        variables: name -> (dimensions, values) or (dimensions, values, attributes).
        coordinates: the same; one with the name of its only dimension may be values alone.
        attributes: of the dataset.
    """

    variables: Variables
    coordinates: Variables
    attributes: JsonObject

    def dataset(self) -> "xr.Dataset":
        """Return the dataset."""
        import xarray as xr

        return xr.Dataset(*self)

    def arrays(self) -> dict[str, Array]:
        """Return the values of all variables and coordinates by name."""
        parts = {**self.variables, **self.coordinates}
        return {name: _whole(name, part)[1] for name, part in parts.items()}

    def netcdf(self) -> bytes:
        """Return the same file that `xarray` writes of the dataset."""
        # Here, since it is slow to load; `xarray` takes five times as long.
        import h5netcdf

        file, labels = io.BytesIO(), set(self._labels())
        with h5netcdf.File(file, "w") as written:
            for name, part in {**self.variables, **self.coordinates}.items():
                dimensions, values, attributes = _whole(name, part)
                if name in self.variables and (own := self._labels(dimensions)):
                    attributes["coordinates"], labels = " ".join(own), labels - {*own}
                _write(written, name, dimensions, values, attributes)
            # Labels that no variable names are attributes of the dataset.
            rest = {"coordinates": " ".join(sorted(labels))} if labels else {}
            for name, value in {**self.attributes, **rest}.items():
                plain = value if isinstance(value, str) else _numeric(name, np.atleast_1d(value))
                written.attrs[name] = plain
        return file.getvalue()

    def _labels(self, dimensions: tuple[str, ...] | None = None) -> list[str]:
        """Return the coordinates whose name is not that of their dimension, of these dimensions."""
        labels = {name: _whole(name, part)[0] for name, part in self.coordinates.items()}
        return [
            name
            for name, over in labels.items()
            if name not in over and (dimensions is None or set(over) <= set(dimensions))
        ]


def labelled(data: "xr.Dataset") -> Labelled:
    """Return the arrays of a dataset."""
    variables, coordinates = (
        {str(name): (each.dims, each.values, each.attrs) for name, each in some.items()}
        for some in (data.data_vars, data.coords)
    )
    return Labelled(variables, coordinates, data.attrs)


def _whole(name: str, part: Any) -> tuple[tuple[str, ...], Array, JsonObject]:
    dimensions, values, *attributes = part if isinstance(part, tuple) else (name, part)
    names = (dimensions,) if isinstance(dimensions, str) else tuple(dimensions)
    return names, np.asarray(values), dict(*attributes)


def _write(
    file: "h5netcdf.File",
    name: str,
    dimensions: tuple[str, ...],
    values: Array,
    attributes: JsonObject,
) -> None:
    """Write one variable."""
    for dimension, size in zip(dimensions, values.shape, strict=True):
        if dimension not in file.dimensions:
            file.dimensions[dimension] = size
    # Text has variable length, and NaN marks a missing float.
    text = values.dtype.kind in "UO"
    kind: Any = _text() if text else _numeric(name, values).dtype
    missing = values.dtype.type(np.nan) if values.dtype.kind == "f" else None
    variable = file.create_variable(name, dimensions, kind, fillvalue=missing)
    variable[...] = values.astype(object) if text else values
    for key, value in attributes.items():
        variable.attrs[key] = value


def _numeric(name: str, values: Array) -> Array:
    """Return numbers of a type that netCDF stores unchanged."""
    assert values.dtype.kind in "iuf", f"`{name}` has type {values.dtype}, which netCDF lacks"
    return values


def _text() -> Any:
    import h5py

    return h5py.string_dtype()
