"""What the benchmarks of the engine step: swarms and many formations, and a yardstick in C."""

import importlib
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, final

import equinox as eqx
import jax.numpy as jnp
import numpy as np

import echelon as ech
from echelon.core.numerics import precision
from echelon.simulation.engine.jax_stepper import JaxStepper
from echelon.simulation.engine.prepare import prepare
from echelon.simulation.native.stepper import NativeStepper
from echelon.simulation.step.assembly import assemble
from echelon.simulation.step.drive import Stepper
from echelon.simulation.step.loop import Loop

DT = 0.005
FORMATIONS, STEPS = 2_560, 300
_WEIGHTS = [*(2e-8, 2e-8, 1e-2), *(1e-8, 1e-8, 1e-3), *(1e-6, 1e-6, 1e-7), *(1e-9,) * 3]
"""Of the states of a newcomer's model, those of the yardstick: by weights of 1 its rates of turning
would be taken back within less than a step, and all that is stepped would be lost at once."""


@final
class Newcomer(ech.ControlAffine):
    """A quadrotor as somebody writes it who never saw this library: matrices, angles, cases."""

    state_names = ("x", "y", "z", "vx", "vy", "vz", "roll", "pitch", "yaw", "p", "q", "r")
    input_names = ("thrust", "torque_x", "torque_y", "torque_z")
    state_groups = {"position": ("x", "y", "z")}
    position = ("x", "y", "z")
    trim = ((0.0,) * 12, (0.028 * 9.81, 0.0, 0.0, 0.0))

    def _turned(self, x: Any) -> tuple[Any, Any]:
        """Return the rotation of the body, and what makes rates of angles of body rates."""
        (sr, sp, sy), (cr, cp, cy), tp = jnp.sin(x[6:9]), jnp.cos(x[6:9]), jnp.tan(x[7])
        one, zero = jnp.ones_like(sr), jnp.zeros_like(sr)
        about_x = jnp.array([[one, zero, zero], [zero, cr, -sr], [zero, sr, cr]])
        about_y = jnp.array([[cp, zero, sp], [zero, one, zero], [-sp, zero, cp]])
        about_z = jnp.array([[cy, -sy, zero], [sy, cy, zero], [zero, zero, one]])
        rates = [[one, sr * tp, cr * tp], [zero, cr, -sr], [zero, sr / cp, cr / cp]]
        return about_z @ about_y @ about_x, jnp.array(rates)

    def drift(self, x: Any) -> Any:
        """Return f(x): drag by the angle at which air meets the body, more of it when fast."""
        R, rates = self._turned(x)
        v, w, J = x[3:6], x[9:], jnp.array([16.57e-6, 16.66e-6, 29.26e-6])
        body = R.T @ v
        speed = jnp.sqrt(body @ body + 1e-6)
        angle = jnp.arctan2(body[2], 1.0 + speed)
        drag = jnp.where(speed > 2.0, 0.01 * speed, 0.02) * (1.0 + angle**2)
        force = -(R @ (drag * body)) - jnp.array([0.0, 0.0, 9.81])
        return jnp.concatenate([v, force, rates @ w, -jnp.cross(w, J * w) / J])

    def input_map(self, x: Any) -> Any:
        """Return g(x)."""
        R, _ = self._turned(x)
        J = jnp.array([16.57e-6, 16.66e-6, 29.26e-6])
        thrust = jnp.zeros((12, 1)).at[3:6, 0].set(R[:, 2] / 0.028)
        return jnp.concatenate([thrust, jnp.zeros((12, 3)).at[9:].set(jnp.diag(1.0 / J))], axis=1)


def flock(graph: ech.Graph, model: ech.ControlAffine | None = None) -> ech.Parts:
    """Return quadrotors behind a leader on a circle, by a gain that the step bears.

    Agents of another model stay behind a leader at its trim.
    """
    leader: Any = ech.laws.Tracking(ech.references.Circle(radius=1.0, rate=0.3))
    leader, model = (leader, ech.models.Quadrotor()) if model is None else (None, model)
    weights = _WEIGHTS if leader is None else None
    method = ech.gains.Riccati(Q=weights, coupling=0.25)
    gain = ech.synthesize(model, ech.Graph.ring(20), method)
    drive = ech.Laws(leader or ech.laws.TrimInput(), ech.laws.Consensus(gain, feedforward="relay"))
    formation = ech.Formation(np.zeros((graph.agents, 12)))
    return ech.Parts(model, graph, formation, drive, initial={"position": 0.02})


class Side(NamedTuple):
    """Ways to step the same agents, and the reference of some steps."""

    native: NativeStepper
    by_jax: JaxStepper
    reference: np.ndarray | None


def steppers(parts: ech.Parts, bits: int) -> Side:
    """Return the native stepper, JAX's and the reference of 10,000 steps."""
    chosen = ech.Settings(horizon=50.0, dt=DT, precision=f"float{bits}")  # type: ignore[arg-type]
    prepared = prepare(parts, chosen)
    problem, drive = prepared.problem, prepared.parts.drive
    assert isinstance(drive, ech.Laws)
    with precision("float64"):
        loop = assemble(problem, drive.leader, drive.follower)
        by_jax = JaxStepper(loop, problem.states)
        # On one core, as a yardstick: threads that wait for each other take time of theirs.
        native = NativeStepper([loop], problem.states, bits, by_jax, threads=1)
        found = drive.reference_states(prepared.parts.model, DT * jnp.arange(10_001))
        reference = None if found is None else np.asarray(found)
    return Side(native, by_jax, reference)


def rate(
    stepper: Stepper,
    agents: int,
    counts: list[int],
    reference: np.ndarray | None,
    bits: int,
    clock: Callable[[], float] = time.process_time,
) -> float:
    """Return agent-steps per second of one turn that stores states every so often.

    Of CPU time, or by another clock.
    """
    steps = sum(counts)
    first, all_ = (None if reference is None else reference[: n + 1] for n in (1, steps))
    with precision(f"float{bits}"):  # type: ignore[arg-type]
        # From within a run: what is written once at its beginning is no step.
        now = stepper.advance(stepper.start(), np.array([1], np.int32), first).now
        begin = clock()
        made = stepper.advance(now, np.array(counts, np.int32), all_)
        spent = clock() - begin
        assert np.isfinite(made.now.states).all(), "what is lost is no agent that is stepped"
        return agents * steps / spent


# ---- many formations -----------------------------------------------------------------------------


def formations(
    bits: int, own: bool, threads: int = 1, integrator: Any = "rk4", steps: int = STEPS
) -> tuple[NativeStepper, np.ndarray]:
    """Return what steps 2,560 formations of 4 that all hear each other, and the reference.

    Each has a gain of its own where `own` is true: other numbers in P, R and c.
    """
    kind: Any = f"float{bits}"
    chosen = ech.Settings(horizon=50.0, dt=DT, precision=kind, integrator=integrator)
    prepared = prepare(flock(ech.Graph.complete(4)), chosen)
    drive, draws = prepared.parts.drive, np.random.default_rng(0)
    assert isinstance(drive, ech.Laws)
    with precision("float64"):
        loop = assemble(prepared.problem, drive.leader, drive.follower)
        states = prepared.problem.states + 0.02 * draws.uniform(-1, 1, (FORMATIONS, 4, 12))
        times = DT * jnp.arange(steps + 1)
        reference = np.asarray(drive.reference_states(prepared.parts.model, times))
        loops = [_regained(loop, draws) for _ in range(FORMATIONS)] if own else None
    pool = ThreadPoolExecutor(threads) if threads > 1 else None
    with precision(kind):
        loops = loops or [loop] * FORMATIONS
        return NativeStepper(loops, states.reshape(-1, 12), bits, None, pool), reference


def _regained(loop: Loop, draws: np.random.Generator) -> Loop:
    """Return a loop with a gain a little other."""

    def numbers(loop: Loop) -> tuple[Any, ...]:
        gain: Any = loop.laws.follower
        return gain.gain.P, gain.gain.R_inverse, gain.gain.coupling

    P, R_inverse, coupling = numbers(loop)
    more = 1.0 + 0.01 * draws.uniform(-1, 1, P.shape)
    scales = draws.uniform(0.9, 1.1, 2)
    other = P * (more + more.T) / 2, R_inverse * scales[0], coupling * scales[1]
    return eqx.tree_at(numbers, loop, other)


def seeded(parts: ech.Parts, bits: int, count: int) -> tuple[NativeStepper, np.ndarray]:
    """Return what steps formations of a seed each, with draws of their own, and the reference."""
    kind: Any = f"float{bits}"
    chosen = ech.Settings(horizon=50.0, dt=DT, precision=kind)
    first = prepare(parts, chosen)
    drive, starts, loops = first.parts.drive, list[np.ndarray](), list[Loop]()
    assert isinstance(drive, ech.Laws)
    for seed in range(count):
        problem = prepare(first.parts, chosen._replace(seed=seed)).problem
        with precision("float64"):
            loops.append(assemble(problem, drive.leader, drive.follower))
        starts.append(problem.states)
    with precision("float64"):
        reference = drive.reference_states(parts.model, DT * jnp.arange(10_001))
    with precision(kind):
        return NativeStepper(loops, np.concatenate(starts), bits, None), np.asarray(reference)


# ---- the yardstick -------------------------------------------------------------------------------


@final
class Yardstick:
    """Kernels in C to compare with, of a folder.

    Its `limit.py` has classes `Ring(x0, d, dtype, mode)` and `Batch(x0, d, dtype)`, of formations
    of 4, with `run(steps)`, a function `rate(kernel, agents, steps, repetitions)`, and the library
    `LIB` with `c_nbr_f32` and `c_nbr_f64`; its `problem.py` makes their starts and graphs.
    """

    def __init__(self, folder: Path) -> None:
        """Note where it is."""
        self.folder = str(folder.resolve())

    @cached_property
    def limit(self) -> Any:
        """Its kernels, which are compiled now."""
        sys.path.insert(0, self.folder)
        return importlib.import_module("limit")

    @property
    def problem(self) -> Any:
        """Its starts and graphs."""
        return importlib.import_module("problem") if self.limit else None

    def ring(self, agents: int, bits: int) -> Any:
        """Return one swarm on a ring."""
        starts = self.problem.problem(agents, self.problem.ring(agents))
        return self.limit.Ring(*starts, _kind(bits), mode=0)

    def formations(self, bits: int) -> Any:
        """Return the formations of 4."""
        graph = self.problem.complete_blocks(FORMATIONS)
        return self.limit.Batch(*self.problem.problem(4 * FORMATIONS, graph), _kind(bits))

    def neighbours(self, agents: int, degree: int, bits: int) -> "Table":
        """Return one swarm that finds its neighbours in a table."""
        return Table(self, self.problem.rand_regular(agents, degree), bits)

    def rate(self, kernel: Any, agents: int, steps: int) -> float:
        """Return agent-steps per second of CPU time, of one turn."""
        return self.limit.rate(kernel, agents, steps, 1)[0]


@final
class Table:
    """The yardstick's kernel for a swarm that finds its neighbours in a table."""

    def __init__(self, yardstick: Yardstick, table: np.ndarray, bits: int) -> None:
        """Lay out states, offsets and the table (N, degree)."""
        limit, kind, (agents, degree) = yardstick.limit, _kind(bits), table.shape
        starts = yardstick.problem.problem(agents, table)
        self.start, d = (np.ascontiguousarray(part.T).astype(kind) for part in starts)
        self.x, self.out = self.start.copy(), np.zeros_like(self.start)
        own = limit._constants(kind)
        self.kept = (self.x, d, self.out, *own, np.ascontiguousarray(table.T, np.int32))
        self.sizes = limit.ct.c_long(agents), degree
        self.call, self.limit = limit._symbol("c_nbr", kind), limit

    def run(self, steps: int) -> None:
        """Take steps from the start."""
        self.x[:] = self.start
        addresses = map(self.limit._ptr, self.kept)
        self.call(*addresses, *self.sizes, self.limit.ct.c_long(steps), 0, 1)


def _kind(bits: int) -> type:
    return np.float64 if bits == 64 else np.float32
