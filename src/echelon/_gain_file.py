"""Gains as files: everything that the law needs to run, and what the gain was made for."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from echelon._certificates import Certificate
from echelon._errors import GainError, OutputError
from echelon._graph import Graph
from echelon._linearization import linearize
from echelon._numerics import precision
from echelon._types import PathLike
from echelon.gains.gain import Gain
from echelon.models.model import ControlAffine

FORMAT = "echelon gain 1"
_SAME = 1e-9
"""Relative difference beyond which two models or spectra are not the same."""


def gain_as_mapping(gain: Gain, model: ControlAffine, graph: Graph) -> dict[str, Any]:
    """Return a gain ready for JSON, with the model and the graph spectrum that it was made for."""
    with precision("float64"):
        linear = linearize(model)
    eigenvalues = graph.grounded_spectrum()
    return {
        "format": FORMAT,
        "method": gain.method,
        "coupling": gain.coupling,
        "P": gain.P.tolist(),
        "R": gain.R.tolist(),
        "inner": None if gain.inner is None else gain.inner.tolist(),
        "model": {
            "class": type(model).__name__,
            "state_names": list(model.state_names),
            "input_names": list(model.input_names),
            "trim": [list(part) for part in model.trim],
            "input_scale": [list(row) for row in model.input_scale],
            "A": linear.A.tolist(),
            "B": linear.B.tolist(),
        },
        "graph": {
            "agents": graph.agents,
            "leaders": list(graph.leaders),
            "lambda_min": float(eigenvalues[0]),
            "lambda_max": float(eigenvalues[-1]),
        },
        "certificate": {
            "kind": gain.certificate.kind,
            "abscissa": gain.certificate.abscissa,
            "modes": gain.certificate.modes,
            "edge": gain.certificate.edge,
            "observable": gain.certificate.observable,
        },
    }


def save_gain(gain: Gain, model: ControlAffine, graph: Graph, path: PathLike) -> None:
    """Write a gain as JSON.

    Raises:
        OutputError: the file cannot be written.
    """
    text = json.dumps(gain_as_mapping(gain, model, graph), indent=1, allow_nan=False)
    try:
        Path(path).write_text(text + "\n", "utf-8")
    except OSError as error:
        raise OutputError(f"`{path}` cannot be written: {error.strerror or error}.") from error


def load_gain(path: PathLike, model: ControlAffine, graph: Graph) -> Gain:
    """Return the gain of a file, for the model and the graph that it was made for.

    Raises:
        GainError: the file is no gain, holds a number that is not finite, or was made for another
            model or graph; the message says what differs.
    """
    told = _read(path)
    try:
        _check_model(path, told["model"], model)
        _check_graph(path, told["graph"], graph)
        return _gain(told)
    except (KeyError, TypeError, ValueError) as error:
        raise GainError(f"`{path}` is no gain that echelon wrote: {error}.") from error


def _read(path: PathLike) -> Mapping[str, Any]:
    try:
        told = json.loads(Path(path).read_text("utf-8"))
    except OSError as error:
        raise GainError(f"the gain file `{path}` cannot be read: {error.strerror}.") from error
    except ValueError as error:
        raise GainError(f"the gain file `{path}` is no JSON: {error}.") from error
    if not isinstance(told, dict) or told.get("format") != FORMAT:
        raise GainError(f"`{path}` is no gain file; its `format` must be `{FORMAT}`.")
    return told


def _gain(told: Mapping[str, Any]) -> Gain:
    inner = told["inner"]
    certificate = Certificate(
        lambda_min=told["graph"]["lambda_min"],
        lambda_max=told["graph"]["lambda_max"],
        **told["certificate"],
    )
    return Gain(
        np.array(told["P"], float),
        np.array(told["R"], float),
        float(told["coupling"]),
        str(told["method"]),
        certificate,
        inner=None if inner is None else np.array(inner, float),
    )


def _check_model(path: PathLike, told: Mapping[str, Any], model: ControlAffine) -> None:
    """Check that the model is the one that the gain was made for, near its trim."""
    with precision("float64"):
        linear = linearize(model)
    name = f"`{type(model).__name__}`"
    for what, ours in (("state_names", model.state_names), ("input_names", model.input_names)):
        if tuple(told[what]) != tuple(ours):
            raise GainError(
                f"the gain in `{path}` was made for `{told['class']}` with {what} "
                f"{list(told[what])}, and the model is {name} with {list(ours)}."
            )
    compared = {
        "input_scale": (told["input_scale"], model.input_scale),
        "the trim input": (told["trim"][1], model.trim[1]),
        "A at the trim": (told["A"], linear.A),
        "B at the trim": (told["B"], linear.B),
    }
    for what, (theirs, ours) in compared.items():
        theirs, ours = np.asarray(theirs, float), np.asarray(ours, float)
        gap = float(np.abs(theirs - ours).max())
        if not gap <= _SAME * max(1e-12, float(np.abs(ours).max())):
            raise GainError(
                f"the gain in `{path}` was made for another {name}: {what} differs by {gap:.3g}; "
                "make it again for these parameters."
            )


def _check_graph(path: PathLike, told: Mapping[str, Any], graph: Graph) -> None:
    """Check that the spectrum is the one that the coupling was chosen for."""
    eigenvalues = graph.grounded_spectrum()
    for what, ours in (("lambda_min", eigenvalues[0]), ("lambda_max", eigenvalues[-1])):
        if not abs(told[what] - ours) <= _SAME * ours:
            raise GainError(
                f"the gain in `{path}` was made for a graph of {told['agents']} agents with "
                f"{what} = {told[what]:.6g}, and this graph of {graph.agents} has {ours:.6g}; "
                "make it again."
            )
