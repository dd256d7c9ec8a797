"""The structure of a run's dataset, without its numbers, compared with what echelon writes.

Readers such as xarray change numbers by attributes (`scale_factor`), mask them (`_FillValue`) and
show groups and names beside them, so a file states more than its arrays.
"""

import io
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from echelon.core.types import JsonObject
from echelon.experiments.results.labelled import groups_of
from echelon.guarantees.verifier.findings import Finding, decide
from echelon.guarantees.verifier.stored_values import compare_values

if TYPE_CHECKING:
    import h5netcdf

_WRITTEN = {"units": ("s", "m"), "_FillValue": ("nan",)}
"""Attributes of variables and their values in every format, beside the names of coordinates."""


def compare_attributes(file: Path) -> Iterator[Finding]:
    """Yield a refused finding for each attribute of a group or variable that echelon never writes.

    Those of the root are compared with the run, one by one.
    """
    for place, part in _structure(file).items():
        for name, value in part["attributes"].items():
            known = name == "coordinates" or ("type" in part and value in _WRITTEN.get(name, ()))
            if not known:
                claim, text = f"{file.name}: {place}.{name}", "echelon does not write it"
                yield decide(ascii(claim)[1:-1], False, value, text=text)._replace(by_scenario=True)


def compare_structure(file: Path, again: bytes) -> Iterator[Finding]:
    """Compare groups, dimensions, variables, types and attributes with those of a file in memory.

    Sizes and numbers are compared with the arrays.
    """
    claim, stored, value = f"{file.name}: structure", _structure(file), _structure(again)
    findings = [*compare_values(claim, stored, value)]
    refused = [each for each in findings if each.verdict == "refused"]
    same = Finding(claim, f"{len(stored)} parts", f"{len(value)} parts", "recomputed", "", True)
    yield from refused or [same]


def _structure(file: Path | bytes) -> dict[str, JsonObject]:
    """Return dimensions, type and attributes of each group and variable as text, by its path."""
    # Here, since it is slow to load.
    import h5netcdf

    parts = dict[str, JsonObject]()
    with h5netcdf.File(io.BytesIO(file) if isinstance(file, bytes) else file, "r") as stored:
        for group in groups_of(stored):
            root = group.name == "/"
            parts[group.name] = {
                "dimensions": " ".join(sorted(group.dimensions)),
                "attributes": {} if root else _attributes(group),
            }
            for name, variable in group.variables.items():
                parts[f"{group.name.rstrip('/')}/{name}"] = {
                    "dimensions": " ".join(variable.dimensions),
                    "type": str(variable.dtype),
                    "attributes": _attributes(variable),
                }
    return parts


def _attributes(place: "h5netcdf.Group | h5netcdf.Variable") -> dict[str, str]:
    return {str(name): str(value) for name, value in place.attrs.items()}
