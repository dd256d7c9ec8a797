"""The order of a step: agents sense, say, hear, look around, act, write and move."""

from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from echelon.core.compiled import cached_jit
from echelon.core.types import Array, Inputs, PyTree, State, States
from echelon.simulation.step.distances import closest_two
from echelon.simulation.step.loop import Loop
from echelon.simulation.step.meter import Sums, reference_at
from echelon.simulation.step.records import (
    Clock,
    ComponentMemory,
    Control,
    Known,
    LawMemories,
    LoopState,
    Mask,
    Own,
    Steps,
    choose,
)
from echelon.simulation.step.run_laws import Sayings, limit_sides


@cached_jit
def begin(loop: Loop, states: States) -> LoopState:
    """Return the moment at which a run begins from states (N, n)."""
    states, model = jnp.asarray(states), loop.model
    laws = loop.laws.begin(model, states)
    cut = jnp.zeros((len(states), len(model.input_names)), jnp.int8)
    now = LoopState(jnp.zeros((), jnp.int32), states, cut, ComponentMemory(laws))
    own = jax.eval_shape(lambda x: loop.laws.owners[0][0].begin(model, x), states[0])
    network = loop.network.begin(loop, said_by(loop, now), loop.laws.message_size(model, own))
    memory = now.memory._replace(
        sensing=jax.vmap(lambda x: loop.sensing.begin(model, x))(states),
        plant=jax.vmap(loop.motion.begin)(states),
        network=network,
        near=loop.surroundings.begin(loop, states, laws),
        roster=loop.roster.begin(states),
    )
    return now._replace(memory=memory)


def begin_forgetful(loop: Loop, states: Any) -> LoopState:
    """Return it for laws without memory, without JAX: one of its calls costs many steps."""
    # `Any`, since NumPy's arrays are where a moment has JAX's until the first step.
    cut: Any = np.zeros((len(states), len(loop.model.input_names)), np.int8)
    step: Any = np.zeros((), np.int32)
    laws = LawMemories(loop.laws.leader.init(), loop.laws.follower.init())
    plant = ((),) * len(loop.motion.weather), ()
    return LoopState(step, states, cut, ComponentMemory(laws, plant=plant))


@cached_jit
def said_by(loop: Loop, now: LoopState) -> Float[jax.Array, "N s"]:
    """Return what all agents say who know their states exactly (N, s)."""
    return saying(loop, now.states, now.memory.laws, Steps(now.step, loop.motion.dt))[1]


def saying(loop: Loop, x: States, laws: LawMemories, clock: Clock) -> tuple[Any, jax.Array]:
    """Return the offsets of both groups at states x, and what all say (N, s)."""
    offsets = loop.places.groups(loop.model, loop.laws, clock.t)
    everywhere = loop.places.of_all(loop.laws, offsets)
    known = Sayings(loop.model, x, everywhere, offsets, laws)
    return offsets, loop.laws.speech.of_all(loop.laws, known)


def hear(loop: Loop, now: LoopState, clock: Clock) -> tuple[Known, PyTree, PyTree]:
    """Return what all know, and what sensing and network remember after it."""
    memory, here = now.memory, loop.roster.here(clock.step)
    numbers = jnp.asarray(loop.laws.numbers)

    # 1. Sense: they know nothing of their true states.
    def sense(own: Any, x: State, number: jax.Array) -> tuple[State, Any]:
        return loop.sensing.read(loop.model, own, x, clock, number)

    x, sensing = jax.vmap(sense)(memory.sensing, now.states, numbers)
    own = Own(numbers, x)
    # 2. Say.
    offsets, said = saying(loop, x, memory.laws, clock)
    # 3. Hear.
    known = Known(clock, here, own, offsets, said, loop.graph.at(clock.step))
    heard, network = loop.network.receive(loop, memory.network, known)
    return known._replace(heard=heard), sensing, network


def control(loop: Loop, now: LoopState, clock: Clock) -> Control:
    """Return what all agents do from a moment on."""
    return act(loop, now, *hear(loop, now, clock))


def act(loop: Loop, now: LoopState, known: Known, sensing: PyTree, network: PyTree) -> Control:
    """Return what all agents do with what they know; the memories are those after hearing it."""
    memory, here = now.memory, known.here
    # 4. Look around.
    near, seen = loop.surroundings.look(loop, memory.near, memory.laws, known)
    known = known._replace(near=near)
    # 5. Act.
    led, followed, speech, network = loop.turns.play(loop, known, memory.laws, network)
    # 6. Write.
    network = loop.network.send(loop, network, known, speech)
    # 7. Deliver: what limits leave is what acts.
    inputs = loop.laws.ordered(led.input, followed.input)
    u = choose(here, inputs, jnp.zeros_like(inputs))
    desired = loop.laws.ordered(led.desired, followed.desired)
    limited, cut = limit_sides(loop.model, u, desired)
    limited, cut = choose(here, (limited, cut), jax.tree.map(jnp.zeros_like, (limited, cut)))
    laws = LawMemories(led.memory, followed.memory)
    sensing = jax.vmap(loop.sensing.acted)(sensing, u)
    memory = memory._replace(laws=laws, sensing=sensing, network=network, near=seen)
    message = loop.laws.ordered(led.message, followed.message)
    return Control(u, limited.any(axis=1), cut, memory, known.said, message)


def held(loop: Loop, mask: Mask, one: LoopState, other: LoopState) -> LoopState:
    """Return the moment in which some agents' bodies are as in `one`, and others' as in `other`."""
    a, b = one.memory, other.memory
    memory = b._replace(
        laws=loop.laws.held(mask, a.laws, b.laws),
        sensing=choose(mask, a.sensing, b.sensing),
        plant=choose(mask, a.plant, b.plant),
    )
    states, cut = choose(mask, (one.states, one.cut), (other.states, other.cut))
    return other._replace(states=states, cut=cut, memory=memory)


def _arrived(loop: Loop, now: LoopState) -> LoopState:
    """Return the moment with those who join in this step."""

    def beside(moment: LoopState, new: jax.Array, there: jax.Array) -> LoopState:
        # Of those that were there before the first one counts.
        other = said_by(loop, now)[jnp.argmax(there)]
        laws = loop.laws.beside(moment.memory.laws, new & there.any(), other)
        return moment._replace(memory=moment.memory._replace(laws=laws))

    def anew(new: jax.Array, states: States) -> LoopState:
        return held(loop, new, begin(loop, states), now)

    return loop.roster.arrived(now, anew, beside)


def _moved(loop: Loop, now: LoopState, acted: Control) -> LoopState:
    """Return the moment one dt later; who is absent stays as it is."""
    rows = now.states, acted.inputs, now.step, jnp.asarray(loop.laws.numbers)
    states, plant = loop.motion.advance(now.memory.plant, *rows)
    cut = acted.cut.astype(jnp.int8)
    after = LoopState(now.step + 1, states, cut, acted.memory._replace(plant=plant))
    before = now.memory
    memory = after.memory._replace(laws=before.laws, sensing=before.sensing, plant=before.plant)
    absent = now._replace(step=after.step, memory=memory)
    return held(loop, loop.roster.here(now.step), after, absent)


# ---- steps ---------------------------------------------------------------------------------------


def step(loop: Loop, now: LoopState) -> LoopState:
    """Return the moment one dt later."""
    now = _arrived(loop, now)
    return _moved(loop, now, control(loop, now, Steps(now.step, loop.motion.dt)))


def measured_step(
    loop: Loop, now: LoopState, reference: Array | None, first: jax.Array | int
) -> tuple[LoopState, Sums]:
    """Return the moment one dt later and its sums; `reference` (S, n) starts at step `first`."""
    now = _arrived(loop, now)
    clock = Steps(now.step, loop.motion.dt)
    acted, here = control(loop, now, clock), loop.roster.here(now.step)
    followed = reference_at(reference, now.step - first, now.states)
    chatter = (acted.cut * now.cut < 0).any(axis=1)
    meter = loop.roster.measured(loop.meter, now.step)
    rows = now.step, now.states, acted.inputs, acted.limited, chatter, followed
    read = meter.read(*rows, loop.places.goals(clock.t))
    read = loop.surroundings.measured(loop, read, now, acted.memory.laws, here)
    read = loop.roster.counted(meter, read, here)
    if meter.paired:
        places = now.states[:, jnp.array(meter.paired)]
        read = read._replace(**closest_two(now.step, places, here))
    return _moved(loop, now, acted), read


Frames: TypeAlias = tuple[Float[jax.Array, "T N n"], Float[jax.Array, "T N m"]]
"""States and inputs at T times."""


@cached_jit
def advance(
    loop: Loop, now: LoopState, counts: jax.Array, reference: Array | None, first: jax.Array | int
) -> tuple[LoopState, Frames, Sums]:
    """Store a frame and take counts[k] steps, for each k.

    Return the last moment, the stored states and inputs, and the sums over the steps. `reference`
    (S, n) is what the leaders follow from the step `first` on.
    """

    def one(_: jax.Array, carry: tuple[LoopState, Sums]) -> tuple[LoopState, Sums]:
        now, sums = measured_step(loop, carry[0], reference, first)
        return now, carry[1].plus(sums)

    def frame(
        carry: tuple[LoopState, Sums], count: jax.Array
    ) -> tuple[tuple[LoopState, Sums], tuple[States, Inputs]]:
        # The first step computes these inputs again, but after the last frame there is none.
        now = _arrived(loop, carry[0])
        stored = (now.states, control(loop, now, Steps(now.step, loop.motion.dt)).inputs)
        return jax.lax.fori_loop(0, count, one, carry), stored

    (now, sums), stored = jax.lax.scan(frame, (now, loop.meter.zero_sums()), counts)
    return now, stored, sums


@cached_jit
def final_states(
    loop: Loop, starts: Float[jax.Array, "S N n"], steps: int
) -> Float[jax.Array, "S N n"]:
    """Return the states (S, N, n) after `steps` steps from each of the starts (S, N, n)."""

    def last(states: States) -> States:
        now = begin(loop, states)
        return jax.lax.fori_loop(0, steps, lambda _, now: step(loop, now), now).states

    return jax.vmap(last)(starts)
