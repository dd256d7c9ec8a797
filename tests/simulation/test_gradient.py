"""Gradients of the cost of runs by gains and starts, against closed forms and differences."""

import numpy as np
import pytest

import echelon as ech

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


@pytest.mark.parametrize("steps", [1, 2, 7, 30])
def test_the_slopes_of_a_scalar_have_a_closed_form(steps):
    c, p, r, start, dt = 0.8, 1.5, 2.0, 0.7, 0.1
    settings = ech.Settings(steps * dt, dt, integrator="euler")
    wrt = ("P", "R", "coupling", "initial")
    found = ech.gradient(integrators(c, p, r, start), settings, squares, wrt)
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


@pytest.mark.slow
def test_the_slopes_of_the_paper_s_run_are_those_of_differences():
    horizon = ["simulation.horizon=0.4", "simulation.dt=0.01", "simulation.engine=native"]
    parts, settings = ech.build(ech.load_scenario("paper", horizon))
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


def with_distances(sums):
    """A cost with slopes along everything that is summed."""
    errors = sums.errors[0].sum() + 0.1 * (sums.errors[1] ** 2).sum()
    led = 0.3 * sums.tracking.sum() + 0.2 * (sums.outputs**2).sum()
    return errors + led + 0.01 * sums.effort.sum() + 0.5 * sums.spacing.sum()


@pytest.mark.slow
def test_slopes_by_starts_and_offsets_are_those_of_differences_on_any_graph_in_wind():
    first = [(0, 1, 2.0), (1, 2, 1.0), (3, 2, 0.5), (2, 1, 1.5), (0, 4, 1.0)]
    then = [(3, 1, 1.0), (1, 2, 0.7), (1, 4, 1.0), (4, 2, 3.0)]
    graph = ech.Graph.switching([(0.0, first), (0.075, then)], (0, 3), 5, directed=True)
    model, rng = ech.models.DoubleIntegrator(dimension=2), np.random.default_rng(0)
    gain = ech.synthesize(model, ech.Graph.path(5), ech.gains.Riccati(coupling=0.3))
    leader = ech.laws.Tracking(ech.references.Circle(radius=0.5, rate=0.5))
    offsets, starts = rng.normal(size=(2, 5, 4))
    settings = ech.Settings(horizon=0.2, dt=0.01, steady_window=0.1)
    parts = ech.Parts(
        model,
        graph,
        ech.Formation(offsets),
        ech.Laws(leader, ech.laws.Consensus(gain, feedforward="relay")),
        initial=starts,
        world=ech.World(disturbance=ech.Disturbance(constant={"velocity": 0.3})),
    )
    found = ech.gradient(parts, settings, with_distances, ("initial", "offsets"))
    moves = {
        "initial": lambda step: parts.replace(initial=starts + step),
        "offsets": lambda step: parts.replace(formation=ech.Formation(offsets + step)),
    }
    for name, moved in moves.items():
        along = rng.normal(size=(5, 4))
        ends = (ech.simulate(moved(h * along), settings).sums for h in (1e-4, -1e-4))
        above, below = map(with_distances, ends)
        expected = (above - below) / 2e-4
        assert (found.slopes[name] * along).sum() == pytest.approx(expected, rel=1e-6)


def regained(parts, p, coupling, r=2.0):
    """The same parts, with another gain of the same form."""
    method = ech.gains.FixedGain([[p]], R=[[r]], coupling=coupling)
    law = ech.laws.Consensus(ech.synthesize(parts.model, parts.graph, method))
    return parts.replace(drive=parts.drive.with_follower(law))


def test_each_gain_and_engine_has_the_derivatives_of_its_own_run():
    parts, settings = integrators(0.8, 1.5, 2.0), ech.Settings(0.7, 0.1, engine="jax")
    wrt = ("P", "coupling")
    gains = ((1.5, 0.8, 2.0), (1.2, 0.9, 2.0), (1.5, 0.8, 2.0), (1.5, 0.8, 1.0))
    found = [ech.gradient(regained(parts, *gain), settings, squares, wrt) for gain in gains]
    assert found[0].value == found[2].value != found[1].value != found[3].value
    # Whoever steps the run, JAX differentiates it.
    native = ech.gradient(
        regained(parts, *gains[0]), settings._replace(engine="native"), squares, wrt
    )
    for name in wrt:
        np.testing.assert_array_equal(found[0].slopes[name], found[2].slopes[name])
        np.testing.assert_array_equal(found[0].slopes[name], native.slopes[name])
        assert not np.array_equal(found[0].slopes[name], found[3].slopes[name])


def test_what_is_changed_in_place_or_refused_is_seen_by_the_next_gradient():
    starts = np.array([[0.0], [0.7]])
    parts, settings = integrators(0.8), ech.Settings(0.7, 0.1)
    parts = parts.replace(initial=starts)
    first = ech.gradient(parts, settings, squares, ("initial",)).value
    starts[1] *= 2.0
    assert ech.gradient(parts, settings, squares, ("initial",)).value == pytest.approx(4.0 * first)
    parts.drive.gain.R_inverse[:] *= 0.5
    weaker = ech.gradient(parts, settings, squares, ("initial",)).value
    found = ech.gradient(regained(parts, 1.0, 0.8, 2.0), settings, squares, ("initial",))
    assert weaker == found.value != first
    starts[1] = np.nan
    with pytest.raises(ech.EchelonError, match="must be finite"):
        ech.gradient(parts, settings, squares, ("initial",))


def test_where_two_agents_meet_the_distance_between_them_takes_no_slope_away():
    found = ech.gradient(
        integrators(1.0, start=0.0), ech.Settings(0.2, 0.1), lambda s: s.spacing.sum(), ("initial",)
    )
    assert found.value == 0.0 and np.isfinite(found.slopes["initial"]).all()


def test_what_has_no_slope_is_refused_in_words():
    parts, settings, rest = integrators(1.0), ech.Settings(0.2, 0.1), ech.laws.TrimInput()
    for given, cost, wrt, told in (
        (parts, squares, "Q", "`wrt` names `Q`, allowed are `P`, `R`, `coupling`, `initial`, `off"),
        (parts, squares, "couplin", r"allowed are .* \(did you mean `coupling`\?\)"),
        (parts, lambda sums: sums.effort[:, None], "P", r"has shape \(2, 1\), and must be one num"),
        (parts.replace(drive=ech.Laws(rest, rest)), squares, "P", "law `TrimInput` has no gain, a"),
    ):
        with pytest.raises(ech.EchelonError, match=told):
            ech.gradient(given, settings, cost, (wrt,))


def test_a_cost_over_a_late_network_has_the_slope_of_differences():
    model, path = ech.models.DoubleIntegrator(2), ech.Graph.path(3)
    gain = ech.synthesize(model, path, ech.gains.Riccati())
    leader = ech.laws.Tracking(ech.references.Circle(radius=1.0, rate=0.5), gain)
    laws = ech.Laws(leader, ech.laws.Consensus(gain, feedforward="relay"))
    late = ech.World(network=ech.Network(rate=50.0, delay=0.05, loss=0.2))
    starts = np.random.default_rng(1).normal(size=(3, 4))
    parts = ech.Parts(model, path, ech.Formation.line(model, path), laws, starts, world=late)
    settings = ech.Settings(horizon=2.0, dt=0.02)
    found = ech.gradient(parts, settings, lambda sums: sums.errors[0].sum(), ["initial"])

    def cost(x):
        return ech.simulate(parts.replace(initial=x), settings).sums.errors[0].sum()

    for way in np.random.default_rng(0).normal(size=(3, *starts.shape)):
        slope = (cost(starts + 1e-5 * way) - cost(starts - 1e-5 * way)) / 2e-5
        assert (found.slopes["initial"] * way).sum() == pytest.approx(slope, rel=1e-6)


@pytest.mark.slow
def test_where_agents_keep_apart_a_sentence_names_what_has_no_derivative():
    parts, settings = ech.build(ech.load_scenario("crossing"))
    settings = settings._replace(horizon=0.1, steady_window=0.1)
    with pytest.raises(
        ech.errors.SimulationError, match="whose end depends on numbers, as `safety`"
    ):
        ech.gradient(parts, settings, lambda sums: sums.errors[0].sum(), ["initial"])
