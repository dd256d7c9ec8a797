"""Limits of inputs inside certified sets: from inside no input passes its limit."""

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from in_words import in_words

import echelon as ech
from echelon.core.statement import NO_LIMIT, Hypothesis
from echelon.core.words import GuaranteeVerdict, Kind
from echelon.experiments.results.recording import recording_of
from echelon.guarantees.promises.coverage import covered, watched_by
from echelon.guarantees.promises.promise import promises

SETTINGS, GRAPH = ech.Settings(horizon=4.0, dt=0.01), ech.Graph.path(3)


class Cart(ech.models.DoubleIntegrator):
    """A double integrator whose inputs have limits."""

    most: float = 1.0

    @property
    def input_limits(self):
        m = len(self.input_names)
        return ech.models.Limits(np.eye(m), (-self.most,) * m, (self.most,) * m)


WIDE = {"position": 90.0, "velocity": 90.0}


def parts_of(model, graph, **more):
    gain = ech.synthesize(model, graph, ech.gains.RobustLQR(domain=WIDE))
    laws = ech.Laws(ech.laws.TrimInput(), ech.laws.Consensus(gain, feedforward="relay"))
    return ech.Parts(model, graph, ech.Formation.line(model, graph), laws, **more), gain


def on_the_border(parts, gain, radius, seed):
    """Starts (N, n) with sum of delta'P delta = radius^2, all in one direction or at random."""
    graph, rng = parts.graph, np.random.default_rng(seed)
    delta = rng.standard_normal(parts.formation.offsets.shape)
    delta[list(graph.leaders)] = 0.0
    size = np.sqrt(np.einsum("ia,ab,ib->", delta, gain.P, delta))
    return parts.formation.offsets + radius / size * delta


@pytest.mark.parametrize("directed", [False, True])
def test_no_input_passes_its_limit_from_the_border_of_the_set(directed):
    model, graph = Cart(dimension=2), ech.Graph.path(4, directed=directed)
    parts, gain = parts_of(model, graph)
    found = ech.guarantee(parts, SETTINGS)
    assert found.verdict is GuaranteeVerdict.GUARANTEED, in_words(found)
    radius = found.certified.radius
    assert not found.hypotheses[Hypothesis.LIMITS].fails and 0.0 < radius < np.inf
    # The worst start of one follower's input, by hand: delta = r Omega^-1 a / |a|.
    L = np.asarray(graph.laplacian().toarray())[1:, 1:]
    B = np.kron(np.array([[0.0], [1.0]]), np.eye(2))
    K = gain.coupling * gain.R_inverse @ B.T @ gain.P
    back = np.linalg.inv(np.kron(np.eye(3), gain.P))
    most = 0.0
    for j in range(3):
        for row in np.kron(L[j], K):
            worst = back @ row * radius / np.sqrt(row @ back @ row)
            most = max(most, abs(row @ worst))
            starts = parts.formation.offsets.copy()
            starts[1:] += worst.reshape(3, 4)
            result = ech.simulate(parts.replace(initial=starts), SETTINGS)
            assert result.saturated.max() == 0.0
    assert most <= 1.0 + 1e-9
    # On an undirected graph the border is where the first input reaches its limit.
    assert directed or most == pytest.approx(1.0, rel=1e-6)


def by_hand(parts, gain, starts, dt, steps):
    """States (steps + 1, N, 4) of clipped carts in the plane, each step in closed form."""
    L = np.asarray(parts.graph.laplacian().toarray())
    B = np.kron(np.array([[0.0], [1.0]]), np.eye(2))
    K = gain.coupling * gain.R_inverse @ B.T @ gain.P
    x, out = starts.copy(), [starts]
    for _ in range(steps):
        u = np.clip(-(L @ (x - parts.formation.offsets)) @ K.T, -1.0, 1.0)
        u[0] = 0.0
        x = np.hstack([x[:, :2] + dt * x[:, 2:] + 0.5 * dt**2 * u, x[:, 2:] + dt * u])
        out.append(x)
    return np.array(out)


def test_starts_from_which_a_run_enters_the_set_are_covered_although_limits_act():
    model, graph = Cart(dimension=2), ech.Graph.path(4)
    parts, gain = parts_of(model, graph)
    settings = ech.Settings(horizon=60.0, dt=0.05)
    radius = ech.guarantee(parts, settings).certified.radius
    starts = on_the_border(parts, gain, 40.0 * radius, seed=3)
    parts = parts.replace(initial=starts)
    found, result = ech.guarantee(parts, settings), ech.simulate(parts, settings)
    assert result.saturated.max() > 0.0
    states = by_hand(parts, gain, starts, 0.05, settings.steps)
    y = states - parts.formation.offsets
    delta = y - y[:, :1]
    sizes = np.sqrt(np.einsum("tia,ab,tib->t", delta, gain.P, delta))
    first = int(np.flatnonzero(sizes <= 0.99 * radius)[0])
    assert first > 0 and (sizes[first:] <= radius).all()
    assert found.enters == pytest.approx(0.05 * first)
    assert found.verdict is GuaranteeVerdict.GUARANTEED and found.covers_start
    assert found.hypotheses[Hypothesis.STARTS].kind is Kind.SAMPLES
    assert covered(result, found)
    assert any("run from these starts" in each for each in found.claim().premises)
    # No rate and no bound is told from the start on.
    seen = recording_of(result)
    assert seen.rate is None and seen.error_bound() is None
    assert "or faster, from there on" in in_words(found)
    # Of a run that ends before, nothing is known.
    short = settings._replace(horizon=0.5 * found.enters)
    soon = ech.guarantee(parts, short)
    assert soon.verdict is GuaranteeVerdict.CONDITIONAL and soon.covers_start is False
    assert not covered(ech.simulate(parts, short), soon)
    [told] = promises(parts, [settings], brief=True)
    assert told.verdict is GuaranteeVerdict.CONDITIONAL and covered(result, told)


def test_a_domain_bounds_no_state_on_which_no_slope_depends():
    """All slopes of a linear model are the same, so its leader may go where it likes."""
    model, graph = Cart(dimension=2), ech.Graph.path(3)
    parts, gain = parts_of(model, graph)
    found = ech.guarantee(parts, SETTINGS)
    assert found.domain == "all states"
    # A pendulum's slopes depend on its angle, and not on its rate.
    swinging = ech.models.Pendulum()
    domain = {"angle": 0.4, "rate": 0.01}
    gain = ech.synthesize(swinging, graph, ech.gains.RobustLQR(domain=domain))
    laws = ech.Laws(ech.laws.TrimInput(), ech.laws.Consensus(gain, feedforward="relay"))
    goals = ech.Formation(np.zeros((3, 2)))
    found = ech.guarantee(ech.Parts(swinging, graph, goals, laws), SETTINGS)
    assert found.domain == "angle in [-0.4, 0.4]"
    # The ellipse touches the border of the domain: r^2 = 0.4^2 / (P^-1)_11.
    whole = 0.4 / np.sqrt(np.linalg.inv(gain.P)[0, 0])
    limits = found.hypotheses[Hypothesis.LIMITS].number
    assert found.certified.radius == pytest.approx(min(whole, limits or np.inf))


class Clipped(ech.models.DoubleIntegrator):
    """A limit without `input_limits`."""

    def limit(self, u):
        return jnp.clip(u, -0.1, 0.1)


class Weak(ech.models.Pendulum):
    """A pendulum with a limit that no rows describe."""

    def limit(self, u):
        return jnp.clip(u, -0.02, 0.02)


def test_a_run_inside_a_set_that_says_nothing_of_limits_is_not_covered_where_one_acts():
    model, graph, goals = Weak(), ech.Graph.path(3), np.zeros((3, 2))
    gain = ech.synthesize(model, graph, ech.gains.RobustLQR(domain={"angle": 1.0}))
    laws = ech.Laws(ech.laws.TrimInput(), ech.laws.Consensus(gain, feedforward="relay"))
    starts = np.array([[0.0, 0.0], [0.3, 0.0], [0.3, 0.0]])
    parts = ech.Parts(model, graph, ech.Formation(goals), laws, initial=starts)
    found, result = ech.guarantee(parts, SETTINGS), ech.simulate(parts, SETTINGS)
    assert found.verdict is GuaranteeVerdict.CONDITIONAL and not found.certified.stays
    assert not found.hypotheses[Hypothesis.STARTS].fails
    assert result.saturated.max() > 0.5 and not covered(result, found)


@pytest.mark.parametrize("kind", [Clipped, Cart])
def test_a_run_that_a_limit_takes_from_its_goals_is_not_guaranteed(kind):
    model, graph = kind(dimension=1) if kind is Clipped else Cart(dimension=1, most=0.1), GRAPH
    parts, gain = parts_of(model, graph)
    far = parts.replace(initial=parts.formation.offsets + np.array([[0.0, 0], [20, 20], [20, 20]]))
    result = ech.simulate(far, SETTINGS._replace(horizon=30.0))
    assert result.saturated.max() == 1.0
    assert np.ptp(result.states[-1, :, 0]) > 10.0 * np.ptp(result.states[0, :, 0])
    found = ech.guarantee(far, SETTINGS)
    assert found.verdict is GuaranteeVerdict.CONDITIONAL and found.conditions == (NO_LIMIT,)
    # Near the goals nothing acts, where rows say what acts; of other seeds each start counts.
    near = ech.guarantee(parts, SETTINGS)
    assert near.promised is (kind is Cart)
    draws = parts.replace(initial={"x": 1e-2 if kind is Cart else 1.0})
    seeds = [SETTINGS._replace(seed=k) for k in range(4)]
    for settings, told in zip(seeds, promises(draws, seeds), strict=True):
        assert told.conditions == ech.guarantee(draws.replace(), settings).conditions


class Dragged(Cart):
    """A cart in a fluid, of which the inherited `flat` knows nothing."""

    def drift(self, x):
        return super().drift(x).at[2:].add(-5.0 * x[2:])


@pytest.mark.slow
def test_inputs_are_bounded_by_the_equations_and_not_by_a_flat_of_others():
    line = ech.references.Line(start=(0.0, 0.0, 0.0), velocity=(1.5, 0.0, 0.0))
    shared = {"roots": (2.0,), "observer": False}
    laws = ech.Laws(
        ech.laws.StoppingLeader(reference=line, speed=0.5, **shared),
        ech.laws.StoppingPoint(speed=1.0, **shared),
    )
    starts = np.array([[0, 0, 1.5, 0], [4, 0, 1.5, 0], [9, 0, 1.5, 0.0]])
    promised = []
    for kind in (Dragged, Cart):
        model = kind(dimension=2, most=8.0)
        goals = ech.Formation(np.zeros((3, 4)))
        parts = ech.Parts(model, GRAPH, goals, laws, initial=starts)
        found = ech.guarantee(parts, SETTINGS)
        promised.append(found.promised)
        result = ech.simulate(parts, SETTINGS)
        assert bool(result.saturated.max()) is (kind is Dragged)
    assert promised == [False, True]


@pytest.mark.slow
def test_a_leader_that_holds_its_inputs_asks_for_more_than_its_path():
    # 16 m/s^2 are the circle's; in steps of 0.1 s the leader asks for 17.7.
    circle = ech.references.Circle(center=(0.0, 0.0, 0.0), radius=1.0, rate=4.0)
    shared = {"roots": (4.0,), "observer": False}
    laws = ech.Laws(
        ech.laws.StoppingLeader(reference=circle, coupling=4.0, speed=2.5, **shared),
        ech.laws.StoppingPoint(coupling=1.0, speed=0.01, **shared),
    )
    starts, goals = np.array([[1.0, 0.0, 0.0, 4.0]] * 3), ech.Formation(np.zeros((3, 4)))
    settings, said = ech.Settings(horizon=6.0, dt=0.1), []
    for most in (16.2, 18.0):
        parts = ech.Parts(Cart(dimension=2, most=most), GRAPH, goals, laws, initial=starts)
        said.append(ech.guarantee(parts, settings).promised)
        assert bool(ech.simulate(parts, settings).saturated.max()) is not said[-1]
    assert said == [False, True]


def test_a_leader_at_its_limit_leaves_no_set_and_a_limit_of_ones_own_no_guarantee():
    class Own(Cart):
        def limit(self, u):
            return jnp.clip(u, -self.most, self.most)

    graph = ech.Graph.path(3)
    found = ech.guarantee(parts_of(Own(dimension=2), graph)[0], SETTINGS)
    assert found.verdict is GuaranteeVerdict.CONDITIONAL
    parts, gain = parts_of(Cart(dimension=2, most=0.3), graph)
    circle = ech.references.Circle(radius=1.0, rate=1.0)
    leader = ech.laws.Tracking(reference=circle)
    parts = parts.replace(drive=ech.Laws(leader, parts.drive.follower))
    found = ech.guarantee(parts, SETTINGS)
    assert found.verdict is GuaranteeVerdict.CONDITIONAL
    assert "limit" in found.hypotheses[Hypothesis.LIMITS].text


def test_held_inputs_may_raise_what_falls_in_continuous_time():
    parts, gain = parts_of(ech.models.DoubleIntegrator(dimension=1), ech.Graph.path(3))
    A, B = np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]])
    L = np.asarray(parts.graph.laplacian().toarray())[1:, 1:]
    root = np.linalg.cholesky(np.kron(np.eye(2), gain.P)).T

    def norm_and_radius(dt):
        block = np.zeros((3, 3))
        block[:2, :2], block[:2, 2:] = A, B
        flow = scipy.linalg.expm(block * dt)
        K = gain.coupling * gain.R_inverse @ B.T @ gain.P
        M = np.kron(np.eye(2), flow[:2, :2]) - np.kron(L, flow[:2, 2:] @ K)
        return np.linalg.norm(root @ M @ np.linalg.inv(root), 2), np.abs(np.linalg.eigvals(M)).max()

    low, high = 0.1, 0.3
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if norm_and_radius(middle)[0] < 1.0 else (low, middle)
    # Just beyond, errors still end, and the sum that is proved to fall rises at first.
    for dt, falls in ((0.9 * low, True), (low * (1.0 + 1e-4), False)):
        norm, radius = norm_and_radius(dt)
        assert radius < 1.0 and bool(norm <= 1.0) is falls
        found = ech.guarantee(parts, ech.Settings(horizon=10 * dt, dt=dt))
        assert found.claimed and (found.verdict is GuaranteeVerdict.GUARANTEED) is falls
        assert falls or found.conditions == ("inputs act at every instant",)


@pytest.mark.slow
def test_a_linear_chain_keeps_its_limits_in_the_tube():
    graph = ech.Graph.path(3)
    circle = ech.references.Circle(radius=0.5, rate=0.2)
    laws = ech.Laws(ech.laws.StoppingLeader(reference=circle), ech.laws.StoppingPoint())
    said = dict[float, bool]()
    for most in (0.05, 50.0):
        model = Cart(dimension=2, most=most)
        formation = ech.Formation.line(model, graph)
        parts = ech.Parts(model, graph, formation, laws, initial={"position": 1.0})
        found = ech.guarantee(parts, SETTINGS)
        said[most] = found.verdict is GuaranteeVerdict.GUARANTEED
        result = ech.simulate(parts, SETTINGS)
        assert not said[most] or result.saturated.max() == 0.0
        largest = float(np.abs(result.inputs).max())
        number = found.hypotheses[Hypothesis.LIMITS].number
        assert not said[most] or (number is not None and largest <= most - number + 1e-9)
    assert said == {0.05: False, 50.0: True}


def broken(parts, settings, result, agent):
    """Return the texts of the conditions that an agent breaks in some step, by its own rows."""
    values = {"x": result.states[:-1, agent], "u": result.inputs[:-1, agent]}
    bound = lambda each, end, none: none if each[end] is None else each[end]  # noqa: E731
    return {
        each["text"]
        for each in watched_by(parts, settings, agent)
        for value in values[each["of"]] @ each["row"]
        if not bound(each, "low", -np.inf) <= value <= bound(each, "high", np.inf)
    }


@pytest.mark.parametrize("size", [0.9, 40.0])
def test_an_agent_sees_the_limits_that_act_on_it(size):
    parts, gain = parts_of(Cart(dimension=2), ech.Graph.path(4))
    settings = ech.Settings(horizon=6.0, dt=0.05)
    radius = ech.guarantee(parts, settings).certified.radius
    parts = parts.replace(initial=on_the_border(parts, gain, size * radius, seed=3))
    result = ech.simulate(parts, settings)
    acted = [bool(share) for share in result.saturated]
    assert [bool(broken(parts, settings, result, k)) for k in range(4)] == acted
    assert any(acted) == (size > 1.0)
    free = settings._replace(limits=False)
    assert watched_by(parts, free, 1) == []


def test_an_agent_sees_that_it_leaves_the_domain_about_its_own_place():
    model, graph = ech.models.Pendulum(), ech.Graph.path(3)
    gain = ech.synthesize(model, graph, ech.gains.RobustLQR(domain={"angle": 0.4, "rate": 0.01}))
    laws = ech.Laws(ech.laws.TrimInput(), ech.laws.Consensus(gain, feedforward="relay"))
    starts = np.array([[0.0, 0.0], [0.39, 0.0], [0.41, 0.0]])
    parts = ech.Parts(model, graph, ech.Formation(np.zeros((3, 2))), laws, initial=starts)
    result = ech.simulate(parts, SETTINGS)
    seen = [broken(parts, SETTINGS, result, k) for k in range(3)]
    out = np.abs(result.states[:-1, :, 0]).max(axis=0) > 0.4
    assert [("`angle` is outside of the domain" in each) for each in seen] == out.tolist()
    assert out[2] and not out[0]


class Unlisted(ech.models.DoubleIntegrator):
    """Inputs that its `limit` cuts, of which it states no rows."""

    def limit(self, u):
        return jnp.clip(u, -1.0, 1.0)


def test_limits_that_a_model_does_not_state_cannot_be_watched():
    parts, _ = parts_of(Unlisted(dimension=1), GRAPH)
    assert watched_by(parts, SETTINGS, 1) is None
    assert watched_by(parts, SETTINGS._replace(limits=False), 1) is not None
