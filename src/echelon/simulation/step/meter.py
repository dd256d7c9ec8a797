"""Sums over all steps of a run, from which its means are computed.

A mean over stored frames would depend on how many are stored, and its first frame would weigh as
much as all the steps after it.
"""

import dataclasses
from types import ModuleType
from typing import NamedTuple, TypeAlias, TypeVar, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from echelon.agents.models.model import ControlAffine
from echelon.agents.network.formation import Formation
from echelon.agents.network.graph import Graph
from echelon.core.types import Array, Input, Inputs, Output, PyTree, State, States
from echelon.simulation.step.distances import finds_pairs, spacing_error
from echelon.simulation.step.records import Mask
from echelon.simulation.step.settings import Settings

Total: TypeAlias = PyTree
"""JAX within a chunk, float64 NumPy on the host: chunks of a float32 run are added without loss."""

_Numbers = TypeVar("_Numbers", jax.Array, Array)

ALWAYS = 2**31 - 1
"""The first step at which a state was outside of its chart, if it never was."""

SLICES = 200
"""Of a run at most, for each of which distances are stored where agents keep apart."""
SETTLED = 0.01
"""A follower has settled when its error stays below this: 1 cm for a position."""


class Sums(NamedTuple):
    """Sums over K steps, each measured at the beginning of a step.

    Pairs are for all steps and for those in the steady window. N agents, L leaders, E edges, q
    outputs.

    Attributes:
        steps: (2,) number of steps.
        errors: (2, N) squared deviation from the goal relative to the leader.
        tracking: (2, L) squared deviation of the leaders from their reference; 0 without one.
        outputs: (L, q) the squared deviation of each output.
        effort: (N,) squared normalized input about the trim.
        spacing: (E,) squared error of the distance between neighbours.
        limited: (N,) number of steps in which a limit changed the input.
        unsettled: (N,) the last step at which the error was above `SETTLED`; -1 if there is none.
        inside: (N, k) the first step at which each of the k states that the model's chart bounds
            was not inside; `ALWAYS` if there is none.
        chatter: (N,) number of steps in which an input went from one limit to the opposite one.
        separation: (N, B) where agents keep apart, the least scaled distance to another agent, m,
            in each of B slices of the run; infinite before.
        avoidance: (N, B) how many others changed the agent's rate, summed over the steps of each.
        closest: (1,) the smallest distance between two agents at the beginning of a step, and `met`
            (1, 3) that step and the two; (0,) and (0, 3) where `RunStatistics.paired` is empty.
        peaks: (N, J) the largest squared deviation from the goal from each of J events on, until
            the next one.
        late: (N, J) the last step in the same span at which the error was above `SETTLED`; -1 if
            there is none.
        lowest, highest: (N, n + m) the extremes of the state less the goal's offset, and of the
            normalized input, infinite before; (N, 0) where `RunStatistics.bounded` is false.
    """

    steps: Total
    errors: Total
    tracking: Total
    outputs: Total
    effort: Total
    spacing: Total
    limited: Total
    unsettled: Total
    inside: Total
    chatter: Total
    separation: Total
    avoidance: Total
    closest: Total
    met: Total
    peaks: Total
    late: Total
    lowest: Total
    highest: Total

    def plus(self, more: "Sums") -> "Sums":
        """Return the sums of two stretches of a run."""
        total = Sums(*(a + b for a, b in zip(self, more, strict=True)))
        total = total._replace(separation=self.separation.clip(None, more.separation))
        # The maximum, and below the minimum; written so that NumPy on the host and JAX within a
        # chunk both have it.
        last = self.unsettled + (more.unsettled - self.unsettled).clip(0)
        since = self.late + (more.late - self.late).clip(0)
        first = self.inside - (self.inside - more.inside).clip(0)
        closer = more.closest < self.closest
        met = self.met + closer[..., None] * (more.met - self.met)
        closest = self.closest.clip(None, more.closest)
        total = total._replace(peaks=self.peaks.clip(more.peaks), late=since)
        low, high = self.lowest.clip(None, more.lowest), self.highest.clip(more.highest)
        total = total._replace(lowest=low, highest=high)
        return total._replace(unsettled=last, inside=first, closest=closest, met=met)

    # ---- sums of formations: an axis F in front of each part ----

    def of(self, formation: int) -> "Sums":
        """Return the sums of one formation."""
        return Sums(*(part[formation] for part in self))

    def where(self, which: Bool[np.ndarray, " F"], others: "Sums") -> "Sums":
        """Return these sums of some formations, and other ones of the rest."""
        # The parts have different ranks, and the mask broadcasts from the front.
        shapes = (which.reshape(-1, *[1] * (np.ndim(part) - 1)) for part in self)
        return Sums(*(np.where(w, a, b) for w, a, b in zip(shapes, self, others, strict=True)))

    def split(self, count: int) -> "Sums":
        """Return sums of `count` formations in a row, from those of one swarm of them all."""
        # These have their axis of two in front of that of the agents.
        pairs = ("errors", "tracking")
        parts = {
            name: part.reshape(2, count, -1).swapaxes(0, 1)
            if name in pairs
            else part.reshape(count, len(part) // count, *part.shape[1:])
            for name, part in self._asdict().items()
            if name != "steps"
        }
        return Sums(steps=np.stack([self.steps] * count), **parts)


def on_host(tree: PyTree) -> PyTree:
    """Return the same with every array in float64 NumPy."""
    return jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), tree)


class OfAgent(NamedTuple):
    """The terms of one agent in the sums of a step: (2,) squared error, effort, and two steps.

    `unsettled` is the step or -1, and the maximum is kept; `inside` (k,) is the step or `ALWAYS`
    for each bounded state, and the minimum is kept. Of `deviation`, as in `Sums.lowest`, both are.
    """

    errors: jax.Array
    effort: jax.Array
    unsettled: jax.Array
    inside: jax.Array
    deviation: jax.Array


def _twice(steady: jax.Array, square: jax.Array) -> Float[jax.Array, "2"]:
    return jnp.where(jnp.stack([jnp.asarray(True), steady]), square, 0.0)


@final
class RunStatistics(eqx.Module):
    """Measures the agents at the beginning of each step, by the model and never by the plant."""

    model: ControlAffine
    offsets: Array
    nearest: Array
    leaders: Array
    edges: Array
    spacings: Array
    first_steady: Array
    charted: Array
    chart: Array
    per_slice: Array
    events: Array
    scales: Array
    # Static, since they decide shapes.
    measured: tuple[int, ...] = eqx.field(static=True)
    slices: int = eqx.field(static=True, default=0)
    # The states of the position, where the closest two are found at every step.
    paired: tuple[int, ...] = eqx.field(static=True, default=())
    # Whether a domain is asked of steps between stored frames.
    bounded: bool = eqx.field(static=True, default=False)

    @classmethod
    def of(
        cls,
        model: ControlAffine,
        graph: Graph,
        formation: Formation,
        settings: Settings,
        scales: Array | None = None,
        bounded: bool = False,
    ) -> "RunStatistics":
        """Return the meter of a run, in which agents that keep apart have `scales` (d,).

        `bounded` is whether agents are to stay in the domain of a theorem.
        """
        per_slice = steps_per_slice(settings)
        measured = measured_states(model)
        i, j = graph.edges.T
        goals = formation.offsets[:, list(measured)]
        return cls(
            model=model,
            offsets=np.asarray(formation.offsets),
            nearest=np.array(graph.nearest_leader()),
            leaders=np.array(graph.leaders),
            edges=graph.edges,
            spacings=np.linalg.norm(goals[i] - goals[j], axis=1),
            # An array and not a constant: another window compiles nothing again.
            first_steady=np.asarray(settings.first_steady, np.int32),
            charted=np.array([model.state_names.index(name) for name in model.chart], int),
            chart=np.array([*model.chart.values()], float).reshape(-1, 2),
            per_slice=np.asarray(per_slice, np.int32),
            events=event_steps(graph, settings),
            scales=np.zeros(0) if scales is None else scales,
            measured=measured,
            slices=0 if scales is None else -(-settings.steps // per_slice),
            paired=measured if finds_pairs(model, graph.agents, settings) else (),
            bounded=bounded and settings.store_every > 1,
        )

    @property
    def extremes(self) -> int:
        """Of how many numbers of an agent the extremes are kept."""
        return self.bounded * (len(self.model.state_names) + len(self.model.input_names))

    def zero_sums(self, xp: ModuleType = jnp) -> Sums:
        """Return the sums of no step, as arrays of JAX or of NumPy.

        They have the precision that is switched on now: float32 within a float32 run.
        """
        dtype = jax.dtypes.canonicalize_dtype(np.float64)
        agents, leaders, q = len(self.offsets), len(self.leaders), len(self.model.output_names)
        return Sums(
            steps=xp.zeros(2, np.int32),
            errors=xp.zeros((2, agents), dtype),
            tracking=xp.zeros((2, leaders), dtype),
            outputs=xp.zeros((leaders, q), dtype),
            effort=xp.zeros(agents, dtype),
            spacing=xp.zeros(len(self.edges), dtype),
            **dict.fromkeys(("limited", "chatter"), xp.zeros(agents, np.int32)),
            unsettled=xp.full(agents, -1, np.int32),
            inside=xp.full((agents, len(self.charted)), ALWAYS, np.int32),
            separation=xp.full((agents, self.slices), jnp.inf, dtype),
            avoidance=xp.zeros((agents, self.slices), dtype),
            closest=xp.full(min(1, len(self.paired)), jnp.inf, dtype),
            met=xp.zeros((min(1, len(self.paired)), 3), np.int32),
            peaks=xp.zeros((agents, len(self.events)), dtype),
            late=xp.full((agents, len(self.events)), -1, np.int32),
            lowest=xp.full((agents, self.extremes), jnp.inf, dtype),
            highest=xp.full((agents, self.extremes), -jnp.inf, dtype),
        )

    def read(
        self,
        step: jax.Array,
        states: States,
        inputs: Inputs,
        limited: jax.Array,
        chatter: jax.Array,
        reference: State | None,
        goals: States | None = None,
    ) -> Sums:
        """Return the sums of one step.

        Args:
            step: its number.
            states: (N, n) at its beginning.
            inputs: (N, m) delivered over it.
            limited: (N,) the agents whose inputs a limit changed.
            chatter: (N,) the agents with an input that went from one limit to the opposite one.
            reference: (n,) the state that the leaders follow at its beginning, or None.
            goals: (N, n) the offsets at its beginning; None for constant ones.
        """
        offsets = jnp.asarray(self.offsets, states.dtype) if goals is None else goals
        y = states - offsets
        steady = step >= jnp.asarray(self.first_steady)

        def one(x: jax.Array, offset: jax.Array, leader: jax.Array, u: jax.Array) -> OfAgent:
            return self.of_agent(step, steady, x, offset, leader, u)

        rows = jax.vmap(one)(states, offsets, y[self.nearest], inputs)
        led = states[self.leaders], offsets[self.leaders]
        since = self._since(step)
        tracking, outputs = self._tracking(steady, led, reference)
        return Sums(
            steps=jnp.stack([jnp.asarray(True), steady]).astype(jnp.int32),
            errors=rows.errors.T,
            tracking=tracking,
            outputs=outputs,
            effort=rows.effort,
            spacing=self.spacing(states, goals),
            limited=limited.astype(jnp.int32),
            unsettled=rows.unsettled.astype(jnp.int32),
            inside=rows.inside.astype(jnp.int32),
            chatter=chatter.astype(jnp.int32),
            separation=jnp.full((len(states), self.slices), jnp.inf, states.dtype),
            avoidance=jnp.zeros((len(states), self.slices), states.dtype),
            closest=jnp.full(min(1, len(self.paired)), jnp.inf, states.dtype),
            met=jnp.zeros((min(1, len(self.paired)), 3), jnp.int32),
            peaks=jnp.where(since, rows.errors[:, :1], 0.0),
            late=jnp.where(since, rows.unsettled[:, None], -1).astype(jnp.int32),
            lowest=rows.deviation,
            highest=rows.deviation,
        )

    def _since(self, step: jax.Array) -> Bool[jax.Array, " J"]:
        """Return which event is the last one before or at a step."""
        events = jnp.asarray(self.events)
        return jnp.arange(len(events)) == jnp.searchsorted(events, step, side="right") - 1

    def following(self, nearest: jax.Array) -> "RunStatistics":
        """Return a meter of errors relative to these leaders (N,)."""
        return dataclasses.replace(self, nearest=nearest)

    def of_present(self, read: Sums, here: Bool[jax.Array, " N"]) -> Sums:
        """Return the sums of a step without the agents, leaders and edges that are absent."""
        nothing, leads = self.zero_sums(), here[self.leaders]
        masks = dict.fromkeys(("effort", "limited", "unsettled", "chatter"), here)
        spans = "inside", "separation", "avoidance", "peaks", "late", "lowest", "highest"
        masks |= dict.fromkeys(spans, here[:, None])
        masks |= {"errors": here[None], "tracking": leads[None], "outputs": leads[:, None]}
        masks["spacing"] = here[self.edges].all(axis=1)
        return read._replace(
            **{
                name: jnp.where(mask, getattr(read, name), getattr(nothing, name))
                for name, mask in masks.items()
            }
        )

    def of_slice(
        self,
        step: jax.Array,
        states: States,
        active: Float[jax.Array, " N"],
        here: Mask = True,
    ) -> dict[str, jax.Array]:
        """Return the terms `separation` and `avoidance` of a step, where agents keep apart.

        They are of the agents that are present, (N,), if not all are.
        """
        nothing, at = self.zero_sums(), step // jnp.asarray(self.per_slice)
        places = states[:, np.array(self.measured)] * jnp.asarray(self.scales[None], states.dtype)
        squares = ((places[:, None] - places[None]) ** 2).sum(axis=2)
        others = jnp.where(jnp.eye(len(states), dtype=bool), jnp.inf, squares)
        others = others if here is True else jnp.where(here[None], others, jnp.inf)
        return {
            "separation": nothing.separation.at[:, at].set(jnp.sqrt(others.min(axis=1))),
            "avoidance": nothing.avoidance.at[:, at].set(active),
        }

    def of_agent(
        self, step: jax.Array, steady: jax.Array, x: State, offset: State, leader: State, u: Input
    ) -> OfAgent:
        """Return the terms of one agent in the sums of a step.

        Args:
            step: its number.
            steady: whether the step begins in the steady window.
            x: the agent's state (n,).
            offset: of its goal (n,).
            leader: the state (n,) of its leader less the leader's offset.
            u: its delivered input (m,).
        """
        # y_i = x_i - xi_i, and y_i - y_0 is the deviation from the goal (theory page).
        y = x - offset
        square = self._length(y - leader)
        # A newton and a newton metre cannot be added; accelerations can.
        v = self.model.normalized(u)
        out = outside(x[self.charted], *jnp.asarray(self.chart.T, x.dtype))
        return OfAgent(
            errors=_twice(steady, square),
            effort=jnp.sum(v * v),
            # Not finite counts as unsettled: a comparison with it is false.
            unsettled=jnp.where(jnp.sqrt(square) <= SETTLED, -1, step),
            inside=jnp.where(out, step, ALWAYS),
            deviation=jnp.concatenate([y, v]) if self.bounded else y[:0],
        )

    def of_leader(
        self, steady: jax.Array, x: State, offset: State, reference: State
    ) -> tuple[Float[jax.Array, "2"], Output]:
        """Return the squared deviations of a leader at x from a reference, (2,), and its outputs'.

        Args:
            steady: whether the step begins in the steady window.
            x: its state (n,).
            offset: of its goal (n,).
            reference: the state that it follows (n,), without that offset.
        """
        # The offset back in: outputs are nonlinear in the state, so each is taken where it holds.
        deviation = output_error(self.model, x, reference + offset)
        return _twice(steady, self._length(x - offset - reference)), deviation * deviation

    def _length(self, deviation: jax.Array) -> jax.Array:
        part = deviation[np.array(self.measured)]
        return jnp.sum(part * part)

    def _tracking(
        self, steady: jax.Array, led: tuple[jax.Array, jax.Array], reference: jax.Array | None
    ) -> tuple[jax.Array, jax.Array]:
        """Return the squared deviations of the leaders (2, L), and of their outputs (L, q)."""
        leaders, q, dtype = len(self.leaders), len(self.model.output_names), led[0].dtype
        if reference is None:
            return jnp.zeros((2, leaders), dtype), jnp.zeros((leaders, q), dtype)
        off, outputs = jax.vmap(lambda x, o: self.of_leader(steady, x, o, reference))(*led)
        return off.T, outputs

    def spacing(self, states: States, goals: States | None = None) -> Float[jax.Array, " E"]:
        """Return the squared errors of the distances along the edges, (E,), for offsets (N, n)."""
        i, j = self.edges.T
        square, desired = jax.vmap(self._length)(states[i] - states[j]), self.spacings
        if goals is not None:
            desired = jnp.sqrt(jax.vmap(self._length)(goals[i] - goals[j]))
        return spacing_error(square, jnp.asarray(desired, states.dtype))


def outside(bounded: _Numbers, low: _Numbers, high: _Numbers) -> _Numbers:
    """Return which states are outside of their chart; NaN is not, since it ends the run itself."""
    return (bounded <= low) | (bounded >= high)


def reference_at(reference: Array | None, k: jax.Array, states: States) -> jax.Array | None:
    """Return row k of a reference (S, n) in the precision of the states; None without one."""
    return None if reference is None else jnp.asarray(reference, states.dtype)[k]


def event_steps(graph: Graph, settings: Settings) -> Int[np.ndarray, " J"]:
    """Return the first steps that do not begin before an event, ascending, each once."""
    times = np.array([event.at for event in graph.events], float)
    return np.unique(np.ceil(times / settings.dt - 1e-6)).astype(np.int32)


def steps_per_slice(settings: Settings) -> int:
    """Return of how many steps each slice of a run is, for which distances are stored."""
    return -(-settings.steps // SLICES)


def measured_states(model: ControlAffine) -> tuple[int, ...]:
    """Return the indices of the states whose errors are measured: the position, or else all."""
    return model.position_indices() or tuple(range(len(model.state_names)))


def output_error(model: ControlAffine, x: State, reference: State) -> Output:
    """Return h(x) - h(reference) (q,); states differ by the model's difference, which may wind."""
    return model.output(reference + model.difference(x, reference)) - model.output(reference)
