"""Leaders without followers: whether they agree, and how far they move from the trim."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from echelon.agents.models.linearization import linearize
from echelon.agents.models.model import ControlAffine
from echelon.agents.network.formation import Formation
from echelon.agents.network.graph import Graph
from echelon.core.compiled import cached_jit
from echelon.core.types import Array, States
from echelon.guarantees.promises.closed_loop import all_alike
from echelon.laws.law import Law, Proves, Travels, TrimInput, gain_of
from echelon.simulation.engine.parts import Parts
from echelon.simulation.engine.result import Result
from echelon.simulation.engine.simulate import simulate
from echelon.simulation.step.meter import measured_states
from echelon.simulation.step.settings import Settings

_SAME = 1e-12
"""Relative to the states; starts that differ by less were meant to agree, and offsets rounded."""
_AXIS = 1e-9  # 1/s; a mode slower than this is not damped
_FRAMES = 20_000
"""Of a leader's own run, from which its excursion is read: so many are 3 MB of 13 states."""


class Leaders(NamedTuple):
    """What is known of the leaders without running them.

    Attributes:
        starts: (L, n) where they start, less their offsets.
        rest: whether their input stays at the trim.
        alike: whether they obey the followers' law, with nothing fed forward.
        answer: whether they act on their neighbours' states.
        slowest: of the modes of a leader by itself, 1/s; None where its law is not known.
    """

    starts: Array
    rest: bool
    alike: bool
    answer: bool
    slowest: float | None

    @property
    def agree(self) -> bool:
        """Whether all are at the same place of the formation from the start and for good."""
        apart = float(np.abs(self.starts - self.starts[0]).max())
        alone = len(self.starts) == 1
        return alone or not self.answer and apart <= _SAME * float(np.abs(self.starts).max())

    @property
    def meet(self) -> bool:
        """Whether their own modes bring them together, near the trim."""
        return self.alike or not self.answer and self.damped

    @property
    def damped(self) -> bool:
        """Whether a leader by itself comes back to what it follows, near the trim."""
        return self.slowest is not None and self.slowest < -_AXIS


def leaders_of(parts: Parts, states: Array) -> Leaders:
    """Return what is known of the leaders of prepared parts that start in `states` (N, n)."""
    model, drive, leads = parts.model, parts.drive, list(parts.graph.leaders)
    law = getattr(drive, "leader", None)
    answer = drive.reacts or law is not None and Proves.of(law).metric(model) is not None
    return Leaders(
        starts=(states - parts.formation.offsets_at([0.0])[0])[leads],
        rest=isinstance(law, TrimInput),
        alike=all_alike(drive, model),
        answer=answer,
        slowest=_slowest(model, law),
    )


def _slowest(model: ControlAffine, law: object) -> float | None:
    A, B = linearize(model)
    if not isinstance(law, Law) or Proves.of(law).metric(model) is not None:
        return None
    gain = gain_of(law)
    if gain is not None:
        A = A - gain.coupling * B @ np.linalg.solve(gain.R, B.T @ gain.P)
    elif not isinstance(law, TrimInput):
        return Travels.of(law).own_mode(model)
    return float(np.linalg.eigvals(A).real.max())


def own_paths(parts: Parts, settings: Settings, starts: Array) -> Array | None:
    """Return the states (T, L, n) of the leaders in a run of their own; None if it diverges."""
    run = own_run(parts, settings, starts)
    return None if run is None else run.states[:, : len(starts)]


def own_run(parts: Parts, settings: Settings, starts: Array) -> Result | None:
    """Return a run of the leaders, the first L agents, by themselves; None if it diverges.

    Their offsets are left out of it.
    """
    count = len(starts)
    # Somebody must follow; one that rests at the trim changes nothing.
    graph = Graph([(k, count) for k in range(count)], leaders=range(count))
    states = np.concatenate([starts, np.asarray(parts.model.trim[0], float)[None]])
    goals = Formation(np.zeros_like(states))
    alone = Parts(parts.model, graph, goals, parts.drive.with_follower(TrimInput()), initial=states)
    every = 1 + settings.steps // _FRAMES
    # Nothing is drawn, whatever the seed.
    chosen = settings._replace(store_every=every, precision="float64", seed=0)
    result = simulate(alone, chosen)
    return result if result.outcome.reached else None


class Apart(NamedTuple):
    """How far the leader that is farthest off the first one is from it: start, end, at most."""

    leader: int
    start: float
    end: float
    most: float


def apart(parts: Parts, settings: Settings, starts: Array) -> Apart:
    """Return how far leaders that are left to themselves drift apart, as errors are measured."""
    paths = own_paths(parts, settings, starts)
    paths = starts[None] if paths is None else paths
    gaps = paths[..., list(measured_states(parts.model))]
    with np.errstate(over="ignore", invalid="ignore"):
        gaps = np.linalg.norm(gaps - gaps[:, :1], axis=2)
    k = int(gaps.max(axis=0).argmax())
    start, *_, end = np.append(gaps[:1, k], gaps[:, k])
    return Apart(parts.graph.leaders[k], float(start), float(end), float(gaps[:, k].max()))


def excursion(parts: Parts, paths: Array) -> Array:
    """Return how far states (T, L, n) go from the trim, (n,)."""
    trim = jnp.asarray(np.asarray(parts.model.trim[0], float))
    states = jnp.asarray(paths.reshape(-1, paths.shape[-1]))
    return np.abs(np.asarray(_differences(parts.model, states, trim))).max(axis=0)


@cached_jit
def _differences(model: ControlAffine, states: States, base: jax.Array) -> jax.Array:
    return jax.vmap(lambda x: model.difference(x, base))(states)
