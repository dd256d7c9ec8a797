"""Borders of flat coordinates: as a model states them, or none for a linear map."""

from collections.abc import Sequence
from fractions import Fraction
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from echelon.agents.models.chains import Chains, derivatives_of, to_flat
from echelon.agents.models.declarations import is_by_user
from echelon.agents.models.model import Airframe, ControlAffine, FlatBound
from echelon.agents.models.quadrotor import Quadrotor
from echelon.core.cache import memoize
from echelon.core.compiled import compiled_for_one_call
from echelon.core.digits import about
from echelon.core.numerics import precision
from echelon.core.types import Array, Input, State
from echelon.core.words import Kind
from echelon.simulation.scalars import Node, ScalarGraph, Unsupported, lower, needed, nodes

# ---- what somebody's class declares, compared with its equations ---------------------------------
# A guarantee that rests on such a declaration is one of samples: between them nobody looked.

_ENDS, _ALONG = 192, 24
"""Segments from one sample, and points of each."""
_SAME = 1e-6  # relative
_NEAR = 0.3  # of angles and normalized inputs of airframes


@memoize
def border_fault(model: ControlAffine, chains: Chains) -> str:
    """Return what a model's declared chains and borders get wrong at samples; empty for nothing.

    Along segments that begin near the trim, up to where they leave the borders, the inputs must
    reach no derivative below the declared ones, and these by a matrix that is never singular: one
    whose determinant has both signs is singular between.
    """
    name = f"`{type(model).__name__}`"
    with precision("float64"):
        x, e = _segments(model, chains)
        values, early, size = map(np.asarray, _on_segments(model, chains, x, e))
    within = np.logical_and.accumulate(_is_within(model, chains, x, values), axis=1)
    if not within.any():
        return f"no sample of the states of {name} is within its `flat_bounds`"
    if (early & within).any():
        return f"the inputs of {name} reach derivatives below those that its `flat_chains` state"
    if (within & ~(size * size[:, :1] > 0.0)).any():
        return f"`flat_bounds` of {name} leave out where its inputs lose their effect"
    return ""


def _segments(model: ControlAffine, chains: Chains) -> tuple[Array, Array]:
    """Return states (K, L, n) and integrators (K, L, k) on segments from near the trim to afar."""
    draw, n = np.random.default_rng(0), len(model.state_names)
    trim = np.concatenate([np.asarray(model.trim[0], float), np.zeros(chains.size)])
    near = draw.uniform(-0.5, 0.5, (_ENDS, len(trim)))
    # As where chains are searched for: a unicycle's speed is one, and is not 0.
    near[:, n:] = draw.uniform(0.2, 0.8, (_ENDS, chains.size))
    far = 10.0 ** draw.uniform(-1.0, 1.5, (_ENDS, 1)) * draw.uniform(-1.0, 1.0, (_ENDS, len(trim)))
    shares = np.linspace(0.0, 1.0, _ALONG)[:, None]
    points = trim + (1.0 - shares) * near[:, None] + shares * far[:, None]
    return points[..., :n], points[..., n:]


@compiled_for_one_call
def _on_segments(
    model: ControlAffine, chains: Chains, x: jax.Array, e: jax.Array
) -> tuple[jax.Array, Bool[jax.Array, "K L"], Float[jax.Array, "K L"]]:
    """Return flat coordinates (K, L, r, m), whether inputs act early, and det(beta)."""
    last, m = np.array(chains.degrees) - 1, np.arange(len(chains.degrees))
    below = np.arange(max(chains.degrees))[:, None] < last

    def one(x: State, e: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        values, _, betas = derivatives_of(model, chains, x, e, max(chains.degrees))
        largest = jnp.abs(betas[:, last, m]).max()
        early = jnp.abs(jnp.where(below, betas, 0.0)).max() > _SAME * largest
        return values, early, jnp.linalg.det(betas[:, last, m])

    return jax.vmap(jax.vmap(one))(x, e)


def _is_within(model: ControlAffine, chains: Chains, x: Array, values: Array) -> Bool[Array, "K L"]:
    within = np.asarray(np.isfinite(values).all(axis=(2, 3)))
    for bound in model.flat_bounds or ():
        entries = values[:, :, bound.derivative, [chains.outputs.index(n) for n in bound.outputs]]
        if len(bound.outputs) == 1:
            within &= entries[..., 0] > bound.above
            continue
        within &= np.linalg.norm(entries, axis=2) > bound.above
        # What turns about between two points may have been 0 there.
        within[:, 1:] &= (entries[:, 1:] * entries[:, :-1]).sum(axis=2) > 0.0
    for name, (low, high) in model.chart.items():
        here = x[..., model.state_names.index(name)]
        within &= (low < here) & (here < high)
    return within


@memoize
def airframe_fault(model: ControlAffine, chains: Chains, frame: Airframe) -> str:
    """Return how the motors of an airframe differ from those that equations and limits move.

    The motion of a model is inverted at samples of its flat coordinates, by its own equations and
    by those of a rigid body. Empty where each motor gives the same thrust.
    """
    limits, name = model.input_limits, f"`airframe` of `{type(model).__name__}`"
    if limits is None or np.shape(limits.matrix) != (4, 4):
        return f"{name} is of four motors, and `input_limits` are not of four rows"
    if {*limits.low} != {0.0} or {*limits.high} != {frame.motor_thrust}:
        most = about(frame.motor_thrust, 4)
        return f"{name} has motors of 0 to {most} N, `input_limits` have others"
    draw, n = np.random.default_rng(0), len(model.state_names)
    x = np.asarray(model.trim[0], float) + draw.uniform(-_NEAR, _NEAR, (_ENDS, n))
    e, tops = draw.uniform(-_NEAR, _NEAR, (_ENDS, chains.size)), draw.normal(size=(_ENDS, 4))
    with precision("float64"):
        own, paths = (np.asarray(part) for part in _inverted(model, chains, x, e, tops))
        body = Quadrotor(**frame._asdict())
        flown = np.asarray(_inputs_along(body, paths))
    mine = np.sort(own @ np.asarray(limits.matrix).T)
    theirs = np.sort(flown @ np.asarray(body.input_limits.matrix).T)
    off = float(np.abs(mine - theirs).max())
    if off <= _SAME * (frame.motor_thrust + np.abs(mine).max()):
        return ""
    return f"{name} is not of its motion: at a sample a motor's thrust is {about(off)} N off"


@compiled_for_one_call
def _inverted(
    model: ControlAffine, chains: Chains, x: jax.Array, e: jax.Array, tops: jax.Array
) -> tuple[Float[jax.Array, "K m"], Float[jax.Array, "K r m"]]:
    top = np.arange(max(chains.degrees) + 1)[:, None] == np.array(chains.degrees)

    def one(x: State, e: jax.Array, tops: jax.Array) -> tuple[Input, jax.Array]:
        flat = to_flat(model, chains, x, e)
        u = model.physical(chains.acting_input(e, flat.invert(tops)))
        return u, jnp.where(top, tops, jnp.pad(flat.values, ((0, 1), (0, 0))))

    return jax.vmap(one)(x, e, tops)


@compiled_for_one_call
def _inputs_along(body: Quadrotor, paths: jax.Array) -> jax.Array:
    return jax.vmap(lambda path: body.flat(path)[1])(paths)


# ---- borders -------------------------------------------------------------------------------------

_STATED = "flat_chains", "flat_bounds"
_PARTIAL = {"exponent", "mantissa", "root_guess"}
"""Operations that are not defined for all numbers; quotients and roots are not for some."""
_Form: TypeAlias = dict[int | None, Fraction]
"""A sum of multiples of nodes by their numbers, and of 1 under None."""


class KnownBounds(NamedTuple):
    """The borders of a model's flat coordinates, and how they are known.

    Attributes:
        kind: of the argument: samples where somebody's class states them.
    """

    bounds: Sequence[FlatBound] | None
    kind: Kind = Kind.PROOF
    fault: str = ""


def bounds_of(model: ControlAffine, chains: Chains) -> KnownBounds:
    """Return the borders of a model's flat coordinates.

    A model declares them with its chains; what a class that is not echelon's declares is compared
    with its equations at samples. There are none if the equations, traced, are defined everywhere
    and make flat coordinates an invertible linear map of all states and integrators, above which
    the inputs act by an invertible constant matrix.
    """
    by_user = {name for name in chains.declared if is_by_user(model, name)}
    mapped = Kind.SAMPLES if "to_flat" in by_user else Kind.PROOF
    if not {*_STATED} <= {*chains.declared}:
        fault = f"`{type(model).__name__}` does not state where its flat coordinates end"
        everywhere = _is_everywhere(model, chains)
        return KnownBounds((), mapped) if everywhere else KnownBounds(None, fault=fault)
    if by_user.isdisjoint(_STATED) or _is_everywhere(model, chains):
        return KnownBounds(model.flat_bounds, mapped)
    fault = border_fault(model, chains)
    return KnownBounds(None if fault else model.flat_bounds, Kind.SAMPLES, fault)


@memoize
def _is_everywhere(model: ControlAffine, chains: Chains) -> bool:
    try:
        coordinates, moved = _traced(model, chains)
    except Unsupported:
        return False
    constant = all(set(form) <= {None} for rows in moved for row in rows for form in row)
    if not constant:
        return False
    numbers = [[[form.get(None, Fraction(0)) for form in row] for row in rows] for rows in moved]
    last = [[rows[degree - 1][k] for k, degree in enumerate(chains.degrees)] for rows in numbers]
    early = any(
        rows[order][k]
        for rows in numbers
        for k, degree in enumerate(chains.degrees)
        for order in range(degree - 1)
    )
    return not early and _is_invertible(last) and _is_invertible(coordinates)


def _traced(
    model: ControlAffine, chains: Chains
) -> tuple[list[list[Fraction]], list[list[list[_Form]]]]:
    """Return slopes, 0 of what is no linear form, and what inputs add to them [input][order][k]."""
    graph, n = ScalarGraph(), len(model.state_names)
    leaves = [graph.leaf("row", place) for place in range(n + chains.size)]
    x, e = (np.array(part, object) for part in (leaves[:n], leaves[n:]))
    order, m = max(chains.degrees), len(chains.degrees)

    def both(x: jax.Array, e: jax.Array) -> tuple[jax.Array, ...]:
        return derivatives_of(model, chains, x, e, order)

    parts = [nodes(graph, part) for part in lower(both, graph, [x, e])]
    if any(_is_partial(node) for node in needed(sum(parts, start=[]))):
        raise Unsupported("a function that is not defined everywhere")
    values, _, moved = ([_form_of(node) for node in part] for part in parts)
    inside = [values[m * i + k] for k, degree in enumerate(chains.degrees) for i in range(degree)]
    places = [leaf.number for leaf in leaves]
    known = [set(form) <= {*places, None} for form in inside]
    rows = [
        [form.get(place, Fraction(0)) if linear else Fraction(0) for place in places]
        for form, linear in zip(inside, known, strict=True)
    ]
    shaped = np.array(moved, object).reshape(m, order, m).tolist()
    return rows, shaped


def _is_partial(node: Node) -> bool:
    if node.op == "sqrt":
        return not _sign(node.args[0])
    if node.op == "div":
        by = node.args[1]
        return _sign(by) != 1.0 and not (by.op == "constant" and by.value != 0.0)
    return node.op in _PARTIAL


def _sign(node: Node) -> float:
    """Return 1 of what is positive for all numbers, 0.5 of what is not negative, 0 of others."""
    if node.op == "constant":
        return float(node.value > 0.0) or 0.5 * (node.value == 0.0)
    if node.op == "mul" and node.args[0] is node.args[1]:
        return 0.5
    signs = [_sign(a) for a in node.args] if node.op in ("add", "mul", "sqrt") else [0.0]
    if not all(signs):
        return 0.0
    return max(signs) if node.op == "add" else min(signs)


def _form_of(node: Node) -> _Form:
    done = dict[int, _Form]()
    todo = [node]
    while todo:
        top = todo[-1]
        waiting = [a for a in top.args if a.number not in done]
        if waiting:
            todo += waiting
            continue
        done[todo.pop().number] = _one(top, [done[a.number] for a in top.args])
    return done[node.number]


def _one(node: Node, args: list[_Form]) -> _Form:
    if node.op == "constant" and np.isfinite(node.value):
        return _tidy({None: Fraction(node.value)})
    if node.op in ("add", "sub", "unfused_sub"):
        return _sum(args[0], args[1], Fraction(1 if node.op == "add" else -1))
    if node.op == "neg":
        return _sum({}, args[0], Fraction(-1))
    for k, other in ((0, 1), (1, 0)):
        if node.op == "mul" and set(args[k]) <= {None}:
            return _sum({}, args[other], args[k].get(None, Fraction(0)))
    if node.op == "div" and set(args[1]) == {None}:
        return _sum({}, args[0], 1 / args[1][None])
    return {node.number: Fraction(1)}


def _sum(a: _Form, b: _Form, factor: Fraction) -> _Form:
    return _tidy({k: a.get(k, Fraction(0)) + factor * b.get(k, Fraction(0)) for k in {*a, *b}})


def _tidy(form: _Form) -> _Form:
    return {k: c for k, c in form.items() if c}


def _is_invertible(rows: list[list[Fraction]]) -> bool:
    rows, n = [list(row) for row in rows], len(rows)
    if any(len(row) != n for row in rows):
        return False
    for k in range(n):
        pivot = next((i for i in range(k, n) if rows[i][k]), None)
        if pivot is None:
            return False
        rows[k], rows[pivot] = rows[pivot], rows[k]
        for i in range(k + 1, n):
            share = rows[i][k] / rows[k][k]
            rows[i] = [a - share * b for a, b in zip(rows[i], rows[k], strict=True)]
    return True
