"""How agents move: the plant under held inputs, its actuators and its disturbances."""

from typing import Self, final

import equinox as eqx
import jax
import jax.numpy as jnp

from echelon.agents.models.model import ControlAffine
from echelon.agents.world.disturbance import Wind, disturbed, draw
from echelon.agents.world.world import World
from echelon.core.numerics import INTEGRATORS
from echelon.core.types import Input, Inputs, State, States
from echelon.simulation.step.settings import Settings


@final
class Motion(eqx.Module):
    """The plant in its world, advanced a step at a time.

    Attributes:
        plant: what moves.
        wind: its disturbance, ready to be drawn; None without one.
        dt: step, s.
        integrator: its name.
        limits: whether the actuators' limits act.
    """

    plant: ControlAffine
    wind: Wind | None
    dt: float = eqx.field(static=True)
    integrator: str = eqx.field(static=True)
    limits: bool = eqx.field(static=True)

    @classmethod
    def of(cls, model: ControlAffine, world: World, settings: Settings) -> Self:
        """Return the motion of agents in a world."""
        # Limits and disturbance are the plant's: its motors may differ from those that laws know.
        plant, disturbance = world.plant_for(model), world.disturbance
        wind = disturbance and disturbance.prepared(plant, settings.dt, settings.seed)
        return cls(plant, wind, settings.dt, settings.integrator, settings.limits)

    def deliver(self, u: Input) -> Input:
        """Return what the actuators make of one agent's desired physical input (m,)."""
        return self.plant.limit(u) if self.limits else u

    def advance(self, states: States, inputs: Inputs, step: jax.Array) -> States:
        """Return the states (N, n) one dt later.

        The delivered inputs (N, m) are held over it, and so is the disturbance of this step.
        """

        # Integrated with the input held, as a digital controller holds it: the order of the method
        # stays, since u and the wind are constant within a step.
        def one(x: State, u: Input, agent: jax.Array) -> State:
            push, noise = draw(self.wind, step, agent)
            return self.move(x, u, push, noise)

        return jax.vmap(one)(states, inputs, jnp.arange(len(states)))

    def move(self, x: State, u: Input, push: State | None, noise: Input | None) -> State:
        """Return the state of one agent one dt later, under what is held over it.

        Args:
            x: its state (n,).
            u: its delivered input (m,).
            push: what wind adds to its rate (n,), or None.
            noise: what is added to its input (m,), or None.
        """
        field = disturbed(self.plant, push, noise)
        return INTEGRATORS[self.integrator](field, x, u, self.dt)
