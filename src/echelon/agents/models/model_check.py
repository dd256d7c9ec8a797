"""The checks of a model, run once for each model in `synthesize` and `simulate`."""

from collections.abc import Mapping
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from echelon.agents.models.heading_symmetry import check_heading
from echelon.agents.models.linearization import AtTrim, at_trim
from echelon.agents.models.model import ControlAffine, Limits
from echelon.agents.models.relative_equilibrium import check_trim
from echelon.core.cache import memoize
from echelon.core.compiled import cached_jit
from echelon.core.errors import ModelError, did_you_mean, is_number, listing
from echelon.core.gone import METHODS
from echelon.core.numerics import precision
from echelon.core.trace import checked_trace, error_summary
from echelon.core.types import Array
from echelon.core.words import amount

_DISTANCES = np.array([0.05, 0.05, 0.2, 0.2, 0.6, 0.6, 3.0, 3.0, 3.0, 100.0])
"""How far from the trim limits are tested, in widths of the range that they allow."""
_SMALL = 1e-6
"""A change of the normalized input; an input that cannot change by it has no linear response."""


class Shortfall(NamedTuple):
    """An input that the actuators do not deliver in full: the delivered and the requested value."""

    delivered: float
    requested: float


def check_model(model: ControlAffine) -> tuple[str, ...]:
    """Check shapes, finite values and Jacobians at the trim, and that it rests or moves steadily.

    A trim that moves does so along translations alone.

    Returns:
        Warnings, one sentence each, about what is allowed but probably a mistake.

    Raises:
        ModelError: the first fault found, as one sentence.
    """
    name = _check_kind(model)
    _check_derived(model, name)
    return _warnings_of(model, name)


@memoize
def _warnings_of(model: ControlAffine, name: str) -> tuple[str, ...]:
    with precision("float64"):
        _check_names(model, name)
        x, u = _check_constants(model, name)
        _check_functions(model, name, x, u)
        check_trim(model, name)
        check_heading(model)
        _check_limit(model, name, u)
        return (*_low_precision(model, name), *_weak_actuators(model, name))


def _check_kind(model: ControlAffine) -> str:
    if isinstance(model, list | tuple | dict):
        raise ModelError(
            f"the model is a {type(model).__name__} of {len(model)}, and must be one model, which "
            "all agents share; agents that all differ from it are described by a `plant`."
        )
    if not isinstance(model, ControlAffine):
        raise ModelError(
            f"the model is {model!r}, and must be an instance of a `ControlAffine` class."
        )
    for old, now in METHODS.items():
        if hasattr(model, old):
            raise ModelError(f"`{old}` of `{type(model).__name__}` is now `{now}`; rename it.")
    return type(model).__name__


_DERIVED = ("velocity", "normalized_drift", "normalized_input_map", "physical", "normalized")


def _check_derived(model: ControlAffine, name: str) -> None:
    """Check that what follows from the equations is not replaced: runs and proofs read both."""
    for what in _DERIVED:
        if what in vars(model) or getattr(type(model), what) is not getattr(ControlAffine, what):
            raise ModelError(
                f"`{name}` replaces `{what}`, which follows from `drift`, `input_map`, `trim` and "
                "`input_scale`; change those."
            )


_KINDS = (
    ("state_units", (tuple, list), "a tuple of units"),
    ("input_units", (tuple, list), "a tuple of units"),
    ("position", (tuple, list), "a tuple of states' names"),
    ("state_groups", Mapping, "a mapping of names to tuples of states' names"),
    ("chart", Mapping, "a mapping of states' names to bounds"),
    ("difference", None, "a method"),
)
"""What models declare, whose names a parameter may have by accident."""


def _check_words(model: ControlAffine, name: str) -> None:
    for what, names in (("state_names", model.state_names), ("input_names", model.input_names)):
        # A text is a sequence of letters, so ("x") without its comma would be accepted by accident.
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
    _check_words(model, name)
    for what, kind, text in _KINDS:
        value = getattr(model, what)
        if not (isinstance(value, kind) if kind else callable(value)):
            raise ModelError(
                f"`{what}` of `{name}` is {value!r}, and must be {text}; a parameter needs another "
                "name."
            )
    states = model.state_names
    if len(set(states)) < len(states):
        raise ModelError(f"`state_names` of `{name}` repeats a name: {listing(states)}.")
    groups = {"position": model.position}
    groups |= {f"state_groups[{key!r}]": members for key, members in model.state_groups.items()}
    for where, members in groups.items():
        for member in members:
            if member not in states:
                raise ModelError(
                    f"`{where}` of `{name}` names `{member}`, which is no state; the states are "
                    f"{listing(states)}{did_you_mean(member, states)}."
                )
    pairs = ("state_units", states), ("input_units", model.input_names)
    for where, names in pairs:
        units = getattr(model, where)
        if len(units) != len(names):
            raise ModelError(
                f"`{where}` of `{name}` has {len(units)} entries, and must have {len(names)}."
            )


_CONSTANTS = "trim", "weights", "input_scale", "symmetry_inputs", "radius", "input_limits"


def _check_constants(model: ControlAffine, name: str) -> tuple[np.ndarray, np.ndarray]:
    n, m = len(model.state_names), len(model.input_names)
    for what in _CONSTANTS:
        # A property may be anyone's code, of parameters that may be of any kind.
        try:
            getattr(model, what)
        except Exception as error:
            raise ModelError(f"`{what}` of `{name}` fails with {error_summary(error)}.") from error
    x, u = _pair(name, "trim", model.trim, n, m)
    _pair(name, "weights", model.weights, n, m)
    scale = _numbers(name, "input_scale", model.input_scale, (m, m))
    if model.symmetry_inputs is not None:
        _numbers(name, "symmetry_inputs", model.symmetry_inputs, (m,))
    # At a condition number near 1/eps = 4.5e15 no digit of the inverse is right.
    if np.linalg.cond(scale) > 1e15:
        raise ModelError(f"`input_scale` of `{name}` is singular, and must be invertible.")
    _check_radius(model, name)
    _check_limits(model, name, m)
    return x, u


def _check_radius(model: ControlAffine, name: str) -> None:
    """Check the size of an agent that has a position; of others the name means something else."""
    radius = model.radius
    if radius is None or not model.position:
        return
    if not is_number(radius) or not 0 < radius < np.inf:
        raise ModelError(
            f"`radius` of `{name}` is {radius!r}, and must be None or a positive finite number of "
            "metres."
        )


def _check_limits(model: ControlAffine, name: str, m: int) -> None:
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
                f"`input_limits` of `{name}` has {amount(k, 'row')} for {amount(m, 'input')}, "
                "which does not define the input that is delivered beyond the limits; add the "
                "method `limit`."
            )


def _has_inverse(G: np.ndarray) -> bool:
    """Tell whether a matrix has a finite inverse in floats; full rank does not imply it."""
    if np.linalg.matrix_rank(G) < len(G):
        return False
    try:
        return bool(np.isfinite(np.linalg.inv(G)).all())
    except np.linalg.LinAlgError:
        return False


def _check_limit(model: ControlAffine, name: str, u: np.ndarray) -> None:
    """Check that `limit` keeps inputs within `input_limits` unchanged and clips all others."""
    if model.input_limits is None:
        return
    G, low, high = (np.asarray(part, float) for part in model.input_limits)
    width = np.where(np.isfinite(high - low), high - low, 1.0 + np.abs(G @ u))
    away = np.random.default_rng(0).normal(size=(len(_DISTANCES), len(u)))
    away *= (_DISTANCES / np.abs(away @ G.T / width).max(axis=1))[:, None]
    for requested, delivered in zip(u + away, limited(model, u + away), strict=True):
        rows, clipped = G @ requested, G @ delivered
        allowed = ((low <= rows) & (rows <= high)).all()
        # NaN is within no limits, and an allowed input must come back to the bit.
        within = np.abs(clipped - np.clip(clipped, low, high)) <= 1e-9 * width
        if not within.all() or allowed and (delivered != requested).any():
            raise ModelError(
                f"`limit` of `{name}` returns {np.round(delivered, 6).tolist()} for "
                f"{np.round(requested, 6).tolist()}, which `input_limits` "
                f"{'allow' if allowed else 'do not allow'}; make `limit` and `input_limits` agree."
            )


def _pair(name: str, what: str, pair: object, n: int, m: int) -> tuple[np.ndarray, np.ndarray]:
    if not isinstance(pair, (tuple, list)) or len(pair) != 2:
        raise ModelError(f"`{what}` of `{name}` is {pair}, and must be a pair (state, input).")
    return (
        _numbers(name, f"{what}[0]", pair[0], (n,)),
        _numbers(name, f"{what}[1]", pair[1], (m,)),
    )


def _numbers(
    name: str, what: str, value: object, shape: tuple[int, ...], most: float = np.finfo(float).max
) -> np.ndarray:
    try:
        array = np.asarray(value, float)  # pyright: ignore
    except (TypeError, ValueError):
        raise ModelError(f"`{what}` of `{name}` is {value}, and must be numbers.") from None
    if len(shape) == 1:
        # The trim of a single state may be a plain number.
        array = np.atleast_1d(array)
    if array.shape != shape:
        raise ModelError(
            f"`{what}` of `{name}` has shape {array.shape}, and must have shape {shape}."
        )
    if not (np.abs(array) <= most).all():
        allowed = "finite" if np.isfinite(most) else "numbers"
        raise ModelError(f"`{what}` of `{name}` is {value}, and must be {allowed}.")
    return array


def _check_functions(model: ControlAffine, name: str, x: np.ndarray, u: np.ndarray) -> None:
    n, m, q = len(x), len(u), len(model.output_names)
    advice = "it must be written with `jax.numpy` and take one agent's state"
    shapes = {"drift": (n,), "input_map": (n, m), "output": (q,), "limit": (m,)}
    for what, shape in shapes.items():
        at, function = (u if what == "limit" else x), getattr(model, what)
        checked_trace(ModelError, f"`{what}` of `{name}`", function, at, advice=advice, shape=shape)
    trim = _differentiate(model, name)
    for what, value, slope in zip(shapes, trim[:3], trim[3:6], strict=False):
        for which, array in ((f"`{what}`", value), (f"the Jacobian of `{what}`", slope)):
            if not np.isfinite(array).all():
                raise ModelError(f"{which} of `{name}` is not finite at the trim {x.tolist()}.")


def _differentiate(model: ControlAffine, name: str) -> AtTrim:
    """Return a model at its trim, after checking JAX's derivatives against slopes of its values."""
    try:
        trim = at_trim(model)
    # The model is the user's code, and JAX raises errors of many types where it has no derivative.
    except Exception as error:
        raise ModelError(
            f"`{name}` has no derivative at its trim ({error_summary(error)}); write the model "
            "with `jax.numpy` only."
        ) from error
    gap = trim.gap
    if gap is not None:
        n, state = len(model.state_names), model.state_names[gap.variable]
        row, column = divmod(gap.entry - n, len(model.input_names))
        which = (
            f"`drift` for `{model.state_names[gap.entry % n]}`"
            if gap.entry < n
            else (f"`input_map` for `{model.state_names[row]}` and `{model.input_names[column]}`")
        )
        raise ModelError(
            f"the derivative of {which} of `{name}` in `{state}` at the trim is "
            f"{gap.derivative:.4g} by JAX and {gap.slope:.4g} by its values; write the model "
            "without `stop_gradient` and without derivatives of its own."
        )
    return trim


def trim_shortfall(
    model: ControlAffine, trim_input: Float[Array, " m"] | None = None
) -> dict[str, Shortfall]:
    """Return the inputs of the trim, or of another model's `trim_input`, that the actuators cut."""
    requested, delivered = np.asarray(model.trim[1], float), at_trim(model).delivered
    if trim_input is not None and (trim_input != requested).any():
        with precision("float64"):
            requested, delivered = trim_input, limited(model, trim_input[None])[0]
    pairs = map(Shortfall, delivered.tolist(), requested.tolist())
    named = zip(model.input_names, pairs, strict=True)
    return {name: pair for name, pair in named if pair.delivered != pair.requested}


def limited(model: ControlAffine, requested: Float[Array, "K m"]) -> Float[Array, "K m"]:
    """Return the inputs that the actuators deliver for requested ones."""
    return np.asarray(_limited(model, requested))


@cached_jit
def _limited(model: ControlAffine, requested: jax.Array) -> jax.Array:
    return jax.vmap(model.limit)(requested)


def is_limited(model: ControlAffine) -> bool:
    """Tell whether a model has `input_limits` or replaces `limit`."""
    return model.input_limits is not None or type(model).limit is not ControlAffine.limit


def at_limits(model: ControlAffine, u: Float[Array, " m"]) -> tuple[str, ...]:
    """Return the normalized inputs that cannot change slightly in both directions about u."""
    changes = _SMALL * np.asarray(model.input_scale, float).T
    requested = np.concatenate([u + changes, u - changes])
    with precision("float64"):
        delivered = limited(model, requested)
    changed = (delivered != requested).any(axis=1).reshape(2, -1).any(axis=0)
    return tuple(n for n, cut in zip(model.input_names, changed, strict=True) if cut)


def _weak_actuators(model: ControlAffine, name: str) -> tuple[str, ...]:
    # `limit` returns what fits unchanged, to the bit, so any difference is saturation.
    cut = trim_shortfall(model).items()
    parts = ", ".join(f"`{what}` {part:.4g} of {full:.4g}" for what, (part, full) in cut)
    return (f"the actuators of `{name}` cannot hold its trim: they deliver {parts}.",) * bool(cut)


def _low_precision(model: ControlAffine, name: str) -> tuple[str, ...]:
    """Warn of parameters that a JAX array made without float64 has already rounded."""
    leaves = jax.tree_util.tree_leaves_with_path(model)
    # A JAX array created outside of an x64 context is float32, whatever its argument.
    rounded = [
        jax.tree_util.keystr(path).lstrip(".")
        for path, leaf in leaves
        if getattr(leaf, "dtype", None) == np.float32
    ]
    if not rounded:
        return ()
    return (
        f"{listing(rounded)} of `{name}` is a float32 array, so its values have only 7 digits; "
        "keep parameters as Python numbers or float64 NumPy arrays.",
    )
