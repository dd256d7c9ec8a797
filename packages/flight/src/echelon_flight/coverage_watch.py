"""Whether a flight keeps to the conditions of its guarantee that one agent can see.

The rule is that of a run: its inputs at no limit, its states in the domain of the claim, and
nothing acts that the claim ignores. Vehicles are not the model: a flight that keeps to them all has
no proof, and one that does not has lost what the proof of the model was worth.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, final


@final
class CoverageWatch:
    """Watches the conditions that law.json names under `guarantee.watched`.

    Args:
        facts: the content of law.json.

    Attributes:
        lost: the time of the plan (s) at which the first condition was broken; infinite before,
            NaN where nothing is guaranteed from the start.
        why: which one that was, or why nothing is guaranteed; empty while all are kept.
    """

    def __init__(self, facts: Mapping[str, Any]) -> None:
        """Have seen nothing yet."""
        stated = facts.get("guarantee", {})
        watched, ignored = stated.get("watched"), stated.get("ignores")
        self.lost, self.why = math.inf, ""
        if watched is None or ignored:
            self.lost, self.why = math.nan, " and ".join(ignored or ["nothing is guaranteed"])
        self._conditions = [_condition(each) for each in watched or ()]

    def look(self, t: float, x: Sequence[float], u: Sequence[float]) -> bool:
        """Judge a state and an input at a time of the plan (s); tell whether it is lost by them."""
        if self.lost != math.inf:
            return False
        for of_input, row, low, high, text in self._conditions:
            values = u if of_input else x
            if not low <= sum([a * values[k] for k, a in row]) <= high:
                self.lost, self.why = t, text
                return True
        return False


def _condition(
    watched: Mapping[str, Any],
) -> tuple[bool, list[tuple[int, float]], float, float, str]:
    """Return of what a row is, the row without its zeros, its bounds, and what is said beyond."""
    low, high, row = watched["low"], watched["high"], enumerate(watched["row"])
    bounds = -math.inf if low is None else low, math.inf if high is None else high
    sparse = [(k, factor) for k, factor in row if factor]
    return watched["of"] == "u", sparse, *bounds, watched["text"]
