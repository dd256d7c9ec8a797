"""How agents move: the plant under held inputs, its motors and its weather."""

import dataclasses
from typing import Self, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from echelon.agents.models.model import ControlAffine
from echelon.agents.world.actuator import MotorArrays
from echelon.agents.world.disturbance import Wind
from echelon.agents.world.world import World
from echelon.core.errors import SimulationError
from echelon.core.numerics import INTEGRATORS, Field
from echelon.core.types import Input, Inputs, PyTree, State, States
from echelon.simulation.step.settings import Settings

# ---- limits --------------------------------------------------------------------------------------


class Limited(eqx.Module):
    """Actuators with the limits of the plant."""

    def limit(self, plant: ControlAffine, u: Input) -> Input:
        """Return what limits leave of an input (m,)."""
        return plant.limit(u)


@final
class Unlimited(Limited):
    """Actuators without limits."""

    def limit(self, plant: ControlAffine, u: Input) -> Input:
        """Return the input."""
        return u


# ---- motors --------------------------------------------------------------------------------------


class IdealMotors(eqx.Module):
    """When an input acts: at once, and it is held."""

    # Whether an input acts as it is commanded, and whether its motors remember the one before.
    at_once, remembers = True, False

    @property
    def memoryless(self) -> "IdealMotors":
        """The motors that begin each step at their command."""
        return self

    @property
    def still(self) -> "IdealMotors":
        """The motors without levels, between which a command would jump."""
        return self

    def begin(self, trim: Input) -> PyTree:
        """Return what the motors of an agent remember that is at rest."""
        return ()

    def integrate(
        self, field: Field, memory: PyTree, x: State, u: Input, plant: "PlantStep"
    ) -> tuple[State, PyTree]:
        """Return the state (n,) one dt later under a field (x, u) -> xdot, and the memory."""
        # With the input held, as a digital controller holds it: the order of the method stays.
        integrate = INTEGRATORS[plant.integrator]
        for _ in range(plant.substeps):
            x = integrate(field, x, u, plant.dt / plant.substeps)
        return x, memory


class LaggingMotors(IdealMotors):
    """Motors that follow their commands with a lag; they remember the input that acts."""

    arrays: MotorArrays
    at_once, remembers = False, True

    @property
    def memoryless(self) -> IdealMotors:
        """The motors that begin each step at their command."""
        return SteppedMotors(self.arrays)

    @property
    def still(self) -> IdealMotors:
        """The motors without levels, between which a command would jump."""
        return dataclasses.replace(self, arrays=dataclasses.replace(self.arrays, step=None))

    def begin(self, trim: Input) -> PyTree:
        """Return the trim: motors begin where agents would be at rest."""
        return trim

    def integrate(
        self, field: Field, memory: PyTree, x: State, u: Input, plant: "PlantStep"
    ) -> tuple[State, PyTree]:
        """Return the state one dt later, and the input that then acts."""
        command = self.arrays.command(u)
        start = self._start(memory, command)

        # Time as a state, of which the stages of a Runge-Kutta method are exact: its order stays.
        def timed(at: jax.Array, _: Input) -> jax.Array:
            return jnp.append(field(at[:-1], self.arrays.after(start, command, at[-1])), 1.0)

        at, integrate = jnp.append(x, 0.0), INTEGRATORS[plant.integrator]
        for _ in range(plant.substeps):
            at = integrate(timed, at, u, plant.dt / plant.substeps)
        return at[:-1], self._after(start, command, plant.dt)

    def _start(self, memory: PyTree, command: Input) -> Input:
        return memory

    def _after(self, start: Input, command: Input, dt: float) -> PyTree:
        return self.arrays.after(start, command, dt)


@final
class SteppedMotors(LaggingMotors):
    """Motors with levels or a least thrust, and no lag: they remember nothing."""

    remembers = False

    def begin(self, trim: Input) -> PyTree:
        """Return nothing."""
        return ()

    def _start(self, memory: PyTree, command: Input) -> Input:
        return command

    def _after(self, start: Input, command: Input, dt: float) -> PyTree:
        return ()


def motors_of(arrays: MotorArrays | None) -> IdealMotors:
    """Return the member for actuators as arrays, None for ideal ones."""
    if arrays is None:
        return IdealMotors()
    return SteppedMotors(arrays) if arrays.lag is None else LaggingMotors(arrays)


# ---- the plant -----------------------------------------------------------------------------------


@final
class PlantStep(eqx.Module):
    """The plant in its world, advanced a step at a time.

    Attributes:
        plant: what moves.
        dt: step, s.
        integrator: its name.
        limiter: what limits leave of an input.
        substeps: of the integrator in a step.
        motors: when an input acts.
        weather: what acts on it besides, part after part; () in still air.
        rows: the parameters in which agents differ, as `plant` and `motors` with rows (N, ...) and
            None for all others; () where all are alike.
    """

    plant: ControlAffine
    dt: float = eqx.field(static=True)
    integrator: str = eqx.field(static=True)
    limiter: Limited = Limited()
    substeps: int = eqx.field(static=True, default=1)
    motors: IdealMotors = IdealMotors()
    weather: tuple[Wind, ...] = ()
    rows: PyTree = ()

    @classmethod
    def of(cls, model: ControlAffine, world: World, settings: Settings, agents: int = 0) -> Self:
        """Return the motion in a world; `SimulationError` if the integrator allows no lag."""
        # Limits and disturbance are the plant's: its motors may differ from those that laws know.
        plant, disturbance = world.plant_for(model), world.disturbance
        motors = motors_of(world.actuator and world.actuator.prepared(plant))
        if settings.integrator == "printed" and (settings.substeps > 1 or not motors.at_once):
            raise SimulationError(
                "`integrator` is `printed`, which has no time: neither `substeps` nor an actuator "
                "has a meaning; use `rk4` or `euler`."
            )
        rows: PyTree = ()
        if world.plants:
            plants = [world.plants.get(k, plant) for k in range(agents)]
            each = [motors_of(world.actuator and world.actuator.prepared(x)) for x in plants]
            rows = _varied(plants), _varied(each)
        return cls(
            plant,
            settings.dt,
            settings.integrator,
            Limited() if settings.limits else Unlimited(),
            settings.substeps,
            motors,
            (disturbance.prepared(plant, settings.dt, settings.seed),) if disturbance else (),
            rows,
        )

    def of_row(self, row: PyTree) -> "PlantStep":
        """Return the motion of one agent, of which `row` has the parameters of its own."""
        if row == ():
            return self
        plant, motors = eqx.combine(row, (self.plant, self.motors))
        return dataclasses.replace(self, plant=plant, motors=motors, rows=())

    def deliver(self, u: Input) -> Input:
        """Return what the actuators make of one agent's desired physical input (m,)."""
        return self.limiter.limit(self.plant, u)

    def begin(self, x: State) -> PyTree:
        """Return what the plant of an agent at x remembers: of its weather, and of its motors."""
        trim = jnp.asarray(np.asarray(self.plant.trim[1], float), x.dtype)
        return tuple(part.begin(x) for part in self.weather), self.motors.begin(trim)

    def field(self, memory: PyTree, step: jax.Array, number: jax.Array) -> tuple[Field, PyTree]:
        """Return (x, u) -> xdot of an agent of a number during a step, and its weather's memory."""
        field, after = self.plant.velocity, list[PyTree]()
        for part, own in zip(self.weather, memory, strict=True):
            field, own = part.on(field, own, step, number)
            after.append(own)
        return field, tuple(after)

    def pushed(self, push: State, noise: Input | None = None) -> Field:
        """Return the field under a push on the rate (n,) and noise on the input (m,), or None."""
        field = self.plant.velocity
        if not self.weather:
            return lambda x, u: field(x, u) + push
        for part in self.weather:
            field = part.under(field, push, noise)
        return field

    def move(
        self, memory: PyTree, x: State, u: Input, step: jax.Array, number: jax.Array
    ) -> tuple[State, PyTree]:
        """Return the state of one agent one dt later, and what its plant then remembers.

        Args:
            memory: of its plant.
            x: its state (n,).
            u: its delivered input (m,), which is held, as the weather is.
            step: the number of the step.
            number: of the agent.
        """
        field, weather = self.field(memory[0], step, number)
        x, motors = self.motors.integrate(field, memory[1], x, u, self)
        return self.plant.own_state(x), (weather, motors)

    def advance(
        self,
        memory: PyTree,
        states: States,
        inputs: Inputs,
        step: jax.Array,
        numbers: Int[jax.Array, " N"],
    ) -> tuple[States, PyTree]:
        """Return the states (N, n) of all agents one dt later, and what their plants remember."""

        def one(
            own: PyTree, x: State, u: Input, number: jax.Array, row: PyTree
        ) -> tuple[State, PyTree]:
            return self.of_row(row).move(own, x, u, step, number)

        return jax.vmap(one)(memory, states, inputs, numbers, self.rows)

    @property
    def still(self) -> "PlantStep":
        """The motion without weather, and with motors without levels."""
        return dataclasses.replace(self, motors=self.motors.still, weather=())

    @property
    def memoryless(self) -> "PlantStep":
        """The motion without gusts, whose motors begin each step at their command."""
        weather = tuple(part.memoryless for part in self.weather)
        return dataclasses.replace(self, motors=self.motors.memoryless, weather=weather)


def _varied(modules: list[ControlAffine] | list[IdealMotors]) -> PyTree:
    """Return the leaves in which modules of one structure differ, as rows; None for the others."""
    flat = [jax.tree.leaves(module) for module in modules]
    tree = jax.tree.structure(modules[0])

    def rows(leaves: tuple[object, ...]) -> jax.Array | None:
        arrays = [np.asarray(leaf) for leaf in leaves]
        same = all(np.array_equal(array, arrays[0]) for array in arrays)
        return None if same else jnp.asarray(np.stack(arrays))

    return tree.unflatten([rows(leaves) for leaves in zip(*flat, strict=True)])
