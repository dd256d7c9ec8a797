"""Errors: each message is one sentence that says what was received and what to do."""

from collections.abc import Iterable


class RangeError(ValueError):
    """A function has no range, or no slopes, on the box or the interval."""


class UnboundedError(RangeError):
    """The range of a variable is needed, but the box leaves it unbounded; `name` is its name."""

    def __init__(self, name: str) -> None:
        self.name = name
        super().__init__(f"the domain leaves `{name}` unbounded, and must give it a bound.")


class JumpError(RangeError):
    """A function may be discontinuous on the box, so it has no slopes there."""


def listing(names: Iterable[str]) -> str:
    """Return names in back-ticks, separated by commas, for use inside a message."""
    return ", ".join(f"`{name}`" for name in names)
