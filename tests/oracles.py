"""Second implementations in plain NumPy and SciPy, which share no code with echelon."""

import itertools

import numpy as np
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.optimize import linprog
from scipy.spatial.transform import Rotation

GRAVITY = 9.81


def rotation(zeta):
    """Body-to-world matrix of the angles (roll, pitch, yaw), by SciPy."""
    return Rotation.from_euler("ZYX", np.asarray(zeta)[..., ::-1]).as_matrix()


def spd(rng, size):
    root = rng.normal(size=(size, size))
    return root @ root.T + 0.05 * np.eye(size)


def skew(w):
    return np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])


def angle_rates(zeta, omega):
    """Rates of (roll, pitch, yaw), solved from the axes that they turn the body about."""
    zeta, omega = np.asarray(zeta), np.asarray(omega)
    about_roll = Rotation.from_rotvec(zeta[..., :1] * np.array([1.0, 0.0, 0.0])).inv()
    pitch_axis = about_roll.apply([0.0, 1.0, 0.0])
    yaw_axis = rotation(zeta)[..., 2, :]
    roll_axis = np.broadcast_to([1.0, 0.0, 0.0], omega.shape)
    axes = np.stack([roll_axis, pitch_axis, yaw_axis], axis=-1)
    return np.linalg.solve(axes, omega[..., None])[..., 0]


def newton_euler(x, u, mass, inertia, gravity=GRAVITY):
    """xdot of quadrotors (..., 12) with state (p, v, zeta, omega) and input (thrust, torques)."""
    velocity, zeta, omega = x[..., 3:6], x[..., 6:9], x[..., 9:12]
    J = np.array(inertia)
    force = u[..., :1] * rotation(zeta)[..., :, 2] - mass * gravity * np.array([0.0, 0.0, 1.0])
    spin = (u[..., 1:] - np.cross(omega, J * omega)) / J
    return np.concatenate([velocity, force / mass, angle_rates(zeta, omega), spin], axis=-1)


def quadrotor_input_map(x, mass, inertia):
    """g(x) column by column, from forces and torques of one newton and one newton metre."""
    still = newton_euler(x, np.zeros(4), mass, inertia)
    columns = [newton_euler(x, unit, mass, inertia) - still for unit in np.eye(4)]
    return np.column_stack(columns)


def adjacency(agents, edges, weights=None):
    A = np.zeros((agents, agents))
    weights = np.ones(len(edges)) if weights is None else weights
    for (i, j), weight in zip(edges, weights, strict=True):
        A[i, j] = A[j, i] = weight
    return A


@st.composite
def connected(draw, most=9, weighted=True):
    """Edges, leaders and number of agents of a random connected graph: a tree, and more edges."""
    agents = draw(st.integers(2, most))
    tree = {(draw(st.integers(0, j - 1)), j) for j in range(1, agents)}
    pair = st.tuples(st.integers(0, agents - 1), st.integers(0, agents - 1))
    more = {(min(e), max(e)) for e in draw(st.lists(pair, max_size=8)) if e[0] != e[1]}
    edges = draw(st.permutations(sorted(tree | more)))
    leaders = draw(st.sets(st.integers(0, agents - 1), min_size=1, max_size=min(3, agents - 1)))
    if weighted:
        edges = [(i, j, draw(st.floats(0.1, 10.0))) for i, j in edges]
    return edges, sorted(leaders), agents


def laplacian(agents, edges, weights=None):
    A = adjacency(agents, edges, weights)
    return np.diag(A.sum(axis=1)) - A


def relabelled(graph, order):
    """The same graph with agent i renamed to order[i]."""
    order = np.asarray(order)
    edges = np.column_stack([order[graph.edges], graph.weights])
    return type(graph)(edges.tolist(), order[list(graph.leaders)].tolist(), graph.agents)


def disagreements(A, x, offsets):
    """z_i = sum_j A_ij (x_i - x_j) + A_ij d_ij with d_ij = xi_j - xi_i, entry by entry."""
    z = np.zeros_like(x)
    for i, j in itertools.product(range(len(A)), repeat=2):
        z[i] += A[i, j] * ((x[i] - x[j]) + (offsets[j] - offsets[i]))
    return z


def held_input_run(velocity, control, x, dt, steps):
    """States (steps + 1, N, n) of agents whose inputs are held over each step, by DOP853.

    `velocity(x, u)` is that of all agents at once, `control(t, x)` returns their inputs (N, m).
    """
    states = [x]
    for k in range(steps):
        u, shape = control(k * dt, x), x.shape

        def flow(_, flat, u=u, shape=shape):
            return velocity(flat.reshape(shape), u).ravel()

        solved = solve_ivp(flow, (0.0, dt), x.ravel(), "DOP853", [dt], rtol=1e-11, atol=1e-12)
        x = solved.y[:, -1].reshape(shape)
        states.append(x)
    return np.array(states)


def prioritized_thrusts(collective, tilt, yaw, maximum):
    """Motor thrusts by three linear programs: most of the tilt, most of the yaw, the collective.

    Variables are (share of tilt, share of yaw, collective, its deviation); `maximum` is near 1.
    """
    tilt, yaw = np.asarray(tilt), np.asarray(yaw)
    ones, none = np.ones_like(tilt), np.zeros_like(tilt)
    thrust = np.column_stack([tilt, yaw, ones, none])
    deviation = [[0.0, 0.0, 1.0, -1.0], [0.0, 0.0, -1.0, -1.0]]
    A = np.vstack([thrust, -thrust, deviation])
    b = np.concatenate([maximum * ones, none, [collective, -collective]])

    def best(cost, low, high):
        bounds = [(low[0], high[0]), (low[1], high[1]), (None, None), (0.0, None)]
        solved = linprog(cost, A, b, bounds=bounds, method="highs-ds")
        assert solved.status == 0, solved.message
        return solved.x

    tilt_share = best([-1.0, 0.0, 0.0, 0.0], (0.0, 0.0), (1.0, 0.0))[0]
    # A little less than the optimum keeps the next program feasible to rounding.
    kept = max(0.0, tilt_share - 1e-9)
    yaw_share = best([0.0, -1.0, 0.0, 0.0], (kept, 0.0), (kept, 1.0))[1]
    fixed = (kept, max(0.0, yaw_share - 1e-9))
    shares = best([0.0, 0.0, 0.0, 1.0], fixed, fixed)
    return thrust @ shares


def delayed_abscissa(A, F, delay, nodes=24):
    """The rightmost root of x' = A x - F x(t - delay), by collocation at Chebyshev's points."""
    n, k = len(A), np.arange(nodes + 1)
    points = np.cos(np.pi * k / nodes)
    weights = np.where((k == 0) | (k == nodes), 2.0, 1.0) * (-1.0) ** k
    D = np.outer(weights, 1.0 / weights) / (points[:, None] - points + np.eye(nodes + 1))
    D -= np.diag(D.sum(axis=1))
    whole = np.kron(2.0 / delay * D, np.eye(n))
    whole[:n], whole[:n, :n], whole[:n, -n:] = 0.0, A, -F
    return np.linalg.eigvals(whole).real.max()
