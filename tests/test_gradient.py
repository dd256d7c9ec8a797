"""How costs of runs change with gains and starts, against closed forms and differences."""

import numpy as np
import pytest

import echelon as ech
from echelon.engine.gradient import gradient

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


def flock():
    """Three vehicles on a line that follow a circle behind their limits."""
    built = ech.load_scenario("paper", ["simulation.horizon=0.4", "simulation.dt=0.01"])
    from echelon.scenario.build import build

    return build(built)


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


def test_without_a_gain_there_is_no_p():
    parts = integrators(1.0)
    rest = ech.laws.TrimInput()
    parts = parts.replace(drive=ech.Laws(rest, rest))
    with pytest.raises(ech.EchelonError, match="law `TrimInput` has no gain, and so no `P`"):
        gradient(parts, ech.Settings(0.2, 0.1), squares, ("P",))
