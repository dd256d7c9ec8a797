"""Random agents, graphs, domains and gain methods, twice: for echelon, and in NumPy to attack it.

The NumPy side has its own calculus: the Jacobian is made here, term by term, and by nothing of
echelon or JAX.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import echelon as ech

FAMILIES = ("linear", "polynomial", "trigonometric")
METHODS = ("monotone", "robust-lqr", "contraction", "riccati", "inner-loop", "given")
_TERMS, _INPUT_TERMS = 6, 2  # both padded, so that systems of one size share what JAX compiles


@dataclass(frozen=True)
class Terms:
    """A sum of terms c x_a x_b x_d cos(w x_k + q pi/2), each in its place of an array.

    `factors` (T, 3) holds a + 1, b + 1, d + 1, and 0 for no factor; `frequency` w is 0 for no wave.
    """

    shape: tuple[int, ...]
    place: np.ndarray
    weight: np.ndarray
    factors: np.ndarray
    frequency: np.ndarray
    along: np.ndarray
    quarter: np.ndarray

    @classmethod
    def of(cls, shape: tuple[int, ...], rows: Iterable[tuple[Any, ...]]) -> "Terms":
        """Return the terms (place, c, (a + 1, b + 1, d + 1), w, k, q)."""
        kept = [row for row in rows if row[1]]
        place, weight, factors, frequency, along, quarter = (
            zip(*kept, strict=True) if kept else [()] * 6
        )
        return cls(
            shape,
            np.array(place, int),
            np.array(weight, float),
            np.array(factors, int).reshape(-1, 3),
            np.array(frequency, float),
            np.array(along, int),
            np.array(quarter, int),
        )

    @cached_property
    def spread(self) -> np.ndarray:
        """What puts terms in their places, (T, size)."""
        return np.eye(int(np.prod(self.shape)))[self.place]

    def rows(self) -> list[tuple[Any, ...]]:
        """Return what `of` takes."""
        return list(
            zip(
                self.place.tolist(),
                self.weight.tolist(),
                map(tuple, self.factors.tolist()),
                self.frequency.tolist(),
                self.along.tolist(),
                self.quarter.tolist(),
                strict=True,
            )
        )

    def at(self, x: np.ndarray) -> np.ndarray:
        """Return the sums at points (K, n), (K, *shape)."""
        if not len(self.weight):
            return np.zeros((len(x), *self.shape))
        one = np.concatenate([np.ones((len(x), 1)), x], axis=1)
        a, b, d = self.factors.T
        values = self.weight * one[:, a] * one[:, b] * one[:, d]
        if self.frequency.any():  # where it is 0, so is the quarter
            angle = self.frequency * x[:, self.along] + 0.5 * np.pi * self.quarter
            values = values * np.cos(angle)
        return (values @ self.spread).reshape(len(x), *self.shape)

    def slope(self, n: int) -> "Terms":
        """Return the derivatives along all n states, of shape (*shape, n), by the product rule."""
        found = []
        for place, weight, factors, frequency, along, quarter in self.rows():
            for slot, factor in enumerate(factors):
                if factor:
                    rest = (*factors[:slot], 0, *factors[slot + 1 :])
                    found.append((place * n + factor - 1, weight, rest, frequency, along, quarter))
            if frequency:
                there = place * n + along
                found.append((there, weight * frequency, factors, frequency, along, quarter + 1))
        return Terms.of((*self.shape, n), found)


@dataclass(frozen=True)
class Plant:
    """xdot = A x + f(x) + (B + g(x)) w in deviations from the trim, w the normalized input."""

    A: np.ndarray
    f: Terms
    B: np.ndarray
    g: Terms

    def drift(self, x: np.ndarray) -> np.ndarray:
        """Return the drift at points (K, n)."""
        return x @ self.A.T + self.f.at(x)

    def input_map(self, x: np.ndarray) -> np.ndarray:
        """Return the input maps (K, n, m)."""
        return self.B + self.g.at(x)

    @property
    def constant(self) -> bool:
        """Whether the input map is the same everywhere."""
        return not len(self.g.weight)

    def closed(self, K: np.ndarray) -> "Plant":
        """Return the plant under w = -K x + w~, term by term."""
        n, m = self.B.shape
        bent = []
        for place, weight, (a, b, _), frequency, along, quarter in self.g.rows():
            row, column = divmod(place, m)
            for j in range(n):
                product = (a, b, j + 1)
                bent.append((row, -weight * K[column, j], product, frequency, along, quarter))
        f = Terms.of((n,), [*self.f.rows(), *bent])
        return replace(self, A=self.A - self.B @ K, f=f)


class Agent(ech.ControlAffine):
    """The same plant for echelon; its coefficients are arrays, so that nothing compiles twice."""

    A: np.ndarray
    B: np.ndarray
    f: dict[str, np.ndarray]
    g: dict[str, np.ndarray]
    shifted: bool = eqx.field(static=True)

    @property
    def state_names(self) -> tuple[str, ...]:
        """x1, x2, ..."""
        return tuple(f"x{k + 1}" for k in range(self.A.shape[0]))

    @property
    def input_names(self) -> tuple[str, ...]:
        """u1, u2, ..."""
        return tuple(f"u{k + 1}" for k in range(self.B.shape[1]))

    @property
    def trim(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """The origin, or where all of x, u is 1/4."""
        at = 0.25 if self.shifted else 0.0
        return (at,) * self.A.shape[0], (at,) * self.B.shape[1]

    @property
    def input_scale(self) -> tuple[tuple[float, ...], ...]:
        """The identity, or twice that."""
        scale = 2.0 if self.shifted else 1.0
        return tuple(map(tuple, scale * np.eye(self.B.shape[1])))

    def drift(self, x: jax.Array) -> jax.Array:
        """Return f(x), such that the trim is an equilibrium."""
        y = x - jnp.asarray(self.trim[0])
        velocity = jnp.asarray(self.A) @ y + _values(self.f, y)
        return velocity - self.input_map(x) @ jnp.asarray(self.trim[1])

    def input_map(self, x: jax.Array) -> jax.Array:
        """Return g(x); times the input scale it is the plant's."""
        y = x - jnp.asarray(self.trim[0])
        whole = jnp.asarray(self.B) + _values(self.g, y).reshape(self.B.shape)
        return whole * (0.5 if self.shifted else 1.0)


def _values(terms: dict[str, np.ndarray], y: jax.Array) -> jax.Array:
    """Return the sums of terms; places and factors are matrices of zeros and ones."""
    one = jnp.concatenate([jnp.ones(1), y])
    a, b, d = (jnp.asarray(pick) @ one for pick in terms["factors"])
    angle = jnp.asarray(terms["angle"]) @ y
    wave = jnp.asarray(terms["sine"]) * jnp.sin(angle)
    wave = wave + jnp.asarray(terms["cosine"]) * jnp.cos(angle)
    return jnp.asarray(terms["place"]) @ (a * b * d * wave)


def _padded(terms: Terms, count: int, n: int) -> dict[str, np.ndarray]:
    """Return terms as matrices of a fixed size; quarters are 0 (cos) or -1 (sin)."""
    used = len(terms.weight)
    place = np.zeros((int(np.prod(terms.shape)), count))
    place[terms.place, range(used)] = terms.weight
    factors, angle = np.zeros((3, count, n + 1)), np.zeros((count, n))
    factors[:, :, 0] = 1.0
    for k in range(3):
        factors[k, :used] = np.eye(n + 1)[terms.factors[:, k]]
    angle[range(used), terms.along] = terms.frequency
    sine = np.pad((terms.quarter == -1).astype(float), (0, count - used))
    return {
        "place": place,
        "factors": factors,
        "angle": angle,
        "sine": sine,
        "cosine": 1.0 - sine,
    }


@dataclass(frozen=True)
class System:
    """A random case: the plant and echelon's model of it, a graph, a domain.

    `low`, `high` (n,) and `input_low`, `input_high` (m,) bound deviations and normalized inputs;
    infinite where the domain does not bound a state.
    """

    number: int
    family: str
    plant: Plant
    model: Agent
    edges: list[tuple[int, int, float]]
    leaders: tuple[int, ...]
    agents: int
    low: np.ndarray
    high: np.ndarray
    input_low: np.ndarray
    input_high: np.ndarray

    @property
    def graph(self) -> ech.Graph:
        """The graph, for echelon."""
        return ech.Graph.from_edges(self.edges, self.leaders, self.agents)

    def domain(self) -> dict[str, tuple[float, float]]:
        """Return the domain as a user writes it."""
        names = (*self.model.state_names, *self.model.input_names)
        low = np.concatenate([self.low, self.input_low])
        high = np.concatenate([self.high, self.input_high])
        return {
            name: (float(a), float(b))
            for name, a, b in zip(names, low, high, strict=True)
            if np.isfinite(a) and a < b
        }

    def grounded(self) -> np.ndarray:
        """Return the follower block of the Laplacian."""
        L = np.zeros((self.agents, self.agents))
        for i, j, weight in self.edges:
            L[i, j] -= weight
            L[j, i] -= weight
        L -= np.diag(L.sum(axis=1))
        rest = [k for k in range(self.agents) if k not in self.leaders]
        return L[np.ix_(rest, rest)]


def random_system(seed: int, number: int) -> System:
    """Return the case of a number; the same for the same seed and number."""
    rng = np.random.default_rng([seed, number])
    family = FAMILIES[number % 3]
    n = int(rng.integers(1, 7))
    m, free = min(n, int(rng.choice([1, 2, n]))), _free(rng, n)
    A = _drift_matrix(rng, n, free)
    bent = rng.choice(free, min(len(free), int(rng.integers(1, 4))), replace=False)
    f = Terms.of((n,), [] if family == "linear" else _terms(rng, family, n, bent, _TERMS, 1.0))
    B, varies = rng.normal(size=(n, m)), rng.random() < 0.25
    g = _terms(rng, "both", n * m, bent, _INPUT_TERMS, 0.3) if varies else []
    plant = Plant(A, f, B, Terms.of((n, m), g))
    shifted = bool(rng.random() < 0.3)
    model = Agent(A, B, _padded(plant.f, _TERMS, n), _padded(plant.g, _INPUT_TERMS, n), shifted)
    return System(number, family, plant, model, *_graph(rng), *_domain(rng, n, m, bent))


def random_method(system: System, name: str, rng: np.random.Generator) -> ech.gains.Method:
    """Return a gain method with random settings.

    Some ask for a coupling below what the theorem needs; no promise may come of it.
    """
    n, m = system.plant.B.shape
    low = float(np.linalg.eigvalsh(system.grounded())[0])
    # Half of them ask for their own coupling, around the edge 1/(2 lambda_min).
    coupling = None if rng.random() < 0.5 else float(0.5 / low * np.exp(rng.uniform(-1.2, 1.2)))
    exact, domain = bool(rng.random() < 0.5), system.domain()
    Q, R = np.exp(rng.normal(size=n)), _definite(rng, m)
    if name == "monotone":
        return ech.gains.Monotone(domain, coupling=coupling or 1.0)
    if name == "robust-lqr":
        return ech.gains.RobustLQR(domain, Q=Q, R=R, coupling=coupling, exact=exact)
    if name == "contraction":
        rate = float(np.exp(rng.uniform(np.log(0.05), np.log(2.0))))
        return ech.gains.Contraction(domain, rate=rate, coupling=coupling, exact=exact)
    if name == "riccati":
        return ech.gains.Riccati(Q=Q, R=R, coupling=coupling)
    if name == "inner-loop":
        return ech.gains.InnerLoop(coupling=coupling or 3.0)
    return ech.gains.FixedGain(P=_definite(rng, n), R=R, coupling=coupling or 1.0)


def _definite(rng: np.random.Generator, n: int) -> np.ndarray:
    T = rng.normal(size=(n, n))
    return T @ T.T / n + 0.3 * np.eye(n)


def _free(rng: np.random.Generator, n: int) -> np.ndarray:
    """Return the states on which the dynamics depend; a quarter of the agents ignore one or two."""
    ignored = int(rng.integers(1, 3)) if n > 2 and rng.random() < 0.25 else 0
    return np.arange(ignored, n)


def _drift_matrix(rng: np.random.Generator, n: int, free: np.ndarray) -> np.ndarray:
    """Return A, with eigenvalues from well damped to unstable; zero in the ignored columns."""
    kind = rng.random()
    A = rng.normal(size=(n, n))
    if kind < 0.4:  # passive: it has a metric that does not grow
        A = 0.5 * (A - A.T) - np.diag(rng.uniform(0.0, 2.0, n))
    elif kind < 0.7:
        A -= np.sqrt(n) * rng.uniform(0.3, 1.5) * np.eye(n)
    elif kind < 0.85 and n > 1:  # a chain of integrators
        A = np.eye(n, k=1) - np.diag([0.0, *rng.uniform(0.0, 1.0, n - 1)])
    A[:, np.setdiff1d(np.arange(n), free)] = 0.0
    return A


def _terms(
    rng: np.random.Generator, family: str, places: int, bent: np.ndarray, most: int, size: float
) -> list[tuple[Any, ...]]:
    """Return random terms of degree 2 or 3, or with a wave; in few states, so that hulls are small.

    A wave stands beside a factor or is a sine, so that the drift vanishes at the trim.
    """
    rows = []
    for _ in range(int(rng.integers(1, most + 1))):
        a, b, d = (int(k) + 1 for k in rng.choice(bent, 3))
        place, weight = int(rng.integers(places)), size * rng.normal() * rng.choice([0.2, 1.0])
        if family == "polynomial" or (family == "both" and rng.random() < 0.5):
            rows.append((place, weight, (a, b, d if rng.random() < 0.5 else 0), 0.0, 0, 0))
        elif rng.random() < 0.5:
            rows.append((place, weight, (0, 0, 0), rng.uniform(0.4, 2.0), a - 1, -1))
        else:
            rows.append((place, weight, (b, 0, 0), rng.uniform(0.4, 2.0), a - 1, 0))
    return rows


def _graph(
    rng: np.random.Generator,
) -> tuple[list[tuple[int, int, float]], tuple[int, ...], int]:
    """Return edges, leaders and the number of agents of a random connected graph."""
    agents = int(rng.integers(2, 31))
    line, weighted = rng.random() < 0.2, rng.random() < 0.3
    pairs = {((k - 1) if line else int(rng.integers(k)), k) for k in range(1, agents)}
    for _ in range(0 if line else int(rng.integers(0, 2 * agents))):
        i, j = sorted(int(k) for k in rng.integers(agents, size=2))
        if i < j:
            pairs.add((i, j))
    edges = [(i, j, float(rng.uniform(0.2, 3.0)) if weighted else 1.0) for i, j in sorted(pairs)]
    several = agents > 3 and rng.random() < 0.15
    return edges, (0, agents - 1) if several else (0,), agents


def _domain(
    rng: np.random.Generator, n: int, m: int, bent: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return bounds of states and inputs; states that bend nothing are bounded or not."""
    width = np.exp(rng.uniform(np.log(0.05), np.log(1.5), n))
    skew = rng.uniform(0.5, 1.0, (2, n)) if rng.random() < 0.5 else np.ones((2, n))
    low, high = -width * skew[0], width * skew[1]
    open_ = rng.random(n) < 0.3
    if rng.random() < 0.97:  # else it may leave open what it must not
        open_[bent] = False
    low[open_], high[open_] = -np.inf, np.inf
    reach = rng.uniform(0.1, 2.0, m) * (rng.random(m) < 0.5)
    return low, high, -reach, reach
