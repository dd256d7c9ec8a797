"""The sums over all steps of a run, of which its means are computed.

A mean over stored frames would depend on how many are stored, and its first frame would weigh as
much as all the steps after it.
"""

from typing import Any, NamedTuple, TypeAlias, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool

from echelon.agents.models.model import ControlAffine
from echelon.agents.network.formation import Formation
from echelon.agents.network.graph import Graph
from echelon.core.types import Array, Inputs, Output, State, States
from echelon.simulation.step.settings import Settings

Total: TypeAlias = Any
"""JAX within a chunk, float64 NumPy on the host: chunks of a float32 run are added without loss."""

ALWAYS = 2**31 - 1
"""Stands for the first step at which a state left its chart, where it never did."""

SETTLED = 0.01
"""A follower has settled when its error stays below this: 1 cm for a position."""


class Sums(NamedTuple):
    """Sums over K steps, each of the moment at which a step begins.

    Pairs are of all steps and of those in the steady window. N agents, L leaders, E edges, q
    outputs.

    Attributes:
        steps: (2,) how many steps.
        errors: (2, N) squared deviation from the goal relative to the leader.
        tracking: (2, L) squared deviation of the leaders from their reference; 0 without one.
        outputs: (L, q) the same for each output.
        effort: (N,) squared normalized input about the trim.
        spacing: (E,) squared error of the distance between neighbours.
        limited: (N,) how many times a limit changed the input.
        unsettled: (N,) the last step at which the error was not below `SETTLED`; -1 without any.
        inside: (N, k) the first step at which each of the k states that the model's chart bounds
            was not inside; `ALWAYS` without any.
        chatter: (N,) how many times an input went from beyond one limit to beyond the other from a
            step to the next.
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

    def plus(self, more: "Sums") -> "Sums":
        """Return the sums of two stretches of a run."""
        total = Sums(*(a + b for a, b in zip(self, more, strict=True)))
        # The maximum, and below the minimum; written so that NumPy on the host and JAX within a
        # chunk both have it.
        last = self.unsettled + (more.unsettled - self.unsettled).clip(0)
        first = self.inside - (self.inside - more.inside).clip(0)
        return total._replace(unsettled=last, inside=first)

    # ---- sums of formations: an axis F in front of each part ----

    def of(self, formation: int) -> "Sums":
        """Return the sums of one formation."""
        return Sums(*(part[formation] for part in self))

    def where(self, which: Bool[np.ndarray, " F"], others: "Sums") -> "Sums":
        """Return these sums of some formations, and other ones of the rest."""
        shapes = (which.reshape(-1, *[1] * (np.ndim(part) - 1)) for part in self)
        return Sums(*(np.where(w, a, b) for w, a, b in zip(shapes, self, others, strict=True)))

    def split(self, count: int) -> "Sums":
        """Return the sums of `count` formations whose agents, leaders and edges follow each other.

        Of one swarm of them all; its steps are those of each.
        """
        pairs = ("errors", "tracking")
        parts = {
            name: part.reshape(2, count, -1).swapaxes(0, 1)
            if name in pairs
            else part.reshape(count, len(part) // count, *part.shape[1:])
            for name, part in self._asdict().items()
            if name != "steps"
        }
        return Sums(steps=np.stack([self.steps] * count), **parts)


def on_host(tree: Any) -> Any:
    """Return the same with every array in float64 NumPy."""
    return jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), tree)


class OfAgent(NamedTuple):
    """What one agent adds to the sums at a step: (2,) squared error, effort, and two steps.

    `unsettled` is the step or -1, of which the largest counts; `inside` (k,) is the step or
    `ALWAYS` for each bounded state, of which the least counts.
    """

    errors: Any
    effort: Any
    unsettled: Any
    inside: Any


def _twice(steady: Any, square: Any) -> Any:
    """Return a square for all steps and for those of the steady window."""
    return jnp.where(jnp.stack([jnp.asarray(True), steady]), square, 0.0)


@final
class Meter(eqx.Module):
    """What is measured at the beginning of each step, on the model and never on the plant."""

    model: ControlAffine
    offsets: Array
    nearest: Array
    leaders: Array
    edges: Array
    spacings: Array
    first_steady: Array
    charted: Array
    chart: Array
    # Static, since they decide shapes.
    measured: tuple[int, ...] = eqx.field(static=True)

    @classmethod
    def of(
        cls, model: ControlAffine, graph: Graph, formation: Formation, settings: Settings
    ) -> "Meter":
        """Return the meter of a run."""
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
            measured=measured,
        )

    def nothing(self, xp: Any = jnp) -> Sums:
        """Return the sums of no step, as arrays of JAX or of NumPy."""
        # The precision that is switched on now: float32 within a float32 run.
        dtype = jax.dtypes.canonicalize_dtype(np.float64)
        agents, leaders, q = len(self.offsets), len(self.leaders), len(self.model.output_names)
        return Sums(
            steps=xp.zeros(2, np.int32),
            errors=xp.zeros((2, agents), dtype),
            tracking=xp.zeros((2, leaders), dtype),
            outputs=xp.zeros((leaders, q), dtype),
            effort=xp.zeros(agents, dtype),
            spacing=xp.zeros(len(self.edges), dtype),
            limited=xp.zeros(agents, np.int32),
            unsettled=xp.full(agents, -1, np.int32),
            inside=xp.full((agents, len(self.charted)), ALWAYS, np.int32),
            chatter=xp.zeros(agents, np.int32),
        )

    def read(
        self,
        step: jax.Array,
        states: States,
        inputs: Inputs,
        limited: jax.Array,
        chatter: jax.Array,
        reference: jax.Array | None,
    ) -> Sums:
        """Return the sums of one step.

        Args:
            step: its number.
            states: (N, n) at its beginning.
            inputs: (N, m) delivered over it.
            limited: (N,) whose inputs a limit changed.
            chatter: (N,) whose inputs went beyond the one limit after the other.
            reference: (n,) what the leaders follow at its beginning, or None.
        """
        offsets = jnp.asarray(self.offsets, states.dtype)
        y = states - offsets
        steady = step >= jnp.asarray(self.first_steady)

        def one(x: jax.Array, offset: jax.Array, leader: jax.Array, u: jax.Array) -> OfAgent:
            return self.of_agent(step, steady, x, offset, leader, u)

        rows = jax.vmap(one)(states, offsets, y[self.nearest], inputs)
        tracking, outputs = self._tracking(steady, states[self.leaders], reference)
        return Sums(
            steps=jnp.stack([jnp.asarray(True), steady]).astype(jnp.int32),
            errors=rows.errors.T,
            tracking=tracking,
            outputs=outputs,
            effort=rows.effort,
            spacing=self.spacing(states),
            limited=limited.astype(jnp.int32),
            unsettled=rows.unsettled.astype(jnp.int32),
            inside=rows.inside.astype(jnp.int32),
            chatter=chatter.astype(jnp.int32),
        )

    def of_agent(self, step: Any, steady: Any, x: Any, offset: Any, leader: Any, u: Any) -> OfAgent:
        """Return what one agent adds to the sums at a step.

        Args:
            step: its number.
            steady: whether the step begins in the steady window.
            x: the agent's state (n,).
            offset: of its goal (n,).
            leader: the state (n,) of its leader less the leader's offset.
            u: its delivered input (m,).
        """
        # y_i = x_i - xi_i, and y_i - y_0 is the deviation from the goal (theory page).
        square = self._length(x - offset - leader)
        # A newton and a newton metre cannot be added; accelerations can.
        v = self.model.normalized(u)
        out = outside(x[self.charted], *jnp.asarray(self.chart.T, x.dtype))
        return OfAgent(
            errors=_twice(steady, square),
            effort=jnp.sum(v * v),
            # Not finite counts as unsettled: a comparison with it is false.
            unsettled=jnp.where(jnp.sqrt(square) <= SETTLED, -1, step),
            inside=jnp.where(out, step, ALWAYS),
        )

    def of_leader(self, steady: Any, x: Any, offset: Any, reference: Any) -> tuple[Any, Any]:
        """Return the squared deviations of a leader at x from a reference, (2,), and its outputs'.

        Args:
            steady: whether the step begins in the steady window.
            x: its state (n,).
            offset: of its goal (n,).
            reference: what it follows (n,), without that offset.
        """
        # The offset back in: outputs are nonlinear in the state, so each is taken where it holds.
        away = output_error(self.model, x, reference + offset)
        return _twice(steady, self._length(x - offset - reference)), away * away

    def _length(self, deviation: jax.Array) -> jax.Array:
        """Return the squared length of the measured part of a deviation (n,)."""
        part = deviation[np.array(self.measured)]
        return jnp.sum(part * part)

    def _tracking(
        self, steady: jax.Array, states: jax.Array, reference: jax.Array | None
    ) -> tuple[jax.Array, jax.Array]:
        """Return the squared deviations of the leaders (2, L), and of their outputs (L, q)."""
        leaders, q, dtype = len(self.leaders), len(self.model.output_names), states.dtype
        if reference is None:
            return jnp.zeros((2, leaders), dtype), jnp.zeros((leaders, q), dtype)
        offsets = jnp.asarray(self.offsets, dtype)[self.leaders]
        off, outputs = jax.vmap(lambda x, o: self.of_leader(steady, x, o, reference))(
            states, offsets
        )
        return off.T, outputs

    def spacing(self, states: States) -> jax.Array:
        """Return the squared errors of the distances along the edges, (E,)."""
        i, j = self.edges.T
        square = jax.vmap(self._length)(states[i] - states[j])
        return spacing_error(square, jnp.asarray(self.spacings, states.dtype))


def spacing_error(square: jax.Array, desired: jax.Array) -> jax.Array:
    """Return the squared errors of distances, whose squares are given, to the desired ones."""
    return (distance_of(square) - desired) ** 2


def distance_of(square: jax.Array) -> jax.Array:
    """Return the root of a square, with a slope of 1 where two agents meet."""
    # A root has no slope at 0, and a single `where` would still differentiate it there.
    apart = square > 0.0
    return jnp.where(apart, jnp.sqrt(jnp.where(apart, square, 1.0)), square)


def outside(bounded: Any, low: Any, high: Any) -> Any:
    """Return which states are beyond their chart; NaN is not, since it is another outcome."""
    return (bounded <= low) | (bounded >= high)


def reference_at(reference: Array | None, k: jax.Array, states: States) -> jax.Array | None:
    """Return row k of a reference (S, n) in the precision of the states; None without one."""
    return None if reference is None else jnp.asarray(reference, states.dtype)[k]


def measured_states(model: ControlAffine) -> tuple[int, ...]:
    """Return the indices of the states that errors are measured on: the position, else all."""
    return model.position_indices() or tuple(range(len(model.state_names)))


def output_error(model: ControlAffine, x: State, reference: State) -> Output:
    """Return h(x) - h(reference), (q,), of two states (n,).

    The model's difference of states, which may wind angles, decides how far apart they are.
    """
    return model.output(reference + model.difference(x, reference)) - model.output(reference)
