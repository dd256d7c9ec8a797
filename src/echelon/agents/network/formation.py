"""The formation: each agent's goal offset xi_i from the leader, its rigidity and symmetry."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from echelon.agents.models.model import ControlAffine
from echelon.agents.models.unlike import UnlikeAgents
from echelon.agents.network.distance_shapes import Distances, realize, rigidity_matrix
from echelon.agents.network.formation_motion import (
    FormationMotion,
    OffsetMotion,
    OwnOffset,
    Reshape,
    nearest_places,
)
from echelon.agents.network.graph import Graph
from echelon.core.compiled import cached_jit
from echelon.core.errors import FormationError, is_number
from echelon.core.limits import LARGEST
from echelon.core.numerics import precision
from echelon.core.types import Array, States
from echelon.core.words import amount

# For an analytic model one random state would do, almost surely; kinks need more.
_SAMPLES = 32
_MAX_TESTED = 64
_SYMMETRY_TOLERANCE = 1e-9


@final
class Formation:
    """Goal offsets xi (N, n), one row per agent; xi_i is agent i's goal minus the leader's state.

    Attributes:
        offsets: (N, n) float64; of a formation that moves, without its motion.
        motion: how they change with time; None for constant ones. `moving` returns a formation with
            one.
        remarks: what should be known of a shape that was found, in sentences.

    Raises:
        FormationError: the offsets are not a finite matrix.
    """

    def __init__(
        self,
        offsets: Sequence[Sequence[float]] | Array,
        motion: FormationMotion | None = None,
        remarks: tuple[str, ...] = (),
    ) -> None:
        self.motion, self.remarks = motion, remarks
        self.offsets = np.array(offsets, dtype=np.float64)
        if self.offsets.ndim != 2 or not (np.abs(self.offsets) <= LARGEST).all():
            raise FormationError(
                f"formation offsets must be a matrix (agents, states) of numbers up to "
                f"{LARGEST:g}, and have shape {self.offsets.shape}."
            )
        self.offsets.setflags(write=False)

    def __eq__(self, other: object) -> bool:
        return (
            isinstance(other, Formation)
            and np.array_equal(self.offsets, other.offsets)
            and bool(eqx.tree_equal(self.motion, other.motion))
        )

    def __repr__(self) -> str:
        agents, states = self.offsets.shape
        largest = np.abs(self.offsets).max(initial=0.0)
        moving = "" if self.motion is None else ", moving"
        size = f"{agents} agents, {amount(states, 'state')}"
        return f"Formation({size}, offsets up to {largest:.4g}{moving})"

    def __hash__(self) -> int:
        # Where -0.0 is 0.0, which it equals.
        return hash((self.offsets.shape, (self.offsets + 0.0).tobytes()))

    @classmethod
    def from_offsets(
        cls, model: ControlAffine, graph: Graph, offsets: Mapping[int, Sequence[float]]
    ) -> "Formation":
        """Return the formation of some offsets; the others are zero.

        Args:
            model: defines the states.
            graph: defines the agents.
            offsets: agent number -> offset, over the position coordinates (metres) or over all n
                states.

        Raises:
            FormationError: an agent is unknown or an offset has a wrong length or a non-finite
                number.
        """
        if not isinstance(offsets, Mapping):
            raise FormationError(
                f"the offsets are a `{type(offsets).__name__}`, and must be a mapping from agents "
                "to offsets, such as {1: (1.0, 0.0)}; a whole matrix is `Formation(offsets)`."
            )
        full = np.zeros((graph.agents, len(model.state_names)))
        for agent, offset in offsets.items():
            if not isinstance(agent, (int, np.integer)) or not 0 <= agent < graph.agents:
                raise FormationError(
                    f"an offset is given for agent {agent}, "
                    f"and agents are numbered from 0 to {graph.agents - 1}."
                )
            full[agent] = _whole_state(model, agent, offset)
        return cls(full)

    @classmethod
    def from_distances(
        cls,
        model: ControlAffine,
        graph: Graph,
        distances: Distances,
        near: Float[Array, "N d"] | None = None,
    ) -> "Formation":
        """Return a formation whose goals have given distances (paper, Definition 3).

        Its offsets are found once: they do not depend on seeds. A shape that is flexible, or not
        the only one, is told of in `remarks`.

        Args:
            model: defines the position.
            graph: defines the agents.
            distances: agent, agent and distance (m) of each pair, as in `[(0, 1, 1.0)]`.
            near: places (N, d), m, to which the shape is turned, and of two mirror images the
                closer one is chosen; by default agent by agent opens a new axis.

        Raises:
            FormationError: the model has no position, or no shape has these distances, or none was
                found.
        """
        axes = list(model.position_indices())
        if not axes:
            raise FormationError(f"`{type(model).__name__}` has no position, and so no distances.")
        shape = realize(graph.agents, len(axes), distances, near)
        offsets = np.zeros((graph.agents, len(model.state_names)))
        offsets[:, axes] = shape.places - shape.places[graph.leaders[0]]
        return cls(offsets, remarks=(*shape.remarks(),))

    @classmethod
    def triangle(cls, model: ControlAffine, graph: Graph, spacing: float = 1.0) -> "Formation":
        """Return a filled triangle with agent 0 at the tip.

        Rows of 2, 3, ... agents follow behind it, towards minus the first axis.
        """
        # Row r begins with agent r (r + 1) / 2, solved for r.
        rows = np.floor((np.sqrt(8.0 * np.arange(graph.agents) + 1.0) - 1.0) / 2.0)
        place = np.arange(graph.agents) - rows * (rows + 1) / 2.0
        # The height of an equilateral triangle, so that neighbours are one spacing apart.
        plan = np.column_stack([-rows * np.sqrt(0.75), place - rows / 2.0])
        return cls._place_plan(model, graph, plan, spacing)

    @classmethod
    def line(cls, model: ControlAffine, graph: Graph, spacing: float = 1.0) -> "Formation":
        """Return agents one behind the other."""
        number = np.arange(graph.agents)
        plan = np.column_stack([-number, np.zeros_like(number)])
        return cls._place_plan(model, graph, plan, spacing)

    @classmethod
    def wedge(cls, model: ControlAffine, graph: Graph, spacing: float = 1.0) -> "Formation":
        """Return a V: agents alternate between two arms at 45 degrees behind agent 0."""
        number = np.arange(graph.agents)
        # One spacing along an arm at 45 degrees.
        step = (number + 1) // 2 * np.sqrt(0.5)
        side = np.where(number % 2 == 1, 1.0, -1.0)
        return cls._place_plan(model, graph, np.column_stack([-step, side * step]), spacing)

    @classmethod
    def circle(cls, model: ControlAffine, graph: Graph, spacing: float = 1.0) -> "Formation":
        """Return agents 1, 2, ... on a circle around agent 0, `spacing` apart along its chords."""
        ring = max(graph.agents - 1, 1)
        angle = 2.0 * np.pi * np.arange(ring) / ring
        # A chord is 2 r sin(pi / ring); for one or two agents it does not set the radius.
        radius = 1.0 if ring < 3 else 0.5 / np.sin(np.pi / ring)
        points = radius * np.column_stack([np.cos(angle), np.sin(angle)])
        plan = np.vstack([np.zeros((1, 2)), points])[: graph.agents]
        return cls._place_plan(model, graph, plan, spacing)

    @classmethod
    def grid(
        cls, model: ControlAffine, graph: Graph, spacing: float = 1.0, columns: int | None = None
    ) -> "Formation":
        """Return rows of `columns` agents (by default near a square), agent 0 at a corner."""
        columns = int(np.ceil(np.sqrt(graph.agents))) if columns is None else columns
        if columns < 1:
            raise FormationError(f"`columns` of a grid is {columns}, and must be at least 1.")
        # More columns than agents are one row, and could exceed the range of integers in arrays.
        number, columns = np.arange(graph.agents), min(columns, graph.agents)
        plan = np.column_stack([-(number // columns), number % columns])
        return cls._place_plan(model, graph, plan, spacing)

    @classmethod
    def _place_plan(
        cls, model: ControlAffine, graph: Graph, plan: np.ndarray, spacing: float
    ) -> "Formation":
        """Place a plan (N, 2), in units of the spacing, on the first two position coordinates."""
        if not (is_number(spacing) and 0.0 < spacing < float("inf")):
            raise FormationError(
                f"the spacing of a formation is {spacing}, and must be positive and finite."
            )
        axes = model.position_indices()
        if not axes:
            raise FormationError(
                f"`{type(model).__name__}` has no position, "
                "so a geometric formation has no meaning; give `offsets`."
            )
        # On a line the plan is projected; goals that coincide then cause a warning before a run.
        used = min(2, len(axes))
        full = np.zeros((graph.agents, len(model.state_names)))
        full[:, axes[:used]] = spacing * plan[:, :used]
        return cls(full)

    def moving(
        self, model: ControlAffine, graph: Graph, changes: Sequence[OffsetMotion | Reshape]
    ) -> "Formation":
        """Return a formation whose offsets begin like these and change with time.

        Args:
            model: defines the position.
            graph: defines the leaders; the first one is the centre.
            changes: reshapes, and motions of the whole shape in the order in which they act.

        Raises:
            FormationError: the model has no position, or a change does not fit it or the others.
        """
        motion = FormationMotion.of(model, graph.leaders, self.offsets, changes)
        return Formation(self.offsets, motion, self.remarks)

    def nearest(
        self, model: ControlAffine, graph: Graph, starts: Mapping[int, Sequence[float]]
    ) -> "Formation":
        """Return the formation in which followers with known starts (n,) share their places anew.

        The squares of their ways add up to as little as possible.

        Raises:
            FormationError: there are too many agents.
        """
        axes, others = list(model.position_indices()), {*graph.followers} & {*starts}
        agents = np.array(sorted(others), int)
        before = np.array([starts[agent] for agent in agents.tolist()], float)
        order = np.arange(graph.agents)
        if len(agents) and axes:
            places = self.offsets[agents][:, axes]
            order[agents] = agents[nearest_places((), before[:, axes], places)]
        return Formation(self.offsets[order], self.motion)

    @property
    def shapes(self) -> "Iterator[Formation]":
        """The shapes that it has at first and after each reshape, without motions of the whole."""
        if self.motion is None:
            yield self
            return
        for places in self.motion.shapes:
            offsets = self.offsets.copy()
            offsets[:, list(self.motion.axes)] = places
            yield Formation(offsets)

    def offsets_at(self, times: Sequence[float] | Array) -> Float[Array, "T N n"]:
        """Return the offsets at times (s), read-only."""
        times = np.asarray(times, float)
        if self.motion is None:
            return np.broadcast_to(self.offsets, (len(times), *self.offsets.shape))
        with precision("float64"):
            return np.asarray(_offsets_at(self.motion, self.offsets, jnp.asarray(times)))

    def displacement(self, i: int, j: int) -> Array:
        """Return d_ij = xi_j - xi_i (paper, Definition 3)."""
        return self.offsets[j] - self.offsets[i]

    def distances(self, graph: Graph) -> Array:
        """Return delta_ij = |d_ij| for each edge, (E,)."""
        i, j = graph.edges.T
        return np.linalg.norm(self.offsets[j] - self.offsets[i], axis=1)

    def rigidity_matrix(self, model: ControlAffine, graph: Graph) -> Array:
        """Return the rigidity matrix (E, N dim).

        The row of edge (i, j) has (p_i - p_j)^T in block i and its negative in block j.
        """
        axes = model.position_indices()
        if not axes:
            raise FormationError(
                f"`{type(model).__name__}` has no position, so rigidity has no meaning for it."
            )
        return rigidity_matrix(self.offsets[:, list(axes)], graph.edges)

    def is_rigid(self, model: ControlAffine, graph: Graph) -> bool:
        """Tell whether edge lengths fix the shape to first order (infinitesimal rigidity)."""
        agents, dim = graph.agents, len(model.position)
        # dim translations and dim (dim - 1) / 2 rotations; fewer agents than axes can fix as many
        # lengths as there are pairs.
        motions = (
            dim * (dim + 1) // 2 if agents >= dim else agents * dim - agents * (agents - 1) // 2
        )
        rank = np.linalg.matrix_rank(self.rigidity_matrix(model, graph))
        return bool(rank == agents * dim - motions)

    def coincident(self) -> tuple[tuple[int, int], ...]:
        """Return pairs of agents (lowest number first) that have the same goal."""
        first, group = _distinct(self.offsets)
        others = np.flatnonzero(first[group] != np.arange(len(group)))
        return tuple(zip(first[group[others]].tolist(), others.tolist(), strict=True))

    def broken_symmetries(
        self, model: ControlAffine, lower: Array | float = -0.5, upper: Array | float = 0.5
    ) -> dict[int, str]:
        """Return the agents whose offsets change the dynamics, each with one reason.

        The formation law is exact for an offset d only if f(x + d) = f(x) and g(x + d) = g(x). Both
        are compared at random states, values and Jacobians, in float64. The test is sampled, at
        most 64 distinct offsets spread over all of them.

        Args:
            model: the agent.
            lower: lower bounds of the states, (n,) or one for all, as deviations from the trim.
            upper: upper bounds.
        """
        if isinstance(model, UnlikeAgents):
            return self._broken_of_groups(model, lower, upper)
        offsets = self.offsets - self.offsets[0] + 0.0  # turns -0.0 into 0.0
        first, group = _distinct(offsets)
        tested = range(0, len(first), max(1, -(-len(first) // _MAX_TESTED)))
        # In float32 rounding alone would exceed the tolerance.
        with precision("float64"):
            changes = {
                k: _describe_change(model, offsets[first[k]], lower, upper)
                for k in tested
                if offsets[first[k]].any()
            }
        reasons = {k: reason for k, reason in changes.items() if reason}
        agents = np.flatnonzero(np.isin(group, [*reasons])) if reasons else np.zeros(0, int)
        return {agent: reasons[int(group[agent])] for agent in agents.tolist()}

    def _broken_of_groups(
        self, model: UnlikeAgents, lower: Array | float, upper: Array | float
    ) -> dict[int, str]:
        """Return the same of unlike agents, each offset among the states of its own group."""
        broken = dict[int, str]()
        for kind, part in enumerate(model.models):
            at, mine = model.states_of(kind), np.flatnonzero(np.array(model.kinds) == kind)
            own = Formation(self.offsets[np.append(0, mine)][:, at])
            bounds = (x if np.ndim(x) == 0 else np.asarray(x)[at] for x in (lower, upper))
            found = own.broken_symmetries(part, *bounds)
            broken |= {int(mine[k - 1]): why for k, why in found.items() if k}
        return dict(sorted(broken.items()))

    def is_invariant(self, model: ControlAffine) -> bool:
        """Tell whether every offset is a symmetry of the model, by the sampled test above."""
        return not self.broken_symmetries(model)


def _distinct(rows: Array) -> tuple[Array, Array]:
    """Return each kind's first row and each row's kind; `numpy.unique` would take seconds."""
    varying = rows[:, np.ptp(rows, axis=0) > 0.0]
    order = np.lexsort(varying.T[::-1]) if varying.size else np.arange(len(rows))
    changed = (varying[order[1:]] != varying[order[:-1]]).any(axis=1)
    kinds, group = np.concatenate([[0], np.cumsum(changed)]), np.empty(len(rows), int)
    group[order] = kinds
    return order[np.concatenate([[True], changed])], group


def _whole_state(model: ControlAffine, agent: int, offset: Iterable[float]) -> np.ndarray:
    values = np.atleast_1d(np.asarray(offset, dtype=np.float64))
    axes, n = model.position_indices(), len(model.state_names)
    if not np.isfinite(values).all():
        raise FormationError(
            f"the offset of agent {agent} is {values.tolist()}, and must be finite."
        )
    if values.shape == (n,):
        return values
    if axes and values.shape == (len(axes),):
        full = np.zeros(n)
        full[list(axes)] = values
        return full
    lengths = f"{len(axes)} (position) or {n} (all states)" if axes else f"{n} (all states)"
    raise FormationError(
        f"the offset of agent {agent} has {amount(values.size, 'number')}, and must have {lengths}."
    )


def _describe_change(
    model: ControlAffine, offset: np.ndarray, lower: Array | float, upper: Array | float
) -> str | None:
    """Return how f or g changes under x -> x + offset, or None where it does not."""
    base = np.asarray(model.trim[0], float)
    # Near the trim by default, so that no angle leaves its chart.
    states = base + np.random.default_rng(0).uniform(lower, upper, (_SAMPLES, len(base)))
    both = np.concatenate([states, states + offset])
    for name, (values, slopes) in _local(model, both).items():
        here, there = np.split(np.asarray(values), 2)
        # A change that happens to vanish at a state rarely vanishes with its slope.
        slope_change = np.abs(np.diff(np.split(np.asarray(slopes), 2), axis=0))[0].max(axis=-1)
        change = np.maximum(np.abs(there - here), slope_change)
        # Each entry against its own size: an inertia makes some entries of g tens of thousands.
        entries = change / np.maximum(1.0, np.abs(here).max(axis=0))
        per_state = change.reshape(_SAMPLES, len(base), -1).max(axis=(0, 2))
        if not entries.max() <= _SYMMETRY_TOLERANCE:
            state = model.state_names[int(np.argmax(per_state))]
            return f"it changes the {name} of `{state}` by up to {per_state.max():.3g}"
    return None


@cached_jit
def _offsets_at(
    motion: FormationMotion, offsets: Float[jax.Array, "N n"], times: Float[jax.Array, " T"]
) -> Float[jax.Array, "T N n"]:
    def one(t: jax.Array) -> jax.Array:
        rows = jnp.asarray(offsets), jnp.asarray(motion.places)
        return jax.vmap(lambda *row: OwnOffset(motion, *row).state(t))(*rows)

    return jax.lax.map(one, times)


@cached_jit
def _local(model: ControlAffine, states: States) -> dict[str, tuple[jax.Array, jax.Array]]:
    parts = {"drift": model.drift, "input map": model.input_map}
    return {
        name: (jax.vmap(part)(states), jax.vmap(jax.jacfwd(part))(states))
        for name, part in parts.items()
    }
