"""Whether a plant that differs from the model, or wind that lasts, carries an agent away.

The law computes zeta' as the model has it. Where the plant follows the path, it differs by the
speeds and accelerations of outputs that the model lacks in that state, at that input; agreement has
to make up for their mean, and has a speed of s alone (theory page, T5).
"""

from collections.abc import Hashable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from echelon.agents.models.chains import flat_output
from echelon.agents.models.model import ControlAffine
from echelon.agents.references.flatness import follow_at
from echelon.agents.references.reference import Reference
from echelon.core.compiled import cached_jit
from echelon.core.digits import about, at_least
from echelon.core.identity import process_key
from echelon.core.statement import Hypothesis, Statement, fails
from echelon.core.types import Array, State
from echelon.core.words import Feedforward, Kind
from echelon.guarantees.stopping.stopping_run import StoppingRun
from echelon.laws.flat_law import FlatLaw
from echelon.laws.flat_loop import FlatLoop
from echelon.laws.stopping_point import StoppingLeader

_TIMES = 256
"""Of the path, so many that its mean is known; spread evenly, and in step with no period."""
_GOLDEN = 0.5 * (5.0**0.5 - 1.0)
_ROUNDS = 12
"""Of Newton's method, which begins at the model's own motion."""
_FOLLOWED = 1e-6
"""What is left of a derivative of an output where the plant follows the path."""


class _Missing(NamedTuple):
    """The model lacks speeds and accelerations (T, m); the plant leaves its path by `left` (T,)."""

    current: jax.Array
    force: jax.Array
    left: jax.Array


def drift_line(run: StoppingRun) -> Statement | None:
    """Return why what lasts carries an agent away for ever; None where it carries none away.

    A leader makes up for it by its own speed of agreement. Followers receive what it commands, or
    what their parent does, and make up for what moves them more or less than the sender.
    """
    world, model, graph = run.parts.world, run.parts.model, run.parts.graph
    if world.plant is None and world.disturbance is None and not world.plants:
        return None
    plants = [world.plants.get(k) or world.plant_for(model) for k in range(graph.agents)]
    laws = {k: run.leader if k in graph.leaders else run.law for k in range(graph.agents)}
    moves = dict[Hashable, _Lasting | None]()
    lasting = list[_Lasting]()
    for k, plant in enumerate(plants):
        key = process_key(plant) or id(plant), laws[k].ready.observer
        if key not in moves:
            moves[key] = _lasting(run, laws[k], plant)
        one = moves[key]
        if one is None:
            text = f"no motion of the plant of agent {k} along the leader's path is known, and it "
            return _fails(f"{text}may drift away", "choose a plant nearer to the model")
        lasting.append(one)
    parents = graph.parents() if run.law.feedforward is Feedforward.PARENT else None
    for k in (*graph.leaders, *graph.followers):
        law = laws[k]
        senders = graph.leaders if parents is None else (int(parents[k]),)
        against = [_Lasting.none(law)] if law is run.leader else [lasting[j] for j in senders]
        for other in against:
            whose = "the leader's" if law is run.leader else "the followers'"
            line = _drifts(k, law, whose, lasting[k].less(other))
            if line is not None:
                return line
    return None


class _Lasting(NamedTuple):
    """What lasts, (m,), as speeds; `push` is what an acceleration demands of agreement."""

    current: Array
    push: Array

    @classmethod
    def none(cls, law: FlatLaw) -> "_Lasting":
        return cls(*np.zeros((2, len(law.ready.chains.degrees))))

    def less(self, other: "_Lasting") -> "_Lasting":
        return _Lasting(self.current - other.current, self.push - other.push)


def _lasting(run: StoppingRun, law: FlatLaw, plant: ControlAffine) -> _Lasting | None:
    """Return what lasts of an agent under a law; None where its plant does not follow the path."""
    missing = _missing_on_path(run, law.ready, plant)
    if not np.asarray(missing.left).max() <= _FOLLOWED:
        return None
    current, force = (np.asarray(part, float).mean(axis=0) for part in missing[:2])
    inner = np.array(law.ready.chains.degrees) > 1
    if law.ready.observer:
        # It watches y' as the model has it, and of what is commanded at once y itself.
        return _Lasting(np.where(inner, current, 0.0), 0.0 * force)
    return _Lasting(current, np.where(inner, law.ready.weights[1:2].sum(axis=0) * force, 0.0))


def _drifts(agent: int, law: FlatLaw, whose: str, lasting: _Lasting) -> Statement | None:
    chains = law.ready.chains
    for k, (name, degree) in enumerate(zip(chains.outputs, chains.degrees, strict=True)):
        current, push, s = float(lasting.current[k]), float(lasting.push[k]), law.speed_of(k)
        asked = abs(current + push)
        if not asked >= s:
            continue
        what = " and ".join(word for word, d in (("current", current), ("push", push)) if d)
        text = (
            f"a lasting {what} along `{name}` demands a speed of {at_least(asked)} from agreement, "
            f"that of agent {agent} is {about(s)}, and it can drift away for ever"
        )
        helps = "" if degree > 1 and abs(current) >= s else "set `observer: true`, or "
        remedy = f"{helps}raise {whose} `speed` above {at_least(asked)}"
        return _fails(text, remedy, asked, f"{at_least(asked)}")
    return None


def _fails(text: str, remedy: str, number: float | None = None, shown: str = "") -> Statement:
    name = Hypothesis.EXACT_STATES
    return fails(name, Kind.PROOF, text, number, shown, remedy=remedy, reason=text)


def _missing_on_path(run: StoppingRun, loop: FlatLoop, plant: ControlAffine) -> _Missing:
    world, model, leader = run.parts.world, run.parts.model, run.leader
    push, air = np.zeros(len(model.state_names)), np.zeros((2, len(model.state_names)))
    if world.disturbance is not None:
        wind = world.disturbance.prepared(plant, run.settings.dt, run.settings.seed)
        push, air = wind.constant, air if wind.air is None else wind.air
    x, u = (np.asarray(part, float)[None] for part in model.trim)
    times = np.zeros(1)
    if isinstance(leader.reference, Reference):
        times = np.modf(_GOLDEN * np.arange(_TIMES))[0] * run.settings.horizon
        x, u = follow_at(model, leader.reference, times)
    path = np.asarray(_path(leader, model, jnp.asarray(times)))[:, :3]
    driven = _Driven(model, plant, loop, jnp.asarray(push), jnp.asarray(air))
    return _missing(driven, *map(jnp.asarray, (path, x, u)))


@cached_jit
def _path(leader: StoppingLeader, model: ControlAffine, times: jax.Array) -> jax.Array:
    return jax.vmap(lambda t: leader.path(model, t))(times)


class _Driven(NamedTuple):
    """A plant under wind, driven through integrators; z = (x, e, w) are its states and inputs."""

    model: ControlAffine
    plant: ControlAffine
    loop: FlatLoop
    push: jax.Array
    air: jax.Array

    @property
    def states(self) -> int:
        """How many entries of z are the state."""
        return len(self.model.state_names)

    def beginning(self, x: State, u: jax.Array) -> jax.Array:
        """Return z of a state and a physical input."""
        v, e = self.model.normalized(u), jnp.zeros(self.loop.chains.size, x.dtype)
        for k, at in enumerate(self.loop.chains.indices):
            e, v = (e.at[at[0]].set(v[k]), v.at[k].set(0.0)) if at else (e, v)
        return jnp.concatenate([x, e, v])

    def parts(self, z: jax.Array) -> tuple[State, jax.Array, jax.Array]:
        end = self.states + self.loop.chains.size
        return z[: self.states], z[self.states : end], z[end:]

    def input(self, z: jax.Array) -> jax.Array:
        _, e, w = self.parts(z)
        return self.model.physical(self.loop.chains.acting_input(e, w))

    def output(self, x: State) -> jax.Array:
        """Return the flat outputs (m,)."""
        return flat_output(self.model, self.loop.chains.outputs, x)

    def velocity(self, x: State, u: jax.Array) -> State:
        drag, wind = self.air
        return self.plant.velocity(x, u) + self.push + drag * (wind - x)

    def moved(self, z: jax.Array) -> jax.Array:
        x, e, w = self.parts(z)
        return jnp.concatenate(
            [self.velocity(x, self.input(z)), self.loop.chains.rate(e, w), jnp.zeros_like(w)]
        )

    def derivatives(self, z: jax.Array) -> jax.Array:
        """Return the flat outputs with their first two derivatives, (3, m)."""

        def along(z: jax.Array) -> tuple[jax.Array, jax.Array]:
            return jax.jvp(lambda z: self.output(z[: self.states]), (z,), (self.moved(z),))

        (y, speed), (_, pull) = jax.jvp(along, (z,), (self.moved(z),))
        return jnp.stack([y, speed, pull])

    def lacks(self, z: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return what the model lacks of the outputs' speeds and accelerations, (m,) each."""
        x, u = z[: self.states], self.input(z)

        def speed(x: State) -> jax.Array:
            return jax.jvp(self.output, (x,), (self.model.velocity(x, u),))[1]

        more = self.velocity(x, u) - self.model.velocity(x, u)
        return jax.jvp(self.output, (x,), (more,))[1], jax.jvp(speed, (x,), (more,))[1]


@cached_jit
def _missing(driven: _Driven, path: jax.Array, states: jax.Array, inputs: jax.Array) -> _Missing:
    """Return what the model lacks where the plant has the derivatives of a path, (T, r, m)."""
    orders = path.shape[1]
    # Of an output that an input moves at once, its acceleration is any.
    asked = np.arange(orders)[:, None] <= np.minimum(driven.loop.chains.degrees, 2)
    # With an observer currents alone matter, which are the same in a state nearby.
    rounds = 0 if driven.loop.observer else _ROUNDS

    def one(x: State, u: jax.Array, there: jax.Array) -> _Missing:
        def off(z: jax.Array) -> jax.Array:
            return jnp.where(asked, driven.derivatives(z)[:orders] - there, 0.0).ravel()

        def improved(_: int, z: jax.Array) -> jax.Array:
            # The least change, since rates of the attitude, say, are free.
            return z - jnp.linalg.pinv(jax.jacfwd(off)(z), rtol=1e-9) @ off(z)

        z = driven.beginning(x, u)
        z = jax.lax.fori_loop(0, rounds, improved, z) if rounds else z
        return _Missing(*driven.lacks(z), jnp.abs(off(z)).max() if rounds else jnp.zeros(()))

    return jax.vmap(one)(states, inputs, path)
