"""Tunes the weights of a Riccati gain: gradient descent on a cost of the simulated run.

The cost is differentiated through the closed loop (`engine/gradient.py`) and the Riccati equation.
Its logarithm is minimized over the logarithms of the weights, so weights remain positive and steps
are relative.
"""

import contextlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg
import scipy.optimize
from jaxtyping import Float

from echelon.agents.models.linearization import linearize
from echelon.core.errors import EchelonError, GainError, check_name, listing
from echelon.core.types import Array
from echelon.experiments.scenario import registry
from echelon.experiments.scenario.build import build
from echelon.experiments.scenario.scenario import Scenario, ScenarioLike, as_scenario
from echelon.experiments.studies.design import with_gain
from echelon.guarantees.promises.promise import Promise, promise
from echelon.simulation.engine.differentiable_run import Cost, Gradient
from echelon.simulation.engine.gradient import gradient
from echelon.simulation.step.meter import Sums
from echelon.synthesis.gains.gain import Gain, synthesize
from echelon.synthesis.gains.riccati import Riccati, weights_of

PARAMETERS: tuple[str, ...] = ("follower.gain.Q", "follower.gain.R", "follower.gain.coupling")
"""The keys of a scenario that can be tuned; of weights, the diagonal."""

COSTS: Mapping[str, Callable[[Sums], Any]] = {
    "formation": lambda sums: sums.errors[0].sum(),
    "effort": lambda sums: sums.effort.sum(),
    "spacing": lambda sums: sums.spacing.sum(),
}
"""Mean squares over all steps: of the followers' errors, of all normalized inputs about the trim,
and of the errors of distances along edges; each summed over agents or edges."""

_RANGE = 1e4
"""Bounds of a parameter: its initial value divided and multiplied by this."""
_LOST = 1e3
"""The logarithm of the cost of a run that diverged, above that of any other."""


class TuneTrial(NamedTuple):
    """A choice of the parameters with its gain, and the cost of the run."""

    values: Mapping[str, Any]
    gain: Gain
    cost: float


class TuneResult(NamedTuple):
    """The gain before and after with its guarantees, and the cost of each trial."""

    before: TuneTrial
    after: TuneTrial
    promised_before: Promise
    promised_after: Promise
    costs: tuple[float, ...]


def cost_named(text: str) -> Cost:
    """Return the cost of a text such as `formation + 0.01*effort`.

    Raises:
        EchelonError: a term is not one of `COSTS`, or a weight is not a positive number.
    """
    terms = [_term(term.strip()) for term in text.split("+")]

    def cost(sums: Sums) -> Any:
        return sum(weight * COSTS[name](sums) for weight, name in terms) / sums.steps[0]

    return cost


def _term(text: str) -> tuple[float, str]:
    first, star, name = text.rpartition("*")
    name, weight = name.strip(), 1.0
    if star:
        with contextlib.suppress(ValueError):
            weight = float(first)
            first = ""
    if first or not 0.0 < weight < np.inf:
        raise EchelonError(
            f"`cost` has the weight `{text.rpartition('*')[0]}` for `{name}`, allowed is a "
            "positive number, as in `formation + 0.01*effort`."
        )
    check_name("`cost` names", name, COSTS)
    return weight, name


def tune(
    scenario: ScenarioLike,
    parameters: Sequence[str] = PARAMETERS[:2],
    cost: str = "formation",
    rounds: int = 30,
    progress: Callable[[int, float], None] | None = None,
) -> TuneResult:
    """Minimize the cost of a scenario's run over the weights of its Riccati gain.

    The search ends when the cost no longer decreases, after the given number of iterations, or at
    Ctrl-C; the best of all trials is returned. It is the best for this run from these starts: the
    guarantee of the gain is computed anew, and a sweep shows its errors from other starts.

    Args:
        scenario: (or its name or file) its followers have a gain of the method `riccati`.
        parameters: of `PARAMETERS`.
        cost: a sum of `COSTS`, each with an optional factor.
        rounds: the largest number of iterations (L-BFGS-B), of one or a few trials each.
        progress: called after each trial with its number and the least cost so far.

    Raises:
        EchelonError: a part of the scenario cannot be built, or cannot be tuned.
    """
    search = _Search(as_scenario(scenario), parameters, cost_named(cost), progress)
    bounds = [(x - np.log(_RANGE), x + np.log(_RANGE)) for x in search.start]
    lowest = search.lowest_coupling
    if lowest is not None:
        bounds[-1] = (min(search.start[-1], np.log(lowest)), bounds[-1][1])
    with contextlib.suppress(KeyboardInterrupt):
        scipy.optimize.minimize(
            search.evaluate,
            search.start,
            jac=True,
            method="L-BFGS-B",
            bounds=bounds,
            options={"maxiter": rounds},
        )
    if not search.trials and search.lost:
        raise EchelonError(
            "the run diverges with the scenario's own weights, and so its cost has no gradient; "
            "shorten `simulation.dt` or `simulation.horizon`."
        )
    if not search.trials:
        raise EchelonError("the search was interrupted before the first trial.")
    before, after = search.trials[0], min(search.trials, key=lambda trial: trial.cost)
    costs = tuple(trial.cost for trial in search.trials)
    return TuneResult(before, after, search.promise_of(before), search.promise_of(after), costs)


class _Search:
    """The search for one scenario; a point is the vector of the logarithms of all parameters."""

    def __init__(
        self,
        scenario: Scenario,
        parameters: Sequence[str],
        cost: Cost,
        progress: Callable[[int, float], None] | None,
    ) -> None:
        _check_parameters(scenario, parameters)
        self.parts, self.settings = build(scenario)
        self.cost, self.progress, self.trials = cost, progress, list[TuneTrial]()
        self.lost = 0
        self.names = [key for key in PARAMETERS if key in parameters]
        gain, spec = self.parts.drive.gain, scenario.follower.gain
        assert gain is not None
        weights = weights_of(self.parts.model, spec.Q, spec.R)
        self.initial = dict(
            zip(PARAMETERS, (*map(_diagonal, weights, "QR"), gain.coupling), strict=True)
        )
        self.coupling = spec.coupling
        initial = [np.atleast_1d(self.initial[name]) for name in self.names]
        # A weight of 0 is not changed by factors.
        self.free = [values > 0.0 for values in initial]
        self.start = np.log(np.concatenate([x[f] for x, f in zip(initial, self.free, strict=True)]))

    @property
    def lowest_coupling(self) -> float | None:
        """The smallest guaranteed coupling, where the coupling is tuned."""
        gain = self.parts.drive.gain
        assert gain is not None
        return gain.certificate.edge if PARAMETERS[2] in self.names else None

    def promise_of(self, trial: TuneTrial) -> Promise:
        """Return the promise with the gain of a trial."""
        return promise(with_gain(self.parts, trial.gain), self.settings)

    def evaluate(self, point: Float[Array, " k"]) -> tuple[float, Float[Array, " k"]]:
        """Return the logarithm of the cost at a point, and its gradient."""
        values = self._values(point)
        try:
            gain = self._gain(values)
            cost = gradient(
                with_gain(self.parts, gain), self.settings, self.cost, ("P", "R", "coupling")
            )
            slopes = self._slopes(gain, cost, values) / max(cost.value, 1e-300)
        except GainError:
            self.lost += 1
            return _LOST, np.zeros_like(point)
        self.trials.append(TuneTrial(values, gain, cost.value))
        if self.progress is not None:
            self.progress(len(self.trials), min(trial.cost for trial in self.trials))
        return float(np.log(max(cost.value, 1e-300))), slopes

    def _values(self, point: Float[Array, " k"]) -> Mapping[str, Any]:
        """Return all parameters at a point."""
        values, rest = dict(self.initial), np.exp(point)
        for name, free in zip(self.names, self.free, strict=True):
            value = np.atleast_1d(np.array(values[name], float))
            value[free], rest = rest[: free.sum()], rest[free.sum() :]
            values[name] = value if np.ndim(self.initial[name]) else value[0]
        return values

    def _gain(self, values: Mapping[str, Any]) -> Gain:
        Q, R, coupling = (values[name] for name in PARAMETERS)
        tuned = PARAMETERS[2] in self.names
        method = Riccati(Q=Q, R=R, coupling=float(coupling) if tuned else self.coupling)
        return synthesize(self.parts.model, self.parts.graph, method)

    def _slopes(self, gain: Gain, cost: Gradient, values: Mapping[str, Any]) -> Array:
        """Return the derivative of the cost with respect to the logarithm of each parameter.

        Raises:
            GainError: the run diverges, and has none.
        """
        if not all(np.isfinite(x).all() for x in (cost.value, *cost.slopes.values())):
            raise GainError("the run diverges with this gain, and its cost has no slopes.")
        by_Q, by_R = through_riccati(*linearize(self.parts.model), gain.P, gain.R, cost.slopes["P"])
        by_R = by_R + cost.slopes["R"]
        along = dict(
            zip(PARAMETERS, (np.diag(by_Q), np.diag(by_R), cost.slopes["coupling"]), strict=True)
        )
        parts = zip(self.names, self.free, strict=True)
        return np.concatenate(
            [np.atleast_1d(along[name] * values[name])[free] for name, free in parts]
        )


def through_riccati(
    A: Float[Array, "n n"],
    B: Float[Array, "n m"],
    P: Float[Array, "n n"],
    R: Float[Array, "m m"],
    slope: Float[Array, "n n"],
) -> tuple[Float[Array, "n n"], Float[Array, "m m"]]:
    """Return derivatives with respect to Q and R from that with respect to P, which is symmetric.

    P solves A'P + P A - P B R^-1 B'P + Q = 0. With K = R^-1 B'P and F = A - B K, a change obeys
    F'dP + dP F + dQ + K'dR K = 0. So <slope, dP> = <X, dQ + K'dR K> with F X + X F' + slope = 0.
    """
    K = np.linalg.solve(R, B.T @ P)
    X = scipy.linalg.solve_continuous_lyapunov(A - B @ K, -slope)
    return X, K @ X @ K.T


def _check_parameters(scenario: Scenario, parameters: Sequence[str]) -> None:
    """Refuse parameters and scenarios that cannot be tuned."""
    for name in parameters:
        check_name("`params` names", name, PARAMETERS)
    if not parameters:
        raise EchelonError(f"`params` is empty, allowed are {listing(PARAMETERS)}.")
    spec, law = scenario.follower.gain, scenario.follower.law
    got = f"the gain file `{spec.file}`" if spec.file else f"the method `{spec.method}`"
    got = f"the method `{spec.python}`" if spec.python else got
    got = f"the law `{law}`" if law != registry.DEFAULT_FOLLOWER_LAW else got
    if (
        law != registry.DEFAULT_FOLLOWER_LAW
        or spec.file
        or spec.python
        or spec.method != Riccati.name
    ):
        raise EchelonError(
            f"the followers have {got}, but only weights of `riccati` under the law "
            "`consensus` can be tuned."
        )


def _diagonal(weight: Array, name: str) -> Array:
    if np.any(weight != np.diag(np.diag(weight))):
        raise EchelonError(
            f"`follower.gain.{name}` has off-diagonal entries, but only a diagonal can be tuned."
        )
    return np.diag(weight)
