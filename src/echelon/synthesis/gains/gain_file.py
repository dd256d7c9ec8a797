"""Gain files: a gain with its certificate, and the model and graph for which it was made."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np

from echelon.agents import models
from echelon.agents.models.linearization import linearize
from echelon.agents.models.model import ControlAffine
from echelon.agents.network.graph import Graph
from echelon.core.errors import GainError, OutputError
from echelon.core.files import write_atomic
from echelon.core.types import Array, JsonObject, PathLike
from echelon.core.words import Kind, Theorem
from echelon.synthesis.certificates.certificate import Certificate, RegionCertificate
from echelon.synthesis.certificates.domain import Domain
from echelon.synthesis.gains.gain import Gain

FORMAT = "echelon gain 2"
_SAME = 1e-9
"""Relative difference beyond which two models or spectra are not the same."""
_MOST_EDGES = 2000
"""The file of a graph with more edges has only its eigenvalues."""

_ENDS = {"lower": -np.inf, "upper": np.inf, "input_lower": 0.0, "input_upper": 0.0}
"""The bounds of a domain, and the value of None in each."""


def gain_as_mapping(gain: Gain, model: ControlAffine, graph: Graph) -> JsonObject:
    """Return a gain ready for JSON, with the data of its certificate.

    These are the model, the graph with its eigenvalues, the domain and the corners of the hull of
    Jacobians; `verify` recomputes every guarantee from them. A bound that is infinite is None.
    """
    sums = graph.spectrum().sums
    return {
        "format": FORMAT,
        "method": gain.method,
        "coupling": gain.coupling,
        "P": gain.P.tolist(),
        "R": gain.R.tolist(),
        "inner": None if gain.inner is None else gain.inner.tolist(),
        "model": _model_as_mapping(model),
        "graph": {
            "agents": graph.agents,
            "leaders": list(graph.leaders),
            "edges": _edges(graph),
            # Stored with the edges: the verifier compares them; a large graph has nothing else.
            "directed": graph.directed,
            "switches": graph.schedule is not None,
            "spectrum": _reals(graph.spectrum().eigenvalues),
            "sums": None if sums is None else sums.tolist(),
        },
        "certificate": _certificate_as_mapping(gain.certificate),
    }


def _reals(values: Array) -> list[Any]:
    """Return numbers for JSON, complex ones as pairs."""
    if not np.iscomplexobj(values):
        return values.tolist()
    return [[float(x.real), float(x.imag)] for x in values]


def _model_as_mapping(model: ControlAffine) -> JsonObject:
    linear = linearize(model)
    return {
        "class": _public_path(type(model)),
        # The verifier rebuilds a bundled model from them; it never imports a user's model.
        "parameters": _parameters(model),
        "state_names": list(model.state_names),
        "input_names": list(model.input_names),
        "trim": [list(part) for part in model.trim],
        "input_scale": [list(row) for row in model.input_scale],
        "A": linear.A.tolist(),
        "B": linear.B.tolist(),
    }


def _public_path(cls: type) -> str:
    """Return the import path of a class; of a bundled one its public name, which never changes."""
    if getattr(models, cls.__name__, None) is cls:
        return f"echelon.models:{cls.__name__}"
    return f"{cls.__module__}:{cls.__qualname__}"


def _parameters(model: ControlAffine) -> JsonObject | None:
    """Return the fields of a model, or None where JSON cannot hold one of them."""
    fields = [field.name for field in dataclasses.fields(model) if field.init]
    stored = {name: getattr(model, name) for name in fields}
    try:
        return json.loads(
            # Through JSON itself, so that the values are those that will be read.
            json.dumps(stored, allow_nan=False, default=lambda x: np.asarray(x).tolist())
        )
    except (TypeError, ValueError):
        return None


def _edges(graph: Graph) -> list[list[float]] | None:
    if len(graph.edges) > _MOST_EDGES:
        return None
    return [[*map(int, e), float(w)] for e, w in zip(graph.edges, graph.weights, strict=True)]


def _certificate_as_mapping(certificate: Certificate) -> JsonObject:
    region = certificate.region
    return {
        "kind": str(certificate.kind),
        "lambda_min": certificate.lambda_min,
        "lambda_max": certificate.lambda_max,
        "abscissa": certificate.abscissa,
        "modes": certificate.modes,
        "edge": certificate.edge,
        "observable": certificate.observable,
        "region": None if region is None else _region_as_mapping(region),
    }


def _region_as_mapping(region: RegionCertificate) -> JsonObject:
    domain = region.domain
    return {
        "kind": str(region.kind),
        "theorem": str(region.theorem),
        "rate": region.rate,
        "radius": region.radius,
        "strength": region.strength,
        # JSON has no infinity, which only Python would read.
        "domain": {
            name: [x if np.isfinite(x) else None for x in getattr(domain, name).tolist()]
            for name in _ENDS
        },
        "hull": _pack(region.hull),
        "error": region.error.tolist(),
    }


def _pack(matrices: Array) -> JsonObject:
    """Return matrices as the first one and the entries that vary; most are the same in all."""
    # A vehicle's hull has thousands of corners that differ in a few entries of (n, n) or (n, 2n).
    places = np.argwhere((matrices != matrices[0]).any(axis=0))
    values = matrices[:, places[:, 0], places[:, 1]]
    return {"base": matrices[0].tolist(), "places": places.tolist(), "values": values.tolist()}


def _unpack(stored: JsonObject) -> Array:
    values = np.array(stored["values"], float)
    # A hull of one matrix has no places, and an empty list no second axis.
    places = np.array(stored["places"], int).reshape(-1, 2)
    matrices = np.repeat(np.array(stored["base"], float)[None], len(values), axis=0)
    matrices[:, places[:, 0], places[:, 1]] = values
    return matrices


def save_gain(gain: Gain, model: ControlAffine, graph: Graph, path: PathLike) -> None:
    """Write a gain as JSON.

    Raises:
        OutputError: the file cannot be written.
    """
    stored = gain_as_mapping(gain, model, graph)
    # A line per key, so that a diff shows the change. NaN is rejected: no guarantee rests on one.
    lines = [f"{json.dumps(key)}: {json.dumps(stored[key], allow_nan=False)}" for key in stored]
    try:
        write_atomic(Path(path), "{\n" + ",\n".join(lines) + "\n}\n")
    except OSError as error:
        raise OutputError(f"`{path}` cannot be written: {error.strerror or error}.") from error


def load_gain(path: PathLike, model: ControlAffine, graph: Graph) -> Gain:
    """Return the gain of a file, for the model and the graph for which it was made.

    Raises:
        GainError: the file is no gain, holds a number that is not finite, or was made for another
            model or graph; the message says what differs.
    """
    stored = _read(path)
    try:
        _check_model(path, stored["model"], model)
        _check_graph(path, stored["graph"], graph)
        gain = _gain(stored)
    # An edited file fails here with one of these errors.
    except (ArithmeticError, LookupError, TypeError, ValueError) as error:
        raise GainError(f"`{path}` is no gain file of echelon: {error}.") from error
    return gain


def _read(path: PathLike) -> JsonObject:
    try:
        stored = json.loads(Path(path).read_text("utf-8"), object_pairs_hook=_mapping)
    except OSError as error:
        raise GainError(f"the gain file `{path}` cannot be read: {error.strerror}.") from error
    except ValueError as error:
        raise GainError(f"the gain file `{path}` is no JSON: {error}.") from error
    form = stored.get("format") if isinstance(stored, dict) else None
    if form != FORMAT:
        older = isinstance(form, str) and form.startswith("echelon gain ")
        advice = f"is `{form}`; make it again with `echelon design`" if older else "is missing"
        raise GainError(
            f"`{path}` is no gain file that this echelon reads: its `format` must be `{FORMAT}`, "
            f"and {advice}."
        )
    return stored


def _mapping(pairs: list[tuple[str, Any]]) -> JsonObject:
    """Return a mapping; readers differ in which of two equal keys they take, so it rejects them."""
    mapping = dict(pairs)
    if len(mapping) < len(pairs):
        names = [key for key, _ in pairs]
        raise ValueError(f"it has the key `{next(k for k in names if names.count(k) > 1)}` twice")
    return mapping


def _gain(stored: JsonObject) -> Gain:
    # Names in the file become members of enumerations here, so that unknown ones are rejected.
    inner, certificate = stored["inner"], stored["certificate"]
    region = None if certificate["region"] is None else _region(certificate["region"])
    numbers = {
        name: _number(certificate, name) for name in ("lambda_min", "lambda_max", "abscissa")
    }
    counts = {name: _count(certificate, name) for name in ("modes", "observable")}
    edge = None if certificate["edge"] is None else _number(certificate, "edge")
    return Gain(
        np.array(stored["P"], float),
        np.array(stored["R"], float),
        _number(stored, "coupling"),
        str(stored["method"]),
        Certificate(
            kind=Kind.named(certificate["kind"]), edge=edge, region=region, **numbers, **counts
        ),
        inner=None if inner is None else np.array(inner, float),
    )


def _number(stored: JsonObject, name: str) -> float:
    value = stored[name]
    if (
        isinstance(value, bool)
        or not isinstance(value, int | float)
        or not np.isfinite(float(value))
    ):
        raise ValueError(f"`{name}` is {value!r}, and must be a finite number")
    return float(value)


def _count(stored: JsonObject, name: str) -> int:
    value = stored[name]
    if isinstance(value, bool) or not isinstance(value, int) or value < 0:
        raise ValueError(f"`{name}` is {value!r}, and must be a whole number")
    return value


def _region(stored: JsonObject) -> RegionCertificate:
    bounds = [
        [end if x is None else x for x in stored["domain"][name]] for name, end in _ENDS.items()
    ]
    return RegionCertificate(
        kind=Kind.named(stored["kind"]),
        rate=_number(stored, "rate"),
        theorem=Theorem.named(stored["theorem"]),
        domain=Domain(*(np.array(some, float) for some in bounds)),
        radius=None if stored["radius"] is None else _number(stored, "radius"),
        strength=_number(stored, "strength"),
        hull=_unpack(stored["hull"]),
        error=np.array(stored["error"], float),
    )


def _check_model(path: PathLike, stored: JsonObject, model: ControlAffine) -> None:
    linear = linearize(model)
    name, made_for = f"`{type(model).__name__}`", str(stored["class"]).rpartition(":")[2]
    for what, ours in (("state_names", model.state_names), ("input_names", model.input_names)):
        if tuple(stored[what]) != tuple(ours):
            raise GainError(
                f"the gain in `{path}` was made for `{made_for}` with {what} "
                f"{list(stored[what])}, and the model is {name} with {list(ours)}."
            )
    # Class and parameters may differ: near the trim only these numbers matter to a gain.
    compared = {
        "input_scale": (stored["input_scale"], model.input_scale),
        "the trim input": (stored["trim"][1], model.trim[1]),
        "A at the trim": (stored["A"], linear.A),
        "B at the trim": (stored["B"], linear.B),
    }
    for what, (theirs, ours) in compared.items():
        theirs, ours = np.asarray(theirs, float), np.asarray(ours, float)
        gap = float(np.abs(theirs - ours).max())
        # `not <=` instead of `>`: a gap that is not a number must not pass.
        if not gap <= _SAME * max(1e-12, float(np.abs(ours).max())):
            raise GainError(
                f"the gain in `{path}` was made for another {name}: {what} differs by {gap:.3g}; "
                "make it again for these parameters."
            )


def _check_graph(path: PathLike, stored: JsonObject, graph: Graph) -> None:
    values, spectrum = stored["spectrum"], graph.spectrum()
    sizes = [abs(complex(*x)) if isinstance(x, list) else float(x) for x in values]
    low = values[0][0] if isinstance(values[0], list) else float(values[0])
    # For switching graphs it is no eigenvalue.
    low = spectrum.low if spectrum.weakest is not None else low
    ends = {"lambda_min": (low, spectrum.low), "lambda_max": (max(sizes), spectrum.high)}
    # The extreme eigenvalues bound every mode, so a coupling fits all graphs that share them.
    for what, (theirs, ours) in ends.items():
        if not abs(theirs - ours) <= _SAME * ours:
            raise GainError(
                f"the gain in `{path}` was made for a graph of {stored['agents']} agents with "
                f"{what} = {theirs:.6g}, and this graph of {graph.agents} has {ours:.6g}; "
                "make it again."
            )
