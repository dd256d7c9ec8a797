"""Whether a plant that differs from the model, or a push that lasts, carries a leader away.

The law computes zeta' as the model has it. Where the plant follows the path, it differs by the
speeds and accelerations of outputs that the model lacks in that state, at that input; agreement has
to make up for their mean, and has a speed of s alone (theory page, T5).
"""

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
from echelon.core.statement import Hypothesis, Statement, fails
from echelon.core.types import State
from echelon.core.words import Kind
from echelon.guarantees.stopping.stopping_run import StoppingRun
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
    """What the model lacks while the plant follows the path, at times (T,) and of outputs (m,).

    Attributes:
        current: of the outputs' speeds, (T, m).
        force: of their accelerations, (T, m).
        left: by how much the plant does not follow the path, (T,).
    """

    current: jax.Array
    force: jax.Array
    left: jax.Array


def leader_drift_line(run: StoppingRun) -> Statement | None:
    """Return why what lasts carries the leader away for ever; None where it does not."""
    world, loop = run.parts.world, run.leader.ready
    if world.plant is None and world.disturbance is None:
        return None
    missing = _missing_on_path(run)
    if not np.asarray(missing.left).max() <= _FOLLOWED:
        text = "no motion of the plant along the leader's path is known, and it may drift away"
        return _fails(text, "choose a plant or a disturbance nearer to the model")
    current, force = (np.asarray(part).mean(axis=0) for part in missing[:2])
    for k, degree in enumerate(loop.chains.degrees):
        s, inner = run.leader.speed_of(k), degree > 1
        # The observer watches y' as the model has it, and of what is commanded at once y itself.
        seen = run.leader.observer
        flow = 0.0 if seen and not inner else float(current[k])
        push = float(loop.weights[1, k] * force[k]) if inner and not seen else 0.0
        if abs(flow + push) >= s:
            return _drifts(loop.chains.outputs[k], flow, push, s, inner)
    return None


def _drifts(name: str, current: float, force: float, s: float, inner: bool) -> Statement:
    """Say what a current, and a force by what it asks of agreement, do to a leader of speed s."""
    asked = abs(current + force)
    what = " and ".join(word for word, d in (("current", current), ("push", force)) if d)
    text = (
        f"a lasting {what} along `{name}` demands a speed of {at_least(asked)} from agreement, the "
    )
    text += f"leader's is {about(s)}, and it can drift away for ever"
    helps = "" if inner and abs(current) >= s else "set `observer: true`, or "
    remedy = f"{helps}raise the leader's `speed` above {at_least(asked)}"
    return _fails(text, remedy, asked, f"{at_least(asked)}")


def _fails(text: str, remedy: str, number: float | None = None, shown: str = "") -> Statement:
    name = Hypothesis.EXACT_STATES
    return fails(name, Kind.PROOF, text, number, shown, remedy=remedy, reason=text)


def _missing_on_path(run: StoppingRun) -> _Missing:
    """Return what the model lacks along the leader's path until the horizon."""
    world, model, leader = run.parts.world, run.parts.model, run.leader
    push = np.zeros(len(model.state_names))
    if world.disturbance is not None:
        push = model.per_state(world.disturbance.constant)
    x, u = (np.asarray(part, float)[None] for part in model.trim)
    times = np.zeros(1)
    if isinstance(leader.reference, Reference):
        times = np.modf(_GOLDEN * np.arange(_TIMES))[0] * run.settings.horizon
        x, u = follow_at(model, leader.reference, times)
    path = np.asarray(_path(leader, model, jnp.asarray(times)))[:, :3]
    plant = world.plants.get(run.parts.graph.leaders[0], world.plant_for(model))
    driven = _Driven(model, plant, leader.ready, jnp.asarray(push))
    return _missing(driven, *map(jnp.asarray, (path, x, u)))


@cached_jit
def _path(leader: StoppingLeader, model: ControlAffine, times: jax.Array) -> jax.Array:
    return jax.vmap(lambda t: leader.path(model, t))(times)


class _Driven(NamedTuple):
    """A plant under a push, driven through integrators; z = (x, e, w) are its states and inputs."""

    model: ControlAffine
    plant: ControlAffine
    loop: FlatLoop
    push: jax.Array

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
        """Return x, e and w."""
        end = self.states + self.loop.chains.size
        return z[: self.states], z[self.states : end], z[end:]

    def input(self, z: jax.Array) -> jax.Array:
        """Return the physical input."""
        _, e, w = self.parts(z)
        return self.model.physical(self.loop.chains.acting_input(e, w))

    def output(self, x: State) -> jax.Array:
        """Return the flat outputs (m,)."""
        return flat_output(self.model, self.loop.chains.outputs, x)

    def moved(self, z: jax.Array) -> jax.Array:
        """Return the rate of z."""
        x, e, w = self.parts(z)
        pushed = self.plant.velocity(x, self.input(z)) + self.push
        return jnp.concatenate([pushed, self.loop.chains.rate(e, w), jnp.zeros_like(w)])

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

        more = self.plant.velocity(x, u) + self.push - self.model.velocity(x, u)
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
