"""The closed loop as components, each of which answers one question of a step.

A component has members, one of them ideal; none is optional. The ideal member is the class whose
methods the others replace. Each member has its own memory, `()` where it remembers nothing, of the
same structure for a whole run. A feature is a new member. The page on the design lists them all.
"""

import abc
import dataclasses
from typing import final

import equinox as eqx
import jax
from jaxtyping import Float

from echelon.agents.models.model import ControlAffine
from echelon.agents.network.channel import Channel
from echelon.agents.network.exchange import Near
from echelon.agents.world.sensing import Sensors, SensorStage
from echelon.core.types import PyTree, States
from echelon.simulation.step.leadership import FixedLeaders
from echelon.simulation.step.meter import RunStatistics, Sums
from echelon.simulation.step.motion import IdealMotors, PlantStep
from echelon.simulation.step.places import FixedPlaces
from echelon.simulation.step.records import (
    Known,
    LawMemories,
    LeaderSpeech,
    LoopState,
    Mask,
    NetworkEstimate,
    Played,
)
from echelon.simulation.step.roster import Everybody, Links
from echelon.simulation.step.run_laws import RunLaws


class IdealNetwork(eqx.Module):
    """What arrives, and who leads: what is said is heard in the same step.

    Attributes:
        leadership: who leads.
    """

    leadership: FixedLeaders
    # Whether messages take time, and whether those that lead announce to all what they do.
    late = False
    announces = False

    def begin(self, loop: "Loop", said: Float[jax.Array, "N s"], forward: int) -> PyTree:
        """Return the memory before the first message, for a feed-forward (forward,)."""
        return ()

    def receive(self, loop: "Loop", memory: PyTree, known: Known) -> tuple[NetworkEstimate, PyTree]:
        """Return what agents know from what arrived, and the memory with it."""
        received = known.links.along_edges(known.said)
        z = known.links(known.said, received, loop.laws.speech.difference(loop.model))
        return NetworkEstimate(z, self.leadership.leads(memory, known.own.number)), memory

    def send(self, loop: "Loop", memory: PyTree, known: Known, speech: LeaderSpeech) -> PyTree:
        """Return the memory after what agents send in a step."""
        return memory

    def with_medium(self, medium: Channel) -> "IdealNetwork":
        """Return the network over another medium; the ideal one has none."""
        return self


class NobodyNear(eqx.Module):
    """Who is near: nobody, where agents do not keep apart."""

    # Whether they do.
    keeps_apart = False

    def begin(self, loop: "Loop", states: States, laws: LawMemories) -> PyTree:
        """Return the memory of agents that begin at states (N, n)."""
        return ()

    def look(
        self, loop: "Loop", memory: PyTree, laws: LawMemories, known: Known
    ) -> tuple[Near | None, PyTree]:
        """Return what each agent knows of all others (N, N - 1, ...), and the memory after it.

        None where agents do not keep apart.
        """
        return None, memory

    def measured(
        self, loop: "Loop", read: Sums, now: LoopState, laws: LawMemories, here: Mask
    ) -> Sums:
        """Return the sums of a step with those of the distances that agents keep."""
        return read

    def with_medium(self, medium: Channel) -> "NobodyNear":
        """Return the surroundings over another medium, if messages about them take one."""
        return self


class Turns(eqx.Module):
    """Who acts when, and with what."""

    @abc.abstractmethod
    def play(self, loop: "Loop", known: Known, laws: LawMemories, network: PyTree) -> Played:
        """Return what leaders and followers do, what leaders say, and the network's memory."""


@final
class Loop(eqx.Module):
    """All that never changes during a run: a member of each component.

    Laws know the model, and the plant of the motion moves. Agents are in their own order.

    Attributes:
        model: what the laws know of an agent.
        laws: what agents say and do.
        sensing: what an agent knows of itself.
        places: of the agents in the formation.
        graph: who hears whom.
        network: what arrives, and who leads.
        surroundings: who is near.
        turns: who acts when.
        motion: how the agents move.
        roster: who is there.
        meter: what is measured at each step.
    """

    model: ControlAffine
    laws: RunLaws
    sensing: Sensors
    places: FixedPlaces
    graph: Links
    network: IdealNetwork
    surroundings: NobodyNear
    turns: Turns
    motion: PlantStep
    roster: Everybody
    meter: RunStatistics

    @property
    def agents(self) -> int:
        """How many there are."""
        return len(self.laws.order)

    def replace(self, **members: eqx.Module) -> "Loop":
        """Return the loop with other members."""
        return dataclasses.replace(self, **members)

    def with_sensor(self, stage: SensorStage) -> "Loop":
        """Return the loop with one more stage between its agents' states and what they know."""
        return self.replace(sensing=Sensors((*self.sensing.stages, stage)))

    def with_motors(self, motors: IdealMotors) -> "Loop":
        """Return the loop with other motors."""
        return self.replace(motion=dataclasses.replace(self.motion, motors=motors))

    def with_medium(self, medium: Channel) -> "Loop":
        """Return the loop with another medium of its messages, if they take one."""
        near = self.surroundings.with_medium(medium)
        return self.replace(network=self.network.with_medium(medium), surroundings=near)
