"""Attack what is promised on directed and switching graphs: `python benchmarks/arrows.py 1000`.

Three kinds of attack, each on so many random graphs, half of them with arrows alone:

- quadrotors under `stopping-point` from far and steep starts, on arrows of which every third set
  takes turns with another: the least upward acceleration must stay above the tube's bound, and the
  farthest stopping point must not move away;
- linear agents under their Riccati gain at the edge of its coupling: every mode of the network, and
  the weighted sum of T7;
- undirected graphs that take turns, at the edge: the one sum of T8.
"""

import functools
import itertools
import sys
from collections.abc import Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg

import echelon as ech
from echelon.agents.models.chains import chains_of, to_flat
from echelon.core.numerics import precision
from echelon.core.types import Array
from echelon.guarantees.stopping.stopping_run import stopping_run_of
from echelon.guarantees.stopping.tube import tube_of
from echelon.laws.stopping_point import StoppingLeader, StoppingPoint
from echelon.simulation.engine.prepare import prepare
from echelon.simulation.step.assembly import assemble
from echelon.simulation.step.sequence import begin, step

AGENTS, DT, SPAN, BATCH, AGAIN = 5, 0.0005, 0.7, 50, 6
ALL = [(i, j) for i in range(AGENTS) for j in range(1, AGENTS) if i != j]


def reached(draw: np.random.Generator, mutual: int) -> Array:
    """Weights of ALL arrows along which agent 0 reaches everybody; of `mutual` ones both ways."""
    row = draw.exponential(size=len(ALL)) * (draw.random(len(ALL)) < 0.3)
    for j in range(1, AGENTS):
        row[ALL.index((int(draw.integers(j)), j))] += 0.3
    for k, (i, j) in enumerate(ALL):
        if mutual and i > j:
            row[k] = row[ALL.index((j, i))]
    return row


def far(draw: np.random.Generator, states: Array) -> Array:
    """Starts up to 20 m off, at 5 m/s, 63 degrees of roll and pitch, turning, up or down."""
    x = np.array(states)
    others = x[1:]
    others[:, :3] += draw.uniform(-20.0, 20.0, (AGENTS - 1, 3))
    others[:, 3:5] += draw.uniform(-5.0, 5.0, (AGENTS - 1, 2))
    others[:, 5] += draw.uniform(-5.3, 5.3, AGENTS - 1)
    others[:, 6:8] = draw.uniform(-1.1, 1.1, (AGENTS - 1, 2))
    others[:, 8:] = draw.uniform(-3.0, 3.0, (AGENTS - 1, 4))
    return x


def fly(loop: Any, weights: jax.Array, starts: jax.Array, dt: float) -> tuple[jax.Array, jax.Array]:
    """The least z'' and the most that the farthest stopping point moves away (S,), of flights."""
    model, chains, ready = loop.model, chains_of(loop.model), loop.laws.follower.ready

    def flat(now: Any) -> tuple[jax.Array, jax.Array]:
        x, e = now.states[loop.laws.followers], now.memory.laws.follower.chain
        values = jax.vmap(lambda x, e: to_flat(model, chains, x, e).values)(x, e)
        led = to_flat(model, chains, now.states[0], now.memory.laws.leader.chain[0]).values
        stops = jax.vmap(ready.stop)(values[:, : len(ready.weights)])
        return values[:, 2, 2], jnp.abs(stops - ready.stop(led[: len(ready.weights)])).max(axis=0)

    def one(rows: jax.Array, x: jax.Array) -> tuple[jax.Array, jax.Array]:
        mine = eqx.tree_at(lambda each: each.graph.exchange.weights, loop, rows)

        def on(_: jax.Array, done: Any) -> Any:
            now, least, size, rose = done
            lift, away = flat(now)
            after = step(mine, now)
            return (
                after,
                jnp.minimum(least, lift.min()),
                away,
                jnp.maximum(rose, (away - size).max()),
            )

        start = begin(mine, x)
        done = start, jnp.inf, flat(start)[1], -jnp.inf
        found = jax.lax.fori_loop(0, round(SPAN / dt), on, done)
        return found[1], found[3]

    return jax.jit(jax.vmap(one))(weights, starts)


def made(dt: float) -> tuple[Any, Any]:
    """Return prepared parts with their settings, and the loop that takes steps of dt (s)."""
    model = ech.models.Quadrotor()
    shared = {"roots": (4.0, 4.5, 5.0), "observer": False}
    laws = StoppingLeader(**shared), StoppingPoint(coupling=3.0, **shared)
    graph = ech.Graph.switching([(0.0, ALL), (0.25, ALL)], directed=True, period=0.5)
    formation = ech.Formation.from_offsets(model, graph, {})
    settings = ech.Settings(SPAN, dt, limits=False)
    prepared = prepare(ech.Parts(model, graph, formation, ech.Laws(*laws)), settings)
    drive: Any = prepared.parts.drive
    return (prepared, settings), assemble(prepared.problem, drive.leader, drive.follower)


def vehicles(draw: np.random.Generator, count: int) -> Iterator[str]:
    """Attack T5, the worst flights again in steps that are ten times as short."""
    (prepared, settings), loop = made(DT)
    weights, starts, bounds, lows, rose = [], [], [], [], []
    for first in range(0, count, BATCH):
        rows, x = [], []
        for k in range(first, first + BATCH):
            now = reached(draw, k % 2)
            rows.append([now, reached(draw, k % 2) if k % 3 == 0 else now])
            x.append(far(draw, prepared.problem.states))
        least, up = fly(loop, jnp.asarray(np.array(rows)), jnp.asarray(np.array(x)), DT)
        for state in x:
            run = stopping_run_of(prepared.parts, settings, state)
            tube = None if run is None else tube_of(run).tube
            bounds.append(tube.left - loop.model.gravity if tube else -np.inf)
        weights, starts = weights + rows, starts + x
        lows, rose = lows + np.asarray(least).tolist(), rose + np.asarray(up).tolist()
    slack = np.array(lows) - np.array(bounds)
    promised, below = np.isfinite(slack).sum(), (slack < 0.0).sum()
    yield f"vehicles: {count} flights, {promised} promised, {below} below their bound"
    yield f"  z'' stays {slack.min():.3g} m/s^2 above its bound, with inputs held for {DT:g} s"
    yield f"  the farthest stopping point moves away by {max(rose):.2g} m a step at most"
    worst = np.union1d(np.argsort(slack)[:AGAIN], np.argsort(rose)[-AGAIN:])
    some = (jnp.asarray(np.array(part)[worst]) for part in (weights, starts))
    least, up = fly(made(DT / 10.0)[1], *some, DT / 10.0)
    finer = np.asarray(least) - np.array(bounds)[worst]
    yield f"  the {len(worst)} worst again, held for a tenth: {finer.min():.3g} m/s^2 above,"
    yield f"  and {float(np.max(up)):.2g} m a step at most"


def _network(A: Array, G: Array, L: Array, c: float) -> Array:
    return np.kron(np.eye(len(L)), A) - c * np.kron(L, G)


def linear(draw: np.random.Generator, count: int) -> Iterator[str]:
    """Attack T7 and T8; return lines of what was found."""
    worst, sums, turns = -np.inf, -np.inf, -np.inf
    for k in range(count):
        n, m = int(draw.integers(1, 5)), int(draw.integers(1, 3))
        A, B = draw.normal(size=(n, n)), draw.normal(size=(n, m))
        P, one = scipy.linalg.solve_continuous_are(A, B, np.eye(n), np.eye(m)), np.eye(AGENTS - 1)
        rows = [reached(draw, k % 2) for _ in range(2)]
        edges = [[(*ALL[e], row[e]) for e in np.flatnonzero(row)] for row in rows]
        graph = ech.Graph(edges[0], directed=True)
        L, found = graph.grounded_laplacian().toarray(), graph.spectrum()
        network = functools.partial(_network, A, B @ B.T @ P)
        worst = max(worst, np.linalg.eigvals(network(L, 0.5 / found.low)).real.max())
        V, whole = np.kron(np.diag(np.asarray(found.sums)), P), network(L, 0.5 / found.proved)
        slope = V @ whole + whole.T @ V + np.kron(np.diag(np.asarray(found.sums)), np.eye(n))
        sums = max(sums, np.linalg.eigvalsh(slope)[-1] / np.abs(V @ whole).max())
        both = ech.Graph.switching([(0.0, edges[0]), (1.0, edges[1])], directed=True)
        if both.spectrum().low > 0.0:
            for each in both.stretches():
                whole, V = network(each.toarray(), 0.5 / both.spectrum().low), np.kron(one, P)
                slope = V @ whole + whole.T @ V + np.eye(len(V))
                turns = max(turns, np.linalg.eigvalsh(slope)[-1] / np.abs(V @ whole).max())
    yield f"linear: the slowest mode at the edge is {worst:.3g} 1/s at most"
    yield f"linear: the weighted sum of T7 rises by {sums:.2g} of its terms at most (rounding)"
    yield f"linear: the one sum of T8 rises by {turns:.2g} of its terms at most (rounding)"


def main() -> None:
    """Run all attacks."""
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 1000
    draw = np.random.default_rng(0)
    with precision("float64"):
        for line in itertools.chain(linear(draw, count), vehicles(draw, count)):
            print(line, flush=True)


if __name__ == "__main__":
    main()
