"""Gradients of the cost of runs by gains and starts, against closed forms and differences."""

import numpy as np
import pytest

import echelon as ech
from echelon.core.cache import BoundedCache
from echelon.simulation.engine import gradient as gradients
from echelon.simulation.engine.content import content_of
from echelon.simulation.engine.gradient import gradient
from echelon.simulation.native import backward

LINE = ech.Graph.path(2)


def squares(sums):
    return sums.errors[0].sum()


def integrators(coupling, p=1.0, r=1.0, start=0.7):
    """One follower, x+ = (1 - dt c p / r) x, whose leader rests at 0."""
    model = ech.models.SingleIntegrator(1)
    gain = ech.synthesize(model, LINE, ech.gains.FixedGain([[p]], R=[[r]], coupling=coupling))
    return ech.Parts(
        model,
        LINE,
        ech.Formation(np.zeros((2, 1))),
        ech.Laws(ech.laws.TrimInput(), ech.laws.Consensus(gain)),
        initial=np.array([[0.0], [start]]),
    )


@pytest.mark.parametrize("engine", ["jax", "native"])
@pytest.mark.parametrize("steps", [1, 2, 7, 30])
def test_the_slopes_of_a_scalar_have_a_closed_form(steps, engine):
    c, p, r, start, dt = 0.8, 1.5, 2.0, 0.7, 0.1
    settings = ech.Settings(steps * dt, dt, integrator="euler", engine=engine)
    wrt = ("P", "R", "coupling", "initial")
    found = ech.gradient(integrators(c, p, r, start), settings, squares, wrt)
    assert found.engine == engine
    # sum over k < K of start^2 q^(2k), q = 1 - dt c p / r.
    q, k = 1.0 - dt * c * p / r, np.arange(steps)
    value = start**2 * (q ** (2 * k)).sum()
    by_q = start**2 * (2 * k * q ** np.maximum(2 * k - 1, 0)).sum()
    assert found.value == pytest.approx(value, rel=1e-13)
    assert found.slopes["coupling"] == pytest.approx(-dt * p / r * by_q, rel=1e-12)
    assert found.slopes["P"] == pytest.approx(np.array([[-dt * c / r * by_q]]), rel=1e-12)
    assert found.slopes["R"] == pytest.approx(np.array([[dt * c * p / r**2 * by_q]]), rel=1e-12)
    # A leader moved with its follower moves nothing else.
    away = 2.0 * value / start
    assert found.slopes["initial"] == pytest.approx(np.array([[-away], [away]]), rel=1e-12)


def flock():
    """Three vehicles on a line that follow a circle behind their limits."""
    horizon = ["simulation.horizon=0.4", "simulation.dt=0.01", "simulation.engine=native"]
    return ech.build(ech.load_scenario("paper", horizon))


@pytest.mark.slow
def test_the_slopes_of_the_paper_s_run_are_those_of_differences():
    parts, settings = flock()
    found = ech.gradient(parts, settings, squares, ("P", "coupling"))
    run = ech.simulate(parts, settings)
    assert found.value == pytest.approx(run.sums.errors[0].sum(), rel=1e-12)
    assert found.sums.effort == pytest.approx(run.sums.effort, rel=1e-9)
    gain, rng = parts.drive.gain, np.random.default_rng(0)
    along = rng.normal(size=gain.P.shape) * np.sqrt(np.outer(np.diag(gain.P), np.diag(gain.P)))
    along = 0.05 * (along + along.T)

    def moved(h, push=0.0):
        P, c = gain.P + h * along, gain.coupling + push
        changed = ech.Gain(P, gain.R, c, gain.method, gain.certificate)
        law = ech.laws.Consensus(changed, parts.drive.feedforward)
        return squares(
            ech.simulate(parts.replace(drive=parts.drive.with_follower(law)), settings).sums
        )

    by_P = (moved(1e-4) - moved(-1e-4)) / 2e-4
    assert (found.slopes["P"] * along).sum() == pytest.approx(by_P, rel=1e-4)
    by_c = (moved(0.0, 1e-4) - moved(0.0, -1e-4)) / 2e-4
    assert found.slopes["coupling"] == pytest.approx(by_c, rel=1e-4)


WRT = ("P", "R", "coupling", "initial")


def all_terms(sums):
    """A cost with slopes along everything that is summed, distances apart."""
    errors = sums.errors[0].sum() + 0.1 * (sums.errors[1] ** 2).sum()
    led = 0.3 * sums.tracking.sum() + 0.2 * (sums.outputs**2).sum()
    return errors + led + 0.01 * sums.effort.sum()


def with_distances(sums):
    return all_terms(sums) + 0.5 * sums.spacing.sum()


def check_equal(parts, settings, cost, wrt):
    ours, theirs = (
        ech.gradient(parts, settings._replace(engine=engine), cost, wrt)
        for engine in ("native", "jax")
    )
    assert (ours.engine, theirs.engine) == ("native", "jax")
    assert ours.value == pytest.approx(theirs.value, rel=1e-13)
    for name in wrt:
        a, b = ours.slopes[name], theirs.slopes[name]
        assert np.abs(b).max() > 0.0 and np.abs(a - b).max() <= 1e-12 * np.abs(b).max(), name


def points(graph, feedforward, dimension=2, **more):
    """Points in the plane that follow a circle."""
    model = ech.models.DoubleIntegrator(dimension=dimension)
    gain = ech.synthesize(model, ech.Graph.path(5), ech.gains.Riccati(coupling=0.3))
    leader = ech.laws.Tracking(ech.references.Circle(radius=0.5, rate=0.5))
    drive = ech.Laws(leader, ech.laws.Consensus(gain, feedforward=feedforward))
    formation = ech.Formation.circle(model, graph, spacing=1.0)
    return ech.Parts(model, graph, formation, drive, initial={"position": 0.3}, **more)


def uneven():
    """Two leaders, edges of one direction and of several weights, that switch; and wind."""
    first = [(0, 1, 2.0), (1, 2, 1.0), (3, 2, 0.5), (2, 1, 1.5), (0, 4, 1.0)]
    then = [(3, 1, 1.0), (1, 2, 0.7), (1, 4, 1.0), (4, 2, 3.0)]
    graph = ech.Graph.switching([(0.0, first), (0.075, then)], (0, 3), 5, directed=True)
    wind = ech.Disturbance(constant={"velocity": 0.3})
    return points(graph, "relay", world=ech.World(disturbance=wind))


SHORT = ech.Settings(horizon=0.2, dt=0.01, steady_window=0.1)


def test_native_slopes_are_those_of_jax_on_any_graph_in_wind():
    check_equal(uneven(), SHORT, all_terms, (*WRT, "offsets"))


def test_native_slopes_are_those_of_jax_along_distances_and_through_parents():
    check_equal(points(ech.Graph.path(11), "parent"), SHORT, with_distances, WRT)


@pytest.mark.slow
def test_native_slopes_are_those_of_jax_for_vehicles_and_the_distances_between_them():
    parts, _ = ech.build(ech.load_scenario("planar-quadrotor"))
    check_equal(parts, SHORT, with_distances, WRT)


@pytest.mark.study
def test_native_slopes_are_those_of_jax_for_a_law_that_remembers():
    parts = points(ech.Graph.ring(5), "relay", dimension=1)
    parts = parts.replace(drive=ech.Laws(ech.laws.StoppingLeader(), ech.laws.StoppingPoint()))
    check_equal(parts, SHORT, all_terms, ("initial", "offsets"))


def ready_runs(room=128 * 2**20):
    """No run that is ready, and room for so many bytes."""
    return BoundedCache(4, lambda ready: ready.size, room)


def test_a_run_is_taken_back_in_stretches_as_in_one(monkeypatch):
    parts, settings = points(ech.Graph.path(11), "parent"), SHORT._replace(engine="native")
    once = ech.gradient(parts, settings, with_distances, WRT)
    monkeypatch.setattr(backward, "_TAPE", 1)
    # The run that is ready has a tape already.
    monkeypatch.setattr(gradients, "_cache", ready_runs())
    again = ech.gradient(parts, settings, with_distances, WRT)
    for name in WRT:
        np.testing.assert_array_equal(once.slopes[name], again.slopes[name])


def regained(parts, p, coupling, r=2.0):
    """The same parts, with another gain of the same form."""
    method = ech.gains.FixedGain([[p]], R=[[r]], coupling=coupling)
    law = ech.laws.Consensus(ech.synthesize(parts.model, parts.graph, method))
    return parts.replace(drive=parts.drive.with_follower(law))


@pytest.mark.parametrize("engine", ["jax", "native"])
def test_a_run_that_is_ready_is_differentiated_anew_for_each_gain(monkeypatch, engine):
    parts, settings = integrators(0.8, 1.5, 2.0), ech.Settings(0.7, 0.1, engine=engine)
    wrt = ("P", "coupling")
    # The last has other numbers where no slope is asked for, which native code holds as constants.
    gains = ((1.5, 0.8, 2.0), (1.2, 0.9, 2.0), (1.5, 0.8, 2.0), (1.5, 0.8, 1.0))
    ready = [ech.gradient(regained(parts, *gain), settings, squares, wrt) for gain in gains]
    for gain, found in zip(gains, ready, strict=True):
        monkeypatch.setattr(gradients, "_cache", ready_runs())
        alone = ech.gradient(regained(parts, *gain), settings, squares, wrt)
        assert found.value == alone.value and found.engine == engine
        for name in wrt:
            np.testing.assert_array_equal(found.slopes[name], alone.slopes[name])
    assert ready[0].value == ready[2].value != ready[1].value


def test_what_is_changed_in_place_or_refused_is_seen_by_the_next_gradient():
    starts = np.array([[0.0], [0.7]])
    parts, settings = integrators(0.8), ech.Settings(0.7, 0.1, engine="native")
    parts = parts.replace(initial=starts)
    first = ech.gradient(parts, settings, squares, ("initial",)).value
    starts[1] *= 2.0
    assert ech.gradient(parts, settings, squares, ("initial",)).value == pytest.approx(4.0 * first)
    # A number of the gain along which there is no slope, a constant of the code.
    parts.drive.gain.R_inverse[:] *= 0.5
    weaker = ech.gradient(parts, settings, squares, ("initial",)).value
    found = ech.gradient(regained(parts, 1.0, 0.8, 2.0), settings, squares, ("initial",))
    assert weaker == found.value != first
    starts[1] = np.nan
    with pytest.raises(ech.EchelonError, match="must be finite"):
        ech.gradient(parts, settings, squares, ("initial",))


RATE = 1.0


class Waning(ech.models.SingleIntegrator):
    """Reads a number of its module."""

    def drift(self, x):
        return -RATE * x


def test_a_run_of_a_user_s_class_is_made_anew(monkeypatch):
    monkeypatch.setattr(gradients, "_cache", ready_runs())
    parts = integrators(0.5).replace(model=Waning(1))
    settings = ech.Settings(0.2, 0.1, integrator="euler", engine="native")

    def value():
        return ech.gradient(parts, settings, squares, ("initial",)).value

    assert value() == pytest.approx(0.7**2 * (1.0 + 0.85**2))
    monkeypatch.setitem(globals(), "RATE", 5.0)
    assert value() == pytest.approx(0.7**2 * (1.0 + 0.45**2))
    assert not gradients._cache


def test_offsets_written_to_are_another_formation_and_equal_ones_the_same(monkeypatch):
    monkeypatch.setattr(gradients, "_cache", ready_runs())
    parts, settings = integrators(0.5), ech.Settings(0.2, 0.1, integrator="euler", engine="jax")

    def value(offsets):
        given = parts.replace(formation=offsets)
        return ech.gradient(given, settings, squares, ("coupling",)).value

    goals = ech.Formation(np.array([[0.0], [0.0]]))
    first = value(goals)
    assert value(ech.Formation(np.zeros((2, 1)))) == first and len(gradients._cache) == 1
    goals.offsets.setflags(write=True)
    goals.offsets[1] = 0.7
    # Of a follower on its goal nothing is left to sum.
    assert value(goals) == 0.0 < first == value(ech.Formation(np.zeros((2, 1))))
    assert len(gradients._cache) == 2


def test_what_is_kept_has_a_bound_in_bytes_and_holds_no_moments(monkeypatch):
    monkeypatch.setattr(gradients, "_cache", ready_runs())
    settings = ech.Settings(0.2, 0.1, engine="native")

    def differentiate(start):
        parts = integrators(0.5, start=start)
        ech.gradient(parts, settings, squares, ("coupling",))
        return content_of(parts, settings, ("coupling",))

    ready = gradients._cache.pop(differentiate(0.7))
    assert not any(way.moments for way in ready._native._passes.values())
    way = next(iter(ready._native._passes.values()))
    assert ready.size > way.tape.nbytes + way.cotangents.nbytes
    monkeypatch.setattr(gradients, "_cache", ready_runs(2 * ready.size))
    for start in (0.8, 0.9, 0.6):
        differentiate(start)
    assert 1 <= len(gradients._cache) <= 2
    monkeypatch.setattr(gradients, "_cache", ready_runs(10))
    differentiate(0.7)
    assert not gradients._cache


class Stretched(ech.models.SingleIntegrator):
    """Sees differences twice as large as they are."""

    def difference(self, x, y):
        return 2.0 * (x - y)


def test_what_cannot_be_taken_back_natively_is_by_jax_and_says_so(monkeypatch):
    parts, settings = integrators(1.0), ech.Settings(0.2, 0.1)
    parts = parts.replace(model=Stretched(1))
    told = "there is no native code for a `difference` of states that is not x - y"
    with pytest.raises(ech.EchelonError, match=told):
        ech.gradient(parts, settings._replace(engine="native"), squares, ("P",))
    monkeypatch.setattr(gradients, "_WORTH", 1)
    found = ech.gradient(parts, settings, squares, ("P",))
    assert found.engine == "jax"
    assert found.warnings[0].startswith(f"JAX differentiates the steps, since {told}")


def test_where_two_agents_meet_the_distance_between_them_takes_no_slope_away():
    found = ech.gradient(
        integrators(1.0, start=0.0), ech.Settings(0.2, 0.1), lambda s: s.spacing.sum(), ("initial",)
    )
    assert found.value == 0.0 and np.isfinite(found.slopes["initial"]).all()


@pytest.mark.parametrize(
    ("wrt", "told"),
    [
        (("Q",), "`wrt` names `Q`, allowed are `P`, `R`, `coupling`, `initial`, `offsets`."),
        (("couplin",), "allowed are .* \\(did you mean `coupling`\\?\\)"),
    ],
)
def test_what_is_no_variable_is_refused_in_words(wrt, told):
    with pytest.raises(ech.EchelonError, match=told):
        gradient(integrators(1.0), ech.Settings(0.2, 0.1), squares, wrt)


@pytest.mark.parametrize("engine", ["jax", "native"])
def test_a_cost_of_many_numbers_is_refused_in_words(engine):
    settings = ech.Settings(0.2, 0.1, engine=engine)
    with pytest.raises(ech.EchelonError, match=r"has shape \(2, 1\), and must be one number"):
        gradient(integrators(1.0), settings, lambda sums: sums.effort[:, None], ("P",))


def test_without_a_gain_there_is_no_p():
    parts = integrators(1.0)
    rest = ech.laws.TrimInput()
    parts = parts.replace(drive=ech.Laws(rest, rest))
    with pytest.raises(ech.EchelonError, match="law `TrimInput` has no gain, and so no `P`"):
        gradient(parts, ech.Settings(0.2, 0.1), squares, ("P",))
