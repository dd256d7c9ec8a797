"""Linear loops in NumPy alone: held steps, modes and delays, with which guarantees must agree."""

import itertools

import numpy as np


def held_step(A: np.ndarray, B: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Return F and G of a step of RK4 with inputs held, of many loops at once."""
    one, M = np.eye(A.shape[-1]), A * dt
    F = one + M @ (one + M @ (one + M @ (one + M / 4.0) / 3.0) / 2.0)
    return F, dt * (one + M @ (one / 2.0 + M @ (one / 6.0 + M / 24.0))) @ B


def radii(
    A: np.ndarray, B: np.ndarray, K: np.ndarray, strengths: np.ndarray, dt: float
) -> np.ndarray:
    """Return the spectral radius of a step in each mode, (..., strengths)."""
    F, G = held_step(A, B, dt)
    steps = F[..., None, :, :] - strengths[:, None, None] * (G @ K)[..., None, :, :]
    return np.abs(np.linalg.eigvals(steps)).max(axis=-1)


def growth(A: np.ndarray, B: np.ndarray, K: np.ndarray, strengths: np.ndarray) -> np.ndarray:
    """Return the slowest mode in continuous time of each loop, (..., strengths)."""
    modes = A[..., None, :, :] - strengths[:, None, None] * (B @ K)[..., None, :, :]
    return np.linalg.eigvals(modes).real.max(axis=-1)


def delayed_growth(A: np.ndarray, G: np.ndarray, delay: float, nodes: int = 16) -> float:
    """Return the rightmost root of x' = A x - G x(t - delay), by Chebyshev collocation."""
    n, k = len(A), np.arange(nodes + 1)
    x = np.cos(np.pi * k / nodes)
    c = np.where((k == 0) | (k == nodes), 2.0, 1.0) * (-1.0) ** k
    D = np.outer(c, 1.0 / c) / (x[:, None] - x + np.eye(nodes + 1))
    D = (D - np.diag(D.sum(axis=1))) * 2.0 / delay
    M = np.kron(D, np.eye(n))
    M[:n] = 0.0
    M[:n, :n], M[:n, -n:] = A, -G
    return float(np.linalg.eigvals(M).real.max())


def whole_steps(
    A: np.ndarray, B: np.ndarray, K: np.ndarray, laplacians: list[np.ndarray], dt: float
) -> list[np.ndarray]:
    """Return the whole network's held step of RK4 under each graph."""
    F, G = held_step(A, B, dt)
    return [np.kron(np.eye(len(L)), F) - np.kron(L, G @ K) for L in laplacians]


def worst_growth(maps: list[np.ndarray], length: int = 8) -> float:
    """Return the largest growth rate a step over all orders of the maps of some lengths."""
    worst = 0.0
    for size in range(1, length + 1):
        for order in itertools.product(maps, repeat=size):
            product = np.linalg.multi_dot(order) if size > 1 else order[0]
            worst = max(worst, np.abs(np.linalg.eigvals(product)).max() ** (1.0 / size))
    return float(worst)


def drawn_graphs(
    rng: np.random.Generator, directed: bool, count: int = 2
) -> tuple[list[list[tuple[int, int, float]]], list[np.ndarray], int]:
    """Return drawn graphs of as many agents led by agent 0, and their grounded Laplacians."""
    agents = int(rng.integers(3, 7))
    graphs, laplacians = [], []
    for _ in range(count):
        order = 1 + rng.permutation(agents - 1)
        tree = [(int(rng.choice([0, *order[:k]])), int(j)) for k, j in enumerate(order)]
        more = [tuple(map(int, rng.permutation(agents)[:2])) for _ in range(rng.integers(0, 4))]
        more = [(i, j) for i, j in more if j and (i or not directed)]
        pairs = {(i, j) if directed else (min(i, j), max(i, j)) for i, j in [*tree, *more]}
        edges = [(i, j, float(rng.uniform(0.5, 5.0))) for i, j in sorted(pairs)]
        A = np.zeros((agents, agents))
        for i, j, weight in edges:
            A[j, i] = weight
            if not directed:
                A[i, j] = weight
        graphs.append(edges)
        laplacians.append((np.diag(A.sum(axis=1)) - A)[1:, 1:])
    return graphs, laplacians, agents
