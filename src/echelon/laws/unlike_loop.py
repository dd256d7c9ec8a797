"""The inner loops of unlike agents under the law `stopping-point`, of which each runs its own.

Agents agree on where they would come to rest in all outputs of all groups. An output that an agent
does not have, such as the height of a rover, it carries for the others: as one integrator that
moves at the rate that the law commands.
"""

from typing import TYPE_CHECKING, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from echelon.agents.models.chains import Chains, initial_integrators
from echelon.agents.models.model import ControlAffine
from echelon.agents.models.unlike import UnlikeAgents
from echelon.core.errors import LawError
from echelon.core.types import Array, Input, Scalar, State
from echelon.laws.flat_loop import FlatLoop, FlatMemory, Observer, beside_turns
from echelon.laws.law import LocalView

if TYPE_CHECKING:
    from collections.abc import Sequence


@final
class UnlikeLoop(eqx.Module):
    """The inner loop of an agent of one of several groups; it has the methods of `FlatLoop`.

    Attributes:
        loops: of each group.
        chains: of all outputs and inputs: the longest of each.
        weights, stiffness: of the leader's group, as in `FlatLoop`.
        observer: of all.
        angles: which outputs are angles.
    """

    loops: tuple[FlatLoop, ...]
    chains: Chains = eqx.field(static=True)
    weights: Array
    stiffness: Array
    observer: Observer = eqx.field(static=True)
    angles: tuple[int, ...] = eqx.field(static=True, default=())

    @classmethod
    def of(
        cls, model: UnlikeAgents, loops: "Sequence[FlatLoop]", observer: Observer
    ) -> "UnlikeLoop":
        """Return it of the loops of the groups.

        Raises:
            LawError: the scale of the thrust is to be estimated.
        """
        if observer.scale:
            raise LawError("got `scale` of the observer for unlike agents, allowed is 0.")
        outputs = tuple(dict.fromkeys(name for loop in loops for name in loop.chains.outputs))
        degrees, angles = dict.fromkeys(outputs, 1), set[int]()
        for loop in loops:
            for name, degree in zip(loop.chains.outputs, loop.chains.degrees, strict=True):
                degrees[name] = max(degrees[name], degree)
            angles |= {outputs.index(loop.chains.outputs[k]) for k in loop.angles}
        integrators = sum((tuple(loop.chains.integrators) for loop in loops), start=())
        chains = Chains(outputs, tuple(degrees.values()), integrators)
        first = loops[model.own_kind]
        weights = np.zeros((max(degrees.values()), len(outputs)))
        weights[0], stiffness = 1.0, np.ones(len(outputs))
        at = [outputs.index(name) for name in first.chains.outputs]
        weights[: len(first.weights), at], stiffness[at] = first.weights, first.stiffness
        return cls(tuple(loops), chains, weights, stiffness, observer, tuple(sorted(angles)))

    # ---- whose is what ----

    def outputs_of(self, kind: int) -> Array:
        """Return where the outputs of a group are among all."""
        return np.array([self.chains.outputs.index(x) for x in self.loops[kind].chains.outputs])

    def ahead_of(self, kind: int, ahead: jax.Array | Array) -> jax.Array | Array:
        """Return what is ahead, (r, m), in the outputs of a group."""
        return ahead[: len(self.loops[kind].weights), self.outputs_of(kind)]

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
        for k, own in enumerate(each):
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
        chain, delivered, base, push, half = model.chosen(x, wholes)
        return memory._replace(chain=chain, delivered=delivered, base=base, push=push, half=half)

    # ---- memory ----

    def zero_memory(self) -> FlatMemory:
        """Return a memory of zeros."""
        zero, inputs = jnp.zeros(len(self.stiffness)), jnp.zeros(len(self.chains.integrators))
        memory = jnp.zeros(self.chains.size), zero, inputs, zero, zero, jnp.zeros(())
        return self.beside(FlatMemory(*memory, carried=zero), zero)

    def begin(self, model: ControlAffine, x: State, ahead: jax.Array) -> FlatMemory:
        """Return the memory of an agent that begins at x, with what is ahead (r, m)."""
        assert isinstance(model, UnlikeAgents)
        each, places = list[FlatMemory](), list[jax.Array]()
        for k, loop in enumerate(self.loops):
            own, part = model.models[k], model.part(k, x)
            mine = self.ahead_of(k, ahead)
            e = initial_integrators(own, loop.chains, part, jnp.asarray(mine))
            each.append(loop.initial_memory(own, part, e))
            places.append(ahead[0].at[self.outputs_of(k)].set(loop.stop(jnp.asarray(mine))))
        carried = model.output(x)[self._among(model)]
        memory = self.zero_memory()._replace(carried=carried.astype(x.dtype))
        memory = jax.tree.map(lambda leaf: leaf.astype(x.dtype), memory)
        return self.beside(self._with(model, x, each, memory), model.chosen(x, places))

    def beside(self, memory: FlatMemory, place: jax.Array) -> FlatMemory:
        """Return the memory of an agent that takes its angles next to those of a place (m,)."""
        angles = np.array(self.angles, int)
        return memory._replace(heading=place[angles]) if self.angles else memory

    def _among(self, model: UnlikeAgents) -> Array:
        return np.array([model.output_names.index(name) for name in self.chains.outputs])

    # ---- coordinates ----

    def stop(self, values: jax.Array) -> jax.Array:
        """Return zeta (m,) of flat coordinates (r, m) of the leader's group."""
        return (jnp.asarray(self.weights, values.dtype) * values).sum(axis=0)

    def place(self, model: ControlAffine, x: State, offset: State, memory: FlatMemory) -> jax.Array:
        """Return zeta less the offset, (m,): where the agent would come to rest."""
        assert isinstance(model, UnlikeAgents) and memory.carried is not None
        carried, each = memory.carried - self._carried_offset(model, offset), list[jax.Array]()
        for k, loop in enumerate(self.loops):
            own, mine = model.models[k], self._memory_of(model, k, memory)
            part = model.part(k, x)
            place = loop.stop(loop.flat_values(own, part, mine))
            place = place - loop.shift(own, offset[model.states_of(k)])
            each.append(carried.at[self.outputs_of(k)].set(place))
        return beside_turns(model.chosen(x, each), memory.heading, self.angles)

    def _carried_offset(self, model: UnlikeAgents, offset: State) -> jax.Array:
        names = model.state_names
        own = [offset[names.index(x)] if x in names else 0.0 for x in self.chains.outputs]
        return jnp.asarray(own, offset.dtype) if not own else jnp.stack(list(map(jnp.asarray, own)))

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
        assert isinstance(model, UnlikeAgents) and memory.carried is not None
        inputs, each, place = list[Input](), list[FlatMemory](), None
        none = jnp.zeros(len(model.input_names), view.x.dtype)
        for k, loop in enumerate(self.loops):
            offset = view.offset[model.states_of(k)]
            own = eqx.tree_at(lambda v: (v.x, v.offset), view, (model.part(k, view.x), offset))
            mine = self._memory_of(model, k, memory)
            u, mine = loop.obey(model.models[k], own, rate[self.outputs_of(k)], mine)
            inputs.append(none.at[model.inputs_of(k)].set(u))
            each.append(mine)
        place = self.place(model, view.x, view.offset, memory)
        carried = memory.carried + view.period * rate
        memory = self.beside(memory._replace(rate=rate, carried=carried), place)
        return model.chosen(view.x, inputs), self._with(model, view.x, each, memory)

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
        for k, loop in enumerate(self.loops):
            own, at = model.models[k], model.inputs_of(k)
            mine = self._memory_of(model, k, memory)
            part = model.part(k, x)
            each.append(loop.settle(own, part, desired[at], delivered[at], mine, period))
        return self._with(model, x, each, memory)
