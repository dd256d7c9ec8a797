"""Families of linear loops for the zoo: what is guaranteed is recomputed by NumPy alone."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from held_loops import (
    delayed_growth,
    drawn_graphs,
    growth,
    radii,
    whole_steps,
)

import echelon as ech
from echelon.core.statement import Topic


@dataclass(frozen=True)
class Finding:
    """What came of one draw.

    Attributes:
        guaranteed: whether anything was guaranteed.
        false: what contradicts the guarantee, in words.
        holds: whether the system does in truth what could be guaranteed; None if not known.
        why: why nothing was guaranteed.
        half: the verdict at half of the region of attraction; None if that is not known.
        local: runs that are lost behind limits, of which a guarantee of small errors says nothing.
    """

    guaranteed: bool
    false: tuple[str, ...] = ()
    holds: bool | None = None
    why: str = ""
    half: str | None = None
    local: tuple[str, ...] = ()


Family = Callable[[np.random.Generator], Finding]


def silent(why: str, holds: bool | None = None) -> Finding:
    """Return the finding of a draw without any guarantee."""
    return Finding(False, holds=holds, why=why.split(";")[0][:90])


def consensus_parts(
    model: ech.ControlAffine, graph: ech.Graph, gain: ech.Gain, **more: Any
) -> ech.Parts:
    """Return agents with equal goals under the paper's law behind passive leaders."""
    goals = ech.Formation(np.zeros((graph.agents, len(model.state_names))))
    law = ech.laws.Consensus(gain, feedforward="relay")
    return ech.Parts(model, graph, goals, ech.Laws(ech.laws.TrimInput(), law), **more)


def feedback(gain: ech.Gain, B: np.ndarray) -> np.ndarray:
    """Return c R^-1 B'P."""
    return gain.coupling * np.linalg.solve(gain.R, B.T @ gain.P)


# ---- directed and switching graphs in held steps -------------------------------------------------


def switching_steps(rng: np.random.Generator) -> Finding:
    """Directed and switching graphs, in steps around the longest in which each of them decays."""
    directed = bool(rng.integers(2))
    graphs, laplacians, agents = drawn_graphs(rng, directed, int(rng.integers(1, 4)))
    A, B = _agent(rng)
    model = ech.models.Linear(A, B)

    def ask(dt: float) -> tuple[ech.Guarantee, ech.Gain, float]:
        if len(graphs) == 1:
            graph = ech.Graph(graphs[0], agents=agents, directed=directed)
        else:
            stretches = [(k * dt, edges) for k, edges in enumerate(graphs)]
            graph = ech.Graph.switching(stretches, directed=directed, period=dt * len(graphs))
        gain = ech.synthesize(model, graph, ech.gains.Riccati())
        settings = ech.Settings(12 * dt, dt)
        answer = ech.guarantee(consensus_parts(model, graph, gain), settings)
        return answer, gain, answer.longest_step(settings)

    try:
        answer, gain, longest = ask(1e-4)
        share = float(rng.choice([0.5, 0.9, 0.98, 1.02]))
        dt = share * longest if 0.0 < longest < 1e3 else 1e-3
        answer, gain, _ = ask(dt)
    except ech.EchelonError as error:
        return silent(str(error))
    maps = whole_steps(A, B, feedback(gain, B), laplacians, dt)
    turn = np.linalg.multi_dot([np.eye(len(maps[0])), *maps[::-1]])
    holds = bool(np.abs(np.linalg.eigvals(turn)).max() < 1.0)
    if not answer.promised:
        return silent(answer.reasons[0], holds)
    # The graphs come in their order, for ever.
    step = float(np.abs(np.linalg.eigvals(turn)).max() ** (1.0 / len(maps)))
    stated = np.exp(-(answer.rate or 0.0) * dt)
    false = [] if step < 1.0 else [f"{share} of the step: {step} a step"]
    if not step <= stated * (1.0 + 1e-9):
        false.append(f"rate {answer.rate}: {step} a step of {dt}")
    return Finding(True, tuple(false), holds)


def _agent(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    order = int(rng.integers(1, 4))
    A = np.eye(order, k=1) + (rng.normal(size=(order, order)) if rng.integers(2) else 0.0)
    B = np.zeros((order, 1))
    B[-1] = 1.0
    return A, B


# ---- many followers under gains of the user's ----------------------------------------------------

_STRENGTHS = np.geomspace(0.5, 5.0, 60)


def many_followers(rng: np.random.Generator) -> Finding:
    """Stars of 33 to 200 followers; of half of them one in the midst is often lost."""
    n, count = int(rng.integers(1, 4)), int(rng.integers(33, 201))
    dt = float(10.0 ** rng.uniform(-4.0, -1.0))
    # Many are drawn, and one of those taken that are stable at both ends of all strengths.
    A, B, root = (rng.normal(size=(400, n, k)) for k in (n, 1, n))
    P = root @ root.swapaxes(1, 2) + 0.05 * np.eye(n)
    K = B.swapaxes(1, 2) @ P
    ends = growth(2.0 * A, B, K, _STRENGTHS[[0, -1]]).max(axis=1) < -1e-3
    bad = (growth(2.0 * A, B, K, _STRENGTHS) >= 0.0) | (radii(2.0 * A, B, K, _STRENGTHS, dt) >= 1.0)
    bent = np.flatnonzero(ends & bad.any(axis=1) & (rng.random(400) < 0.5))
    pick = int([*bent, *np.flatnonzero(ends), 0][0])
    A, B, P, K = 2.0 * A[pick], B[pick], P[pick], K[pick]
    weights = np.exp(rng.uniform(np.log(_STRENGTHS[0]), np.log(_STRENGTHS[-1]), count))
    if bad[pick].any() and rng.random() < 0.8:
        good = ~np.interp(np.log(weights), np.log(_STRENGTHS), bad[pick].astype(float)).astype(bool)
        weights = np.where(good, weights, _STRENGTHS[-1])
        if rng.random() < 0.4:
            weights[0] = np.median(_STRENGTHS[bad[pick]])
    return _judge_star(A, B, P, K, np.sort(weights), dt)


def _judge_star(A: Any, B: Any, P: Any, K: Any, weights: np.ndarray, dt: float) -> Finding:
    graph, model = (
        ech.Graph([(0, k + 1, w) for k, w in enumerate(weights)]),
        ech.models.Linear(A, B),
    )
    worst, radius = growth(A, B, K, weights).max(), radii(A, B, K, weights, dt).max()
    holds = bool(worst < -1e-6 and radius < 1.0 - 1e-9)
    try:
        gain = ech.synthesize(model, graph, ech.gains.FixedGain(P=P.tolist(), coupling=1.0))
        parts, settings = consensus_parts(model, graph, gain), ech.Settings(2.0 * dt, dt)
        answer = ech.guarantee(parts, settings)
    except ech.EchelonError as error:
        return silent(str(error), holds)
    false = list[str]()
    longest = answer.longest_step(settings)
    if worst < 0.0 and 0.0 < longest < 1e3:
        if radii(A, B, K, weights, 0.999 * longest).max() >= 1.0:
            false.append(f"longest step {longest} is lost inside")
        if answer.promised and radii(A, B, K, weights, 1.01 * longest).max() < 1.0:
            false.append(f"longest step {longest} is not the longest")
    if worst < 0.0:
        false += _margins(A, B, K, weights, dt, ech.check(parts, settings).lines)
    if not answer.promised:
        return Finding(False, tuple(false), holds, answer.reasons[0][:90])
    # The rate stated is that of held steps, which is not the one of continuous time.
    if worst >= 0.0 or radius >= 1.0 or radius > np.exp(-(answer.rate or 0.0) * dt) + 1e-9:
        false.append(f"rate {answer.rate}: slowest mode {worst}, radius {radius} in {dt} s")
    return Finding(True, tuple(false), holds)


def _margins(A: Any, B: Any, K: Any, weights: np.ndarray, dt: float, lines: Any) -> list[str]:
    """Return what is wrong with the margins of held steps, a little inside and outside."""
    by_topic, false = {line.statement: line for line in lines}, list[str]()
    gain, delay = by_topic.get(Topic.GAIN), by_topic.get(Topic.DELAY)
    if gain is not None and " to " in (gain.number_text or ""):
        for factor, inside in zip(map(float, gain.number_text.split(" to ")), (1.01, 0.99)):
            if 0.0 < factor < np.inf:
                if radii(A, B, K, inside * factor * weights, dt).max() >= 1.0:
                    false.append(f"gain margin {factor} is lost inside")
                if radii(A, B, K, (2.0 - inside) * factor * weights, dt).max() < 1.0:
                    false.append(f"gain margin {factor} is not all")
    if delay is not None and delay.number and np.isfinite(delay.number):
        some = weights[np.unique(np.linspace(0, len(weights) - 1, 60).astype(int))]
        if max(delayed_growth(A, k * B @ K, 0.99 * delay.number) for k in some) >= 0.0:
            false.append(f"delay margin {delay.number} is lost inside")
    return false


# ---- two and three leaders that start apart, weakly coupled --------------------------------------


def leaders_apart(rng: np.random.Generator) -> Finding:
    """Two or three leaders, apart or alike, passive or under stopping points."""
    leaders, agents = int(rng.integers(2, 4)), int(rng.integers(4, 9))
    edges = [
        (int(rng.integers(0, k)), k, float(10.0 ** rng.uniform(-1.5, 1.0)))
        for k in range(1, agents)
    ]
    chosen = (0, *sorted(1 + rng.permutation(agents - 1)[: leaders - 1]))
    graph = ech.Graph(edges, tuple(map(int, chosen)), agents)
    L = np.zeros((agents, agents))
    for i, j, weight in edges:
        L[i, j] -= weight
        L[j, i] -= weight
    L -= np.diag(L.sum(axis=1))
    L[list(chosen)] = 0.0
    apart = bool(rng.random() < 0.7)
    judge = _stopping_leaders if rng.random() < 0.5 else _passive_leaders
    return judge(rng, graph, L, apart)


def _free(graph: ech.Graph) -> list[int]:
    return [k for k in range(graph.agents) if k not in graph.leaders]


def _passive_leaders(
    rng: np.random.Generator, graph: ech.Graph, L: np.ndarray, apart: bool
) -> Finding:
    n = int(rng.integers(1, 4))
    A = np.eye(n, k=1) - np.diag(10.0 ** rng.uniform(-3.0, 1.0, n))
    A += (rng.random() < 0.3) * 0.3 * rng.normal(size=(n, n))
    A[-1, -1] *= rng.random() < 0.8
    B = np.eye(n)[:, -1:]
    model, states = ech.models.Linear(A, B), np.zeros((graph.agents, n))
    if apart:
        states[list(graph.leaders[1:])] = rng.normal(size=(len(graph.leaders) - 1, n))
    P = np.eye(n).tolist()
    coupling = float(10.0 ** rng.uniform(-2.0, 1.0))
    method = ech.gains.Riccati() if rng.integers(2) else ech.gains.FixedGain(P, coupling=coupling)
    try:
        gain = ech.synthesize(model, graph, method)
        parts = consensus_parts(model, graph, gain, initial=states)
        answer = ech.guarantee(parts, ech.Settings(0.01, _STEP))
    except ech.EchelonError as error:
        return silent(str(error))
    rest = list(range(1, graph.agents)) if apart else _free(graph)
    [steps] = whole_steps(A, B, feedback(gain, B), [L[np.ix_(rest, rest)]], _STEP)
    return against(answer, float(np.log(np.abs(np.linalg.eigvals(steps)).max())) / _STEP)


def _stopping_leaders(
    rng: np.random.Generator, graph: ech.Graph, L: np.ndarray, apart: bool
) -> Finding:
    order, own = int(rng.integers(1, 3)), float(10.0 ** rng.uniform(-2.0, 0.7))
    kind = (ech.models.SingleIntegrator, ech.models.DoubleIntegrator)[order - 1]
    root, c = float(rng.integers(1, 9)) / 2.0, float(10.0 ** rng.uniform(-1.0, 0.7))
    states = np.zeros((graph.agents, 2 * order))
    states[_free(graph), :2] = rng.normal(size=(len(_free(graph)), 2))
    if apart:
        states[list(graph.leaders[1:]), :2] = rng.normal(size=(len(graph.leaders) - 1, 2))
    shared: dict[str, Any] = {"speed": float(10.0 ** rng.uniform(-0.5, 1.0)), "observer": False}
    if order == 2:
        shared["roots"] = (root,)
    leader = ech.laws.StoppingLeader(coupling=own, **shared)
    drive = ech.Laws(leader, ech.laws.StoppingPoint(coupling=c, **shared))
    goals = ech.Formation(np.zeros(states.shape))
    parts = ech.Parts(kind(2), graph, goals, drive, initial=states)
    try:
        answer: Any = ech.guarantee(parts, ech.Settings(1.0, 1e-3))
    except ech.EchelonError as error:
        return silent(str(error))
    rest = list(range(graph.agents)) if apart else _free(graph)
    pull = c * L + own * np.diag([k in graph.leaders for k in range(graph.agents)])
    modes = -np.linalg.eigvals(pull[np.ix_(rest, rest)]).real
    slowest = float(max(modes.max(), -root if order == 2 else -np.inf))
    finding = against(answer, slowest)
    if answer.promised and answer.tube.arrival is not None:
        law = StoppingFlight(pull, shared["speed"], root if order == 2 else None, graph.leaders)
        late = law.gap(states, answer.tube.arrival)
        if not late <= 0.01 * (1.0 + 1e-3):
            text = f"within 1 cm from {answer.tube.arrival} s: {late} m"
            return Finding(True, (*finding.false, text), True)
    return finding


_STEP = 1e-4
"""s; of loops whose rate is judged."""


def against(answer: ech.Guarantee, slowest: float) -> Finding:
    """Judge a rate by the slowest mode in truth, that of the steps which run."""
    if not answer.promised:
        return silent(answer.reasons[0], bool(slowest < -1e-9))
    rate = answer.rate or 0.0
    false = rate > -slowest * (1.0 + 1e-6) + 1e-9
    return Finding(True, (f"rate {rate}: slowest mode {slowest}",) if false else (), slowest < 0.0)


@dataclass(frozen=True)
class StoppingFlight:
    """Integrators under stopping points that lead to the origin, in continuous time.

    Attributes:
        pull: (N, N) how fast stopping points are drawn, with leaders towards the origin.
        speed: s of sigma.
        root: of q, for double integrators; None for single ones.
        leaders: their numbers, the first of which the errors are to.
    """

    pull: np.ndarray
    speed: float
    root: float | None
    leaders: tuple[int, ...]

    def rate(self, x: np.ndarray, sources: np.ndarray) -> np.ndarray:
        """Return xdot of states (N, n)."""
        y, v = x[:, :2], x[:, 2:]
        zeta = y if self.root is None else y + v / self.root
        asked = self.pull @ zeta
        rate = -asked / np.sqrt(1.0 + (asked / self.speed) ** 2)
        followers = [k for k in range(len(x)) if k not in self.leaders]
        rate[followers] += rate[sources[followers]]
        if self.root is None:
            return rate
        return np.concatenate([v, self.root * (rate - v)], axis=1)

    def gap(self, x: np.ndarray, end: float) -> float:
        """Return how far off followers are from their leader at a time and until a little later."""
        sources = self._sources()
        fast = max(np.abs(self.pull).sum(axis=1).max(), self.root or 0.0)
        steps = min(int(np.ceil(end * fast * 4.0)) + 10, 40_000)
        h, worst = end / steps, 0.0
        for k in range(int(1.3 * steps)):
            k1 = self.rate(x, sources)
            k2 = self.rate(x + 0.5 * h * k1, sources)
            k3 = self.rate(x + 0.5 * h * k2, sources)
            x = x + h / 6.0 * (k1 + 2 * k2 + 2 * k3 + self.rate(x + h * k3, sources))
            if k + 1 >= steps:
                gaps = np.linalg.norm(x[:, :2] - x[sources, :2], axis=1)
                worst = max(worst, float(gaps.max()))
        return worst

    def _sources(self) -> np.ndarray:
        """Return (N,) whose rate an agent is sent: of the leader nearest in links, the first."""
        links = np.where((self.pull != 0.0) | (self.pull != 0.0).T, 1.0, np.inf)
        far = np.array([np.where(np.arange(len(links)) == k, 0.0, np.inf) for k in self.leaders])
        for _ in links:
            far = np.minimum(far, (far[:, :, None] + links).min(axis=1))
        return np.array(self.leaders)[far.argmin(axis=0)]


LINEAR: dict[str, Family] = {
    "switching graphs": switching_steps,
    "many followers": many_followers,
    "leaders apart": leaders_apart,
}
