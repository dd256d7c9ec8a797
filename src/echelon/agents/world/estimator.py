"""A filter with a constant gain: what an agent makes of measurements that are late and noisy."""

from typing import NamedTuple, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Float

from echelon.agents.models.linearization import linearize
from echelon.agents.models.model import ControlAffine
from echelon.core.errors import SimulationError
from echelon.core.numerics import rk4
from echelon.core.types import Array, Input, State

_INPUT, _PUSH, _DRIFT = 0.1, 1.0, 0.01
"""Densities, by the root of a second: of what acts beside the inputs, in normalized ones; of how
fast a push on the velocity changes; and of all states, in their units."""
_EXACT = 1e-6
"""Standard deviation in place of none, which the Riccati equation needs."""


class Estimate(NamedTuple):
    """What an agent knows of itself as of its last measurement, and what it has done since.

    Attributes:
        x: (n,) its state.
        push: (k,) what acts on its velocity and is not in the model.
        inputs: (d + 1, m) delivered in the steps since the measurement before.
    """

    x: State
    push: Float[jax.Array, " k"]
    inputs: Float[jax.Array, "D m"]


@final
class Estimator(eqx.Module):
    """Predicts the state by the model, and corrects it by a constant gain.

    The gain is that of the Kalman filter of the model linearized at its trim, with a push on the
    velocity that changes slowly. The prediction is the nonlinear model's.

    Attributes:
        gain: (n + k, n).
        pushed: (k,) the states on whose rate a push acts.
        late: age of a measurement, in steps.
        dt: of a step, s.
    """

    gain: Array
    pushed: tuple[int, ...] = eqx.field(static=True)
    late: int = eqx.field(static=True)
    dt: float = eqx.field(static=True)

    @classmethod
    def of(cls, model: ControlAffine, std: Float[Array, " n"], late: int, dt: float) -> "Estimator":
        """Return the filter of a model whose states are measured with deviations (n,).

        Raises:
            SimulationError: the Riccati equation has no solution.
        """
        n, names = len(model.state_names), model.state_groups.get("velocity", ())
        pushed = tuple(model.state_names.index(name) for name in names)
        A, B = linearize(model)
        size, m = n + len(pushed), B.shape[1]
        whole = np.zeros((size + m, size + m))
        whole[:n, :n], whole[:n, size:] = A, B
        whole[list(pushed), range(n, size)] = 1.0
        step = scipy.linalg.expm(dt * whole)
        F, G = step[:size, :size], step[:size, size:]
        drift = np.append(np.full(n, _DRIFT), np.full(len(pushed), _PUSH))
        Q = _INPUT**2 / dt * G @ G.T + np.diag(dt * drift**2)
        C, R = np.eye(n, size), np.diag(np.maximum(std, _EXACT) ** 2)
        try:
            P = scipy.linalg.solve_discrete_are(F.T, C.T, Q, R)
        except (np.linalg.LinAlgError, ValueError) as error:
            raise SimulationError(
                f"no constant gain estimates the states of `{type(model).__name__}` "
                f"({error}); set `estimator: none`."
            ) from error
        gain = np.linalg.solve(P[:n, :n] + R, P[:n]).T
        return cls(gain, pushed, late, dt)

    def begin(self, model: ControlAffine, x: State) -> Estimate:
        """Return the estimate of an agent at x before it has measured anything."""
        trim = jnp.asarray(np.asarray(model.trim[1], float), x.dtype)
        push = jnp.zeros(len(self.pushed), x.dtype)
        return Estimate(x, push, jnp.tile(trim, (self.late + 1, 1)))

    def measure(
        self, model: ControlAffine, before: Estimate, y: State, first: jax.Array
    ) -> tuple[State, Estimate]:
        """Return the state now, and the estimate as of a measurement y (n,).

        The `first` one is taken as it is.
        """
        x = jnp.where(first, y, self._moved(model, before.x, before.push, before.inputs[0]))
        more = jnp.asarray(self.gain, x.dtype) @ model.difference(y, x)
        x, push = x + more[: len(x)], before.push + more[len(x) :]
        now = x
        for u in before.inputs[1:]:
            now = self._moved(model, now, push, u)
        return now, before._replace(x=x, push=push)

    def act(self, estimate: Estimate, u: Input) -> Estimate:
        """Return the estimate with the input (m,) that is delivered until the next step."""
        return estimate._replace(inputs=jnp.concatenate([estimate.inputs[1:], u[None]]))

    def _moved(self, model: ControlAffine, x: State, push: jax.Array, u: Input) -> State:
        """Return the state a step later."""

        def velocity(x: State, u: Input) -> State:
            return model.velocity(x, u).at[np.array(self.pushed, int)].add(push)

        return rk4(velocity, x, u, self.dt)
