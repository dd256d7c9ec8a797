"""A run, the variables that a cost of it is differentiated by, and the derivatives."""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from echelon.core.errors import SimulationError, check_name
from echelon.core.trace import error_summary
from echelon.core.types import Array
from echelon.simulation.engine.law_drive import Laws
from echelon.simulation.step.drive import Drive, Problem
from echelon.simulation.step.loop import Loop
from echelon.simulation.step.meter import Sums

Cost: TypeAlias = Callable[[Sums], jax.Array]
"""A scalar cost of the sums over all steps of a run, written with `jax.numpy`."""

VARIABLES = ("P", "R", "coupling", "initial", "offsets")
"""What a cost can be differentiated by.

P, R and the coupling of the followers' gain; the initial states (N, n); the goals' offsets (N, n),
at fixed initial states.
"""


class Gradient(NamedTuple):
    """A cost, its derivative by each requested variable, and the sums of the run.

    The derivatives by P and R are symmetric, for symmetric changes. `engine` is what differentiated
    the run; a warning gives the reason if native code would have been faster but is unavailable.
    """

    value: float
    slopes: Mapping[str, Array]
    sums: Sums
    engine: str = "jax"
    warnings: tuple[str, ...] = ()


class DifferentiableRun(NamedTuple):
    """A loop, the variables' values, the initial states (N, n) and the leaders' reference."""

    loop: Loop
    values: dict[str, Array]
    states: Array
    reference: Array | None


def values_of(problem: Problem, drive: Drive, wrt: Sequence[str]) -> dict[str, Array]:
    """Return the values of the variables by name.

    Raises:
        SimulationError: no laws drive the run, the law has no gain, or a variable is unknown.
    """
    gain = drive.gain
    if not isinstance(drive, Laws):
        raise SimulationError(
            f"a run driven by `{type(drive).__name__}` cannot be differentiated; use `Laws`."
        )
    available = {"initial": np.asarray(problem.states), "offsets": problem.formation.offsets}
    if gain is not None:
        available |= {"P": gain.P, "R": gain.R, "coupling": np.asarray(gain.coupling)}
    for name in wrt:
        if name in VARIABLES and name not in available:
            law = type(drive.follower).__name__
            raise SimulationError(f"the followers' law `{law}` has no gain, and so no `{name}`.")
        check_name("`wrt` names", name, VARIABLES, SimulationError)
    return {name: available[name] for name in wrt}


def symmetric(name: str, slope: Array) -> Array:
    """Return the derivative by a variable, for symmetric changes of a matrix."""
    return 0.5 * (slope + slope.T) if name in ("P", "R") else slope


def cost_number(cost: Cost, sums: Sums) -> jax.Array:
    """Return the cost of sums.

    Raises:
        SimulationError: it fails, or is not one number.
    """
    try:
        value = cost(sums)
    # The cost is the user's code, which may raise whatever it likes.
    except Exception as error:
        raise SimulationError(
            f"the cost of a run fails with {error_summary(error)}; it must be a function of the "
            "run's sums, written with `jax.numpy`."
        ) from error
    if (shape := jnp.shape(value)) != ():
        raise SimulationError(
            f"the cost of a run has shape {shape}, and must be one number, such as a sum of it."
        )
    return value
