"""A sweep on many machines: the workers of a dask cluster compute its batches."""

import socket
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from echelon.core.errors import EchelonError, MissingExtraError, OutputError

if TYPE_CHECKING:
    from echelon.experiments.sweeps.plan import Sweep
    from echelon.experiments.sweeps.sweep_dataset import SweepBatch
    from echelon.experiments.sweeps.workers import Workers

_PATIENCE = 10.0
"""Seconds in which a scheduler must answer."""
_KNOCK = 3.0
"""Seconds in which its machine must accept a connection."""
_POLL = 0.2
"""Seconds between two checks for finished batches, so that Ctrl-C takes effect at once."""
_workers: "dict[str, Workers]" = {}
_one_at_a_time = threading.Lock()


def check_scheduler(address: str) -> None:
    """Check that something listens at the address of a scheduler, which takes no JAX and no dask.

    Raises:
        OutputError: it is no address, or nothing listens there.
    """
    parts = urlsplit(address if "://" in address else f"tcp://{address}")
    try:
        host, port = parts.hostname, parts.port
    except ValueError:
        host, port = None, None
    if host is None or port is None:
        raise OutputError(
            f"`--cluster` is `{address}`, and must be an address with a port, such as "
            "`tcp://host:8786`."
        )
    try:
        socket.create_connection((host, port), _KNOCK).close()
    except OSError as error:
        why = error.strerror or f"nothing in {_KNOCK:g} s"
        raise OutputError(f"the cluster at `{address}` does not answer: {why}.") from error


def fly_on(
    address: str, plan: "Sweep", todo: Sequence[tuple[int, int]], progress: Callable[[], None]
) -> "Iterator[SweepBatch]":
    """Yield batches (first, count) of a sweep as the workers of a cluster complete them.

    A batch whose worker is lost is computed again by another, to the same bits. Workers must have
    echelon, and see the files that the scenario names.

    The address is such as `tcp://host:8786`; an error that `progress` raises ends the sweep.

    Raises:
        MissingExtraError: dask.distributed is not installed.
        EchelonError: there is no such scheduler, or a batch fails on it.
    """
    distributed = _distributed()
    client = _connect(distributed, address)
    try:
        # Each sweep has workers under a name of its own.
        name = f"echelon-{id(plan)}-{time.time_ns()}"
        remote = client.scatter(plan, broadcast=False)
        left = {client.submit(_fly, name, remote, *batch, pure=False) for batch in todo}
        while left:
            done = {future for future in left if future.done()}
            for future in done:
                yield _result(future)
            left -= done
            progress()
            if left and not done:
                time.sleep(_POLL)
    finally:
        client.close()


def _fly(name: str, plan: "Sweep", first: int, count: int) -> "SweepBatch":
    """Return a batch, computed by this worker, which builds the sweep's parts once."""
    from echelon.experiments.sweeps.workers import Workers

    # Two threads of a worker would compile the same code, and use more threads than processors.
    with _one_at_a_time:
        if name not in _workers:
            _workers.clear()
            _workers[name] = Workers(plan)
        return _workers[name].batch(first, count, lambda done, steps: None)


def _result(future: Any) -> "SweepBatch":
    try:
        return future.result()
    except EchelonError:
        raise
    except Exception as error:
        raise OutputError(f"a batch of the sweep failed on the cluster: {error}.") from error


def _connect(distributed: Any, address: str) -> Any:
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
            "install it with `pip install '.[cluster]'` in echelon's clone."
        ) from None
    return distributed
