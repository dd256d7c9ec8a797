"""Self-checks of an installation: versions, devices, and known results of the simulation."""

import importlib
from collections.abc import Callable, Iterator
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from echelon.agents.models import ControlAffine, Pendulum, Quadrotor
from echelon.agents.models.linearization import linearize
from echelon.agents.models.model_check import check_model
from echelon.agents.network.formation import Formation
from echelon.agents.network.graph import Graph
from echelon.agents.references import Lemniscate
from echelon.core import cache, numerics
from echelon.core.errors import EchelonError, ModelError
from echelon.core.files import versions
from echelon.core.numerics import require_jax
from echelon.core.words import amount
from echelon.experiments.results.metrics import metrics
from echelon.experiments.scenario import registry
from echelon.laws.consensus import Consensus
from echelon.laws.path_leader import Tracking
from echelon.simulation.engine.law_drive import Laws
from echelon.simulation.engine.parts import Parts
from echelon.simulation.engine.simulate import simulate
from echelon.simulation.native import vectors
from echelon.simulation.native.threads import processors
from echelon.simulation.step.settings import Settings
from echelon.synthesis.gains.gain import synthesize
from echelon.synthesis.gains.riccati import Riccati


class Check(NamedTuple):
    """One self-check: a claim, whether it holds, and the measured number."""

    claim: str
    holds: bool
    found: str


def facts() -> dict[str, str]:
    """Return versions and devices."""
    try:
        require_jax()
        devices = ", ".join(f"{x.platform}:{x.id} ({x.device_kind})" for x in jax.devices())
    except EchelonError:
        devices = "none"
    count = processors()
    native = f"{vectors()}; {amount(count, 'thread')}, as many as processors"
    return {**versions(), "devices": devices, "native code": native}


def checks() -> Iterator[Check]:
    """Run the self-checks one after the other; where JAX cannot run, that alone is found."""
    try:
        require_jax()
    except EchelonError as error:
        yield Check("JAX runs in this process", False, str(error).rstrip("."))
        return
    for test in CHECKS:
        # Results on disk may come from another machine or an earlier state of this one.
        with numerics.precision("float64"), cache.use_folder(None):
            check = test()
        yield check


def _double_precision() -> Check:
    # In float32 the error would be 1e-8.
    third = float(jnp.asarray(1.0) / 3.0)
    return Check(
        "arithmetic is in float64 without a flag",
        third == 1.0 / 3.0,
        f"1/3 is off by {abs(third - 1 / 3):.1g}",
    )


def _precision_kept() -> Check:
    """Linearize in a float32 program."""
    # No other code uses this damping, so the result is not cached.
    damping = 0.1234567890123
    with numerics.precision("float32"):
        A = linearize(Pendulum(damping=damping)).A
        after = jnp.asarray(1.0).dtype
    off = abs(float(A[1, 1]) + damping)
    return Check(
        "a float32 program gets float64 results, and stays in float32",
        off < 1e-15 and after == jnp.float32,
        f"A is off by {off:.1g}, and JAX is in {after} after it",
    )


def _models() -> Check:
    parameters = {"linear": {"A": ((0.0, 1.0), (0.0, 0.0)), "B": ((0.0,), (1.0,))}}
    faults = []
    for name, entry in registry.MODELS.items():
        module, _, cls = entry.target.partition(":")
        make: Callable[..., ControlAffine] = getattr(importlib.import_module(module), cls)
        try:
            check_model(make(**parameters.get(name, {})))
        except ModelError as error:
            faults.append(str(error))
    return Check(
        "every bundled model is finite, with its trim an equilibrium",
        not faults,
        " ".join(faults) or f"{len(registry.MODELS)} models",
    )


def _spectra() -> Check:
    # The paper's tree. By hand: det(L - x) = (1 - x) (x^2 - 4 x + 1).
    tree = Graph.from_edges([(0, 1), (1, 2), (1, 3)]).spectrum().eigenvalues
    off = float(np.abs(tree - np.array([2.0 - np.sqrt(3.0), 1.0, 2.0 + np.sqrt(3.0)])).max())
    return Check(
        "the tree's grounded spectrum is 2 - sqrt 3, 1, 2 + sqrt 3",
        off < 1e-12,
        f"off by {off:.1g}",
    )


def _order() -> Check:
    """Measure the order of the Runge-Kutta step on the pendulum."""
    model, x, u = Pendulum(), jnp.array([1.0, 0.0]), jnp.zeros(1)

    def end(steps: int) -> jax.Array:
        step = lambda _, x: numerics.rk4(model.velocity, x, u, 1.0 / steps)  # noqa: E731
        return jax.lax.fori_loop(0, steps, step, x)

    coarse, fine, finest = (end(steps) for steps in (20, 40, 80))
    # Halving a step divides the error by 2^4, up to the next order: 3.8 allows for that, but not
    # for order 3.
    order = float(np.log2(jnp.linalg.norm(coarse - fine) / jnp.linalg.norm(fine - finest)))
    return Check("the Runge-Kutta step has order 4", order > 3.8, f"measured {order:.2f}")


def _flatness() -> Check:
    """Compare the rate of the quadrotor's flat state with its dynamics."""
    model, reference = Quadrotor.crazyflie(), Lemniscate()

    t = jnp.asarray(1.3)
    (x, u), (rate, _) = jax.jvp(partial(reference.follow, model), (t,), (jnp.ones_like(t),))
    # An identity of the exact map, so the residual is rounding only.
    off = float(jnp.abs(rate - model.velocity(x, u)).max())
    return Check(
        "the quadrotor's flatness map solves its equations", off < 1e-9, f"residual {off:.1g}"
    )


def _closed_loop() -> Check:
    model, graph = Quadrotor.crazyflie(), Graph.path(3)
    formation = Formation.from_offsets(model, graph, {1: (1.0, 0.0, 0.0), 2: (2.0, 0.0, 0.0)})
    follower = Consensus(synthesize(model, graph, Riccati()), feedforward="relay")
    parts = Parts(
        model,
        graph,
        formation,
        Laws(Tracking(Lemniscate()), follower),
        initial={"position": 0.5, "attitude": 0.2},
    )
    settings = Settings(horizon=30.0, dt=0.01, store_every=10, steady_window=2.0)
    worst = metrics(simulate(parts, settings)).worst_steady or float("inf")
    return Check(
        "two followers join a flying leader", worst < 1e-6, f"error {worst:.1g} m after 30 s"
    )


CHECKS: tuple[Callable[[], Check], ...] = (
    *(_double_precision, _precision_kept, _models, _spectra),
    *(_order, _flatness, _closed_loop),
)
"""The self-checks, in their order."""
