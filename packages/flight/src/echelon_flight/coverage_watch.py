"""Whether a flight keeps to the conditions of its guarantee that one agent can see.

They are those that cover a run: inputs at no limit, states in the domain of the claim, and nothing
that the claim ignores. Of the vehicle nothing is proved, whether or not it keeps to them.
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
            NaN where there is nothing to watch.
        why: which one that was, or why there is nothing to watch; empty while all are kept.
    """

    def __init__(self, facts: Mapping[str, Any]) -> None:
        """Begin with all conditions kept, if there are any to watch."""
        stated = facts.get("guarantee", {})
        watched, ignored = stated.get("watched"), stated.get("ignores")
        self.lost, self.why = math.inf, ""
        if watched is None or ignored:
            nothing = stated.get("verdict", "none") == "none"
            why = "nothing is guaranteed" if nothing else "an agent cannot see its conditions"
            self.lost, self.why = math.nan, " and ".join(ignored or [why])
        self._conditions = [_condition(each) for each in watched or ()]

    def look(self, t: float, x: Sequence[float], u: Sequence[float]) -> bool:
        """Return whether state and input at a time of the plan (s) are the first to break one."""
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
    """Return whether it is of the input, its row without zeros, its bounds, and its text."""
    low, high, row = watched["low"], watched["high"], enumerate(watched["row"])
    bounds = -math.inf if low is None else low, math.inf if high is None else high
    sparse = [(k, factor) for k, factor in row if factor]
    return watched["of"] == "u", sparse, *bounds, watched["text"]
