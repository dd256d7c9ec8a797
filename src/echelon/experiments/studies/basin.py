"""Where a gain is seen to work: many starts in a slice of two states, run until they settle.

Nothing here is proved. It stands beside the certified set to show how far that falls short.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from echelon.agents.models.linearization import linearize
from echelon.agents.models.model import ControlAffine
from echelon.agents.network.formation import Formation
from echelon.core.errors import GainError, did_you_mean, listing
from echelon.core.numerics import precision
from echelon.core.types import Array
from echelon.guarantees.promises.promise import promise
from echelon.laws.trim_input import TrimInput
from echelon.simulation.engine.law_drive import Laws
from echelon.simulation.engine.parts import Parts
from echelon.simulation.engine.prepare import prepare
from echelon.simulation.step.loop import Loop, assemble
from echelon.simulation.step.sequence import final_states
from echelon.simulation.step.settings import Settings

# Odd, so that the middle of a grid is the goal; two starts lie 1/20 of its half-width apart.
SIDE = 41
_AGENTS = 6000  # followers of all starts together; a slice of larger graphs is coarser
# Slower loops are not run for longer: what a start must fall to grows with the time that it has.
_STEPS = 3000
_FARTHEST = 30.0  # in the states' units, and a half turn for angles


class StateSlice(NamedTuple):
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
        # The largest s_k on s'form s = r^2 is r sqrt((form^-1)_kk), by Lagrange's multipliers.
        return radius * np.sqrt(np.diag(np.linalg.inv(self.form)))

    @property
    def largest(self) -> float:
        """The radius of the largest ellipse that is tried, where it lies within reach."""
        return float((self.reach / self.extents(1.0)).max())

    def ellipse(self, radius: float, points: int) -> Array:
        """Return points (points, 2) of the ellipse of a radius."""
        # With form = L L', s = L'^-1 y takes the circle |y| = r to s'form s = r^2.
        angles = 2.0 * np.pi * np.arange(points) / points
        round_ = np.column_stack([np.cos(angles), np.sin(angles)])
        return radius * np.linalg.solve(np.linalg.cholesky(self.form).T, round_.T).T


class Trial(NamedTuple):
    """The closed loop that the starts are run in: the leader rests at the trim.

    A start counts as converged when after `horizon` its errors, in the metric of P, have fallen to
    `fallen` of what they were: half as fast, in the logarithm, as the slowest mode falls.
    """

    parts: Parts
    loop: Loop
    dt: float
    steps: int
    fallen: float

    @property
    def horizon(self) -> float:
        """How long each start is run, s."""
        return self.steps * self.dt

    @property
    def followers(self) -> int:
        """How many followers start off their goals."""
        return len(self.parts.graph.followers)


def trial(parts: Parts, settings: Settings) -> Trial:
    """Return the closed loop of a stable gain, run for six times its slowest time constant."""
    model, graph, dt = parts.model, parts.graph, settings.dt
    assert isinstance(parts.drive, Laws)
    rest = np.tile(np.asarray(model.trim[0], float), (graph.agents, 1))
    laws = Laws(TrimInput(), parts.drive.follower)
    # Offsets that are symmetries move errors as none do, and a leader that rests excites nobody:
    # what is left to see is the loop.
    alone = Parts(model, graph, Formation(np.zeros_like(rest)), laws, initial=rest)
    prepared = prepare(alone, settings)
    loop = assemble(prepared.problem, laws.leader, laws.follower)
    slow = -promise(parts, settings).loop.slowest
    # After six time constants the slowest mode is at e^-6 = 1/400, and e^-3 = 1/20 is asked for:
    # the transient before it may cost the rest.
    steps = int(np.clip(np.ceil(6.0 / (slow * dt)), 1, _STEPS))
    return Trial(prepared.parts, loop, dt, steps, float(np.exp(-0.5 * slow * steps * dt)))


def slice_of(parts: Parts, states: tuple[int, int]) -> StateSlice:
    """Return the slice through the goals in two states, in the metric of the gain."""
    model, gain, followers = parts.model, parts.drive.gain, len(parts.graph.followers)
    assert gain is not None
    trim, reach = np.asarray(model.trim[0], float), []
    for k in states:
        angle = model.state_units[k] == "rad"
        low, high = model.chart.get(model.state_names[k], (-np.inf, np.inf))
        # On the border of a chart f need not be finite, as at a pitch of 90 degrees.
        room = 0.98 * min(high - trim[k], trim[k] - low)
        reach.append(min(room, np.pi if angle else _FARTHEST))
    # All deviate alike, so the sum over followers is one's form times their number.
    return StateSlice(states, followers * gain.P[np.ix_(states, states)], np.array(reach))


def side_of(followers: int) -> int:
    """Return how many starts a side of the grid has, an odd number."""
    # All starts run as one batch: side^2 times the followers is what memory and time depend on.
    return int(np.clip(np.sqrt(_AGENTS / followers), 11, SIDE)) // 2 * 2 + 1


def observed_radius(run: Trial, plane: StateSlice) -> float:
    """Return the largest radius up to which all starts tried in a slice converge; 0 for none.

    The starts lie within reach on ellipses s'form s = r^2, each a fixed factor larger than the one
    before, over three decades up to the largest that the slice allows.
    """
    side = side_of(run.followers)
    radii = np.geomspace(1e-3 * plane.largest, plane.largest, side)
    rings = np.stack([plane.ellipse(r, side) for r in radii])
    tried = np.all(np.abs(rings) <= plane.reach, axis=2)
    # A start beyond reach becomes the goal, which converges: rings keep their shape, and what was
    # not tried counts against none.
    starts = np.where(tried[..., None], rings, 0.0).reshape(-1, 2)
    held = np.all(converged(run, plane, starts).reshape(side, side), axis=1)
    count = side if bool(held.all()) else int(np.argmin(held))
    return float(radii[count - 1]) if count else 0.0


def grid(plane: StateSlice, half: Array, side: int) -> tuple[Array, Array]:
    """Return the two axes of a grid of starts, each symmetric about the goal."""
    return np.linspace(-half[0], half[0], side), np.linspace(-half[1], half[1], side)


def converged(run: Trial, plane: StateSlice, starts: Array) -> Array:
    """Return for deviations (S, 2) in a slice whether the followers converge, (S,) of bool."""
    model, graph, gain = run.parts.model, run.parts.graph, run.parts.drive.gain
    assert gain is not None
    trim, shape = np.asarray(model.trim[0], float), (len(starts), graph.agents)
    deviations = np.zeros((*shape, len(trim)))
    # Two advanced indices and a slice between would put the slice last.
    for place, k in enumerate(plane.states):
        deviations[:, list(graph.followers), k] = starts[:, place, None]

    def size(y: Array) -> Array:
        return np.sqrt(np.einsum("sfi,ij,sfj->s", y, gain.P, y))

    with precision("float64"), np.errstate(invalid="ignore", over="ignore"):
        ends = np.asarray(final_states(run.loop, jnp.asarray(trim + deviations), run.steps))
        # A start on the goal stays there, and what is not finite has not converged.
        fallen = size(ends - trim) <= run.fallen * size(deviations)
        return fallen | ~starts.any(axis=1)


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


def chosen_slice(model: ControlAffine, asked: str | None) -> tuple[int, int]:
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
    return _telling(model)


def _telling(model: ControlAffine) -> tuple[int, int]:
    """Return a pair of states in which the loop is seen to work."""
    groups = model.state_groups
    if "velocity" in groups and "attitude" in groups:
        moved, turned = model.states_called("velocity"), model.states_called("attitude")
        # A tilt turns the thrust aside: the angle with the largest entry of A is the one that
        # drives a velocity.
        push = np.abs(linearize(model).A[np.ix_(moved, turned)])
        row, column = np.unravel_index(int(push.argmax()), push.shape)
        return moved[row], turned[column]
    places = model.position_indices()
    return (places[0], places[1]) if len(places) > 1 else (0, 1)
