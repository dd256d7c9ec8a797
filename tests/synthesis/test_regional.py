"""Gains with a guarantee on a domain, gain files, `check` and `design`."""

import json
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from in_words import in_words

import echelon as ech
from echelon.core.numerics import precision
from echelon.core.words import Kind, Theorem, Verdict
from echelon.synthesis.certificates import Domain
from echelon.synthesis.certificates.domain_metrics import radius
from echelon.synthesis.certificates.jacobians import (
    has_constant_input_map,
    jacobians,
    model_jacobian,
    offsets_are_symmetries,
    sample_jacobians,
)

LINE = ech.Graph.path(4)
DEG = np.pi / 180.0
TILT = {"roll": 20 * DEG, "pitch": 20 * DEG, "yaw": 10 * DEG, "thrust": 2.0}


def sentence(act):
    with pytest.raises(ech.EchelonError) as caught:
        act()
    return str(caught.value)


@pytest.fixture(scope="module")
def robust():
    return ech.synthesize(ech.models.QuadrotorThrust(), LINE, ech.gains.RobustLQR(TILT, exact=True))


def test_a_robust_gain_is_proved_and_no_sample_contradicts_it(robust):
    region, model = robust.certificate.region, ech.models.QuadrotorThrust()
    assert (region.kind, region.theorem) == (Kind.PROOF, Theorem.T1)
    assert region.rate >= 0.2 and np.linalg.cond(robust.P) <= 500
    assert rate_seen(model, robust, TILT) >= region.rate
    # The certified set fits into the domain: the farthest point of {x'Px <= r^2} along state j is
    # r sqrt(W_jj).
    domain, r = Domain.about(model, TILT), region.radius
    assert r == radius(domain, robust.P)
    reach, margins = r * np.sqrt(np.diag(np.linalg.inv(robust.P))), domain.margins()
    assert (reach <= margins * (1 + 1e-12)).all()
    assert np.isclose((reach / margins).max(), 1.0)


def test_only_a_constant_input_map_gives_the_nonlocal_theorem():
    euler, thrust = ech.models.QuadrotorEuler(), ech.models.QuadrotorThrust()
    with precision("float64"):
        assert has_constant_input_map(thrust, Domain.about(thrust, TILT))
        assert not has_constant_input_map(euler, Domain.about(euler, TILT))


def rate_seen(model, gain, bounds):
    """The slowest contraction at states and corners of a domain, each with the g that it has."""
    random, domain, low = np.random.default_rng(8), Domain.about(model, bounds), LINE.spectrum().low
    points = [np.concatenate(both) for both in zip(*map(domain.sample, (300, 300)), strict=True)]
    sides = [(domain.lower, domain.upper), (domain.input_lower, domain.input_upper)]
    for some, (lower, upper) in zip(points, sides, strict=True):
        bounded = np.isfinite(lower)
        corners = np.where(random.integers(0, 2, (300, len(lower))), upper, lower)
        some[300:, bounded] = corners[:, bounded]
    root, worst = np.linalg.inv(np.linalg.cholesky(gain.P)), -np.inf
    with precision("float64"):
        jacobian = jax.jit(model_jacobian(model))
        for x, v in zip(np.array(model.trim[0]) + points[0], points[1], strict=True):
            A, g = np.asarray(jacobian(x, v)), np.asarray(model.normalized_input_map(jnp.array(x)))
            slope = gain.P @ A - gain.coupling * low * gain.P @ g @ gain.R_inverse @ g.T @ gain.P
            worst = max(worst, np.linalg.eigvalsh(root @ (slope + slope.T) @ root.T)[-1])
    return -0.5 * worst


@pytest.mark.parametrize("tilt", [0.2, 0.35])
def test_where_g_varies_the_rate_holds_with_the_g_of_each_state(tilt):
    model, bounds = ech.models.PlanarQuadrotor(), {"roll": tilt, "thrust": 1.0}
    region = (gain := ech.synthesize(model, LINE, ech.gains.RobustLQR(bounds))).certificate.region
    seen = rate_seen(model, gain, bounds)
    assert region is None or (region.theorem is Theorem.T2 and 0.0 < region.rate <= seen + 1e-12)
    assert tilt > 0.3 or region is not None


def test_a_coupling_below_what_the_metric_needs_is_promised_its_own_rate_only():
    model, bounds = ech.models.Pendulum(damping=0.1), {"angle": 0.5}
    full = ech.synthesize(model, LINE, ech.gains.Contraction(bounds, rate=0.5, exact=False))
    half = ech.gains.Contraction(bounds, rate=0.5, exact=False, coupling=0.5 * full.coupling)
    gain = ech.synthesize(model, LINE, half)
    seen, region = rate_seen(model, gain, bounds), gain.certificate.region
    assert full.certificate.region.rate >= 0.5 * (1 - 1e-5)
    assert gain.certificate.edge == full.certificate.edge
    assert seen < 0.45 and (region is None or region.rate <= seen + 1e-12)


def test_a_pendulum_is_monotone_up_to_the_angle_of_the_closed_form():
    # sqrt(g)(1 - sqrt(cos th)) > damping: infeasible beyond 0.787 rad for 9.81 and 0.5.
    pendulum = ech.models.Pendulum(damping=0.5)
    edge = np.arccos((1.0 - 0.5 / np.sqrt(9.81)) ** 2)

    def gain(angle):
        return ech.synthesize(pendulum, LINE, ech.gains.Monotone({"angle": angle}))

    inside = gain(0.99 * edge)
    region, P = inside.certificate.region, inside.P
    assert region.theorem is Theorem.A5 and region.kind is Kind.VERTICES
    with precision("float64"):
        found = jacobians(pendulum, Domain.about(pendulum, {"angle": 0.99 * edge}))
    for A in found.matrices:
        assert np.linalg.eigvalsh(P @ A + A.T @ P).max() <= 1e-7 * np.abs(P).max()
    assert "no constant metric" in sentence(lambda: gain(1.01 * edge))


class Turned(ech.ControlAffine):
    """A decaying drift and an input that pushes along a direction which the state turns."""

    state_names = ("east", "north")
    input_names = ("push",)

    def drift(self, x):
        return -x

    def input_map(self, x):
        return jnp.stack([jnp.cos(x[0]), jnp.sin(x[0])])[:, None]


def test_where_g_varies_a_monotone_drift_is_certified_a_smaller_set(tmp_path):
    gain = ech.synthesize(Turned(), LINE, ech.gains.Monotone({"east": 1.0, "north": 2.0}))
    region, ends = gain.certificate.region, LINE.spectrum().eigenvalues[[0, -1]]
    assert region.theorem is Theorem.A5
    assert region.radius == pytest.approx(
        radius(region.domain, gain.P) * np.sqrt(ends[0] / ends[1]), rel=1e-12
    )
    # V = delta'(L kron P) delta does not rise: on its set no agent leaves the domain.
    L = LINE.grounded_laplacian().toarray()
    reach = np.sqrt(ends[1]) * region.radius * np.sqrt(np.diag(np.linalg.inv(np.kron(L, gain.P))))
    assert (reach.reshape(3, 2) <= np.array([1.0, 2.0]) * (1 + 1e-9)).all()
    ech.save_gain(gain, Turned(), LINE, tmp_path / "gain.json")
    assert ech.verify(tmp_path / "gain.json", Turned()).holds
    told = json.loads((tmp_path / "gain.json").read_text())
    told["certificate"]["region"]["radius"] *= float(np.sqrt(ends[1] / ends[0]))
    (tmp_path / "gain.json").write_text(json.dumps(told))
    found = ech.verify(tmp_path / "gain.json", Turned())
    assert found.sentence == "Refused: g is constant (A5) does not hold as stored."


@pytest.mark.parametrize(
    ("model", "domain"),
    [
        (ech.models.DoubleIntegrator(3), {}),
        (ech.models.PrintedQuadrotor(), {"attitude": 0.2, "rate": 0.5}),
    ],
)
def test_nilpotent_drifts_have_no_monotone_metric_and_the_block_is_named(model, domain):
    told = sentence(lambda: ech.synthesize(model, LINE, ech.gains.Monotone(domain)))
    assert "has a Jordan block on the imaginary axis, at 0" in told and "`vx`" in told


@pytest.mark.parametrize(
    ("bounds", "told"),
    [
        (
            {"pitch": 1.6},
            "reaches [-1.6, 1.6], and `Quadrotor` holds only inside (-1.571, 1.571).",
        ),
        (
            {"roll": (0.2, -0.2)},
            "is [0.2, -0.2], and must be finite with its lower end below its upper.",
        ),
        ({"roll": (0.1, 0.2)}, "is [0.1, 0.2], and must contain the trim, 0."),
    ],
)
def test_a_bad_domain_has_its_sentence(bounds, told):
    found = sentence(lambda: Domain.about(ech.models.Quadrotor(), bounds))
    assert found == f"the domain of `{[*bounds][0]}` {told}"


def test_a_domain_needs_known_names_and_all_bounds_that_matter():
    euler, robust = ech.models.QuadrotorEuler(), ech.gains.RobustLQR
    assert "did you mean `roll`?" in sentence(lambda: Domain.about(euler, {"rol": 0.1}))
    for method, told in (
        (robust({"roll": 0.1}), "the domain leaves `pitch` unbounded"),
        (robust(), "this method needs a `domain`"),
    ):
        assert sentence(lambda: ech.synthesize(euler, LINE, method)).startswith(told)


@pytest.fixture
def saved(tmp_path):
    model = ech.models.Quadrotor.crazyflie()
    gain = ech.synthesize(model, LINE, ech.gains.InnerLoop())
    ech.save_gain(gain, model, LINE, tmp_path / "gain.json")
    return model, gain, tmp_path / "gain.json"


def test_a_gain_comes_back_to_the_bit(saved):
    model, gain, file = saved
    again = ech.load_gain(file, model, LINE)
    for name in ("P", "R", "inner", "R_inverse"):
        assert getattr(again, name).tobytes() == getattr(gain, name).tobytes()
    assert again.coupling == gain.coupling and again.method == "inner-loop"
    assert again.certificate.abscissa == gain.certificate.abscissa


def test_a_promise_on_a_domain_comes_back_whole(tmp_path):
    # A domain with two sides, one unbounded state, and a hull of many corners.
    model, bounds = ech.models.PlanarQuadrotor(), {"roll": (-0.1, 0.2), "thrust": 1.0}
    gain = ech.synthesize(model, LINE, ech.gains.RobustLQR(bounds))
    ech.save_gain(gain, model, LINE, tmp_path / "gain.json")
    saved, again = gain.certificate, ech.load_gain(tmp_path / "gain.json", model, LINE).certificate
    for name in ("kind", "lambda_min", "lambda_max", "abscissa", "modes", "edge", "observable"):
        assert getattr(again, name) == getattr(saved, name)
    ours, theirs = again.region, saved.region
    for name in ("kind", "rate", "theorem", "radius", "strength"):
        assert getattr(ours, name) == getattr(theirs, name)
    for name in ("hull", "error"):
        assert getattr(ours, name).tobytes() == getattr(theirs, name).tobytes()
    for name in ("lower", "upper", "input_lower", "input_upper"):
        assert np.array_equal(getattr(ours.domain, name), getattr(theirs.domain, name))
    text = (tmp_path / "gain.json").read_text()
    assert "Infinity" not in text and ours.domain.in_words(model) == (
        "roll in [-0.1, 0.2], thrust in [-1, 1]"
    )


def test_a_gain_file_of_an_older_echelon_is_refused(saved):
    model, _, file = saved
    file.write_text(file.read_text().replace("echelon gain 2", "echelon gain 1"))
    assert sentence(lambda: ech.load_gain(file, model, LINE)) == (
        f"`{file}` is no gain file that this echelon reads: its `format` must be "
        "`echelon gain 2`, and is `echelon gain 1`; make it again with `echelon design`."
    )


def test_samples_stand_at_all_corners_and_need_the_bounds_that_matter():
    model = Sampled()
    with precision("float64"):
        found = jacobians(model, Domain.about(model, {"place": (-1.0, 0.5)}))
    assert found.kind is Kind.SAMPLES and not found.error.any()
    seen, slopes = found.matrices[:, 0, 0], 2.0 / np.sqrt(np.pi) * np.exp([-1.0, -0.25])
    for slope in slopes:
        assert np.abs(seen + slope).min() < 1e-14
    assert seen.max() <= -slopes.min() + 1e-14
    told = sentence(lambda: ech.synthesize(model, LINE, ech.gains.RobustLQR({"far": 1.0})))
    assert told.startswith("the domain leaves `place` unbounded")


def test_a_gain_for_another_model_or_graph_is_refused_with_the_reason(saved, tmp_path):
    model, _, file = saved

    def refused(model=model, graph=LINE, file=file):
        return sentence(lambda: ech.load_gain(file, model, graph))

    other = ech.models.Quadrotor(mass=0.03)
    assert "made for another `Quadrotor`: input_scale differs by 0.002" in refused(other)
    assert "made for `Quadrotor` with state_names" in refused(ech.models.PlanarQuadrotor())
    told = refused(graph=ech.Graph.path(5))
    assert "made for a graph of 4 agents with lambda_min = 0.198062" in told
    content = json.loads(file.read_text())
    content["P"][0][0] = float("nan")
    file.write_text(json.dumps(content))
    assert "`P` holds a number that is not finite" in refused()
    file.write_text("{}")
    assert "is no gain file" in refused()
    assert "cannot be read" in refused(file=tmp_path / "no.json")


def verdicts(scenario, *changes):
    found = ech.check(*ech.build(ech.load_scenario(scenario, list(changes))))
    return {line.name: line for line in found.lines}, found


@pytest.mark.slow
def test_the_papers_own_experiment_is_checked_line_by_line():
    lines, found = verdicts("paper-literal")
    assert not found.promised
    assert lines["detectability of (A, g'P)"].verdict is Verdict.FAILS
    assert lines["detectability of (A, g'P)"].number == 4
    assert lines["detectability of (A, g'P)"].number_text == "rank 4 of 12"
    assert lines["finite condition on P"].verdict is Verdict.VACUOUS
    assert lines["LMI as printed"].verdict is Verdict.FAILS
    assert lines["Assumption 5, P-monotone drift"].verdict is Verdict.FAILS
    assert "for no P > 0" in lines["Assumption 5, P-monotone drift"].text
    lines, found = verdicts("paper")
    assert found.promised and lines["disagreement decays"].verdict is Verdict.HOLDS
    low, high = (float(part) for part in lines["gain margin"].number_text.split(" to "))
    assert low <= 0.5 and 1.5 < high < 3.0
    assert all(isinstance(line.verdict, Verdict) for line in found.lines)


def test_an_inner_loop_makes_assumption_5_hold():
    lines, found = verdicts("paper", "follower.gain={method: inner-loop}")
    assert lines["Assumption 5, P-monotone drift"].verdict is Verdict.HOLDS
    assert lines["Lemma 4, drift along z"].verdict is Verdict.HOLDS and found.promised


@pytest.mark.slow
def test_a_broken_offset_and_a_missing_relay_are_named():
    lines, found = verdicts("paper", "formation.offsets.1=[1,0,0,0,0,0,0.2,0,0,0,0,0]")
    line = lines["offsets are symmetries"]
    assert line.verdict is Verdict.FAILS and not found.promised
    assert line.text.startswith("the offset of agent 1: it changes the drift")
    lines, found = verdicts("paper", "follower.feedforward=none")
    assert lines["leader's motion is matched"].verdict is Verdict.FAILS
    assert "the leader's input rests" in in_words(found.promise)


def test_a_weak_input_weakens_the_trim_thrust_too():
    # At the edge of the gain, on the line of 3: the published corner is -0.094 1/s.
    edge = 0.5 / LINE.spectrum().low
    lines, _ = verdicts("paper-line", f"follower.gain.coupling={edge!r}")
    assert lines["input scaling"].number == pytest.approx(-0.094, abs=6e-4)


def test_check_exits_by_what_is_promised_and_by_a_missing_solver(echelon, monkeypatch):
    code, out, err = echelon("check", "paper")
    assert (code, err) == (0, "") and "Guaranteed (linearization)" in out
    code, out, _ = echelon("check", "paper-literal", "--json")
    assert code == 1 and json.loads(out)["guarantee"]["verdict"] == "none"
    monkeypatch.setitem(sys.modules, "cvxpy", None)
    robust = "follower.gain={method: robust-lqr, domain: {position: 0.5, velocity: 0.5}}"
    code, _, err = echelon("run", "van-der-pol", "--set", robust)
    assert code == 4 and "pip install" in err and "certify" in err


class Fenced(ech.ControlAffine):
    """A mass that a soft fence pushes back beyond 7.5 m, on the side of its sign."""

    side: float = 1.0
    state_names = ("x", "v")
    input_names = ("u",)

    def drift(self, x):
        push = 2.0 * jnp.maximum(self.side * x[0] - 7.5, 0.0)
        return jnp.stack([x[1], -self.side * push])

    def input_map(self, x):
        return jnp.array([[0.0], [1.0]], x.dtype)


@pytest.mark.parametrize(
    ("side", "offsets", "wanted"),
    [
        # Agents reach 6 m, and their places without an offset so much less.
        (1.0, (0.0, -1.0), True),
        (1.0, (0.0, -2.0), False),
        (1.0, (0.0, 9.0), True),
        (1.0, (0.0, 9.0, -2.0), False),
        (-1.0, (0.0, 1.0), True),
        (-1.0, (0.0, 2.0), False),
        (-1.0, (0.0, -9.0), True),
        (-1.0, (0.0, -9.0, 2.0), False),
        (-1.0, (5.0, 6.0, 4.0), True),
        (-1.0, (5.0, 7.0), False),
    ],
)
def test_offsets_are_proved_as_far_as_places_lie_without_them(side, offsets, wanted):
    model = Fenced(side=side)
    domain = Domain.about(model, {"x": 6.0, "v": 2.0})
    some = np.stack([offsets, np.zeros(len(offsets))], axis=1)
    assert offsets_are_symmetries(model, domain, some) is wanted
    # What all share moves nobody against another, and a velocity moves the place.
    assert offsets_are_symmetries(model, domain, some + [0.0, 3.0]) is wanted
    some[1, 1] = 0.5
    assert not offsets_are_symmetries(model, domain, some)


@pytest.mark.parametrize("slope", [2.0**-70, -(2.0**-300)])
def test_an_input_map_is_constant_or_is_not_however_little_it_varies(slope):
    class Uneven(Fenced):
        def input_map(self, x):
            return jnp.stack([0.0, 1.0 + slope * x[1]])[:, None]

    # Floats cannot tell them apart, and what is proved of one is not proved of the other.
    for model, wanted in ((Uneven(), False), (Fenced(), True)):
        domain = Domain.about(model, {"x": 6.0, "v": 2.0})
        assert has_constant_input_map(model, domain) is wanted


def test_a_model_that_jumps_has_no_jacobians():
    class Kicked(Fenced):
        def drift(self, x):
            return jnp.stack([x[1], -1.0 * (x[0] > 1.0)])

    model = Kicked()
    told = sentence(lambda: jacobians(model, Domain.about(model, {"x": 6.0, "v": 2.0})))
    assert "may jump with `x` inside the domain" in told
    near = Domain.about(model, {"x": 0.5, "v": 2.0})
    assert jacobians(model, near).matrices.tolist() == [[[0.0, 1.0], [0.0, 0.0]]]


def squares(x, v):
    """A velocity whose Jacobian tells where it was taken: diag(x)."""
    return 0.5 * x**2


@pytest.mark.parametrize("slope", [-1.0, 1.0])
def test_a_state_that_the_slopes_do_not_feel_may_be_left_open(slope):
    model = ech.models.Linear([[slope]], [[1.0]])
    with precision("float64"):
        found = sample_jacobians(model, Domain.about(model, {}), lambda x, u: slope * x, None)
        assert (found == slope).all()
        with pytest.raises(ech.errors.GainError, match="leaves `x1` unbounded"):
            sample_jacobians(model, Domain.about(model, {}), squares, None)


@pytest.mark.parametrize("size", [2, 7, 9])
def test_samples_lie_in_the_domain_and_at_its_corners(size):
    model = ech.models.Linear(-np.eye(size), np.ones((size, 1)))
    domain = Domain.about(model, dict.fromkeys(model.state_names, (-1.0, 2.0)))
    with precision("float64"):
        found = sample_jacobians(model, domain, squares, None)
    places = np.einsum("kii->ki", found)
    corners = places[len(places) // 2 :]
    assert ((places >= -1.0) & (places <= 2.0)).all() and set(corners.ravel()) == {-1.0, 2.0}
    # Every one where they are few, and of many about as often one side as the other.
    if size <= 7:
        assert len({tuple(row) for row in corners}) == 2**size
    else:
        assert len({tuple(row) for row in corners}) > 100
        assert (np.abs((corners > 0.0).mean(axis=0) - 0.5) < 0.1).all()


class Sampled(ech.ControlAffine):
    """A spring without an enclosure, beside a state that may do something far off."""

    bend: object = staticmethod(jnp.zeros_like)
    state_names = ("place", "far")
    input_names = ("force",)

    def drift(self, x):
        return jnp.stack([-jax.scipy.special.erf(x[0]) + self.bend(x[1]), -x[1]])

    def input_map(self, x):
        return jnp.array([[1.0], [0.0]], x.dtype)


@pytest.mark.parametrize("side", [-1.0, 1.0])
@pytest.mark.parametrize("edge", [2.0, 20.0, 800.0])
def test_samples_look_far_along_a_state_without_bounds(side, edge):
    calm = Sampled()
    domain = Domain.about(calm, {"place": 0.5})
    assert jacobians(calm, domain).kind is Kind.SAMPLES
    model = Sampled(bend=lambda z: jnp.maximum(side * z - edge, 0.0))
    assert "leaves `far` unbounded" in sentence(lambda: jacobians(model, domain))


def test_a_jacobian_of_which_one_entry_is_no_number_is_refused():
    model = Sampled(bend=lambda z: jnp.sqrt(0.9 - z))
    domain = Domain.about(model, {"place": 0.5, "far": 1.0})
    told = sentence(lambda: jacobians(model, domain))
    assert "the Jacobian of `Sampled` is not finite inside the domain" in told


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    """A model, the text of a gain file of it, and the error of another text in its place."""
    model, file = ech.models.Pendulum(), tmp_path_factory.mktemp("gains") / "gain.json"
    gain = ech.synthesize(model, LINE, ech.gains.Monotone({"angle": 0.5}))
    ech.save_gain(gain, model, LINE, file)
    certificate = json.loads(file.read_text())["certificate"]

    def refused(**changes):
        whole = json.loads(file.read_text()) | {"certificate": certificate | changes}
        file.write_text(json.dumps(whole))
        return sentence(lambda: ech.load_gain(file, model, LINE))

    return certificate["region"], refused


@pytest.mark.parametrize("wrong", [{"x": 1}, "1", [1.0], True, -(10**400), float("nan")])
def test_a_gain_file_whose_numbers_are_none_is_refused(stored, wrong):
    region, refused = stored
    for name in ("lambda_min", "abscissa", "modes", "observable", "edge"):
        assert "is no gain file of echelon" in refused(**{name: wrong}), name
    for name in ("rate", "radius", "strength"):
        told = f"`{name}` is {{'x': 1}}, and must be a finite number."
        assert told in refused(region=region | {name: {"x": 1}})


@pytest.mark.parametrize("domain", [{}, {"angle": 0.5}])
def test_a_contraction_that_needs_no_feedback_has_the_coupling_one(domain):
    model = ech.models.Pendulum() if domain else ech.models.Linear([[-1.0]], [[1.0]])
    gain = ech.synthesize(model, ech.Graph.path(4), ech.gains.Contraction(domain, rate=0.05))
    assert (gain.coupling, gain.certificate.edge) == (1.0, 0.0)
    assert gain.certificate.region.rate >= 0.05
