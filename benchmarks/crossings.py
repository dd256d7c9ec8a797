"""Measure collision avoidance under the law `stopping-point`: formations that cross each other.

Run `python benchmarks/crossings.py` (some 20 minutes on two cores; `--share 0.1` is quicker). All
flights of a kind are one compiled program. The figures stand in docs/theory/separation.md.
"""

import argparse
import itertools
import time
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import echelon as ech
from echelon.agents.world.actuator import Actuator
from echelon.agents.world.sensing import Sensing
from echelon.core.numerics import precision
from echelon.core.types import Array
from echelon.simulation.engine.prepare import prepare
from echelon.simulation.step.assembly import assemble
from echelon.simulation.step.loop import Loop
from echelon.simulation.step.places import FixedPlaces
from echelon.simulation.step.records import LoopState
from echelon.simulation.step.sequence import begin, step

MODEL = ech.models.Quadrotor.crazyflie()
RADII = (0.125, 0.125, 0.375)
SCALES = np.array([1.0, 1.0, RADII[0] / RADII[2]])
HOME = (0.0, 0.0, 3.0)
ROOTS = (4.0, 4.5, 5.0)
ARRIVED = 0.05  # m
_TOGETHER = 20  # flights that are stepped at once, which fit into a cache
_EVERY = 10  # steps between two stored distances from the goals


class Crossing(NamedTuple):
    """FixedPlaces (N, 3) of agents at the start, and their offsets from the leader, agent 0."""

    starts: Array
    goals: Array


Kind: TypeAlias = Callable[[int, int], Crossing]


class Flights(NamedTuple):
    """Of F flights: the least scaled distance (m), and when all had arrived (s, or infinite)."""

    least: Array
    arrival: Array


def spread(count: int, size: Array, least: float, draw: np.random.Generator) -> Array:
    """Return places (count, 3) in a box of a size that are so far apart when scaled."""
    places = np.zeros((0, 3))
    while len(places) < count:
        place = draw.uniform(-0.5, 0.5, 3) * size
        if not len(places) or np.linalg.norm((places - place) * SCALES, axis=1).min() > least:
            places = np.vstack([places, place])
    return places


def at_random(count: int, seed: int) -> Crossing:
    """Return agents that cross in a box of 4 x 4 x 2 m."""
    draw, size = np.random.default_rng(seed), np.array([4.0, 4.0, 2.0])
    starts, goals = (spread(count, size, 0.5, draw) for _ in range(2))
    return Crossing(starts - starts[0], goals - goals[0])


def antipodal(count: int, seed: int) -> Crossing:
    """Return agents on a circle that go to the other side of it, past the leader in its middle."""
    draw = np.random.default_rng(seed)
    angles = 2.0 * np.pi * np.arange(count - 1) / (count - 1)
    radius = max(2.0, 0.5 * (count - 1) / (2.0 * np.pi) * 1.5)
    circle = radius * np.stack([np.cos(angles), np.sin(angles), 0.0 * angles], axis=1)
    starts = np.vstack([np.zeros(3), circle + draw.uniform(-0.05, 0.05, circle.shape)])
    return Crossing(starts, np.vstack([np.zeros(3), -circle]))


def parts_of(crossing: Crossing, safety: ech.Safety | None, world: ech.World) -> ech.Parts:
    """Return agents at rest that cross, behind a leader that hovers at its start."""
    count = len(crossing.starts)
    start = np.pad(crossing.starts + HOME, ((0, 0), (0, 9)))
    drive = ech.Laws(
        ech.laws.StoppingLeader(roots=ROOTS, reference=ech.references.Hover(position=HOME)),
        ech.laws.StoppingPoint(roots=ROOTS, safety=safety),
    )
    formation = ech.Formation(np.pad(crossing.goals, ((0, 0), (0, 9))))
    return ech.Parts(MODEL, ech.Graph.star(count), formation, drive, initial=start, world=world)


def flown(
    crossings: list[Crossing],
    safety: ech.Safety | None,
    world: ech.World = ech.World(),
    horizon: float = 15.0,
    dt: float = 0.005,
) -> Flights:
    """Return what crossings of equally many agents come to, each of them checked at its start."""
    settings = ech.Settings(horizon=horizon, dt=dt, engine="jax")
    problems = [prepare(parts_of(one, safety, world), settings) for one in crossings]
    drive = problems[0].parts.drive
    assert isinstance(drive, ech.Laws)
    with precision("float64"):
        loop = assemble(problems[0].problem, drive.leader, drive.follower)
        states = np.stack([one.problem.states for one in problems])
        offsets = np.stack([one.problem.formation.offsets for one in problems])
        count = -(-len(states) // _TOGETHER)
        rounds = zip(np.array_split(states, count), np.array_split(offsets, count), strict=True)
        results = [_fly(loop, *both, settings.steps // _EVERY) for both in rounds]
    least, errors = (np.concatenate([np.asarray(x) for x in part]) for part in zip(*results))
    late = errors > ARRIVED
    last = late.shape[1] - np.argmax(late[:, ::-1], axis=1)
    arrival = np.where(late.any(axis=1), last, 0) * _EVERY * dt
    return Flights(least, np.where(late[:, -1], np.inf, arrival))


@eqx.filter_jit
def _fly(loop: Loop, states: Array, offsets: Array, frames: int) -> tuple[jax.Array, jax.Array]:
    """Return the least scaled distance (F,), and the largest distance from a goal (F, frames)."""
    scales = jnp.asarray(SCALES)

    def one(states: jax.Array, offsets: jax.Array) -> tuple[jax.Array, jax.Array]:
        own = loop.replace(places=FixedPlaces(offsets))

        def each(_: jax.Array, carry: tuple[LoopState, jax.Array]) -> tuple[LoopState, jax.Array]:
            now = step(own, carry[0])
            places = now.states[:, :3] * scales
            squares = ((places[:, None] - places) ** 2).sum(axis=2)
            squares = jnp.where(jnp.eye(len(places), dtype=bool), jnp.inf, squares)
            return now, jnp.minimum(carry[1], squares.min())

        def frame(
            carry: tuple[LoopState, jax.Array], _: None
        ) -> tuple[tuple[LoopState, jax.Array], jax.Array]:
            now, least = jax.lax.fori_loop(0, _EVERY, each, carry)
            away = (now.states - offsets)[:, :3]
            return (now, least), jnp.linalg.norm(away - away[0], axis=1).max()

        start = begin(own, states), jnp.asarray(jnp.inf, states.dtype)
        (_, least), errors = jax.lax.scan(frame, start, None, length=frames)
        return jnp.sqrt(least), errors

    return jax.vmap(one)(jnp.asarray(states), jnp.asarray(offsets))


# ---- tables --------------------------------------------------------------------------------------


def in_words(flights: Flights) -> str:
    """Return the figures of flights."""
    there = np.isfinite(flights.arrival)
    median = np.median(flights.arrival[there]) if there.any() else np.inf
    return (
        f"{len(flights.least):4d} flights: least scaled distance {flights.least.min():.4f}, "
        f"arrived {100.0 * there.mean():.1f} %, median {median:.2f} s"
    )


def crossings_of(kinds: Iterable[Kind], counts: Iterable[int], each: int, **how: Any) -> None:
    """Fly crossings of some kinds with so many agents, and print what they come to."""
    for kind, count in itertools.product(kinds, counts):
        began = time.process_time()
        flights = flown([kind(count, seed) for seed in range(each)], **how)
        seconds = time.process_time() - began
        print(f"{kind.__name__:10} {count:3d} agents: {in_words(flights)} ({seconds:.0f} s)")


def cost(agents: int) -> tuple[float, float]:
    """Return the microseconds of a step of an agent, with and without the filter."""
    safety, times = ech.Safety(radii=RADII), list[float]()
    for how in (safety, None):
        parts = parts_of(antipodal(agents, 0), how, ech.World())
        settings = ech.Settings(horizon=5.0, dt=0.005, engine="jax", store_every=1000)
        # The first run compiles.
        ech.simulate(parts, settings)
        began = time.process_time()
        ech.simulate(parts, settings)
        seconds = time.process_time() - began
        times.append(1e6 * seconds / settings.steps / agents)
    return times[0], times[1]


def main() -> None:
    """Print all tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--share", type=float, default=1.0, help="of the flights")
    parser.add_argument("--only", default="", help="ideal, deadlocks, late or cost")
    chosen = parser.parse_args()

    def some(count: int) -> int:
        return max(1, round(chosen.share * count))

    tight = ech.Safety(radii=RADII, margin=0.0)
    usual = ech.Safety(radii=RADII)
    if chosen.only in ("", "ideal"):
        crossings_of((at_random, antipodal), (6, 10, 14), some(80), safety=tight)
    if chosen.only in ("", "deadlocks"):
        crossings_of((antipodal,), (30,), some(20), safety=usual, horizon=25.0)
    if chosen.only in ("", "late"):
        crossings_of((at_random, antipodal), (6, 10), some(20), safety=usual, world=LATE)
    for agents in (14, 31) if chosen.only in ("", "cost") else ():
        print(
            "{} agents: {:.1f} us an agent and step, {:.1f} without".format(agents, *cost(agents))
        )


LATE = ech.World(
    network=ech.Network(rate=50.0, delay=0.02),
    actuator=Actuator(lag=0.03),
    sensing=Sensing(noise={"position": 1e-3, "velocity": 0.02, "attitude": 3.5e-3, "rate": 0.05}),
)
"""Messages 20 ms late, motors that lag 30 ms, and noise."""

if __name__ == "__main__":
    main()
