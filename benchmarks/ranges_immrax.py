"""Compare slopes by `echelon_ranges` with those by immrax, on twenty functions of models.

It needs immrax 0.3.8, which asks for an older matplotlib than echelon, and so an environment of its
own: `python -m venv ENV`, `ENV/bin/pip install immrax lazy-loader pydantic`, and in the clone
`PYTHONPATH=src:packages/ranges/src ENV/bin/python benchmarks/ranges_immrax.py`.

Both bound the slopes of a function on the same box: echelon_ranges by `slope_hull`, immrax by the
natural inclusion function of the Jacobian that JAX finds. Width is the sum over all entries. The
volume of a hull is smaller than that of its entries, which immrax cannot say.
"""

import time
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from echelon.agents.models import (
    ControlAffine,
    CrazyflieAttitude,
    Pendulum,
    PlanarQuadrotor,
    PrintedQuadrotor,
    Quadrotor,
    QuadrotorEuler,
    QuadrotorThrust,
    Unicycle,
    UnicyclePoint,
    VanDerPol,
)
from echelon_ranges import Box, RangeError, slope_hull

try:
    import immrax
    from immrax.inclusion import nif
except ImportError as missing:
    raise SystemExit(f"immrax is missing.\n{__doc__.split(chr(10) * 2)[1]}") from missing

# JAX 0.10 traces `jnp.stack` as a primitive that immrax 0.3.8 does not know; it only moves entries.
if jax.lax.stack_p not in nif.inclusion_registry:
    nif._add_passthrough_to_registry(jax.lax.stack_p)

HALF = 0.3
_Field = Callable[[jax.Array, jax.Array], jax.Array]


class Entries(NamedTuple):
    """Bounds (k, n) of the slopes, seconds of the first call and of another."""

    low: np.ndarray
    high: np.ndarray
    first: float
    again: float


def velocity(model: ControlAffine) -> _Field:
    """Return (x, v) -> xdot."""
    return lambda x, v: model.normalized_drift(x) + model.normalized_input_map(x) @ v


def input_map(model: ControlAffine) -> _Field:
    """Return the entries of g(x)."""
    return lambda x, v: model.input_map(x).reshape(-1)


def closed(model: ControlAffine, law: Callable[[jax.Array], jax.Array]) -> _Field:
    """Return a closed loop."""
    return lambda x, v: model.drift(x) + model.input_map(x) @ law(x)


def hover(x: jax.Array) -> jax.Array:
    """Return saturated thrust and torque of a planar quadrotor."""
    return jnp.clip(jnp.stack([-x[1] - x[4], -4.0 * x[2] - x[5] + x[0]]), -0.2, 0.2)


def functions() -> dict[str, tuple[_Field, int, int]]:
    """Return the functions (x, v) with their numbers of states and inputs."""
    models = [
        *(Pendulum(), VanDerPol(), PlanarQuadrotor(), Unicycle(), UnicyclePoint()),
        *(Quadrotor.crazyflie(), QuadrotorEuler(), QuadrotorThrust(), CrazyflieAttitude()),
        PrintedQuadrotor(),
    ]
    sizes = [(len(m.state_names), len(m.input_names)) for m in models]
    found = {type(m).__name__: (velocity(m), *s) for m, s in zip(models, sizes, strict=True)}
    for model, size in zip(models, sizes, strict=True):
        if type(model) in (PlanarQuadrotor, UnicyclePoint, Quadrotor, QuadrotorThrust):
            found[f"g of {type(model).__name__}"] = (input_map(model), *size)
    pendulum, oscillator = Pendulum(), VanDerPol()
    loops = {
        "Pendulum, clip": closed(pendulum, lambda x: jnp.clip(-20.0 * x[:1] - x[1:], -1.0, 1.0)),
        "VanDerPol, tanh": closed(oscillator, lambda x: -jnp.tanh(3.0 * x[:1] + x[1:])),
        "VanDerPol, max": closed(oscillator, lambda x: jnp.maximum(-x[:1], -2.0 * x[:1])),
        "Pendulum, |w| w drag": closed(pendulum, lambda x: -jnp.abs(x[1:]) * x[1:]),
        "Pendulum, dead zone": closed(
            pendulum, lambda x: jnp.where(x[:1] > 0.1, 0.1 - x[:1], jnp.zeros(1))
        ),
    }
    found |= {name: (loop, 2, 1) for name, loop in loops.items()}
    found["PlanarQuadrotor, clip"] = (closed(PlanarQuadrotor(), hover), 6, 2)
    return found


def timed(compute: Callable[[], tuple[np.ndarray, np.ndarray]]) -> Entries:
    """Return what is computed, with the seconds of two calls."""
    begun = time.perf_counter()
    compute()
    middle = time.perf_counter()
    low, high = compute()
    return Entries(low, high, middle - begun, time.perf_counter() - middle)


def ours(function: _Field, n: int, m: int, at: np.ndarray | None = None) -> Entries:
    """Return the range of each entry by echelon_ranges, on the box or at a corner of it."""
    low, high = (at, at) if at is not None else (np.full(n + m, -HALF), np.full(n + m, HALF))

    def compute() -> tuple[np.ndarray, np.ndarray]:
        hull = slope_hull(function, Box(low[:n], high[:n]), Box(low[n:], high[n:]))
        return hull.vertices.min(axis=0) - hull.error, hull.vertices.max(axis=0) + hull.error

    return timed(compute)


def theirs(function: _Field, n: int, m: int) -> Entries:
    """Return the range of each entry by immrax."""
    inclusion = jax.jit(nif.natif(jax.jacfwd(function)))
    low, high = np.full(n + m, -HALF), np.full(n + m, HALF)
    x, v = immrax.interval(low[:n], high[:n]), immrax.interval(low[n:], high[n:])

    def compute() -> tuple[np.ndarray, np.ndarray]:
        found = inclusion(x, v)
        whole = isinstance(found, immrax.Interval)
        return tuple(np.asarray(a) for a in ((found.lower, found.upper) if whole else (found,) * 2))

    return timed(compute)


def sampled_width(function: _Field, n: int, m: int) -> float:
    """Return the width that Jacobians at random points, many of them corners, have at least."""
    z = np.clip(np.random.default_rng(0).uniform(-2.0, 2.0, (4000, n + m)), -1.0, 1.0) * HALF
    found = jax.vmap(jax.jacfwd(function))(jnp.asarray(z[:, :n]), jnp.asarray(z[:, n:]))
    return float(np.ptp(np.asarray(found), axis=0).sum())


def lost(function: _Field, n: int, m: int, bounds: Entries) -> int:
    """Count entries whose slope at one of twenty corners is outside of bounds, whatever rounds."""
    signs = np.random.default_rng(1).choice([-HALF, HALF], (20, n + m))
    exact = [ours(function, n, m, corner) for corner in signs]
    return int(np.any([(x.low > bounds.high) | (x.high < bounds.low) for x in exact], axis=0).sum())


def row(name: str, function: _Field, n: int, m: int) -> str:
    """Return a row of the table."""
    cells = [name]
    try:
        mine = ours(function, n, m)
        cells += [f"{sampled_width(function, n, m):.4g}", f"{(mine.high - mine.low).sum():.4g}"]
        cells.append(f"{mine.again * 1e3:.0f}")
    except RangeError as error:
        cells += [f"{sampled_width(function, n, m):.4g}", str(error)[:60], ""]
    try:
        other = theirs(function, n, m)
    except Exception as error:
        return " | ".join([*cells, str(error).splitlines()[0][:60], "", "", ""])
    cells += [f"{(other.high - other.low).sum():.4g}", f"{lost(function, n, m, other)}"]
    return " | ".join([*cells, f"{other.first * 1e3:.0f}", f"{other.again * 1e3:.2f}"])


def main() -> None:
    """Print the table."""
    jax.config.update("jax_enable_x64", True)
    print(f"immrax on JAX {jax.__version__}, box of +-{HALF} about 0")
    print("function | sampled | ranges | ms | immrax | entries lost | ms first | ms again")
    print("|".join(["---"] * 8))
    for name, (function, n, m) in functions().items():
        print(row(name, function, n, m), flush=True)


if __name__ == "__main__":
    main()
