"""The live closed loop: steps for each picture, and knobs that change it without compiling."""

import dataclasses
import math
from collections.abc import Callable, Hashable
from typing import Any, NamedTuple, TypeAlias, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from echelon.agents.models.model import ControlAffine
from echelon.agents.network.channel import NEVER, Channel
from echelon.agents.network.formation import Formation
from echelon.agents.network.hearing import edges_of
from echelon.agents.world.disturbance import Disturbance
from echelon.apps.live.attendance import attendance, room_for_events
from echelon.apps.live.knobs import Knobs, LiveParts
from echelon.core.compiled import cached_jit
from echelon.core.errors import GraphError, MissingExtraError
from echelon.core.numerics import Precision, precision
from echelon.core.types import Array, PyTree
from echelon.experiments.results.lyapunov import fixed_metric, potential
from echelon.laws.law import KeepsApart, Law, Travels
from echelon.laws.safety_check import separations
from echelon.output.viewer.replay import link_shades
from echelon.simulation.engine.jax_stepper import JaxStepper
from echelon.simulation.engine.law_drive import Laws
from echelon.simulation.engine.parts import Parts
from echelon.simulation.engine.prepare import prepare
from echelon.simulation.native import is_installed
from echelon.simulation.native.stepper import NativeStepper
from echelon.simulation.scalars import Unsupported
from echelon.simulation.step.assembly import assemble
from echelon.simulation.step.loop import Loop
from echelon.simulation.step.nearby import all_hulls
from echelon.simulation.step.networks import LateNetwork
from echelon.simulation.step.places import MovingPlaces
from echelon.simulation.step.records import ComponentMemory, LawMemories, LoopState
from echelon.simulation.step.roster import Switches
from echelon.simulation.step.run_laws import FeedforwardFraction
from echelon.simulation.step.sequence import begin
from echelon.simulation.step.settings import Settings
from echelon.synthesis.gains.gain import Gain

_MANY = 200
"""With more agents than this JAX steps them in float32, which takes half the time."""

TurnableStepper: TypeAlias = JaxStepper | NativeStepper
"""Steps agents; a loop that is like the first but for its numbers compiles nothing again."""


class LiveEngine(NamedTuple):
    """A stepper, and the precision in which it computes."""

    stepper: TurnableStepper
    precision: Precision


def choose_stepper(loop: Loop, unlike: Loop, states: Array, settings: Settings) -> LiveEngine:
    """Return what steps a loop: native code wherever it can be made.

    `unlike` differs from it in all numbers that will change.
    """
    by_jax = LiveEngine(
        JaxStepper(loop, states), settings.precision if len(states) <= _MANY else "float32"
    )
    if settings.engine == "jax" or not is_installed() or jax.default_backend() != "cpu":
        return by_jax
    try:
        # In float64: even so it takes a tenth of a picture's time.
        with precision("float64"):
            return LiveEngine(NativeStepper([loop], states, 64, None, variant=unlike), "float64")
    except (Unsupported, MissingExtraError, TypeError):
        # A law that needs its numbers as numbers is traced by JAX as it stands.
        return by_jax


PICTURE = 0.04
"""Seconds between two pictures."""
_FAR = 1e5
"""A state that is as large as this has diverged."""
_AHEAD = 60.0
"""Seconds ahead for which the times of the graph's switches are computed, at least."""


class Picture(NamedTuple):
    """The swarm at a time (s): states (N, n), inputs (N, m), errors (N,), offsets (N, n).

    `reference` (n,) is that of the leaders, None if they follow nothing; `lyapunov` is V, NaN if
    it does not exist; `beyond` (N,) marks the agents whose states or inputs are not finite, or are
    too large for the stepper; `shades` (E,) are those of the links over a network; `apart` is the
    least scaled distance between hulls of agents that keep apart, m, infinite of others; `here`
    (N,) marks who is there, None where all always are.
    """

    time: float
    states: Array
    inputs: Array
    errors: Array
    offsets: Array
    reference: Array | None
    lyapunov: float
    beyond: Array
    shades: Array = np.zeros(0)
    apart: float = math.inf
    here: Array | None = None


@final
class LiveLoop:
    """Agents under laws that are simulated without an end time.

    With `eventful` agents can be lost and join, and shapes change, in no native code.

    Raises:
        EchelonError: a part is malformed or does not fit the others.
    """

    def __init__(
        self, parts: Parts, settings: Settings, panel: LiveParts, eventful: bool = False
    ) -> None:
        disturbance = parts.world.disturbance or Disturbance()
        world = dataclasses.replace(parts.world, disturbance=disturbance)
        parts = room_for_events(parts, settings.dt) if eventful else parts
        prepared = prepare(parts.replace(world=world), settings)
        problem, drive = prepared.problem, prepared.parts.drive
        assert isinstance(drive, Laws)
        with precision("float64"):
            # Checked with the members of a user's parts, which come after all that knobs change.
            assemble(problem, drive.leader, drive.follower)
            loop = assemble(problem._replace(parts=()), drive.leader, drive.follower)
        law = loop.laws.follower
        gain = panel.gain(panel.start)
        if gain is not None:
            law = eqx.tree_at(lambda law: law.gain.inner, law, _inner(gain), is_leaf=_is_none)
        elif panel.start.coupling is not None:
            c = np.asarray(panel.start.coupling)
            law = eqx.tree_at(lambda law: law.coupling, law, c, is_leaf=_is_none)
        # The share of the feed-forward is a number of the loop, so that a knob can change it.
        part = FeedforwardFraction(np.asarray(1.0))
        laws = dataclasses.replace(loop.laws, follower=law, feedforward=part)
        self.panel, self.settings, self.parts = panel, settings, prepared.parts
        self.warnings = prepared.warnings
        self.eventful = eventful
        self.noisy = [k for k, stage in enumerate(loop.sensing.stages) if stage.random]
        self.noises = self._noises(loop)
        self.plain: Loop = self._with_network(loop.replace(laws=laws), panel.start)
        self.potentials: dict[Hashable, Callable[[Array], Array]] = {}
        self.states, self.first = problem.states, 0
        self.measured = list(problem.meter.measured)
        self.nearest, self.here = np.array(parts.graph.nearest_leader()), None
        self.weights = np.asarray(loop.graph.exchange.weights, np.float64)
        self.place = edges_of(parts.graph, loop.graph.exchange)
        self.edge = self.place[0]
        self.count = max(1, round(PICTURE / settings.dt))
        self.offsets = panel.offsets(panel.start)
        self.potential = self._potential(panel.start)
        self.ahead = range(0)
        self._look_ahead(0)
        self._count(panel.start)
        self.loop = self._whole(self.plain)
        # Other in all numbers that knobs change, except for weights.
        other = (np.full(np.shape(leaf), np.nan) for leaf in self._changing(self.plain))
        unlike = self._whole(eqx.tree_at(self._changing, self.plain, tuple(other)))
        engine = choose_stepper(self.loop, unlike, self.states, settings)
        self.stepper = engine.stepper
        self.precision: Precision = engine.precision
        self.restart()

    def _adjustable(self, loop: Loop) -> tuple[PyTree, ...]:
        """Return the numbers that knobs change: the feed-forward's share, and those of the law."""
        laws: Any = loop.laws
        follower, share = laws.follower, laws.feedforward.fraction
        if self.panel.start.coupling is None:
            return (share,)
        if self.panel.parts.drive.gain is None:
            return share, follower.coupling
        gain = follower.gain
        return share, gain.coupling, gain.P, gain.R, gain.R_inverse, gain.inner

    def _changing(self, loop: Loop) -> tuple[PyTree, ...]:
        """Return all numbers that knobs change, except for places and weights."""
        return (*self._adjustable(loop), loop.motion.weather[0].constant, *self._noises(loop))

    def _noises(self, loop: Loop) -> tuple[Array, ...]:
        """Return the deviations of the noise of each stage of the sensing that has one."""
        stages: Any = loop.sensing.stages
        return tuple(stages[k].std for k in self.noisy)

    def _whole(self, plain: Loop) -> Loop:
        """Return a loop with the members of a user's parts, as echelon's own are now."""
        with precision("float64"):
            for part in self.parts.world.parts:
                plain = part.member(plain)
        return plain

    def _look_ahead(self, step: int) -> None:
        schedule, dt = self.parts.graph.schedule, self.settings.dt
        if schedule is None or schedule.period is None or step in self.ahead:
            return
        first = max(0, int(step * dt / schedule.period) - 1)
        horizon = max(_AHEAD, 4.0 * schedule.period)
        switches = Switches(*schedule.switches(dt, horizon, first))
        loop = self.plain.replace(graph=dataclasses.replace(self.plain.graph, switches=switches))
        if loop.roster.changes:
            loop = loop.replace(roster=dataclasses.replace(loop.roster, switches=switches))
        self.plain, self.loop = loop, self._whole(loop)
        # A whole period before the end: a picture that begins in this range also ends in it.
        last = int(first + horizon / schedule.period) * schedule.period
        self.ahead = range(int(switches.steps[0]), int(last / dt) - self.count)

    @property
    def span(self) -> float:
        """Seconds from a picture to the next."""
        return self.count * self.settings.dt

    def restart(self) -> None:
        """Restart from the initial states, with the same knobs."""
        self.proceed(self.states, self.first)

    def proceed(self, states: Float[Array, "N n"], step: int) -> None:
        """Proceed from states at a step, with the same knobs; laws begin without memory."""
        with precision(self.precision):
            now = begin(self.loop, jnp.asarray(states))
            self.now: LoopState = now._replace(step=jnp.asarray(step, jnp.int32))

    def take_over(self, other: "LiveLoop") -> None:
        """Proceed from where another loop of the same laws is, with as much memory as fits."""
        self.proceed(np.asarray(other.now.states, float), other.steps)
        mine, memory, begun = self.now, other.now, self.now.memory

        def same(one: PyTree, two: PyTree) -> PyTree:
            ours, theirs = (jax.tree.structure(x) for x in (one, two))
            shapes = [[np.shape(leaf) for leaf in jax.tree.leaves(x)] for x in (one, two)]
            if ours != theirs or shapes[0] != shapes[1]:
                return one
            return jax.tree.map(lambda x, y: jnp.asarray(y, jnp.asarray(x).dtype), one, two)

        with precision(self.precision):
            kept = ComponentMemory(*map(same, begun, memory.memory))
            kept = kept._replace(
                laws=LawMemories(*map(same, begun.laws, memory.memory.laws)),
                # Whoever returns begins where this loop does.
                roster=self.loop.roster.begin(jnp.asarray(self.states, mine.states.dtype)),
            )
            self.now = mine._replace(memory=kept, cut=same(mine.cut, memory.cut))

    @property
    def engine(self) -> str:
        """What computes the steps, `native` or `jax`."""
        return self.stepper.engine

    @property
    def steps(self) -> int:
        """The number of steps so far."""
        return int(self.now.step)

    @property
    def active(self) -> float:
        """How many others changed the rates of agents that keep apart, in the last step."""
        active = KeepsApart.of(self.loop.laws.follower).active(self.now.memory.laws.follower)
        return 0.0 if active is None else float(np.sum(np.asarray(active)))

    def _apart(self) -> float:
        """Return the least scaled distance between hulls of agents that keep apart, m."""
        safety = self.loop.laws.follower.safety
        if safety is None:
            return math.inf
        with precision(self.precision):
            hulls = np.asarray(_hulls(self.loop, self.now.states, self.now.memory.laws), np.float64)
        hulls = hulls if self.here is None else hulls[self.here]
        gaps = separations(hulls * safety.scales(self.loop.model))
        return float((gaps + np.diag(np.full(len(gaps), np.inf))).min())

    def apply(self, knobs: Knobs) -> None:
        """Change the loop to these positions of the knobs."""
        self.potential = self._potential(knobs)
        self.offsets = self.panel.offsets(knobs)
        self._count(knobs)
        weights = self.weights.copy()
        weights[..., np.isin(self.edge, list(knobs.cut))] = 0.0
        loop = eqx.tree_at(
            lambda loop: (loop.places.offsets, loop.graph.exchange.weights),
            self.plain,
            (self.offsets, weights),
        )
        noises = (knobs.noise * std for std in self.noises)
        numbers = *self._numbers(knobs), self.panel.wind(knobs), *noises
        loop = self._with_network(eqx.tree_at(self._changing, loop, numbers), knobs)
        places = loop.places
        if isinstance(places, MovingPlaces):
            moving = self.panel.motion(knobs, places.motion)
            assert moving is not None
            loop = loop.replace(places=MovingPlaces(places.offsets, moving))
        self.plain, self.loop = loop, self._whole(loop)

    def _count(self, knobs: Knobs) -> None:
        if not self.plain.roster.changes:
            return
        law, graph = self.plain.laws.follower, self.parts.graph
        now = attendance(graph, knobs.events, law.leaderward, self.settings.dt)
        self.plain, self.weights = now.put_into(self.plain), now.weights
        self.here, self.nearest = now.present[-1], now.nearest[-1]

    def _roomy(self, channel: Channel) -> Channel:
        """Return a channel with memory for the longest delay, and the code of outages."""
        most = self.panel.longest_delay or 0.0
        steps = math.ceil(most / self.settings.dt) + int(channel.jitter) + 1
        return dataclasses.replace(channel, slots=steps // int(channel.every) + 2, bursty=True)

    def _with_network(self, loop: Loop, knobs: Knobs) -> Loop:
        network, settings = self.panel.network(knobs), self.settings
        if network is None:
            return loop
        channel = network.prepared(settings.dt, math.inf, settings.seed)
        return loop.with_medium(self._roomy(channel))

    def _numbers(self, knobs: Knobs) -> tuple[PyTree, ...]:
        share, gain = np.asarray(float(knobs.feedforward)), self.panel.gain(knobs)
        if knobs.coupling is None:
            return (share,)
        c = np.asarray(knobs.coupling)
        if gain is None:
            return share, c
        return share, c, gain.P, gain.R, gain.R_inverse, _inner(gain)

    def _potential(self, knobs: Knobs) -> Callable[[Array], Array] | None:
        """Return the function that computes V; None without a P or for a disconnected graph."""
        P, gain = fixed_metric(self.parts), self.panel.gain(knobs)
        moves = self.panel.parts.formation.motion is not None
        if P is None or knobs.roomy or moves:
            return None
        P = P if gain is None else gain.P
        key = knobs.cut, knobs.method, knobs.weight
        if key not in self.potentials:
            try:
                function = potential(self.parts.model, self.panel.graph(knobs), P)
            except GraphError:
                return None
            # Bounded, since turning the knob of the weight passes many values.
            self.potentials = {**dict(list(self.potentials.items())[-16:]), key: function}
        return self.potentials[key]

    def kick(self, agent: int, change: Array) -> None:
        """Add a change (n,) to the state of an agent."""
        states = np.array(self.now.states)
        states[agent] += change
        self.now = self.now._replace(states=states)

    def advance(self, still: bool = False) -> Picture:
        """Return the next picture, or the present one if `still`."""
        self._look_ahead(self.steps)
        # Once a picture, however many knobs were turned since the last one.
        if self.stepper.loop is not self.loop:
            self.stepper.replace_loop(self.loop)
        # A frame at the beginning, from which all steps are taken, and one at the end.
        counts = np.array([0 if still else self.count, 0], np.int32)
        reference = self.reference_at(self.settings.dt * (self.steps + np.arange(self.count + 1)))
        with precision(self.precision):
            chunk = self.stepper.advance(self.now, counts, reference)
        self.now, states, inputs = chunk.now, chunk.states[-1], chunk.inputs[-1]
        time = self.steps * self.settings.dt
        places = self.loop.places
        motion = places.motion if isinstance(places, MovingPlaces) else None
        offsets = Formation(self.offsets, motion).offsets_at([time])[0]
        y, here = states - offsets, self.here
        with np.errstate(over="ignore", invalid="ignore"):
            deviation = (y - y[self.nearest])[:, self.measured]
            errors = np.linalg.norm(deviation, axis=1) * (1.0 if here is None else here)
        valid = np.isfinite(inputs).all(axis=1) & (np.abs(states) < _FAR).all(axis=1)
        # Which agent it is nobody knows.
        valid &= not np.any(chunk.inexact)
        V = float(self.potential(y[None])[0]) if valid.all() and self.potential else np.nan
        desired = None if reference is None else reference[counts[0]]
        beyond = np.logical_not(valid)
        shades = self._shades(int(counts[0]))
        rows = time, states, inputs, errors, offsets, desired, V, beyond, shades
        return Picture(*rows, self._apart(), here)

    def _shades(self, steps: int) -> Float[Array, " E"]:
        """Return how each link is drawn after some steps; nothing in the ideal network."""
        late, network = self.loop.network, self.parts.world.network
        if not isinstance(late, LateNetwork) or network is None:
            return np.zeros(0)
        channel, (posts, mail) = late.medium, self.now.memory.network
        now, every = self.steps, int(channel.every)
        stamps, arrival = np.asarray(mail.stamp), np.asarray(posts.arrival)
        sent = np.arange(-(-(now - steps) // every), -(-now // every))[-channel.slots :]
        gone = (arrival[sent % channel.slots] == NEVER).sum(axis=0)
        edges = len(self.parts.graph.edges)
        ages, lost = np.full((edges, 2), np.nan), np.zeros((edges, 2))
        age = np.where(stamps == NEVER, np.inf, (now - stamps) * self.settings.dt)
        ages[self.place], lost[self.place] = age, gone
        lost[~self.parts.receives] = 0
        return link_shades(ages, lost, network.forget, self.parts.receives)

    def goals(self, picture: Picture) -> Float[Array, "N n"]:
        """Return the goals: of leaders relative to the reference, NaN if they follow nothing."""
        y = picture.states - picture.offsets
        goals = y[self.nearest] + picture.offsets
        leaders = np.unique(self.nearest)
        if picture.reference is None:
            goals[leaders] = np.nan
        else:
            goals[leaders] = picture.reference + picture.offsets[leaders]
        return goals

    def off_reference(self, picture: Picture) -> float:
        """Return the largest distance of a leader from the reference, NaN if there is none."""
        leaders = np.unique(self.nearest)
        away = (picture.states - self.goals(picture))[leaders][:, self.measured]
        return float(np.linalg.norm(away, axis=1).max())

    def reference_at(self, times: Float[Array, " T"]) -> Float[Array, "T n"] | None:
        """Return the leaders' reference states at times (s); None if they follow nothing."""
        with precision("float64"):
            states = _reference_states(self.loop.laws.leader, self.loop.model, jnp.asarray(times))
        return None if states is None else np.asarray(states, np.float64)


@cached_jit
def _reference_states(leader: Law, model: ControlAffine, times: jax.Array) -> jax.Array | None:
    return Travels.of(leader).reference_states(model, times)


_hulls = cached_jit(all_hulls)


def _inner(gain: Gain) -> Array:
    """Return the inner loop of a gain, zero without one, so that either compiles to one."""
    if gain.inner is not None:
        return gain.inner
    return np.zeros((len(gain.R), len(gain.P)))


def _is_none(node: object) -> bool:
    return node is None
