"""Labelled arrays as netCDF, without what labels can do beyond that and takes long to load."""

import io
from collections.abc import Mapping
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

        file, labels = io.BytesIO(), set(self._labels())
        with h5netcdf.File(file, "w") as written:
            for name, part in {**self.variables, **self.coordinates}.items():
                dimensions, values, told = _whole(name, part)
                if name in self.variables and (mine := self._labels(dimensions)):
                    told["coordinates"], labels = " ".join(mine), labels - {*mine}
                _write(written, name, dimensions, values, told)
            # Labels that no variable names are named by the whole.
            rest = {"coordinates": " ".join(sorted(labels))} if labels else {}
            for name, value in {**self.attributes, **rest}.items():
                known = value if isinstance(value, str) else _known(name, np.atleast_1d(value))
                written.attrs[name] = known
        return file.getvalue()

    def _labels(self, dimensions: tuple[str, ...] | None = None) -> list[str]:
        """Return which coordinates label dimensions, or any, under another name."""
        owns = {name: _whole(name, part)[0] for name, part in self.coordinates.items()}
        return [
            name
            for name, own in owns.items()
            if name not in own and (dimensions is None or set(own) <= set(dimensions))
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
    kind: Any = _text() if text else _known(name, values).dtype
    missing = values.dtype.type(np.nan) if values.dtype.kind == "f" else None
    made = file.create_variable(name, dimensions, kind, fillvalue=missing)
    made[...] = values.astype(object) if text else values
    for key, value in attributes.items():
        made.attrs[key] = value


def _known(name: str, values: Array) -> Array:
    """Return numbers of a kind that stands in a file as it is."""
    assert values.dtype.kind in "iuf", f"`{name}` is of {values.dtype}, which `xarray` turns first"
    return values


def _text() -> Any:
    import h5py

    return h5py.string_dtype()
