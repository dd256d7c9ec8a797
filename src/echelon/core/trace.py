"""Checks of user functions by a JAX trace: shapes, types, casts and frozen values.

Tracing somebody's model takes much of the time before a run, so one public call does it once.
"""

import contextlib
import hashlib
import inspect
from collections.abc import Callable, Hashable, Iterable, Iterator
from contextvars import ContextVar
from pathlib import Path
from typing import Any, TypeVar

import jax
import numpy as np
from jax.core import Tracer
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal

from echelon.core.errors import EchelonError
from echelon.core.identity import array_bits, process_key
from echelon.core.numerics import inlined
from echelon.core.types import PyTree

_R = TypeVar("_R")
_TRACES = ContextVar[dict[Hashable, Callable[..., Any]] | None]("traces", default=None)


@contextlib.contextmanager
def shared_traces() -> Iterator[None]:
    """Share traces by `call_once_traced` within this context: a public call, or one inside it."""
    # Not from one call to the next, as arrays that somebody's code reads may be changed in place.
    before = _TRACES.get()
    token = _TRACES.set({} if before is None else before)
    try:
        yield
    finally:
        _TRACES.reset(token)


def call_once_traced(function: Callable[..., _R], *arguments: PyTree) -> _R:
    """Return what a function returns; inside other traces it is traced once for equal shapes."""
    traces = _TRACES.get()
    if traces is None or not any(isinstance(leaf, Tracer) for leaf in arguments):
        return function(*arguments)
    # By what its code reads, too; a model with numbers that are traced has no key.
    key = process_key(function)
    if key is None:
        return function(*arguments)
    if key not in traces:
        traces[key] = inlined(function)
    return traces[key](*arguments)


def trace_digest(function: Callable[..., PyTree], *arguments: PyTree) -> bytes:
    """Return a digest of what a function computes at arguments of these shapes.

    It is of the equations and the bits of all constants, so that it changes with whatever the
    function reads, a number of its module too.

    Raises:
        Exception: whatever the function raises.
    """
    jaxpr = jax.make_jaxpr(lambda *a: function(*a))(*arguments)
    numbers = (number for _, numbers, _ in _steps(jaxpr) for number in numbers)
    parts = [str(jaxpr).encode(), *numbers]
    return hashlib.sha256(b"".join(b"%d:" % len(part) + part for part in parts)).digest()


def _steps(jaxpr: Jaxpr | ClosedJaxpr) -> Iterator[tuple[str, list[bytes], bool]]:
    """Yield all equations, inner ones too: name, the numbers in it, and whether it rounds."""
    yield "constants", [array_bits(value) for value in getattr(jaxpr, "consts", ())], False
    for equation in getattr(jaxpr, "jaxpr", jaxpr).eqns:
        name = equation.primitive.name
        numbers = [array_bits(v.val) for v in equation.invars if isinstance(v, Literal)]
        yield name, numbers, name == "convert_element_type" and _shortens(equation)
        for inner in _inner(equation.params.values()):
            yield from _steps(inner)


def _inner(values: Iterable[object]) -> Iterator[Any]:
    for value in values:
        if hasattr(value, "eqns") or hasattr(value, "jaxpr"):
            yield value
        elif isinstance(value, tuple | list):
            yield from _inner(value)


def _shortens(equation: Any) -> bool:
    [before], [after] = equation.invars, equation.outvars
    kinds = [np.dtype(v.aval.dtype) for v in (before, after)]
    return (
        kinds[0] == np.float64
        and jax.numpy.issubdtype(kinds[1], jax.numpy.floating)
        and (kinds[1].itemsize < kinds[0].itemsize)
    )


def check_array(
    fault: Callable[[str], Exception], what: str, value: Any, shape: tuple[int, ...]
) -> None:
    """Raise `fault` unless a trace returns one array of a shape, of float64 or whole numbers."""
    if not hasattr(value, "shape"):
        raise fault(
            f"{what} has the type `{type(value).__name__}`, and must be one array, such as "
            "`jnp.stack([...])` makes."
        )
    if value.shape != shape:
        raise fault(f"{what} has shape {value.shape}, and must have shape {shape}.")
    # Whole numbers are exact, and JAX multiplies them with any other.
    if value.dtype != np.float64 and not np.issubdtype(value.dtype, np.integer):
        raise fault(
            f"{what} has the type {value.dtype}, and must have that of its argument, float64; "
            "write `jnp.asarray(..., x.dtype)`."
        )


def checked_trace(
    fault: Callable[[str], Exception],
    what: str,
    function: Callable[..., PyTree],
    *arguments: PyTree,
    advice: str,
    shape: tuple[int, ...] | None = None,
) -> PyTree:
    """Trace somebody's function twice, which must neither fail nor round nor change.

    Nothing is compiled or computed.

    Args:
        fault: makes an error of a sentence.
        what: the function, as the sentence begins.
        function: somebody's own code.
        arguments: what it is traced at.
        advice: what it must be, for a function that raises.
        shape: of the one array that it must return; None for another result.

    Returns:
        What it returns, each array as its shape and type.

    Raises:
        Exception: the one that `fault` makes, for the first fault found.
    """
    try:
        first, result = jax.make_jaxpr(
            lambda *a: call_once_traced(function, *a), return_shape=True
        )(*arguments)
        # Under a name of its own, since JAX would hand out the first trace of one function again.
        second = jax.make_jaxpr(lambda *a: function(*a))(*arguments)
    # A sentence of our own, which says more than its place would.
    except EchelonError:
        raise
    # It is anyone's code: whatever it raises is its own fault, and stays attached as the cause.
    except Exception as error:
        raise fault(f"{what} fails with {error_summary(error)}; {advice}.") from error
    steps = list(_steps(first))
    if any(rounds for _, _, rounds in steps):
        raise fault(
            f"{what} casts float64 numbers to fewer digits, and must keep the type of its "
            "argument, `x.dtype`."
        )
    if [step[:2] for step in steps] != [step[:2] for step in _steps(second)]:
        raise fault(
            f"{what} differs from one call to the next, as a clock or a random number makes it, "
            "and must be a function of its arguments alone."
        )
    if shape is not None:
        check_array(fault, what, result, shape)
    return result


def error_summary(error: BaseException) -> str:
    """Return the class and the first line of somebody else's error, without a full stop."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return f"{type(error).__name__}: {lines[0].rstrip('.:') if lines else 'no message'}"


def form_of(tree: PyTree) -> tuple[object, ...]:
    """Return the structure of a tree, and the shapes and types of its arrays."""
    leaves, structure = jax.tree.flatten(tree)
    return structure, [(leaf.shape, leaf.dtype) for leaf in leaves]


def form_in_words(tree: PyTree) -> str:
    """Return the types and shapes of a tree, such as `float64 (3,), float64 ()`."""
    leaves = jax.tree.leaves(tree)
    return ", ".join(f"{leaf.dtype} {leaf.shape}" for leaf in leaves) or "nothing"


def place_of(code: Any) -> str:
    """Return the file and the line where a class or a function begins."""
    try:
        line = inspect.getsourcelines(code)[1]
        return f"{Path(inspect.getsourcefile(code) or '').name}:{line}"
    except (OSError, TypeError):  # its source is not there, as in a session of Python
        return str(getattr(code, "__module__", type(code).__module__))
