"""How agents move: the plant under held inputs, its actuators and its disturbances."""

import dataclasses
from typing import NamedTuple, Self, TypeAlias, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from echelon.agents.models.model import ControlAffine
from echelon.agents.world.actuator import MotorArrays
from echelon.agents.world.disturbance import Wind, disturbed, draw
from echelon.agents.world.world import World
from echelon.core.errors import SimulationError
from echelon.core.numerics import INTEGRATORS
from echelon.core.types import Input, Inputs, PyTree, State, States
from echelon.simulation.step.settings import Settings

Row: TypeAlias = tuple[PyTree, PyTree]
"""The parameters of one agent's plant and motors that differ from those of others."""


class MotionState(NamedTuple):
    """What the plants remember besides their states; parts that they lack are None.

    Attributes:
        actuators: (N, m) the inputs that act at the beginning of a step.
        gusts: (N, n) the correlated wind of the step before.
    """

    actuators: Inputs | None = None
    gusts: States | None = None


@final
class PlantStep(eqx.Module):
    """The plant in its world, advanced a step at a time.

    Attributes:
        plant: what moves.
        wind: its disturbance, ready to be drawn; None without one.
        dt: step, s.
        integrator: its name.
        limits: whether the actuators' limits act.
        substeps: of the integrator in a step.
        motors: the actuators; None for ideal ones.
        rows: the parameters in which agents differ, as `plant` and `motors` with rows (N, ...) and
            None for all others; None where all are alike.
    """

    plant: ControlAffine
    wind: Wind | None
    dt: float = eqx.field(static=True)
    integrator: str = eqx.field(static=True)
    limits: bool = eqx.field(static=True)
    substeps: int = eqx.field(static=True, default=1)
    motors: MotorArrays | None = None
    rows: Row | None = None

    @classmethod
    def of(cls, model: ControlAffine, world: World, settings: Settings, agents: int = 0) -> Self:
        """Return the motion in a world; `SimulationError` if the integrator allows no lag."""
        # Limits and disturbance are the plant's: its motors may differ from those that laws know.
        plant, disturbance = world.plant_for(model), world.disturbance
        wind = disturbance and disturbance.prepared(plant, settings.dt, settings.seed)
        motors = world.actuator and world.actuator.prepared(plant)
        if settings.integrator == "printed" and (settings.substeps > 1 or motors is not None):
            raise SimulationError(
                "`integrator` is `printed`, which has no time: neither `substeps` nor an actuator "
                "has a meaning; use `rk4` or `euler`."
            )
        rows = None
        if world.plants:
            plants = [world.plants.get(k, plant) for k in range(agents)]
            motors_of = [world.actuator and world.actuator.prepared(x) for x in plants]
            rows = _varied(plants), _varied(motors_of)
        return cls(
            plant,
            wind,
            settings.dt,
            settings.integrator,
            settings.limits,
            settings.substeps,
            motors,
            rows,
        )

    @property
    def ideal(self) -> bool:
        """Whether inputs act at once, on agents that are alike, with independent draws of wind."""
        windy = self.wind is not None and (self.wind.fade is not None or self.wind.air is not None)
        return self.motors is None and self.rows is None and self.substeps == 1 and not windy

    def of_row(self, row: Row | None) -> "PlantStep":
        """Return the motion of one agent, of which `row` has the parameters of its own."""
        if row is None:
            return self
        plant, motors = eqx.combine(row, (self.plant, self.motors))
        return dataclasses.replace(self, plant=plant, motors=motors, rows=None)

    def deliver(self, u: Input) -> Input:
        """Return what the actuators make of one agent's desired physical input (m,)."""
        return self.plant.limit(u) if self.limits else u

    def begin(self, states: States) -> MotionState:
        """Return what the plants remember at the beginning of a run."""
        gusty = self.wind is not None and self.wind.fade is not None
        # Actuators begin where the agents would be at rest.
        trim = jnp.asarray(np.asarray(self.plant.trim[1], float), states.dtype)
        lagging = self.motors is not None and self.motors.lag is not None
        return MotionState(
            jnp.tile(trim, (len(states), 1)) if lagging else None,
            jnp.zeros_like(states) if gusty else None,
        )

    def advance(
        self, states: States, inputs: Inputs, step: jax.Array, memory: MotionState = MotionState()
    ) -> tuple[States, MotionState]:
        """Return states (N, n) one dt later, and memory; inputs (N, m) and disturbance are held."""

        # Integrated with the input held, as a digital controller holds it: the order of the method
        # stays, since u and the wind are constant within a step.
        def one(
            x: State,
            u: Input,
            agent: jax.Array,
            row: Row | None,
            own: MotionState,
        ) -> tuple[State, MotionState]:
            motion = self.of_row(row)
            push, noise = draw(self.wind, step, agent)
            if own.gusts is not None and self.wind is not None:
                gust = self.wind.gusts(own.gusts, step, agent)
                own, push = own._replace(gusts=gust), gust if push is None else push + gust
            if motion.motors is None:
                return motion.move(x, u, push, noise), own
            return motion.follow(x, u, push, noise, own)

        return jax.vmap(one)(states, inputs, jnp.arange(len(states)), self.rows, memory)

    def move(self, x: State, u: Input, push: State | None, noise: Input | None) -> State:
        """Return the state of one agent one dt later, under what is held over it.

        Args:
            x: its state (n,).
            u: its delivered input (m,).
            push: what wind adds to its rate (n,), or None.
            noise: what is added to its input (m,), or None.
        """
        field = disturbed(self.plant, push, noise, None if self.wind is None else self.wind.air)
        integrate = INTEGRATORS[self.integrator]
        for _ in range(self.substeps):
            x = integrate(field, x, u, self.dt / self.substeps)
        return x

    def follow(
        self, x: State, u: Input, push: State | None, noise: Input | None, own: MotionState
    ) -> tuple[State, MotionState]:
        """Return the state of one agent one dt later, whose actuators follow its input."""
        motors = self.motors
        assert motors is not None
        command = motors.command(u)
        start = command if own.actuators is None else own.actuators
        field = disturbed(self.plant, push, noise, None if self.wind is None else self.wind.air)

        # Time as a state, of which the stages of a Runge-Kutta method are exact: its order stays.
        def timed(at: jax.Array, _: Input) -> jax.Array:
            return jnp.append(field(at[:-1], motors.after(start, command, at[-1])), 1.0)

        at, integrate = jnp.append(x, 0.0), INTEGRATORS[self.integrator]
        for _ in range(self.substeps):
            at = integrate(timed, at, u, self.dt / self.substeps)
        if own.actuators is not None:
            own = own._replace(actuators=motors.after(start, command, self.dt))
        return at[:-1], own


def _varied(modules: list[ControlAffine] | list[MotorArrays | None]) -> PyTree:
    """Return the leaves in which modules of one structure differ, as rows; None for the others."""
    flat = [jax.tree.leaves(module) for module in modules]
    tree = jax.tree.structure(modules[0])

    def rows(leaves: tuple[object, ...]) -> jax.Array | None:
        arrays = [np.asarray(leaf) for leaf in leaves]
        same = all(np.array_equal(array, arrays[0]) for array in arrays)
        return None if same else jnp.asarray(np.stack(arrays))

    return tree.unflatten([rows(leaves) for leaves in zip(*flat, strict=True)])
