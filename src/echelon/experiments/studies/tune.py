"""A Riccati gain whose weights are chosen by the flight: a stated cost lowered along its slope.

The cost is differentiated through the closed loop (`engine/gradient.py`) and through the Riccati
equation, and its logarithm is lowered over the logarithms of the weights, which keeps them positive
and makes steps of them relative.
"""

import contextlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg
import scipy.optimize

from echelon.agents.models.linearization import linearize
from echelon.core.errors import EchelonError, GainError, did_you_mean, listing
from echelon.core.types import Array
from echelon.experiments.scenario import registry
from echelon.experiments.scenario.build import build
from echelon.experiments.scenario.scenario import Scenario
from echelon.experiments.studies.design import with_gain
from echelon.guarantees.promises.promise import Promise, promise
from echelon.simulation.engine.gradient import Cost, Gradient, gradient
from echelon.simulation.step.meter import Sums
from echelon.synthesis.gains.gain import Gain, synthesize
from echelon.synthesis.gains.riccati import Riccati
from echelon.synthesis.gains.weights import weights_of

PARAMETERS: tuple[str, ...] = ("follower.gain.Q", "follower.gain.R", "follower.gain.coupling")
"""What can be tuned, by its key in a scenario; of weights, the diagonal."""

COSTS: Mapping[str, Callable[[Sums], Any]] = {
    "formation": lambda sums: sums.errors[0].sum(),
    "effort": lambda sums: sums.effort.sum(),
    "spacing": lambda sums: sums.spacing.sum(),
}
"""Mean squares over all steps: of the followers' errors, of all normalized inputs about the trim,
and of what distances along edges are off; each summed over agents or edges."""

_RANGE = 1e4
"""A parameter is looked for between so many times less and more than where it begins."""
_LOST = 1e3
"""The logarithm of the cost of a run that is lost, beyond that of any other."""


class TuneTrial(NamedTuple):
    """One choice of the parameters: them, the gain they make, and the cost of its run."""

    values: Mapping[str, Any]
    gain: Gain
    cost: float


class TuneResult(NamedTuple):
    """A gain before and after, what is promised with each, and the cost after each trial."""

    before: TuneTrial
    after: TuneTrial
    promised_before: Promise
    promised_after: Promise
    costs: tuple[float, ...]


def cost_named(text: str) -> Cost:
    """Return the cost that words such as `formation + 0.01*effort` say.

    Raises:
        EchelonError: a word is none of `COSTS`, or a weight is no positive number.
    """
    terms = [_term(each.strip()) for each in text.split("+")]

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
            f"`cost` weighs `{name}` by `{text.rpartition('*')[0]}`, and must by a "
            "positive number, as in `formation + 0.01*effort`."
        )
    if name not in COSTS:
        raise EchelonError(
            f"`cost` names `{name}`, allowed are {listing(COSTS)}{did_you_mean(name, COSTS)}."
        )
    return weight, name


def tune(
    scenario: Scenario,
    parameters: Sequence[str] = PARAMETERS[:2],
    cost: str = "formation",
    rounds: int = 30,
    progress: Callable[[int, float], None] | None = None,
) -> TuneResult:
    """Lower the cost of a scenario's run by the weights of its Riccati gain.

    It goes on until the cost lies still, for so many rounds at most, or until Ctrl-C; the best of
    all trials is returned. It is the best for this run, from these starts: what is promised of the
    gain is computed anew, and what it does from others is for a sweep to say.

    Args:
        scenario: whose followers have a gain by `riccati`.
        parameters: of `PARAMETERS`.
        cost: a sum of `COSTS`, each perhaps times a number.
        rounds: the most rounds of the search (L-BFGS-B), of one trial or a few each.
        progress: called after each trial with its number and the least cost so far.

    Raises:
        EchelonError: a part of the scenario cannot be made, or is not what can be tuned.
    """
    search = _Search(scenario, parameters, cost_named(cost), progress)
    bounds = [(x - np.log(_RANGE), x + np.log(_RANGE)) for x in search.start]
    lowest = search.lowest_coupling
    if lowest is not None:
        bounds[-1] = (min(search.start[-1], np.log(lowest)), bounds[-1][1])
    with contextlib.suppress(KeyboardInterrupt):
        scipy.optimize.minimize(
            search.try_at,
            search.start,
            jac=True,
            method="L-BFGS-B",
            bounds=bounds,
            options={"maxiter": rounds},
        )
    if not search.tried:
        raise EchelonError("nothing was tried before the search was interrupted.")
    before, after = search.tried[0], min(search.tried, key=lambda each: each.cost)
    costs = tuple(each.cost for each in search.tried)
    return TuneResult(before, after, search.promise_of(before), search.promise_of(after), costs)


class _Search:
    """Trials of one scenario; positions are the logarithms of the parameters, end to end."""

    def __init__(
        self,
        scenario: Scenario,
        parameters: Sequence[str],
        cost: Cost,
        progress: Callable[[int, float], None] | None,
    ) -> None:
        _check_parameters(scenario, parameters)
        self.parts, self.settings = build(scenario)
        self.cost, self.progress, self.tried = cost, progress, list[TuneTrial]()
        self.names = [key for key in PARAMETERS if key in parameters]
        gain, spec = self.parts.drive.gain, scenario.follower.gain
        assert gain is not None
        weights = weights_of(self.parts.model, spec.Q, spec.R)
        self.begun = dict(
            zip(PARAMETERS, (*map(_diagonal, weights, "QR"), gain.coupling), strict=True)
        )
        self.chosen = spec.coupling
        begun = [np.atleast_1d(self.begun[name]) for name in self.names]
        # What has weight 0 keeps it: there is no way from there by factors.
        self.free = [each > 0.0 for each in begun]
        self.start = np.log(np.concatenate([x[f] for x, f in zip(begun, self.free, strict=True)]))

    @property
    def lowest_coupling(self) -> float | None:
        """The edge of the guarantee, where the coupling is tuned."""
        gain = self.parts.drive.gain
        assert gain is not None
        return gain.certificate.edge if PARAMETERS[2] in self.names else None

    def promise_of(self, tried: TuneTrial) -> Promise:
        """Return what is promised with the gain of a trial."""
        return promise(with_gain(self.parts, tried.gain), self.settings)

    def try_at(self, place: Array) -> tuple[float, Array]:
        """Return the logarithm of the cost at a place, and its slope."""
        values = self._values(place)
        try:
            gain = self._gain(values)
            found = gradient(
                with_gain(self.parts, gain), self.settings, self.cost, ("P", "R", "coupling")
            )
        except GainError:
            return _LOST, np.zeros_like(place)
        slopes = self._slopes(gain, found, values) / max(found.value, 1e-300)
        if not (np.isfinite(found.value) and np.isfinite(slopes).all()):
            return _LOST, np.zeros_like(place)
        self.tried.append(TuneTrial(values, gain, found.value))
        if self.progress is not None:
            self.progress(len(self.tried), min(each.cost for each in self.tried))
        return float(np.log(max(found.value, 1e-300))), slopes

    def _values(self, place: Array) -> Mapping[str, Any]:
        """Return all parameters, those that are tuned at a place."""
        values, rest = dict(self.begun), np.exp(place)
        for name, free in zip(self.names, self.free, strict=True):
            value = np.atleast_1d(np.array(values[name], float))
            value[free], rest = rest[: free.sum()], rest[free.sum() :]
            values[name] = value if np.ndim(self.begun[name]) else value[0]
        return values

    def _gain(self, values: Mapping[str, Any]) -> Gain:
        Q, R, coupling = (values[name] for name in PARAMETERS)
        own = PARAMETERS[2] in self.names
        method = Riccati(Q=Q, R=R, coupling=float(coupling) if own else self.chosen)
        return synthesize(self.parts.model, self.parts.graph, method)

    def _slopes(self, gain: Gain, found: Gradient, values: Mapping[str, Any]) -> Array:
        """Return the slope of the cost along the logarithm of each parameter."""
        by_Q, by_R = through_riccati(
            *linearize(self.parts.model), gain.P, gain.R, found.slopes["P"]
        )
        by_R = by_R + found.slopes["R"]
        along = dict(
            zip(PARAMETERS, (np.diag(by_Q), np.diag(by_R), found.slopes["coupling"]), strict=True)
        )
        parts = zip(self.names, self.free, strict=True)
        return np.concatenate(
            [np.atleast_1d(along[name] * values[name])[free] for name, free in parts]
        )


def through_riccati(A: Array, B: Array, P: Array, R: Array, slope: Array) -> tuple[Array, Array]:
    """Return the slopes along Q and R of what has a slope along P, P the solution of Riccati.

    With K = R^-1 B'P and F = A - B K, a change obeys F'dP + dP F + dQ + K'dR K = 0. So
    <slope, dP> = <X, dQ + K'dR K> with F X + X F' + slope = 0.

    Args:
        A: (n, n).
        B: (n, m).
        P: (n, n), of A'P + P A - P B R^-1 B'P + Q = 0.
        R: (m, m).
        slope: (n, n) symmetric.
    """
    K = np.linalg.solve(R, B.T @ P)
    X = scipy.linalg.solve_continuous_lyapunov(A - B @ K, -slope)
    return X, K @ X @ K.T


def _check_parameters(scenario: Scenario, parameters: Sequence[str]) -> None:
    """Refuse what cannot be tuned."""
    for name in parameters:
        if name not in PARAMETERS:
            raise EchelonError(
                f"`params` names `{name}`, allowed are {listing(PARAMETERS)}"
                f"{did_you_mean(name, PARAMETERS)}."
            )
    if not parameters:
        raise EchelonError(f"`params` names nothing, allowed are {listing(PARAMETERS)}.")
    spec, law = scenario.follower.gain, scenario.follower.law
    found = f"the gain file `{spec.file}`" if spec.file else f"the method `{spec.method}`"
    found = f"a method of one's own, `{spec.python}`" if spec.python else found
    found = f"the law `{law}`" if law != registry.DEFAULT_FOLLOWER_LAW else found
    if (
        law != registry.DEFAULT_FOLLOWER_LAW
        or spec.file
        or spec.python
        or spec.method != Riccati.name
    ):
        raise EchelonError(
            f"the followers have {found}, and what is tuned are the weights of `riccati`; set "
            "`follower={law: consensus, gain: {method: riccati}}`."
        )


def _diagonal(weight: Array, name: str) -> Array:
    if np.any(weight != np.diag(np.diag(weight))):
        raise EchelonError(
            f"`follower.gain.{name}` has entries off its diagonal, and a diagonal is tuned."
        )
    return np.diag(weight)
