"""Labelled arrays: as plain arrays, as netCDF, or as an `xarray.Dataset`, which is slow to load."""

import io
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import numpy as np

from echelon.core.types import Array, JsonObject

if TYPE_CHECKING:
    import h5netcdf
    import xarray as xr


Variables: TypeAlias = dict[str, Any]
"""Arrays with the names of their dimensions, by name."""
GroupOf: TypeAlias = Callable[[str, tuple[str, ...]], str]
"""Returns the group of a variable in its file, by its name and dimensions."""


class Labelled(NamedTuple):
    """The arguments of `xarray.Dataset`.

    Attributes:
        variables: name -> (dimensions, values) or (dimensions, values, attributes).
        coordinates: the same; one with the name of its only dimension may be values alone.
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

    def netcdf(self, group_of: "GroupOf | None" = None) -> bytes:
        """Return the file that `xarray` writes of the dataset.

        Args:
            group_of: the group of a variable, by its name and dimensions; the root by default. A
                group has the coordinates of its dimensions too, so that it is a dataset by itself.
        """
        # Here, since it is slow to load; `xarray` takes five times as long.
        import h5netcdf

        file = io.BytesIO()
        with h5netcdf.File(file, "w") as written:
            for name, part in self._split(group_of or (lambda *_: "")).items():
                part.write(written.create_group(name) if name else written)
        return file.getvalue()

    def _split(self, group_of: "GroupOf") -> "dict[str, Labelled]":
        groups, used = {"": Labelled({}, {}, self.attributes)}, dict[str, set[str]]()
        for name, part in self.variables.items():
            over = _whole(name, part)[0]
            group = group_of(name, over)
            groups.setdefault(group, Labelled({}, {}, {})).variables[name] = part
            used.setdefault(group, set()).update(over)
        for name, part in self.coordinates.items():
            over = _whole(name, part)[0]
            places = [group for group, names in used.items() if names.issuperset(over)]
            for group in places or [group_of(name, over)]:
                groups.setdefault(group, Labelled({}, {}, {})).coordinates[name] = part
        return groups

    def write(self, place: "h5netcdf.Group") -> None:
        """Write all variables, coordinates and attributes into a group."""
        labels = set(self._labels())
        for name, part in {**self.variables, **self.coordinates}.items():
            dimensions, values, attributes = _whole(name, part)
            if name in self.variables and (own := self._labels(dimensions)):
                attributes["coordinates"], labels = " ".join(own), labels - {*own}
            _write(place, name, dimensions, values, attributes)
        # Labels that no variable names are an attribute of the group.
        if labels:
            place.attrs["coordinates"] = " ".join(sorted(labels))
        for name, value in self.attributes.items():
            plain = value if isinstance(value, str) else _numeric(name, np.atleast_1d(value))
            place.attrs[name] = plain

    def _labels(self, dimensions: tuple[str, ...] | None = None) -> list[str]:
        labels = {name: _whole(name, part)[0] for name, part in self.coordinates.items()}
        return [
            name
            for name, over in labels.items()
            if name not in over and (dimensions is None or set(over) <= set(dimensions))
        ]


def read_labelled(file: Path) -> Labelled:
    """Return the arrays of all groups of a netCDF file, and the attributes of its root.

    Raises:
        OSError: the file cannot be read; a damaged one may also raise other errors.
        ValueError: a coordinate, of which each group has a copy, is not the same in all.
    """
    import h5netcdf

    result = Labelled({}, {}, {})
    with h5netcdf.File(file, "r") as stored:
        for group in groups_of(stored):
            named = [group.attrs, *(each.attrs for each in group.variables.values())]
            labels = {label for each in named for label in str(each.get("coordinates", "")).split()}
            for name, variable in group.variables.items():
                is_label = name in labels or variable.dimensions == (name,)
                place = result.coordinates if is_label else result.variables
                attributes = {k: v for k, v in variable.attrs.items() if k not in _OF_FORMAT}
                values = _values(variable[...])
                if name in place and values.tolist() != _whole(name, place[name])[1].tolist():
                    raise ValueError(f"its groups have different values of `{name}`")
                place[name] = (variable.dimensions, values, attributes)
        for name, value in stored.attrs.items():
            plain = value.item() if isinstance(value, np.generic) else value
            result.attributes[name] = plain
    result.attributes.pop("coordinates", None)
    return result


_OF_FORMAT = ("coordinates", "_FillValue")
"""Attributes of variables that belong to the format of the file."""


def groups_of(group: "h5netcdf.Group") -> "Iterator[h5netcdf.Group]":
    """Yield a group and all groups in it."""
    yield group
    for inner in group.groups.values():
        yield from groups_of(inner)


def _values(stored: Array) -> Array:
    """Return an array as it was written; texts are stored as bytes."""
    values = np.asarray(stored)
    if values.dtype.kind != "O":
        return values
    texts = (x.decode() if isinstance(x, bytes) else str(x) for x in values.ravel())
    return np.array([*texts], str).reshape(values.shape)


def _whole(name: str, part: Any) -> tuple[tuple[str, ...], Array, JsonObject]:
    dimensions, values, *attributes = part if isinstance(part, tuple) else (name, part)
    names = (dimensions,) if isinstance(dimensions, str) else tuple(dimensions)
    return names, np.asarray(values), dict(*attributes)


def _write(
    file: "h5netcdf.Group",
    name: str,
    dimensions: tuple[str, ...],
    values: Array,
    attributes: JsonObject,
) -> None:
    import h5py

    for dimension, size in zip(dimensions, values.shape, strict=True):
        if dimension not in file.dimensions:
            file.dimensions[dimension] = size
    # Text has variable length, and NaN marks a missing float.
    text = values.dtype.kind in "UO"
    kind: Any = h5py.string_dtype() if text else _numeric(name, values).dtype
    missing = values.dtype.type(np.nan) if values.dtype.kind == "f" else None
    variable = file.create_variable(name, dimensions, kind, fillvalue=missing)
    variable[...] = values.astype(object) if text else values
    for key, value in attributes.items():
        variable.attrs[key] = value


def _numeric(name: str, values: Array) -> Array:
    """Return numbers of a type that netCDF stores unchanged."""
    assert values.dtype.kind in "iuf", f"`{name}` has type {values.dtype}, which netCDF lacks"
    return values
