"""Many runs at once, each as `simulate` would have it."""

from collections.abc import Callable, Iterator, Sequence

from echelon.core.errors import EchelonError
from echelon.engine.parts import Parts
from echelon.engine.result import Result
from echelon.engine.settings import Settings
from echelon.engine.simulate import simulate


def simulate_many(
    runs: Sequence[tuple[Parts, Settings]],
    told: Callable[[int, int], None] | None = None,
    threads: int | None = None,
) -> Iterator[Result | EchelonError]:
    """Yield what each run came to, in their order.

    Args:
        runs: parts and settings of each.
        told: called several times a second.
        threads: on which native code runs; one for each processor when left out.
    """
    for parts, settings in runs:
        try:
            yield simulate(parts, settings, told)
        except EchelonError as error:
            yield error
