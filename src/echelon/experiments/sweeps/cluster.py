"""A sweep on many machines: the workers of a dask cluster compute its batches."""

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from echelon.core.errors import EchelonError, MissingExtraError, OutputError
from echelon.experiments.sweeps.plan import Sweep
from echelon.experiments.sweeps.workers import SweepBatch, Workers

_PATIENCE = 10.0
"""Seconds in which a scheduler must answer."""
_LOOK = 0.2
"""Seconds between two looks at what is done, so that Ctrl-C is heard at once."""
_crews: dict[str, Workers] = {}
_one_at_a_time = threading.Lock()


def fly_on(
    address: str, plan: Sweep, todo: Sequence[tuple[int, int]], told: Callable[[], None]
) -> Iterator[SweepBatch]:
    """Yield batches (first, count) of a sweep as the workers of a cluster have done them.

    A batch whose worker is lost is computed again by another, to the same bits. Workers must have
    echelon, and see the files that the scenario names.

    Args:
        address: of the scheduler, such as `tcp://host:8786`.
        plan: the sweep.
        todo: the batches.
        told: called several times a second; what it raises ends the sweep.

    Raises:
        MissingExtraError: dask.distributed is not installed.
        EchelonError: there is no such scheduler, or a batch fails on it.
    """
    distributed = _distributed()
    client = _connected(distributed, address)
    try:
        # Its name decides where a worker keeps it: another sweep is another crew.
        name = f"echelon-{id(plan)}-{time.time_ns()}"
        sent = client.scatter(plan, broadcast=False)
        left = {client.submit(_fly, name, sent, *each, pure=False) for each in todo}
        while left:
            done = {each for each in left if each.done()}
            for future in done:
                yield _received(future)
            left -= done
            told()
            if left and not done:
                time.sleep(_LOOK)
    finally:
        client.close()


def _fly(name: str, plan: Sweep, first: int, count: int) -> SweepBatch:
    """Return a batch, computed here; what was built for another of the sweep is there."""
    # The threads of a worker would else compile the same twice, and share the processors twice.
    with _one_at_a_time:
        if name not in _crews:
            _crews.clear()
            _crews[name] = Workers(plan)
        return _crews[name].batch(first, count, lambda done, steps: None)


def _received(future: Any) -> SweepBatch:
    try:
        return future.result()
    except EchelonError:
        raise
    except Exception as error:
        raise OutputError(f"a batch of the sweep failed on the cluster: {error}.") from error


def _connected(distributed: Any, address: str) -> Any:
    try:
        return distributed.Client(address, timeout=_PATIENCE)
    except (OSError, ValueError, TypeError) as error:
        why = str(error).partition("\n")[0].rstrip(".")
        raise OutputError(f"the cluster at `{address}` does not answer: {why}.") from error


def _distributed() -> Any:
    try:
        import distributed
    except ImportError:
        raise MissingExtraError(
            "a sweep on a cluster needs dask.distributed; "
            "install it with `pip install 'echelon-formation[cluster]'`."
        ) from None
    return distributed
