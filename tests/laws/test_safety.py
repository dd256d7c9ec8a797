"""Collision avoidance: hulls by a second computation, attacks on the theorem, and flights."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

import echelon as ech
from echelon.agents.network.exchange import Near
from echelon.core.errors import EchelonError
from echelon.core.numerics import precision
from echelon.experiments.results.dataset import labelled_parts
from echelon.experiments.results.metrics import avoidance
from echelon.laws.safety import hull_points, nearest_point

ROOTS = (4.0, 4.5, 5.0)
SAFETY = ech.Safety(radii=(0.125, 0.125, 0.375), margin=0.0)
SCALES = np.array([1.0, 1.0, 1.0 / 3.0])
SPEEDS = np.array([2.5, 2.5, 2.4])
KEPT = 0.25


def exact(points):
    """The nearest points (K, d) of hulls (K, r, d) to 0: every face's, by its normal equations."""
    count, r, _ = points.shape
    best, least = np.full(points[:, 0].shape, np.nan), np.full(count, np.inf)
    for size in range(1, r + 1):
        for face in itertools.combinations(range(r), size):
            corners = points[:, face]
            system = np.zeros((count, size + 1, size + 1))
            system[:, :size, :size] = corners @ corners.swapaxes(1, 2)
            system[:, size, :size] = system[:, :size, size] = 1.0
            shares = np.linalg.pinv(system, rcond=1e-13)[:, :size, size]
            foot = np.einsum("ks,ksd->kd", shares, corners)
            square = np.where((shares >= -1e-12).all(axis=1), (foot**2).sum(axis=1), np.inf)
            better = square < least
            best[better], least[better] = foot[better], square[better]
    return best


def nearest(points, kind="float64"):
    with precision(kind):
        return np.asarray(NEAREST(jnp.asarray(points)))


NEAREST = jax.jit(nearest_point)


@pytest.mark.parametrize(("r", "d"), [(4, 3), (4, 2), (3, 3), (2, 2), (1, 3), (4, 1)])
def test_the_nearest_point_of_a_hull_is_that_of_all_its_faces(r, d):
    draw = np.random.default_rng(r + d)
    points = draw.normal(size=(600, r, d)) + 1.5 * draw.normal(size=(600, 1, d))
    # Flat hulls, and agents that rest beside each other, whose points coincide.
    points[:100, 1:] = points[:100, :1] + 1e-6 * draw.normal(size=(100, r - 1, d))
    points[100:200, 1:] = points[100:200, :1]
    value = nearest(points)
    sizes = np.linalg.norm(value, axis=1)
    np.testing.assert_allclose(sizes, np.linalg.norm(exact(points), axis=1), atol=1e-9)
    # What proves it: no point of the hull is nearer than a plane through the nearest one.
    beyond = np.einsum("kd,krd->kr", value, points).min(axis=1)
    assert (beyond >= sizes**2 - 1e-9).all()
    # Points that coincide but for rounding are not around the origin.
    place = draw.normal(size=(20_000, 1, d))
    points = place * (1.0 + 1e-16 * draw.integers(-3, 4, (20_000, r, d)))
    np.testing.assert_allclose(nearest(points), place[:, 0], atol=1e-12)


@pytest.mark.parametrize("width", [1.0, 0.3, 0.1, 0.02, 1e-3, 1e-4, 1e-6])
@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_the_nearest_point_of_a_thin_hull_is_off_by_what_its_precision_leaves(width, kind):
    draw, count = np.random.default_rng(3), 2000
    # Agents on their way to rest: hulls along a line, over whose inside the origin is.
    points = draw.normal(size=(count, 4, 3)) * np.array([1.0, width, 0.05 * width])
    shares = draw.dirichlet(np.ones(4), size=count)
    points -= np.einsum("kr,krd->kd", shares, points)[:, None]
    points += draw.normal(size=(count, 1, 3)) * np.array([0.0, 0.0, 0.25])
    turn = np.linalg.qr(draw.normal(size=(count, 3, 3)))[0]
    points = np.einsum("krd,kde->kre", points, turn).astype(kind)
    value = nearest(points, kind.__name__)
    assert value.dtype == kind
    true = np.linalg.norm(exact(points.astype(float)), axis=1)
    off = np.linalg.norm(value.astype(float), axis=1) - true
    # A point of the hull, up to rounding, and so never nearer than the nearest one.
    size, eps = np.linalg.norm(points, axis=2).max(axis=1), np.finfo(kind).eps
    # The second computation itself leaves 1e-9.
    assert (off >= -8.0 * eps * size - 1e-9).all()
    away = np.sqrt(eps) * size
    assert (off <= 8.0 * eps * size + np.minimum(away, away**2 / (2.0 * true + 1e-300))).all()


def apart_by(points, distance):
    """Hulls (K, 4, 3) moved along their normals so that they are so far from 0, and the normals."""
    # Not about the origin, from which no plane would separate them.
    about = np.linalg.norm(exact(points), axis=1) < 1e-3
    points = points + np.where(about, 9.0, 0.0)[:, None, None]
    nearest = exact(points)
    size = np.linalg.norm(nearest, axis=-1, keepdims=True)
    normals = nearest / size
    return points + ((distance - size) * normals)[:, None], normals


@jax.jit
def filtered(rates, gaps, leads):
    known = jnp.ones(leads.shape[-1], bool)
    return jax.vmap(
        lambda rate, gap, lead: SAFETY.filtered(
            rate, Near(gap, lead, known), jnp.asarray(SCALES), jnp.asarray(SPEEDS)
        )
    )(rates, gaps, leads)


def test_what_leaves_the_filter_meets_every_row_and_no_speed_is_passed():
    draw, cases, others = np.random.default_rng(1), 300, 6
    hulls = draw.normal(size=(cases * others, 4, 3)) + draw.normal(size=(cases * others, 1, 3))
    distances = KEPT + draw.exponential(0.2, (cases * others, 1))
    hulls, normals = apart_by(hulls, distances)
    hulls, normals = (x.reshape(cases, others, *x.shape[1:]) for x in (hulls, normals))
    rates, leads = draw.uniform(-1, 1, (cases, 3)) * SPEEDS, draw.random((cases, others)) < 0.2
    with precision("float64"):
        value, active = map(np.asarray, filtered(rates, hulls / SCALES, leads))
    room = np.einsum("cnd,cnd->cn", normals, hulls[:, :, 3]) - KEPT
    low = -4.0 * np.where(leads, 1.0, 0.5) * room
    meets = np.einsum("cnd,cd->cn", normals, value * SCALES)
    assert (meets >= low - 1e-8).all()
    assert (np.abs(value) <= SPEEDS + 1e-12).all()
    free = (np.einsum("cnd,cd->cn", normals, rates * SCALES) >= low).all(axis=1)
    assert 0 < free.sum() < cases
    np.testing.assert_array_equal(value[free], rates[free])
    np.testing.assert_array_equal(active == 0.0, free)


def held(period):
    """M, N of the points after a hold: c(t + T) = M c + N zeta', from c_k' = r (c_(k+1) - c_k)."""
    A = np.zeros((5, 5))
    for k, root in enumerate(ROOTS):
        A[k, k], A[k, k + 1] = -root, root
    A[3, 4] = 1.0
    flow = scipy.linalg.expm(A * period)
    return flow[:4, :4], flow[:4, 4]


def worst_flights(gain_step, flights=200, steps=40, seed=0):
    """The least distances of pairs that start at the limit and want to go towards each other."""
    draw, period = np.random.default_rng(seed), gain_step / SAFETY.gain
    gaps, normals = apart_by(
        draw.normal(size=(flights, 4, 3)) + draw.normal(size=(flights, 1, 3)), KEPT
    )
    gaps, least = gaps / SCALES, np.full(flights, np.inf)
    parts = [held(part * period) for part in (1 / 3, 2 / 3, 1.0)]
    leads = draw.random((flights, 1)) < 0.3
    for k in range(steps):
        # At full speed towards the other's nearest point, or to a corner of the speeds at random.
        normals = exact(gaps * SCALES) / SCALES
        aim = np.where(draw.random((flights, 1)) < 0.7, -normals, draw.normal(size=normals.shape))
        wanted = np.sign(aim) * SPEEDS
        with precision("float64"):
            own = np.asarray(filtered(wanted, gaps[:, None], leads)[0])
            other = np.asarray(filtered(-wanted, -gaps[:, None], np.zeros_like(leads))[0])
        rate = own - np.where(leads, 0.0, other)
        for M, N in parts:
            after = np.einsum("ab,kbd->kad", M, gaps) + N[:, None] * rate[:, None]
            least = np.minimum(least, np.linalg.norm(exact(after * SCALES), axis=1))
        gaps = after
    return least


@pytest.mark.parametrize("gain_step", [0.02, 0.4, 1.0])
def test_no_pair_comes_nearer_than_its_hulls_were_allowed_to(gain_step):
    assert worst_flights(gain_step).min() >= KEPT - 1e-9


def test_a_gain_above_one_over_the_step_is_refused_with_a_reason():
    assert worst_flights(1.3, 100).min() < KEPT - 0.01


def test_the_points_of_a_hull_move_towards_each_other_and_end_at_rest():
    draw = np.random.default_rng(3)
    values = draw.normal(size=(4, 3))
    with precision("float64"):
        now = np.asarray(hull_points(jnp.asarray(values), ROOTS))
        rates = np.asarray(hull_points(jnp.asarray(np.vstack([values[1:], np.zeros(3)])), ROOTS))
    for k, root in enumerate(ROOTS):
        np.testing.assert_allclose(rates[k], root * (now[k + 1] - now[k]), atol=1e-12)
    weights = np.poly(-np.array(ROOTS))[::-1] / np.prod(ROOTS)
    np.testing.assert_allclose(now[3], weights @ values, atol=1e-12)


CARTS = ech.models.DoubleIntegrator()
STAR = ech.Graph.star(5)
CIRCLE = [(np.cos(a), np.sin(a)) for a in 0.25 * np.pi + 0.02 + 0.5 * np.pi * np.arange(4)]
ROUND = ech.Safety(radii=(0.1, 0.1, 0.1))
BRIEF = ech.Settings(horizon=0.02, dt=0.02, engine="jax")


def crossing(safety, graph=STAR, size=2.0, model=CARTS, **law):
    offsets = {k + 1: (size * x, size * y) for k, (x, y) in enumerate(CIRCLE)}
    starts = {k + 1: (-size * x, -size * y, 0.0, 0.0) for k, (x, y) in enumerate(CIRCLE)}
    drive = ech.Laws(ech.laws.StoppingLeader(), ech.laws.StoppingPoint(safety=safety, **law))
    formation = ech.Formation.from_offsets(model, graph, offsets)
    return ech.Parts(model, graph, formation, drive, initial=starts)


def least_distance(result):
    places = result.states[:, :, None, :2]
    apart = np.linalg.norm(places - places.swapaxes(1, 2), axis=-1)
    return apart[:, ~np.eye(5, dtype=bool)].min()


def test_agents_cross_without_touching_and_arrive():
    settings = ech.Settings(horizon=10.0, dt=0.02)
    result = ech.simulate(crossing(ROUND), settings)
    least = least_distance(result)
    assert least >= 0.2 and result.sums.separation.min() == pytest.approx(least, rel=1e-9)
    assert result.formation_errors[-1].max() < 1e-3
    active = result.sums.avoidance.sum(axis=0)
    assert active.any() and not active[-20:].any()
    assert least_distance(ech.simulate(crossing(None), settings)) < 0.05


@pytest.mark.slow
def test_agents_that_nobody_holds_back_fly_as_without():
    settings = ech.Settings(horizon=1.0, dt=0.02, engine="jax")
    parts = (crossing(safety, size=20.0) for safety in (ROUND, None))
    wide, free = (ech.simulate(each, settings) for each in parts)
    assert not wide.sums.avoidance.any()
    np.testing.assert_allclose(wide.inputs, free.inputs, atol=1e-12)


@pytest.mark.slow
def test_a_run_says_the_ellipsoids_of_its_model():
    class Round(ech.models.DoubleIntegrator):
        radius: float = 0.1

    parts = crossing(ech.Safety(), model=Round())
    result = ech.simulate(parts, ech.Settings(horizon=0.1, dt=0.02))
    ellipsoid, data = avoidance(result).ellipsoid, labelled_parts(result.parts, result.settings)
    assert (ellipsoid.radius, ellipsoid.height) == pytest.approx((0.1, 0.3))
    assert float(data.variables["ellipsoid_radius"][1]) == 0.1


class Elsewhere(ech.models.DoubleIntegrator):
    """A cart whose outputs have the names of places, and are twice as far."""

    output_names = flat_outputs = ("x", "y")
    flat_chains = None

    def output(self, x):
        return 2.0 * x[:2]


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda: crossing(ROUND, model=Elsewhere()), "its output `x` is not the state of that"),
        (lambda: crossing(ech.Safety()), "`radii`, since `DoubleIntegrator` has no `radius`"),
        (lambda: crossing(ech.Safety(radii=(0.1, 0.2, 0.1))), "the first two equal"),
        (lambda: crossing(ech.Safety(radii=(0.1, 0.1, 0.0))), "three positive numbers"),
        (lambda: crossing(ech.Safety(radii=(0.1, 0.1))), "three positive numbers"),
        (lambda: crossing(ech.Safety(margin=-1.0)), "must be not negative"),
        (lambda: crossing(ech.Safety(radii=(0.1,) * 3, gain=60.0)), "one over the step, 50 1/s"),
        (lambda: crossing(ech.Safety(radii=(0.1,) * 3, reach=1.0)), "must be at least"),
        (lambda: crossing(ROUND, speed=np.inf), "must be at least inf m"),
        (lambda: crossing(ROUND, size=0.15), "goal of agent 0 is too near to that of agent"),
        (lambda: crossing(ROUND, feedforward="parent"), "needs `feedforward: relay`"),
        (lambda: crossing(3.0), "must be a `Safety`"),
        (
            lambda: crossing(ROUND).replace(initial={1: (0, 0, 0, 0), 2: (0.21, 0, 0, 0)}),
            "too near to agent 1, 0 m as `safety` measures it, and at least 0.25 m are allowed",
        ),
        (lambda: crossing(ROUND, ech.Graph.path(5, leaders=(0, 4))), "needs one leader"),
    ],
)
def test_what_cannot_be_kept_apart_is_refused_with_one_sentence(change, sentence):
    with pytest.raises(EchelonError, match=sentence) as refusal:
        ech.simulate(change(), BRIEF)
    assert str(refusal.value).count(". ") == 0


@pytest.mark.slow
def test_agents_that_hear_one_way_keep_apart_and_native_code_does_not():
    parts = crossing(ROUND)
    one_way = ech.simulate(parts.replace(graph=STAR.one_way()), BRIEF)
    assert one_way.outcome is ech.Outcome.COMPLETED
    with pytest.raises(EchelonError, match="no native code for agents that keep away"):
        ech.simulate(parts, BRIEF._replace(engine="native"))


def test_a_reach_for_any_speed_is_known_without_a_warning():
    safety = ech.Safety(radii=(0.1,) * 3)
    speeds = np.array([3e155, 4e155])
    assert safety.needed_reach(speeds, np.ones(2)) == pytest.approx(2.5e155)
