"""A domain: the box of states and inputs on which a certificate holds."""

from collections.abc import Mapping
from typing import TypeAlias, final

import numpy as np

from echelon.agents.models.model import ControlAffine
from echelon.agents.models.straight_range import straight_range
from echelon.core.digits import at_least, at_most
from echelon.core.errors import GainError, did_you_mean, is_number, listing
from echelon.core.types import Array

Bound: TypeAlias = float | tuple[float, float]


@final
class Domain:
    """A box about a model's trim, in deviations of states and normalized inputs.

    Attributes:
        lower, upper: (n,) bounds on x - x*; infinite for states that were not named.
        input_lower, input_upper: (m,) bounds on the normalized input; zero where not named.

    A certificate on a domain holds while every agent's state, and the leader's input, stay inside.
    """

    def __init__(self, lower: Array, upper: Array, input_lower: Array, input_upper: Array) -> None:
        self.lower, self.upper = np.array(lower, float), np.array(upper, float)
        self.input_lower, self.input_upper = (
            np.array(input_lower, float),
            np.array(input_upper, float),
        )
        for array in (self.lower, self.upper, self.input_lower, self.input_upper):
            array.setflags(write=False)

    @classmethod
    def about(cls, model: ControlAffine, bounds: Mapping[str, Bound]) -> "Domain":
        """Return the box with bounds by state, group or input name.

        Args:
            model: defines the names, the trim and the chart.
            bounds: a half-width, or (lower, upper), in the state's unit or that of the normalized
                input. Other states are unbounded, other inputs are those of the trim.

        Raises:
            GainError: a name is unknown, a bound is empty, inverted or leaves the model's chart.
        """
        inputs, lower, upper = np.zeros((2, len(model.input_names))), {}, {}
        for name, bound in bounds.items():
            low, high = _interval(name, bound)
            if name in model.input_names:
                inputs[:, model.input_names.index(name)] = low, high
            else:
                _check_name(model, name)
                lower[name], upper[name] = low, high
        state = np.array([model.per_state(lower, -np.inf), model.per_state(upper, np.inf)])
        _check_chart(model, state)
        _check_turns(model, state)
        return cls(*state, *inputs)

    def straight(self, model: ControlAffine) -> "Domain":
        """Return the domain with a bound for each state whose difference is x - y only nearby.

        Open or too wide, it would hold agents whose differences theorems do not speak of.
        """
        half = 0.499 * straight_range(model).reach
        bent = ~(self.upper - self.lower < 2.0 * half) & np.isfinite(half)
        lower = np.where(bent, np.maximum(self.lower, -half), self.lower)
        upper = np.where(bent, np.minimum(self.upper, half), self.upper)
        return Domain(lower, upper, self.input_lower, self.input_upper)

    def sample(self, count: int, seed: int = 0, free: float = 1.0) -> tuple[Array, Array]:
        """Return random deviations (count, n) and inputs (count, m); unbounded states in +-free."""
        # Seeded, so that a guarantee by samples can be checked again.
        random = np.random.default_rng(seed)
        low = np.where(np.isfinite(self.lower), self.lower, -free)
        high = np.where(np.isfinite(self.upper), self.upper, free)
        states = random.uniform(low, high, (count, len(low)))
        return states, random.uniform(
            self.input_lower, self.input_upper, (count, len(self.input_lower))
        )

    def in_words(self, model: ControlAffine, varying: Array | None = None) -> str:
        """Return the bounds as text, deviations from the trim.

        Inputs (m,) whose column of g is `varying` are named without a bound too.
        """
        names = (*model.state_names, *model.input_names)
        lower = np.concatenate([self.lower, self.input_lower])
        upper = np.concatenate([self.upper, self.input_upper])
        named = [
            f"{name} in [{at_least(low, 4)}, {at_most(high, 4)}]"
            for name, low, high in zip(names, lower, upper, strict=True)
            if np.isfinite([low, high]).all() and low < high
        ]
        if varying is not None:
            held = varying & (self.input_lower == self.input_upper)
            named += [f"{model.input_names[k]} at its trim" for k in np.flatnonzero(held)]
        return ", ".join(named) or "all states"

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Domain) and self._bounds() == other._bounds()

    def __hash__(self) -> int:
        return hash(self._bounds())

    def _bounds(self) -> tuple[tuple[float, ...], ...]:
        arrays = (self.lower, self.upper, self.input_lower, self.input_upper)
        return tuple(tuple(array.tolist()) for array in arrays)

    @property
    def box(self) -> tuple[Array, Array]:
        """The bounds on x - x*, lower and upper."""
        return self.lower, self.upper

    def margins(self) -> Array:
        """Return (n,) the deviation from the trim that each state may have to both sides."""
        # The certified set is symmetric about the trim, so the nearer bound counts.
        return np.minimum(self.upper, -self.lower)


def _interval(name: str, bound: Bound) -> tuple[float, float]:
    pair = (-bound, bound) if is_number(bound) else bound
    ends = np.asarray(pair, object)
    if ends.shape != (2,) or not all(is_number(end) for end in ends):
        raise GainError(
            f"the domain of `{name}` is {bound}, and must be a half-width or a pair "
            "`[lower, upper]`."
        )
    low, high = map(float, ends)
    if not (np.isfinite([low, high]).all() and low < high):
        raise GainError(
            f"the domain of `{name}` is [{low:g}, {high:g}], and must be finite with its lower end "
            "below its upper."
        )
    if not low <= 0.0 <= high:
        raise GainError(
            f"the domain of `{name}` is [{low:g}, {high:g}], and must contain the trim, 0."
        )
    return float(low), float(high)


def _check_name(model: ControlAffine, name: str) -> None:
    if name not in model.state_names and name not in model.state_groups:
        allowed = [*model.state_groups, *model.state_names, *model.input_names]
        raise GainError(
            f"the domain names `{name}`, and `{type(model).__name__}` has {listing(allowed)}"
            f"{did_you_mean(name, allowed)}."
        )


def _check_turns(model: ControlAffine, state: Array) -> None:
    """Check that two agents in the domain differ by what laws take for their difference."""
    reach, wide = straight_range(model).reach, state[1] - state[0]
    for k in np.flatnonzero(np.isfinite(wide) & ~(wide < reach)):
        raise GainError(
            f"the domain of `{model.state_names[k]}` is {wide[k]:.4g} wide, and "
            f"`{type(model).__name__}` takes differences of it the shorter way round; allowed is "
            f"less than {reach[k]:.4g} in all."
        )


def _check_chart(model: ControlAffine, state: Array) -> None:
    trim = np.asarray(model.trim[0], float)
    for name, (low, high) in model.chart.items():
        k = model.state_names.index(name)
        reach = trim[k] + state[:, k]
        if np.isfinite(reach).all() and not (low < reach[0] and reach[1] < high):
            raise GainError(
                f"the domain of `{name}` reaches [{reach[0]:.4g}, {reach[1]:.4g}], and "
                f"`{type(model).__name__}` holds only inside ({low:.4g}, {high:.4g})."
            )
