"""Where a gain is seen to work: many starts in a slice of two states, run until they settle.

Nothing here is proved. It stands beside the certified set to show how far that falls short.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from echelon.core.errors import GainError, did_you_mean, listing
from echelon.core.numerics import precision, rk4
from echelon.core.types import Array, Input, State
from echelon.engine.parts import Parts
from echelon.engine.settings import Settings
from echelon.gains.gain import Gain
from echelon.laws.consensus import feedback
from echelon.models.linearization import linearize
from echelon.models.model import ControlAffine
from echelon.network.graph import Graph

SIDE = 41
_AGENTS = 6000  # followers of all starts together; a slice of larger graphs is coarser
_STEPS = 3000
_FARTHEST = 30.0  # in the states' units, and a half turn for angles


class Slice(NamedTuple):
    """Starts in which all followers deviate alike from their goals, in two states, and no other.

    Attributes:
        states: the indices of the two states.
        form: (2, 2), with sum_i delta_i'P delta_i = s'form s for the deviation s.
        reach: (2,) the largest deviations that are tried.
    """

    states: tuple[int, int]
    form: Array
    reach: Array

    def extents(self, radius: float) -> Array:
        """Return how far the ellipse s'form s = radius^2 reaches along both axes."""
        return radius * np.sqrt(np.diag(np.linalg.inv(self.form)))

    @property
    def largest(self) -> float:
        """The radius of the largest ellipse that is tried, where it lies within reach."""
        return float((self.reach / self.extents(1.0)).max())

    def ellipse(self, radius: float, points: int) -> Array:
        """Return points (points, 2) of the ellipse of a radius."""
        angles = 2.0 * np.pi * np.arange(points) / points
        round_ = np.column_stack([np.cos(angles), np.sin(angles)])
        return radius * np.linalg.solve(np.linalg.cholesky(self.form).T, round_.T).T


class Trial(NamedTuple):
    """The closed loop that the starts are run in: the leader rests at the trim.

    A start counts as converged when after `horizon` its errors, in the metric of P, have fallen to
    `fallen` of what they were: half as fast, in the logarithm, as the slowest mode falls.
    """

    model: ControlAffine
    gain: Gain
    laplacian: Array
    dt: float
    steps: int
    fallen: float
    limits: bool

    @property
    def horizon(self) -> float:
        """How long each start is run, s."""
        return self.steps * self.dt


def trial(model: ControlAffine, graph: Graph, gain: Gain, dt: float, limits: bool) -> Trial:
    """Return the closed loop of a stable gain, run for six times its slowest time constant."""
    slow = -gain.certificate.abscissa
    steps = int(np.clip(np.ceil(6.0 / (slow * dt)), 1, _STEPS))
    L = graph.grounded_laplacian().toarray()
    return Trial(model, gain, L, dt, steps, float(np.exp(-0.5 * slow * steps * dt)), limits)


def slice_of(model: ControlAffine, gain: Gain, followers: int, states: tuple[int, int]) -> Slice:
    """Return the slice through the goals in two states."""
    trim, reach = np.asarray(model.trim[0], float), []
    for k in states:
        angle = model.state_units[k] == "rad"
        low, high = model.chart.get(model.state_names[k], (-np.inf, np.inf))
        room = 0.98 * min(high - trim[k], trim[k] - low)
        reach.append(min(room, np.pi if angle else _FARTHEST))
    return Slice(states, followers * gain.P[np.ix_(states, states)], np.array(reach))


def side_of(followers: int) -> int:
    """Return how many starts a side of the grid has, an odd number."""
    return int(np.clip(np.sqrt(_AGENTS / followers), 11, SIDE)) // 2 * 2 + 1


def observed_radius(run: Trial, plane: Slice) -> float:
    """Return the largest radius up to which all starts tried in a slice converge; 0 for none.

    The starts lie within reach on ellipses s'form s = r^2, each a fixed factor larger than the one
    before, over three decades up to the largest that the slice allows.
    """
    side = side_of(len(run.laplacian))
    radii = np.geomspace(1e-3 * plane.largest, plane.largest, side)
    rings = np.stack([plane.ellipse(r, side) for r in radii])
    tried = np.all(np.abs(rings) <= plane.reach, axis=2)
    starts = np.where(tried[..., None], rings, 0.0).reshape(-1, 2)
    held = np.all(converged(run, plane, starts).reshape(side, side), axis=1)
    count = side if bool(held.all()) else int(np.argmin(held))
    return float(radii[count - 1]) if count else 0.0


def grid(plane: Slice, half: Array, side: int) -> tuple[Array, Array]:
    """Return the two axes of a grid of starts, each symmetric about the goal."""
    return np.linspace(-half[0], half[0], side), np.linspace(-half[1], half[1], side)


def converged(run: Trial, plane: Slice, starts: Array) -> Array:
    """Return for deviations (S, 2) in a slice whether the followers converge, (S,) of bool."""
    n = len(run.model.state_names)
    deviations = np.zeros((len(starts), n))
    deviations[:, plane.states] = starts
    lean: Any = eqx.tree_at(
        lambda gain: (gain.coupling, gain.certificate),
        run.gain,
        (np.asarray(run.gain.coupling), None),
    )
    with precision("float64"):
        ratio = _ratio(run.model, lean, run.laplacian, deviations, run.dt, run.steps, run.limits)
        # A start on the goal stays there, and what is not finite has not converged.
        return np.asarray(ratio <= run.fallen) | ~deviations.any(axis=1)


@eqx.filter_jit
def _ratio(
    model: ControlAffine,
    gain: Gain,
    laplacian: Array,
    deviations: Array,
    dt: float,
    steps: int,
    limits: bool,
) -> jax.Array:
    """Return the size of the errors at the end over that at the start, in the metric of P, (S,)."""
    trim = jnp.asarray(np.asarray(model.trim[0], float))
    L, P = jnp.asarray(laplacian), jnp.asarray(gain.P)

    def control(x: State, z: State) -> Input:
        v = gain.inner_loop(model, x) - feedback(gain, model, x, z)
        u = model.physical(v)
        return model.limit(u) if limits else u

    def step(_: jax.Array, x: jax.Array) -> jax.Array:
        z = jnp.einsum("fg,sgn->sfn", L, x - trim[None, None])
        u = jax.vmap(jax.vmap(control))(x, z)
        move = jax.vmap(jax.vmap(lambda x, u: rk4(model.velocity, x, u, dt)))
        return move(x, u)

    def size(x: jax.Array) -> jax.Array:
        y = x - trim[None, None]
        return jnp.sqrt(jnp.einsum("sfi,ij,sfj->s", y, P, y))

    start = trim[None, None] + jnp.repeat(jnp.asarray(deviations)[:, None], len(laplacian), axis=1)
    return size(jax.lax.fori_loop(0, steps, step, start)) / size(start)


class Radii(NamedTuple):
    """Both radii of sum_i delta_i'P delta_i, for a leader at rest at the trim, and the slice.

    `certified` is None where no set is; `observed` counts only starts of the slice, and `largest`
    is where the trying ended.
    """

    states: tuple[str, str]
    certified: float | None
    observed: float
    largest: float
    horizon: float

    def sentence(self) -> str:
        """Say both, side by side."""
        proved = "none, since no set is certified"
        if self.certified is not None:
            proved = "everywhere" if self.certified == np.inf else f"{self.certified:.3g}"
        seen = f"{self.observed:.3g}" if self.observed < self.largest else "all that was tried,"
        seen += "" if self.observed < self.largest else f" up to {self.largest:.3g}"
        return (
            f"Radius r of sum_i delta_i'P delta_i <= r^2, leader at rest: certified {proved}; "
            f"observed {seen}, for starts in `{self.states[0]}` and `{self.states[1]}` alone, "
            f"run for {self.horizon:.3g} s."
        )


def chosen_slice(model: ControlAffine, gain: Gain, asked: str | None) -> tuple[int, int]:
    """Return the two states of a slice: those asked for, as `y,roll`, or a telling pair.

    That is a velocity with the angle that drives it; where there is none, the first two coordinates
    of the position, or the first two states.

    Raises:
        GainError: those asked for are not two different states of the model.
    """
    names = model.state_names
    if asked is not None:
        parts = [part.strip() for part in asked.split(",")]
        for name in parts:
            if name not in names:
                raise GainError(
                    f"`--slice` names `{name}`, and the states are {listing(names)}"
                    f"{did_you_mean(name, names)}."
                )
        if len(set(parts)) != 2 or len(parts) != 2:
            raise GainError(f"`--slice` is `{asked}`, and must be two states such as `y,roll`.")
        return names.index(parts[0]), names.index(parts[1])
    if len(names) < 2:
        raise GainError(f"a slice needs two states, and `{type(model).__name__}` has one.")
    return _telling(model, gain)


def _telling(model: ControlAffine, gain: Gain) -> tuple[int, int]:
    """Return a pair of states in which the loop is seen to work."""
    groups = model.state_groups
    if "velocity" in groups and "attitude" in groups:
        moved, turned = model.states_called("velocity"), model.states_called("attitude")
        push = np.abs(linearize(model).A[np.ix_(moved, turned)])
        row, column = np.unravel_index(int(push.argmax()), push.shape)
        return moved[row], turned[column]
    places = model.position_indices()
    return (places[0], places[1]) if len(places) > 1 else (0, 1)


def prepare_trial(
    parts: Parts, settings: Settings, gain: Gain, states: tuple[int, int]
) -> tuple[Trial, Slice]:
    """Return the loop that starts of a slice are run in, and the slice."""
    run = trial(parts.model, parts.graph, gain, settings.dt, settings.limits)
    return run, slice_of(parts.model, gain, len(parts.graph.followers), states)
