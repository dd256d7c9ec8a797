"""The inner loops of unlike agents under the law `stopping-point`, of which each runs its own.

Agents agree on where they would come to rest in all outputs of all groups. An output that an agent
does not have, such as the height of a rover, it carries for the others: as one integrator that
moves at the rate that the law commands. An output whose chain is longer in another group follows
what is commanded through a filter with the roots that its own chain lacks. So the same polynomial
is between zeta and y in all groups, q(D) y' = k0 zeta', and agents that move keep their places, but
for what held inputs leave of them, which is proportional to the step.
"""

from typing import TYPE_CHECKING, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from echelon.agents.models.chains import Chains, initial_integrators
from echelon.agents.models.model import ControlAffine
from echelon.agents.models.unlike import UnlikeAgents
from echelon.agents.network.formation_motion import OwnOffset
from echelon.core.errors import LawError
from echelon.core.types import Array, Input, Scalar, State
from echelon.laws.flat_loop import FlatLoop, FlatMemory, Observer, beside_turns, chain_weights
from echelon.laws.law import LocalView

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

_INSTANT = 1e-12
"""Of a root times the period; a shorter one is none."""


@final
class UnlikeLoop(eqx.Module):
    """The inner loop of an agent of one of several groups; it has the methods of `FlatLoop`.

    Attributes:
        loops: of each group.
        chains: of all outputs and inputs: the longest of each.
        weights, stiffness: of the longest chains, as in `FlatLoop`.
        roots: (r - 1,) of q, 1/s.
        leading: the group of the leader.
        present: the groups of the agents under the law.
        observer: of all.
        angles: which outputs are angles.
    """

    loops: tuple[FlatLoop, ...]
    chains: Chains = eqx.field(static=True)
    weights: Array
    stiffness: Array
    roots: tuple[float, ...] = eqx.field(static=True)
    leading: int = eqx.field(static=True)
    present: tuple[int, ...] = eqx.field(static=True)
    observer: Observer = eqx.field(static=True)
    angles: tuple[int, ...] = eqx.field(static=True, default=())

    @classmethod
    def of(
        cls,
        model: UnlikeAgents,
        loops: "Sequence[FlatLoop]",
        roots: tuple[float, ...],
        agents: "Iterable[int]",
    ) -> "UnlikeLoop":
        """Return it for some agents, of the loops of all groups; the longest has all roots (1/s).

        Raises:
            LawError: the scale of the thrust is to be estimated.
        """
        observer, degrees, angles = loops[0].observer, dict[str, int](), dict[str, None]()
        if observer.scale:
            raise LawError("got `scale` of the observer for unlike agents, allowed is 0.")
        for loop in loops:
            names = loop.chains.outputs
            for name, degree in zip(names, loop.chains.degrees, strict=True):
                degrees[name] = max(degrees.get(name, 1), degree)
            angles |= dict.fromkeys(names[k] for k in loop.angles)
        outputs = tuple(degrees)
        integrators = sum((tuple(loop.chains.integrators) for loop in loops), start=())
        chains = Chains(outputs, tuple(degrees.values()), integrators)
        weights, stiffness = chain_weights(chains.degrees, roots)
        turning = tuple(sorted(map(outputs.index, angles)))
        rest = roots, model.own_kind, model.kinds_of(agents), observer, turning
        return cls(tuple(loops), chains, weights, stiffness, *rest)

    # ---- whose is what ----

    def outputs_of(self, kind: int) -> Array:
        """Return where the outputs of a group are among all."""
        return np.array([self.chains.outputs.index(x) for x in self.loops[kind].chains.outputs])

    def ahead_of(self, kind: int, ahead: jax.Array | Array) -> jax.Array:
        """Return what is ahead, (r, m), in the outputs of a group."""
        return jnp.asarray(ahead)[: len(self.loops[kind].weights), self.outputs_of(kind)]

    def filters_of(self, kind: int) -> Array:
        """Return which roots (r - 1, m) an output's own chain lacks; none of what it carries."""
        rows, at = np.arange(len(self.roots))[:, None], self.outputs_of(kind)
        whole, lacks = (
            np.array(self.chains.degrees),
            np.zeros((len(rows), len(self.stiffness)), bool),
        )
        own = np.array(self.loops[kind].chains.degrees)
        lacks[:, at] = (rows >= own - 1) & (rows < whole[at] - 1)
        return lacks

    def of_leader(self, path: jax.Array) -> jax.Array:
        """Return a path (r + 1, m), which stays at 0 in outputs that the leader does not have."""
        has = np.isin(np.arange(path.shape[1]), self.outputs_of(self.leading))
        return jnp.where(has, path, 0.0)

    def _chain_of(self, kind: int) -> slice:
        ends = np.cumsum([0, *(loop.chains.size for loop in self.loops)]).tolist()
        return slice(ends[kind], ends[kind + 1])

    def _memory_of(self, model: UnlikeAgents, kind: int, memory: FlatMemory) -> FlatMemory:
        at, loop, heading = self.outputs_of(kind), self.loops[kind], None
        if loop.angles and memory.heading is not None:
            mine = [self.angles.index(at[k]) for k in loop.angles]
            heading = memory.heading[np.array(mine)]
        return FlatMemory(
            memory.chain[self._chain_of(kind)],
            memory.rate[at],
            memory.delivered[model.inputs_of(kind)],
            memory.base[at],
            memory.push[at],
            memory.half,
            heading=heading,
        )

    def _with(
        self, model: UnlikeAgents, x: State, each: "Sequence[FlatMemory]", memory: FlatMemory
    ) -> FlatMemory:
        """Return the memory with that of the agent's group; of the other groups it is zero."""
        zero, wholes = self.zero_memory(), list[tuple[jax.Array, ...]]()
        for k, own in zip(self.present, each, strict=True):
            at = self.outputs_of(k)
            wholes.append(
                (
                    zero.chain.at[self._chain_of(k)].set(own.chain),
                    zero.delivered.at[model.inputs_of(k)].set(own.delivered),
                    zero.base.at[at].set(own.base),
                    zero.push.at[at].set(own.push),
                    own.half,
                )
            )
        chain, delivered, base, push, half = model.chosen(x, wholes, self.present)
        return memory._replace(chain=chain, delivered=delivered, base=base, push=push, half=half)

    # ---- memory ----

    def zero_memory(self) -> FlatMemory:
        """Return a memory of zeros."""
        zero, inputs = jnp.zeros(len(self.stiffness)), jnp.zeros(len(self.chains.integrators))
        memory = jnp.zeros(self.chains.size), zero, inputs, zero, zero, jnp.zeros(())
        carried = jnp.zeros((1 + len(self.roots), len(zero)))
        return self.beside(FlatMemory(*memory, carried=carried), zero)

    def begin(
        self, model: ControlAffine, x: State, ahead: jax.Array, moves: bool = False
    ) -> FlatMemory:
        """Return the memory of an agent that begins at x, with what is ahead (r, m).

        Filters begin at rest, unless the agent moves along what is ahead.
        """
        assert isinstance(model, UnlikeAgents)
        each, filters = list[FlatMemory](), list[jax.Array]()
        for k in self.present:
            loop = self.loops[k]
            own, part, mine = model.models[k], model.part(k, x), self.ahead_of(k, ahead)
            e = initial_integrators(own, loop.chains, part, mine)
            each.append(loop.initial_memory(own, part, e))
            level = self._level(k, ahead)
            filters.append(level if moves else jnp.zeros_like(level))
        # What it does not have begins at 0, where `output` has it too.
        carried = jnp.pad(model.chosen(x, filters, self.present), ((1, 0), (0, 0)))
        memory = self.zero_memory()._replace(carried=carried)
        memory = self._with(model, x, each, jax.tree.map(lambda y: y.astype(x.dtype), memory))
        return self.beside(memory, self.stop(ahead))

    def _level(self, kind: int, ahead: jax.Array) -> jax.Array:
        """Return the filters (r - 1, m) of an agent that moves along what is ahead (r, m)."""
        lacks, speeds = self.filters_of(kind), jnp.concatenate([ahead[1:], 0.0 * ahead[:1]])
        own, at, rows = self.loops[kind], self.outputs_of(kind), list[jax.Array]()
        weights = jnp.zeros(self.weights.shape).at[0].set(1.0)
        weights = weights.at[: len(own.weights), at].set(own.weights)
        for row, root in zip(lacks, self.roots, strict=True):
            rows.append(jnp.where(row, (weights * speeds).sum(axis=0), 0.0))
            # (D / root + 1) q(D), of which one more derivative is taken.
            later = jnp.concatenate([0.0 * weights[:1], weights[:-1] / root])
            weights = jnp.where(row, weights + later, weights)
        return jnp.stack(rows) if rows else 0.0 * ahead[:0]

    def beside(self, memory: FlatMemory, place: jax.Array) -> FlatMemory:
        """Return the memory of an agent that takes its angles next to those of a place (m,)."""
        angles = np.array(self.angles, int)
        return memory._replace(heading=place[angles]) if self.angles else memory

    # ---- coordinates ----

    def stop(self, values: jax.Array) -> jax.Array:
        """Return zeta (m,) of flat coordinates (r, m) by the longest chains."""
        return (jnp.asarray(self.weights, values.dtype) * values).sum(axis=0)

    def place(self, model: ControlAffine, x: State, offset: State, memory: FlatMemory) -> jax.Array:
        """Return zeta less the offset, (m,): where the agent would come to rest."""
        assert isinstance(model, UnlikeAgents) and memory.carried is not None
        names, each, stages = model.state_names, list[jax.Array](), memory.carried[1:]
        known = [offset[names.index(y)] if y in names else 0.0 * x[0] for y in self.chains.outputs]
        carried = memory.carried[0] - jnp.stack(known)
        for k in self.present:
            loop = self.loops[k]
            own, part = model.models[k], model.part(k, x)
            place = loop.stop(loop.flat_values(own, part, self._memory_of(model, k, memory)))
            place = place - loop.shift(own, offset[model.states_of(k)])
            roots = np.array(self.roots)[:, None]
            ahead = jnp.where(self.filters_of(k), stages / roots, 0.0).sum(axis=0)
            at = self.outputs_of(k)
            each.append(carried.at[at].set(place + ahead[at]))
        return beside_turns(model.chosen(x, each, self.present), memory.heading, self.angles)

    def _filtered(
        self, kind: int, rate: jax.Array, stages: jax.Array, period: Scalar | float
    ) -> tuple[jax.Array, jax.Array]:
        """Return the mean of a rate (m,) behind the filters of a group, and their states after.

        Each is w' = root (v - w) with v held, so that zeta moves by the rate times the period.
        """
        lacks, after = self.filters_of(kind), list[jax.Array]()
        for row, root, w in reversed(list(zip(lacks, self.roots, stages, strict=True))):
            left = jnp.exp(-root * period)
            mean = rate + (w - rate) * (1.0 - left) / jnp.maximum(root * period, _INSTANT)
            after.append(jnp.where(row, rate + (w - rate) * left, 0.0))
            rate = jnp.where(row, mean, rate)
        return rate, jnp.stack(after[::-1]) if after else stages

    # ---- a step ----

    def obey(
        self,
        model: ControlAffine,
        view: LocalView,
        rate: jax.Array,
        memory: FlatMemory,
        offset_rate: State | None = None,
    ) -> tuple[Input, FlatMemory]:
        """Return the physical input that makes zeta move at a rate (m,), and the next memory."""
        assert isinstance(model, UnlikeAgents)
        rows = [self._obeyed(k, model, view, rate, memory) for k in self.present]
        inputs, each, stages = zip(*rows, strict=True)
        place = self.place(model, view.x, view.offset, memory)
        carried = model.chosen(view.x, stages, self.present)
        memory = self.beside(memory._replace(rate=rate, carried=carried), place)
        return model.chosen(view.x, inputs, self.present), self._with(model, view.x, each, memory)

    def _obeyed(
        self, kind: int, model: UnlikeAgents, view: LocalView, rate: jax.Array, memory: FlatMemory
    ) -> tuple[Input, FlatMemory, jax.Array]:
        """Return the input of an agent of a group, its memory, and what it carries."""
        assert memory.carried is not None
        at, inputs = self.outputs_of(kind), jnp.zeros(len(model.input_names), view.x.dtype)
        known = model.part(kind, view.x), view.offset[model.states_of(kind)]
        own = eqx.tree_at(lambda v: (v.x, v.offset), view, known)
        passed, after = self._filtered(kind, rate, memory.carried[1:], view.period)
        mine = self._memory_of(model, kind, memory)
        u, mine = self.loops[kind].obey(model.models[kind], own, passed[at], mine)
        held = (memory.carried[0] + view.period * rate).at[at].set(0.0)
        carried = jnp.concatenate([held[None], after])
        return inputs.at[model.inputs_of(kind)].set(u), mine, carried

    def stopping_offset(
        self, model: ControlAffine, own: OwnOffset, t: Scalar
    ) -> tuple[State, State]:
        """Refuse offsets that move."""
        raise LawError("a formation that moves is of agents of one model, and these are unlike.")

    def settle(
        self,
        model: ControlAffine,
        x: State,
        desired: Input,
        delivered: Input,
        memory: FlatMemory,
        period: Scalar | float,
    ) -> FlatMemory:
        """Return the memory after the actuators delivered `delivered` of the `desired` input."""
        assert isinstance(model, UnlikeAgents)
        each = list[FlatMemory]()
        for k in self.present:
            loop = self.loops[k]
            own, at = model.models[k], model.inputs_of(k)
            mine = self._memory_of(model, k, memory)
            part = model.part(k, x)
            each.append(loop.settle(own, part, desired[at], delivered[at], mine, period))
        return self._with(model, x, each, memory)
