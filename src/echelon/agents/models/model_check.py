"""The checks that a model passes once, when it enters `synthesize` or `simulate`."""

from typing import Any, NamedTuple

import jax
import numpy as np

from echelon.agents.models.heading_symmetry import check_heading
from echelon.agents.models.linearization import AtTrim, at_trim
from echelon.agents.models.model import ControlAffine, Limits
from echelon.core.compiled import cached_jit
from echelon.core.errors import ModelError, did_you_mean, listing
from echelon.core.memoize import memoize
from echelon.core.numerics import precision
from echelon.core.trace import check_function, error_summary

# Far above the rounding of T/m - g, far below what a trim typed with a few digits misses by.
_TRIM_TOLERANCE = 1e-9
_REACH = np.array([0.05, 0.05, 0.2, 0.2, 0.6, 0.6, 3.0, 3.0, 3.0, 100.0])
"""How far from the trim limits are tried, in widths of what they allow."""
_LITTLE = 1e-6
"""A change of the normalized input: where limits leave no room for it, nothing linear holds."""


class Shortfall(NamedTuple):
    """What the actuators deliver of an input, and what is asked of them."""

    delivered: float
    asked: float


def check_model(model: ControlAffine) -> tuple[str, ...]:
    """Check shapes, finite values and Jacobians at the trim, and that the trim is an equilibrium.

    Returns:
        Warnings, one sentence each, about what is allowed but probably not meant.

    Raises:
        ModelError: the first fault found, as one sentence.
    """
    return _warnings_of(model, _check_kind(model))


@memoize
def _warnings_of(model: ControlAffine, name: str) -> tuple[str, ...]:
    """Return the warnings of a model after all checks; once for a model."""
    with precision("float64"):
        _check_names(model, name)
        x, u = _check_constants(model, name)
        _check_functions(model, name, x, u)
        _check_trim(model, name, u)
        check_heading(model)
        _check_limit(model, name, u)
        return (*_low_precision(model, name), *_weak_actuators(model, name))


def _check_kind(model: ControlAffine) -> str:
    """Return the name of the model's class, after checking that it is one."""
    if isinstance(model, list | tuple | dict):
        raise ModelError(
            f"the model is a {type(model).__name__} of {len(model)}, and all agents share one "
            "model; agents that differ from it together are a `plant`."
        )
    if not isinstance(model, ControlAffine):
        raise ModelError(
            f"the model is {model!r}, and must be an instance of a `ControlAffine` class."
        )
    return type(model).__name__


def _check_words(model: ControlAffine, name: str) -> None:
    """Check that states and inputs have names, which are text."""
    for what, names in (("state_names", model.state_names), ("input_names", model.input_names)):
        # A text is a sequence too, of letters: ("x") without its comma would name one state by
        # luck.
        if isinstance(names, str):
            raise ModelError(
                f"`{what}` of `{name}` is the text `{names}`, and must be a tuple of names; "
                f'one name is written ("{names}",).'
            )
        if not isinstance(names, tuple | list) or not all(isinstance(n, str) for n in names):
            raise ModelError(f"`{what}` of `{name}` is {names!r}, and must be a tuple of names.")
    n, m = len(model.state_names), len(model.input_names)
    if not (n and m):
        raise ModelError(
            f"`{name}` has {n} state names and {m} input names, and needs at least one of each."
        )


def _check_names(model: ControlAffine, name: str) -> None:
    """Check the names, and that groups, position and units speak of states that exist."""
    _check_words(model, name)
    known = model.state_names
    if len(set(known)) < len(known):
        raise ModelError(f"`state_names` of `{name}` repeats a name: {listing(known)}.")
    named = {"position": model.position}
    named |= {f"state_groups[{key!r}]": members for key, members in model.state_groups.items()}
    for where, members in named.items():
        for member in members:
            if member not in known:
                raise ModelError(
                    f"`{where}` of `{name}` names `{member}`, which is no state; the states are "
                    f"{listing(known)}{did_you_mean(member, known)}."
                )
    for where, units, names in (
        ("state_units", model.state_units, known),
        ("input_units", model.input_units, model.input_names),
    ):
        if len(units) != len(names):
            raise ModelError(
                f"`{where}` of `{name}` has {len(units)} entries, and must have {len(names)}."
            )


def _check_constants(model: ControlAffine, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the trim as arrays, after checking all constant data."""
    n, m = len(model.state_names), len(model.input_names)
    x, u = _pair(name, "trim", model.trim, n, m)
    _pair(name, "weights", model.weights, n, m)
    scale = _numbers(name, "input_scale", model.input_scale, (m, m))
    # Near a condition of 1/eps = 4.5e15 no digit of the inverse is right.
    if np.linalg.cond(scale) > 1e15:
        raise ModelError(f"`input_scale` of `{name}` is singular, and must be invertible.")
    _check_limits(model, name, m)
    return x, u


def _check_limits(model: ControlAffine, name: str, m: int) -> None:
    """Check that the actuators' inequalities low <= G u <= high fit each other and the inputs."""
    limits = model.input_limits
    if limits is None:
        return
    if not isinstance(limits, Limits):
        raise ModelError(f"`input_limits` of `{name}` is {limits!r}, and must be a `Limits`.")
    k = len(limits.low)
    _numbers(name, "input_limits.matrix", limits.matrix, (k, m))
    low, high = (
        _numbers(name, f"input_limits.{end}", getattr(limits, end), (k,), np.inf)
        for end in ("low", "high")
    )
    if not (low < high).all():
        raise ModelError(f"`input_limits` of `{name}` must have each `low` below its `high`.")
    if type(model).limit is ControlAffine.limit:
        if k != m or not _has_inverse(np.asarray(limits.matrix, float)):
            raise ModelError(
                f"`input_limits` of `{name}` has {k} rows for {m} inputs, which do not say what is "
                "delivered of an input beyond them; add `limit`."
            )


def _has_inverse(G: np.ndarray) -> bool:
    """Tell whether floats can invert a matrix: of numbers too small they can tell a rank alone."""
    if np.linalg.matrix_rank(G) < len(G):
        return False
    try:
        return bool(np.isfinite(np.linalg.inv(G)).all())
    except np.linalg.LinAlgError:
        return False


def _check_limit(model: ControlAffine, name: str, u: np.ndarray) -> None:
    """Check that `limit` leaves what `input_limits` allow, and brings the rest in."""
    if model.input_limits is None:
        return
    G, low, high = (np.asarray(part, float) for part in model.input_limits)
    width = np.where(np.isfinite(high - low), high - low, 1.0 + np.abs(G @ u))
    away = np.random.default_rng(0).normal(size=(len(_REACH), len(u)))
    away *= (_REACH / np.abs(away @ G.T / width).max(axis=1))[:, None]
    for asked, delivered in zip(u + away, limited(model, u + away), strict=True):
        rows, brought = G @ asked, G @ delivered
        allowed = ((low <= rows) & (rows <= high)).all()
        # NaN is within nothing, and an input that is allowed must come back to the bit.
        within = np.abs(brought - np.clip(brought, low, high)) <= 1e-9 * width
        if not within.all() or allowed and (delivered != asked).any():
            raise ModelError(
                f"`limit` of `{name}` makes {np.round(delivered, 6).tolist()} of "
                f"{np.round(asked, 6).tolist()}, which `input_limits` "
                f"{'allow' if allowed else 'do not allow'}; let both say the same."
            )


def _pair(name: str, what: str, pair: Any, n: int, m: int) -> tuple[np.ndarray, np.ndarray]:
    """Return data given as (state, input), after checking both."""
    if not isinstance(pair, (tuple, list)) or len(pair) != 2:
        raise ModelError(f"`{what}` of `{name}` is {pair}, and must be a pair (state, input).")
    return (
        _numbers(name, f"{what}[0]", pair[0], (n,)),
        _numbers(name, f"{what}[1]", pair[1], (m,)),
    )


def _numbers(
    name: str, what: str, value: Any, shape: tuple[int, ...], most: float = np.finfo(float).max
) -> np.ndarray:
    """Return constant data as an array of the given shape, finite unless `most` is not."""
    try:
        array = np.asarray(value, float)
    except (TypeError, ValueError):
        raise ModelError(f"`{what}` of `{name}` is {value}, and must be numbers.") from None
    if len(shape) == 1:
        # The trim of a single state may be a plain number.
        array = np.atleast_1d(array)
    _check_shape(name, what, array.shape, shape)
    if not (np.abs(array) <= most).all():
        allowed = "finite" if np.isfinite(most) else "numbers"
        raise ModelError(f"`{what}` of `{name}` is {value}, and must be {allowed}.")
    return array


_ADVICE = "it must be written with `jax.numpy` and take one agent's state"


def _check_functions(model: ControlAffine, name: str, x: np.ndarray, u: np.ndarray) -> None:
    """Check what f, g, h and the limits return, and that f, g and h are finite at the trim."""
    n, m, q = len(x), len(u), len(model.output_names)
    functions = {"drift": model.drift, "input_map": model.input_map, "output": model.output}
    shapes = ((n,), (n, m), (q,), (m,))
    for (what, function), shape in zip(
        (functions | {"limit": model.limit}).items(), shapes, strict=True
    ):
        at = u if what == "limit" else x
        check_function(
            ModelError, f"`{what}` of `{name}`", function, at, shape=shape, advice=_ADVICE
        )
    there = _differentiate(model, name)
    slopes = (there.drift_slope, there.input_slope, there.output_slope)
    for what, value, slope in zip(functions, there[:3], slopes, strict=True):
        for which, array in ((f"`{what}`", value), (f"the Jacobian of `{what}`", slope)):
            if not np.isfinite(array).all():
                raise ModelError(f"{which} of `{name}` is not finite at the trim {x.tolist()}.")


def _differentiate(model: ControlAffine, name: str) -> AtTrim:
    """Return a model at its trim, after checking that JAX's derivatives are its slopes there."""
    try:
        there = at_trim(model)
    # The model is anyone's code, and JAX says in many ways that it cannot derive it.
    except Exception as error:
        raise ModelError(
            f"`{name}` has no derivative at its trim, by {error_summary(error)}; write it "
            "with `jax.numpy` alone."
        ) from error
    gap = there.gap
    if gap is not None:
        n, state = len(model.state_names), model.state_names[gap.variable]
        row, column = divmod(gap.entry - n, len(model.input_names))
        which = (
            f"`drift` for `{model.state_names[gap.entry % n]}`"
            if gap.entry < n
            else (f"`input_map` for `{model.state_names[row]}` and `{model.input_names[column]}`")
        )
        raise ModelError(
            f"JAX finds the derivative {gap.said:.4g} in `{state}` of {which} of `{name}` at the "
            f"trim, and its values show {gap.seen:.4g}; write it without `stop_gradient` and "
            "derivatives of its own."
        )
    return there


def _check_shape(name: str, what: str, got: tuple[int, ...], shape: tuple[int, ...]) -> None:
    if got != shape:
        raise ModelError(f"`{what}` of `{name}` has shape {got}, and must have shape {shape}.")


def _check_trim(model: ControlAffine, name: str, u: np.ndarray) -> None:
    """Check |f(x*) + g(x*) u*| <= 1e-9 in the model's units."""
    residual = at_trim(model).drift + at_trim(model).input_map @ u
    worst = int(np.argmax(np.abs(residual)))
    if abs(residual[worst]) > _TRIM_TOLERANCE:
        raise ModelError(
            f"the trim of `{name}` is no equilibrium: f(x*) + g(x*) u* is {residual[worst]:.3g} "
            f"in state `{model.state_names[worst]}`, and must be within {_TRIM_TOLERANCE:g} "
            "of zero; replace `trim`."
        )


def trim_shortfall(model: ControlAffine, wanted: np.ndarray | None = None) -> dict[str, Shortfall]:
    """Return which inputs of a trim the actuators cut, by name; `wanted` (m,) is another's trim."""
    asked, delivered = np.asarray(model.trim[1], float), at_trim(model).delivered
    if wanted is not None and (wanted != asked).any():
        with precision("float64"):
            asked, delivered = wanted, limited(model, wanted[None])[0]
    triples = zip(model.input_names, delivered.tolist(), asked.tolist(), strict=True)
    return {name: Shortfall(got, wanted) for name, got, wanted in triples if got != wanted}


def limited(model: ControlAffine, asked: np.ndarray) -> np.ndarray:
    """Return what the actuators deliver of each of some inputs (K, m)."""
    return np.asarray(_limited(model, asked))


@cached_jit
def _limited(model: ControlAffine, asked: jax.Array) -> jax.Array:
    return jax.vmap(model.limit)(asked)


def is_limited(model: ControlAffine) -> bool:
    """Tell whether the actuators of a model have limits, said in either way."""
    return model.input_limits is not None or type(model).limit is not ControlAffine.limit


def at_limits(model: ControlAffine, u: np.ndarray) -> tuple[str, ...]:
    """Return which normalized inputs cannot be changed by a little both ways about u (m,)."""
    moved = _LITTLE * np.asarray(model.input_scale, float).T
    asked = np.concatenate([u + moved, u - moved])
    with precision("float64"):
        got = limited(model, asked)
    changed = (got != asked).any(axis=1).reshape(2, -1).any(axis=0)
    return tuple(n for n, cut in zip(model.input_names, changed, strict=True) if cut)


def _weak_actuators(model: ControlAffine, name: str) -> tuple[str, ...]:
    """Warn of a trim that the actuators do not deliver."""
    # `limit` returns what fits unchanged, to the bit, so any difference is saturation.
    short = trim_shortfall(model).items()
    told = ", ".join(f"`{what}` {got:.4g} of {asked:.4g}" for what, (got, asked) in short)
    return (f"the actuators of `{name}` cannot hold its trim: they deliver {told}.",) * bool(short)


def _low_precision(model: ControlAffine, name: str) -> tuple[str, ...]:
    """Warn of parameters that a JAX array made without float64 has already rounded."""
    leaves = jax.tree_util.tree_leaves_with_path(model)
    # Made outside of an x64 context a JAX array is float32, whatever it was given.
    rounded = [
        jax.tree_util.keystr(path).lstrip(".")
        for path, leaf in leaves
        if getattr(leaf, "dtype", None) == np.float32
    ]
    if not rounded:
        return ()
    return (
        f"{listing(rounded)} of `{name}` is a float32 array, so its values carry only 7 digits; "
        "keep parameters as Python numbers or float64 NumPy arrays.",
    )
