"""Where the places of agents in the formation are: at offsets that are constant, or move."""

import dataclasses
from typing import TypeAlias, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from echelon.agents.models.model import ControlAffine
from echelon.agents.network.formation import Formation
from echelon.agents.network.formation_motion import FormationMotion, OwnOffset
from echelon.core.types import Array, PyTree, Scalar
from echelon.laws.law import Law, Speaks
from echelon.simulation.step.records import GroupOffsets
from echelon.simulation.step.run_laws import RunLaws

Agents: TypeAlias = Array | jax.Array
"""The numbers of some agents."""


class FixedPlaces(eqx.Module):
    """The offsets of a formation, which never change: what laws use, and where errors are measured.

    Attributes:
        offsets: (N, n) at the start.
    """

    offsets: Array

    @classmethod
    def of(cls, formation: Formation) -> "FixedPlaces":
        """Return the places of a formation."""
        offsets, motion = np.asarray(formation.offsets), formation.motion
        return FixedPlaces(offsets) if motion is None else MovingPlaces(offsets, motion)

    @property
    def rows(self) -> PyTree:
        """What differs between agents, with a row of each; the offsets come first."""
        return (self.offsets,)

    def of_rows(self, rows: PyTree) -> "FixedPlaces":
        """Return the places of agents with these rows."""
        return FixedPlaces(*rows)

    def of_one(self, number: int) -> "FixedPlaces":
        """Return the places of one agent alone."""
        return self.of_rows(tuple(leaf[number : number + 1] for leaf in self.rows))

    def of_group(self, model: ControlAffine, law: Law, t: Scalar, agents: Agents) -> GroupOffsets:
        """Return what agents under a law take for their offsets at a time (s)."""
        return GroupOffsets(jnp.asarray(self.offsets, jnp.result_type(t))[agents], None)

    def of_all(
        self, laws: RunLaws, groups: tuple[GroupOffsets, GroupOffsets]
    ) -> Float[jax.Array, "N n"]:
        """Return what all agents take for their offsets, of those of the two groups."""
        return jnp.asarray(self.offsets, groups[0].offset.dtype)

    def goals(self, t: Scalar) -> Float[jax.Array, "N n"] | None:
        """Return the offsets at which errors are measured; None of the meter's own."""
        return None

    def groups(
        self, model: ControlAffine, laws: RunLaws, t: Scalar
    ) -> tuple[GroupOffsets, GroupOffsets]:
        """Return what leaders and followers take for their offsets at a time (s)."""
        led, followed = (self.of_group(model, law, t, agents) for law, agents in laws.groups)
        return led, followed


@final
class MovingPlaces(FixedPlaces):
    """Offsets that are functions of time."""

    motion: FormationMotion

    @property
    def rows(self) -> PyTree:
        """What differs between agents: offsets, and places in the shapes."""
        return self.offsets, self.motion.places

    def of_rows(self, rows: PyTree) -> FixedPlaces:
        """Return the places of agents with these rows."""
        offsets, places = rows
        return MovingPlaces(offsets, dataclasses.replace(self.motion, places=places))

    def of_group(self, model: ControlAffine, law: Law, t: Scalar, agents: Agents) -> GroupOffsets:
        """Return what the law makes of them."""
        kind = jnp.result_type(t)
        rows = (jnp.asarray(x, kind)[agents] for x in (self.offsets, self.motion.places))
        one = lambda *row: Speaks.of(law).goal_offset(model, OwnOffset(self.motion, *row), t)  # noqa: E731
        return GroupOffsets(*jax.vmap(one)(*rows))

    def of_all(
        self, laws: RunLaws, groups: tuple[GroupOffsets, GroupOffsets]
    ) -> Float[jax.Array, "N n"]:
        """Return what both groups take for them, in the agents' order."""
        return laws.ordered(*(group.offset for group in groups))

    def goals(self, t: Scalar) -> Float[jax.Array, "N n"] | None:
        """Return the offsets themselves."""
        kind = jnp.result_type(t)
        rows = (jnp.asarray(x, kind) for x in (self.offsets, self.motion.places))
        return jax.vmap(lambda *row: OwnOffset(self.motion, *row).state(t))(*rows)
