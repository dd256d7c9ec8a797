"""The common base of leaders that follow a path of states: the path, and how others predict it."""

from typing import Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from echelon.agents.models.model import ControlAffine
from echelon.agents.references.demand import first_state, follow_at, followed_states
from echelon.agents.references.reference import Guide, check_kind_of
from echelon.core.numerics import precision
from echelon.core.types import Array, Scalar, State
from echelon.laws.law import Expected, Law, LocalView, Memory


class PathLeader(Law):
    """A leader that follows the states of a reference.

    Args:
        reference: the path to follow.
        fading: the rate (1/s) at which others expect its deviation to fade; set by `predictable`.
    """

    reference: Guide
    fading: Array | None = eqx.field(default=None, kw_only=True)

    def __check_init__(self) -> None:
        """Check that the reference is one."""
        check_kind_of(self.reference)

    def start(self, model: ControlAffine) -> State:
        """Return the reference's state at time zero."""
        return first_state(model, self.reference)

    def reference_states(self, model: ControlAffine, times: jax.Array) -> jax.Array:
        """Return x_r at each of `times`, (T, n)."""
        return followed_states(model, self.reference, times)

    @property
    def plans(self) -> bool:
        """Whether others can predict it: they know the path."""
        return True

    def predictable(self, model: ControlAffine) -> Self:
        """Find the slowest mode of the leader about the beginning of its path."""
        mode = self.own_mode(model)
        if mode is None:
            with precision("float64"):
                mode = _slowest(self, model)
        fading = np.asarray(max(-mode, 0.0))
        return eqx.tree_at(lambda law: law.fading, self, fading, is_leaf=lambda x: x is None)

    def deviation(
        self, model: ControlAffine, t: Scalar, x: State, offset: State, memory: Memory
    ) -> State:
        """Return x - x_r, (n,)."""
        return model.difference(x, self.reference.follow(model, t)[0] + offset)

    def expected(
        self,
        model: ControlAffine,
        t: Scalar,
        deviation: State,
        age: Scalar,
        period: Scalar | float,
    ) -> Expected:
        """Return the path with what is left of the deviation, at the leader's slowest mode."""
        left = deviation * jnp.exp(-jnp.asarray(self.fading, deviation.dtype) * age)
        return Expected(self.reference.follow(model, t)[0] + left)


def _slowest(law: PathLeader, model: ControlAffine) -> float:
    """Return the largest real part (1/s) of the modes about the beginning of the path."""
    x, _ = follow_at(model, law.reference, np.zeros(1))
    start = jnp.asarray(x[0])
    rest, silence = jnp.zeros_like(start), jnp.zeros(len(model.input_names))

    def velocity(x: State) -> State:
        view = LocalView(jnp.zeros(()), x, rest, rest, silence)
        return model.velocity(x, law.update(model, view, law.begin(model, x))[0])

    slope = np.asarray(jax.jit(jax.jacfwd(velocity))(start))
    return float(np.linalg.eigvals(slope).real.max())
