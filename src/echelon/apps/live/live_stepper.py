"""Which engine steps the agents of a loop whose numbers change while it runs."""

from typing import NamedTuple, TypeAlias

import jax

from echelon.core.errors import MissingExtraError
from echelon.core.numerics import Precision, precision
from echelon.core.types import Array
from echelon.simulation.engine.jax_stepper import JaxStepper
from echelon.simulation.native import is_installed
from echelon.simulation.native.stepper import NativeStepper
from echelon.simulation.scalars import Unsupported
from echelon.simulation.step.loop import Loop
from echelon.simulation.step.settings import Settings

_MANY = 200
"""With more agents than this JAX steps them in float32, which takes half the time."""

TurnableStepper: TypeAlias = JaxStepper | NativeStepper
"""Steps agents; a loop that is like the first but for its numbers compiles nothing again."""


class LiveEngine(NamedTuple):
    """A stepper, and the precision in which it computes."""

    stepper: TurnableStepper
    precision: Precision


def choose_stepper(loop: Loop, unlike: Loop, states: Array, settings: Settings) -> LiveEngine:
    """Return what steps a loop: native code wherever it can be made.

    Args:
        loop: to begin with.
        unlike: one that differs from it in all numbers that will change.
        states: (N, n) at the beginning.
        settings: of the scenario.
    """
    by_jax = LiveEngine(
        JaxStepper(loop, states), settings.precision if len(states) <= _MANY else "float32"
    )
    if settings.engine == "jax" or not is_installed() or jax.default_backend() != "cpu":
        return by_jax
    try:
        # In float64: even so it takes a tenth of a picture's time.
        with precision("float64"):
            return LiveEngine(NativeStepper([loop], states, 64, None, variant=unlike), "float64")
    except (Unsupported, MissingExtraError, TypeError):
        # A law that needs its numbers as numbers is traced by JAX as it stands.
        return by_jax
