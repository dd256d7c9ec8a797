"""A family of the zoo: numbers of the user's that change within one process."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from held_loops import radii
from zoo_linear import Family, Finding, against, consensus_parts, feedback, silent

import echelon as ech

SLOPE = -1.0
MATRIX = np.array([[-1.0, 1.0], [0.0, -1.0]])
TABLE = {"damping": [0.5]}


def _pull(strength: list[float] = [1.0]) -> float:  # noqa: B006
    return strength[0]


def _reader(closed: list[float]) -> type[ech.ControlAffine]:
    class Reader(ech.ControlAffine):
        state_names, input_names = ("a", "b"), ("u",)
        share = 1.0

        def drift(self, x: jax.Array) -> jax.Array:
            own = SLOPE * self.share + closed[0] - TABLE["damping"][0] - _pull()
            return jnp.asarray(MATRIX) @ x + own * x

        def input_map(self, x: jax.Array) -> jax.Array:
            return jnp.array([[0.0], [1.0]], x.dtype)

    return Reader


def _slope_now(reader: Any, closed: list[float]) -> np.ndarray:
    own = SLOPE * reader.share + closed[0] - TABLE["damping"][0] - _pull()
    return MATRIX + own * np.eye(2)


_CHANGES: dict[str, Callable[[Any, list[float], np.random.Generator], None]] = {
    "a number": lambda reader, closed, rng: globals().update(SLOPE=float(rng.normal())),
    "an entry": lambda reader, closed, rng: MATRIX.__setitem__((1, 1), 2.0 * rng.normal()),
    "an array": lambda reader, closed, rng: globals().update(MATRIX=rng.normal(size=(2, 2))),
    "a table": lambda reader, closed, rng: TABLE.update(damping=[float(rng.normal())]),
    "a closure": lambda reader, closed, rng: closed.__setitem__(0, float(rng.normal())),
    "a class": lambda reader, closed, rng: setattr(reader, "share", float(2.0 * rng.normal())),
    "a default": lambda reader, closed, rng: _pull.__defaults__[0].__setitem__(0, rng.normal()),  # type: ignore
}


def changed_numbers(rng: np.random.Generator) -> Finding:
    """Globals, arrays, tables, closures, classes and defaults that change between two answers."""
    state = SLOPE, MATRIX.copy(), TABLE["damping"], _pull.__defaults__[0][0]  # type: ignore
    try:
        return _before_and_after(rng)
    finally:
        globals().update(SLOPE=state[0], MATRIX=state[1])
        TABLE["damping"], _pull.__defaults__[0][0] = state[2:]  # type: ignore


def _before_and_after(rng: np.random.Generator) -> Finding:
    globals()["MATRIX"] = rng.normal(size=(2, 2)) - 1.5 * np.eye(2)
    closed, B, graph = [float(rng.normal())], np.array([[0.0], [1.0]]), ech.Graph.path(4)
    reader, settings = _reader(closed), ech.Settings(0.01, 1e-4)
    line = np.diag([2.0, 2.0, 1.0]) - np.eye(3, k=1) - np.eye(3, k=-1)
    lam = np.linalg.eigvalsh(line)
    again, proof = bool(rng.integers(2)), bool(rng.random() < 0.3)

    def ask() -> ech.Parts:
        method = ech.gains.Contraction({}, rate=0.1) if proof else ech.gains.Riccati()
        model = reader()
        return consensus_parts(model, graph, ech.synthesize(model, graph, method))

    try:
        parts = ask()
        ech.guarantee(parts, settings)
        list(_CHANGES.values())[rng.integers(len(_CHANGES))](reader, closed, rng)
        parts = ask() if again else parts
        answer = ech.guarantee(parts, settings)
    except ech.EchelonError as error:
        return silent(str(error))
    assert isinstance(parts.drive, ech.Laws) and parts.drive.gain is not None
    A, K = _slope_now(reader, closed), feedback(parts.drive.gain, B)
    slowest = np.log(radii(A, B, K, lam, settings.dt).max()) / settings.dt
    return against(answer, float(slowest))


CHANGED: dict[str, Family] = {"changed numbers": changed_numbers}
