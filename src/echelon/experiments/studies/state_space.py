"""The closed loop as a linear system: the leader's path in, the agents' errors out."""

import dataclasses
import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from echelon.agents.models.linearization import at_trim
from echelon.agents.models.model import ControlAffine
from echelon.agents.models.relative_equilibrium import trim_velocity
from echelon.agents.references.reference import LeaderPath
from echelon.agents.world.world import World
from echelon.core.digits import about
from echelon.core.errors import (
    LawError,
    MissingExtraError,
    OutputError,
    SimulationError,
    check_kind,
)
from echelon.core.files import write_atomic
from echelon.core.numerics import precision
from echelon.core.types import Array, Input, PathLike, Scalar, State, States
from echelon.laws.law import reference_of
from echelon.simulation.engine.law_drive import Laws
from echelon.simulation.engine.parts import Parts
from echelon.simulation.engine.prepare import prepare
from echelon.simulation.step.assembly import assemble
from echelon.simulation.step.loop import Loop
from echelon.simulation.step.records import Steps
from echelon.simulation.step.sequence import begin_forgetful, control
from echelon.simulation.step.settings import Settings

_MOST = 2000
"""States of all agents; their matrix is dense."""
_REST = 1e-9
"""In the states' units per second; more than rounding leaves at a rest."""


@final
@dataclasses.dataclass(frozen=True, eq=False)
class StateSpace:
    """A linear system xdot = A x + B w, y = C x + D w; `state_space` says what x, w and y are.

    `A, B, C, D = system` unpacks it.

    Attributes:
        A, B, C, D: its matrices.
        states: names of x, such as `vx_1` of agent 1.
        inputs: names of w, such as `path_x`.
        outputs: names of y, such as `error_x_1`.
    """

    A: Float[Array, "Nn Nn"]
    B: Float[Array, "Nn k"]
    C: Float[Array, "Nn Nn"]
    D: Float[Array, "Nn k"]
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]

    def __iter__(self) -> Iterator[Array]:
        """Yield A, B, C and D."""
        yield from (self.A, self.B, self.C, self.D)

    def to_control(self) -> Any:
        """Return it as a `StateSpace` of python-control, with its names.

        Raises:
            MissingExtraError: python-control is not installed.
        """
        try:
            import control  # pyright: ignore[reportMissingImports]
        except ImportError as error:
            raise MissingExtraError(
                "`to_control` needs python-control; install it with `pip install '.[control]'`."
            ) from error
        # `ss` would remove states that nothing drives.
        names = {"states": self.states, "inputs": self.inputs, "outputs": self.outputs}
        lists = {key: list(value) for key, value in names.items()}
        return control.StateSpace(*self, remove_useless_states=False, **lists)


class _Momentary(LeaderPath):
    """A leader's motion at one moment, by which the loop is differentiated."""

    state: State
    input: Input

    def follow(self, model: ControlAffine, t: Scalar) -> tuple[State, Input]:
        """Return its state (n,) and input (m,)."""
        return self.state, self.input

    def check(self) -> None:
        """Do nothing: it is made from the trim."""

    def fit(self, model: ControlAffine) -> None:
        """Do nothing: it is made from the model's trim."""


def state_space(parts: Parts, file: PathLike | None = None) -> StateSpace:
    """Return the closed loop linearized at rest: all agents at their goals, the leader at its trim.

    A trim that moves rests in axes that move with it. All quantities are deviations from that rest,
    in continuous time, in the model's units:

    - x (N n): the states of agent 0, then of agent 1, and so on.
    - w (n + m): the state and the input that the leaders' reference prescribes. Without a
      reference B and D have no columns.
    - y (N n): the error of each agent: of a follower, its state minus its nearest leader's and
      minus the difference of their offsets; of a leader, its state minus the reference's.

    Limits, wind, noise and the network are left out, and the agents are those of the model.

    Args:
        parts: agents with laws that have no memory, on a graph that does not switch.
        file: `.mat` file to write: A, B, C, D and the names of x, w and y.

    Raises:
        LawError: a law has a memory, so that its loop has further states.
        SimulationError: there is no linearization, the goals are no rest, or the agents have more
            than 2,000 states.
        OutputError: the file cannot be written.
    """
    check_kind("parts", parts, Parts)
    _check(parts)
    settings = Settings(horizon=1.0, dt=1e-3, limits=False)
    ready = prepare(dataclasses.replace(parts, world=World()), settings)
    drive = ready.parts.drive
    assert isinstance(drive, Laws)
    for place, law in (("leader", drive.leader), ("follower", drive.follower)):
        if jax.tree.leaves(law.init()):
            raise LawError(
                f"the {place}'s law `{type(law).__name__}` has a memory, and `state_space` takes "
                "laws without one, such as `consensus` and `tracking`."
            )
    loop = assemble(ready.problem, drive.leader, drive.follower)
    with precision("float64"):
        system = _linearized(loop, ready.parts)
    if file is not None:
        _write(system, Path(file))
    return system


def _check(parts: Parts) -> None:
    size = parts.graph.agents * len(parts.model.state_names)
    fault = None
    if not isinstance(parts.drive, Laws):
        fault = f"the agents are driven by `{type(parts.drive).__name__}`, and not by laws"
    elif parts.graph.schedule is not None:
        fault = "the graph switches, and a linear system has one graph"
    elif parts.formation.motion is not None:
        fault = "the formation changes with time, and a linear system has one"
    elif size > _MOST:
        fault = f"the agents have {size} states, and at most {_MOST} are allowed"
    elif at_trim(parts.model).kinks.any() or at_trim(parts.model).gap is not None:
        fault = f"`{type(parts.model).__name__}` is not smooth at its trim"
    if fault:
        raise SimulationError(f"the closed loop is no linear system: {fault}.")


def _linearized(loop: Loop, parts: Parts) -> StateSpace:
    model, count = parts.model, parts.graph.agents
    x, u = (np.asarray(part, float) for part in model.trim)
    n, led = len(x), reference_of(loop.laws.leader) is not None
    rest = jnp.asarray(x + loop.places.offsets)
    motion = jnp.asarray(np.concatenate([x, u]) if led else np.zeros(0))
    nearest = np.array(parts.graph.nearest_leader())

    def velocity(states: States, w: jax.Array) -> States:
        now = loop
        if led:
            moment = _Momentary(w[:n], w[n:])
            now = eqx.tree_at(lambda loop: loop.laws.leader.reference, loop, moment)
        begun = jax.tree.map(jnp.asarray, begin_forgetful(now, states))
        inputs = control(now, begun, Steps(begun.step, now.motion.dt)).inputs
        return jax.vmap(model.velocity)(states, inputs) - trim_velocity(model)[None]

    def errors(states: States, w: jax.Array) -> States:
        places = states - loop.places.offsets
        lead = jnp.tile(w[:n] if led else jnp.asarray(x), (count, 1))
        targets = jnp.where(
            np.isin(np.arange(count), loop.laws.leaders)[:, None], lead, places[nearest]
        )
        return jax.vmap(model.difference)(places, targets)

    drift = np.abs(np.asarray(jax.jit(velocity)(rest, motion)))
    if not drift.max() <= _REST:
        agent, k = np.unravel_index(int(np.argmax(drift)), drift.shape)
        raise SimulationError(
            f"the closed loop is not at rest at the goals: `{model.state_names[k]}` of agent "
            f"{agent} moves there by {about(drift.max())} per second."
        )
    (A, B), (C, D) = (
        jax.jit(jax.jacfwd(function, (0, 1)))(rest, motion) for function in (velocity, errors)
    )
    size = count * n
    shapes = ((A, size), (B, len(motion)), (C, size), (D, len(motion)))
    A, B, C, D = (np.asarray(part).reshape(size, columns) for part, columns in shapes)
    states = tuple(f"{name}_{k}" for k in range(count) for name in model.state_names)
    path = tuple(f"path_{name}" for name in (*model.state_names, *model.input_names))
    outputs = tuple(f"error_{name}" for name in states)
    return StateSpace(A, B, C, D, states, path[: len(motion)], outputs)


def _write(system: StateSpace, file: Path) -> None:
    """Write the system with its names, as cell arrays."""
    from scipy.io import savemat

    content = io.BytesIO()
    # MATLAB has cell arrays for lists of text.
    cells = {
        name: np.array(value, dtype=object) if isinstance(value, tuple) else value
        for name, value in vars(system).items()
    }
    savemat(content, cells, oned_as="column")
    try:
        write_atomic(file, content.getvalue())
    except OSError as error:
        raise OutputError(f"`{file}` cannot be written: {error.strerror or error}.") from error
