"""What stands in a result for agents whose inputs an optimization gave, outside of any law."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from echelon.core.errors import LawError
from echelon.core.types import Input, State
from echelon.laws.law import Law, LocalView, Memory
from echelon.models.model import ControlAffine
from echelon.references.flatness import reference_targets
from echelon.references.reference import Reference


class Optimized(Law):
    """Inputs by `simulate_plans` or `simulate_mpc`.

    Args:
        told: what the agents are told by others, in words.
        reference: what the leaders follow, if anything.
    """

    told: tuple[str, ...] = eqx.field(static=True)
    reference: Reference | None = None

    @property
    def information(self) -> tuple[str, ...]:
        """What the agents are told."""
        return self.told

    def start(self, model: ControlAffine) -> State:
        """Return the reference's state at time zero, or the trim."""
        if self.reference is None:
            return jnp.asarray(np.asarray(model.trim[0], float))
        return jnp.asarray(reference_targets(model, self.reference, np.zeros(1)).states[0])

    def reference_states(self, model: ControlAffine, times: jax.Array) -> jax.Array | None:
        """Return the reference's states (T, n)."""
        if self.reference is None:
            return None
        return jnp.asarray(reference_targets(model, self.reference, np.asarray(times)).states)

    def update(self, model: ControlAffine, view: LocalView, memory: Memory) -> tuple[Input, Memory]:
        """Refuse: a plan is not made from what one agent knows at one time.

        Raises:
            LawError: always.
        """
        raise LawError(
            "`Optimized` only says that an optimization gave the inputs; "
            "use `simulate_plans` or `simulate_mpc` to run it again."
        )
