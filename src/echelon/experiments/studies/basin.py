"""Observed region of attraction: many starts in a slice of two states, simulated until they settle.

It is not a proof; compared with the certified set, it shows how conservative that set is.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from echelon.agents.models.linearization import linearize
from echelon.agents.models.model import ControlAffine
from echelon.agents.network.formation import Formation
from echelon.core.digits import about, at_most
from echelon.core.errors import GainError, check_name
from echelon.core.numerics import precision
from echelon.core.types import Array
from echelon.guarantees.promises.promise import guarantee
from echelon.laws.law import TrimInput
from echelon.simulation.engine.law_drive import Laws
from echelon.simulation.engine.parts import Parts
from echelon.simulation.engine.prepare import prepare
from echelon.simulation.step.assembly import assemble
from echelon.simulation.step.loop import Loop
from echelon.simulation.step.sequence import final_states
from echelon.simulation.step.settings import Settings

# Odd, so that the centre of a grid is the goal; starts are 1/20 of the half-width apart.
SIDE = 41
_AGENTS = 6000  # followers of all starts together; the grid is coarser for larger graphs
# Slower loops are not simulated for longer: the required decay is smaller for a shorter time.
_STEPS = 3000
_FARTHEST = 30.0  # in the states' units, and a half turn for angles


class StateSlice(NamedTuple):
    """Starts in which all followers have the same deviation from their goals, in two states only.

    Attributes:
        states: the indices of the two states.
        form: with sum_i delta_i'P delta_i = s'form s for the deviation s.
        limits: the largest deviations that are tried.
    """

    states: tuple[int, int]
    form: Float[Array, "2 2"]
    limits: Float[Array, "2"]

    def extents(self, radius: float) -> Float[Array, "2"]:
        """Return the half-widths of the ellipse s'form s = radius^2 along both axes."""
        # The largest s_k on s'form s = r^2 is r sqrt((form^-1)_kk), by Lagrange's multipliers.
        return radius * np.sqrt(np.diag(np.linalg.inv(self.form)))

    @property
    def largest(self) -> float:
        """The radius of the largest ellipse that is tried."""
        return float((self.limits / self.extents(1.0)).max())

    def ellipse(self, radius: float, points: int) -> Float[Array, "points 2"]:
        """Return points of the ellipse with a radius."""
        # With form = L L', s = L'^-1 y maps the circle |y| = r to s'form s = r^2.
        angles = 2.0 * np.pi * np.arange(points) / points
        circle = np.column_stack([np.cos(angles), np.sin(angles)])
        return radius * np.linalg.solve(np.linalg.cholesky(self.form).T, circle.T).T


class Trial(NamedTuple):
    """The closed loop in which starts are simulated, with the leader at rest at the trim.

    A start has converged if after `horizon` its errors, in the metric of P, are at most `decay`
    times the initial ones; the logarithm of `decay` is half that of the slowest mode.
    """

    parts: Parts
    loop: Loop
    dt: float
    steps: int
    decay: float

    @property
    def horizon(self) -> float:
        """The simulated time of each start, s."""
        return self.steps * self.dt

    @property
    def followers(self) -> int:
        """The number of followers, which start off their goals."""
        return len(self.parts.graph.followers)


def trial(parts: Parts, settings: Settings) -> Trial:
    """Return the closed loop of a stable gain, simulated for six slowest time constants."""
    model, graph, dt = parts.model, parts.graph, settings.dt
    assert isinstance(parts.drive, Laws)
    rest = np.tile(np.asarray(model.trim[0], float), (graph.agents, 1))
    laws = Laws(TrimInput(), parts.drive.follower)
    # Offsets that are symmetries do not change errors, and a leader at rest excites nobody: only
    # the loop remains.
    alone = Parts(model, graph, Formation(np.zeros_like(rest)), laws, initial=rest)
    prepared = prepare(alone, settings)
    loop = assemble(prepared.problem, laws.leader, laws.follower)
    slow = -guarantee(parts, settings).loop.slowest
    # After six time constants the slowest mode has decayed to e^-6 = 1/400; e^-3 = 1/20 is
    # required, which allows for a transient.
    steps = int(np.clip(np.ceil(6.0 / (slow * dt)), 1, _STEPS))
    return Trial(prepared.parts, loop, dt, steps, float(np.exp(-0.5 * slow * steps * dt)))


def slice_of(parts: Parts, states: tuple[int, int]) -> StateSlice:
    """Return the slice through the goals in two states, in the metric of the gain."""
    model, gain, followers = parts.model, parts.drive.gain, len(parts.graph.followers)
    assert gain is not None
    trim, limits = np.asarray(model.trim[0], float), []
    for k in states:
        angle = model.state_units[k] == "rad"
        low, high = model.chart.get(model.state_names[k], (-np.inf, np.inf))
        # At the boundary of a chart f may be infinite, as at a pitch of 90 degrees.
        inside = 0.98 * min(high - trim[k], trim[k] - low)
        limits.append(min(inside, np.pi if angle else _FARTHEST))
    # All deviations are equal, so the sum over followers is their number times one form.
    return StateSlice(states, followers * gain.P[np.ix_(states, states)], np.array(limits))


def side_of(followers: int) -> int:
    """Return the number of starts along a side of the grid, an odd number."""
    # All starts are one batch: memory and time depend on side^2 times the followers.
    return int(np.clip(np.sqrt(_AGENTS / followers), 11, SIDE)) // 2 * 2 + 1


def observed_radius(run: Trial, plane: StateSlice) -> float:
    """Return the largest radius up to which all starts tried in a slice converge; 0 for none.

    The starts lie within reach on ellipses s'form s = r^2, each a fixed factor larger than the one
    before, over three decades up to the largest that the slice allows.
    """
    side = side_of(run.followers)
    radii = np.geomspace(1e-3 * plane.largest, plane.largest, side)
    rings = np.stack([plane.ellipse(r, side) for r in radii])
    tried = np.all(np.abs(rings) <= plane.limits, axis=2)
    # A start beyond reach becomes the goal, which converges: rings keep their shape, and what was
    # not tried counts against none.
    starts = np.where(tried[..., None], rings, 0.0).reshape(-1, 2)
    held = np.all(converged(run, plane, starts).reshape(side, side), axis=1)
    count = side if bool(held.all()) else int(np.argmin(held))
    return float(radii[count - 1]) if count else 0.0


def grid(plane: StateSlice, half: Array, side: int) -> tuple[Array, Array]:
    """Return the two axes of a grid of starts, symmetric about the goal."""
    # From whole numbers, so that the centre is the goal to the bit.
    places = np.arange(-(side // 2), side // 2 + 1) / (side // 2)
    return half[0] * places, half[1] * places


def converged(run: Trial, plane: StateSlice, starts: Float[Array, "S 2"]) -> Bool[Array, " S"]:
    """Return whether the followers converge from each deviation in a slice."""
    model, graph, gain = run.parts.model, run.parts.graph, run.parts.drive.gain
    assert gain is not None
    trim, shape = np.asarray(model.trim[0], float), (len(starts), graph.agents)
    deviations = np.zeros((*shape, len(trim)))
    # Two index arrays with a slice between them would move the slice to the end.
    for place, k in enumerate(plane.states):
        deviations[:, list(graph.followers), k] = starts[:, place, None]

    def size(y: Float[Array, "S F n"]) -> Float[Array, " S"]:
        return np.sqrt(np.einsum("sfi,ij,sfj->s", y, gain.P, y))

    with precision("float64"), np.errstate(invalid="ignore", over="ignore"):
        ends = np.asarray(final_states(run.loop, jnp.asarray(trim + deviations), run.steps))
        # A start at the goal stays there, and a run that is not finite has not converged.
        decayed = size(ends - trim) <= run.decay * size(deviations)
        return decayed | ~starts.any(axis=1)


class Radii(NamedTuple):
    """The certified and the observed radius of sum_i delta_i'P delta_i, leader at rest at the trim.

    `certified` is None without a certified set; `observed` concerns only starts in the slice, and
    `largest` is the largest radius that was tried.
    """

    states: tuple[str, str]
    certified: float | None
    observed: float
    largest: float
    horizon: float

    def sentence(self) -> str:
        """Return both radii in a sentence."""
        certified = "none, since no set is certified"
        if self.certified is not None:
            certified = "everywhere" if self.certified == np.inf else at_most(self.certified)
        observed = at_most(self.observed)
        if self.observed >= self.largest:
            observed = f"all that was tried, up to {at_most(self.largest)}"
        return (
            f"Radius r of sum_i delta_i'P delta_i <= r^2, leader at rest: certified {certified}; "
            f"observed {observed}, for starts in `{self.states[0]}` and `{self.states[1]}` alone, "
            f"run for {about(self.horizon)} s."
        )


def chosen_slice(model: ControlAffine, names: str | None) -> tuple[int, int]:
    """Return the two states of a slice, from a text such as `y,roll`.

    The default is a velocity with the angle that drives it; without such a pair, the first two
    coordinates of the position, or the first two states.

    Raises:
        GainError: the text does not name two different states of the model.
    """
    states = model.state_names
    if names is not None:
        parts = [part.strip() for part in names.split(",")]
        for name in parts:
            check_name("`--slice` names", name, states, GainError)
        if len(set(parts)) != 2 or len(parts) != 2:
            raise GainError(
                f"`--slice` is `{names}`, allowed are two different states such as `y,roll`."
            )
        return states.index(parts[0]), states.index(parts[1])
    if len(states) < 2:
        raise GainError(f"a slice needs two states, but `{type(model).__name__}` has one.")
    return _default_slice(model)


def _default_slice(model: ControlAffine) -> tuple[int, int]:
    """Return a pair of states that are coupled by the dynamics."""
    groups = model.state_groups
    if "velocity" in groups and "attitude" in groups:
        velocities, angles = model.states_called("velocity"), model.states_called("attitude")
        # A tilt deflects the thrust: the largest entry of A has the angle that drives a velocity.
        entries = np.abs(linearize(model).A[np.ix_(velocities, angles)])
        row, column = np.unravel_index(int(entries.argmax()), entries.shape)
        return velocities[row], angles[column]
    position = model.position_indices()
    return (position[0], position[1]) if len(position) > 1 else (0, 1)
