"""Agents of different models in one formation, under the law `stopping-point`."""

import math

import jax.numpy as jnp
import numpy as np
import pytest

import echelon as ech
from echelon.agents.models.unlike import UnlikeAgents
from echelon.core.errors import EchelonError
from echelon.simulation.engine.prepare import prepare

DT = 0.02
OFFSETS = {1: (1.0, 0.5), 2: (-1.0, 0.2), 3: (0.0, -1.0)}
ROOT = 4.0


def unlike(*groups, offsets=OFFSETS, leader=None, graph=None, **rest):
    model = UnlikeAgents.of(groups)
    graph = graph or ech.Graph.path(len(model.kinds))
    formation = ech.Formation.from_offsets(model, graph, offsets)
    laws = ech.Laws(leader or ech.laws.StoppingLeader(), ech.laws.StoppingPoint())
    return ech.Parts(model, graph, formation, laws, **rest)


def integrators(order=1, **parameters):
    kind = ech.models.SingleIntegrator if order == 1 else ech.models.DoubleIntegrator
    return kind(dimension=2, **parameters)


CARTS = ("walker", 1, integrators(1)), ("cart", 2, integrators(2)), ("dog", 1, integrators(1))


def run(parts, horizon=2.0, **settings):
    return ech.simulate(parts, ech.Settings(horizon=horizon, dt=DT, seed=1, **settings))


@pytest.mark.parametrize("order", [1, 2])
def test_one_model_given_as_two_groups_moves_as_one(order):
    model = integrators(order)
    two = unlike(("a", 2, model), ("b", 2, model), initial={"position": 1.0})
    starts = np.array(run(two, 0.1, engine="jax").states[0])[:, : len(model.state_names)]
    graph = ech.Graph.path(4)
    formation = ech.Formation.from_offsets(model, graph, OFFSETS)
    laws = ech.Laws(ech.laws.StoppingLeader(), ech.laws.StoppingPoint())
    one = run(ech.Parts(model, graph, formation, laws, initial=starts))
    both = run(two)
    np.testing.assert_allclose(both.states[..., : starts.shape[1]], one.states, atol=1e-12)
    np.testing.assert_array_equal(both.states[..., -1], [[0, 0, 1, 1]] * len(both.times))


def test_the_same_by_a_second_implementation():
    """Single and double integrators: zeta' = -sigma(c z), the single ones behind one filter."""
    circle = ech.references.Circle(center=(0.0, 0.0, 0.0), radius=2.0, rate=0.3)
    parts = unlike(
        *CARTS, leader=ech.laws.StoppingLeader(reference=circle), initial={"position": 1.0}
    )
    prepared = prepare(parts, ech.Settings(horizon=1.0, dt=DT)).parts.drive
    speeds = np.array(prepared.follower.speeds), np.array(prepared.leader.speeds)
    c, own = prepared.follower.strength(DT), prepared.leader.strength(DT)
    result = run(parts, 3.0)
    places = np.array([(0.0, 0.0), *OFFSETS.values()])
    slow = [False, True, True, False]

    def path(t, k):
        turn = 0.3 * t + k * np.pi / 2
        return 2.0 * 0.3**k * np.array([np.cos(turn), np.sin(turn)])

    p, v = result.states[0][:, :2].copy(), result.states[0][:, 2:4].copy()
    # The leader's filter begins at the rate of its path.
    w = np.zeros((4, 2))
    w[0] = path(0.0, 1)
    for step in range(len(result.times) - 1):
        t = step * DT
        np.testing.assert_allclose(result.states[step][:, :2], p, atol=1e-9)
        zeta = p + np.where(np.array(slow)[:, None], v, w) / ROOT - places
        at, ahead = (path(t, k) + path(t, k + 1) / ROOT for k in (0, 1))
        rate = np.empty((4, 2))
        rate[0] = ahead - bounded(own * (zeta[0] - at), speeds[1])
        for i in (1, 2, 3):
            near = [j for j in (i - 1, i + 1) if j < 4]
            z = sum(zeta[i] - zeta[j] for j in near)
            rate[i] = rate[0] - bounded(c * z, speeds[0])
        left = np.exp(-ROOT * DT)
        for i in range(4):
            if slow[i]:
                u = ROOT * (rate[i] - v[i])
                p[i] += DT * v[i] + 0.5 * DT**2 * u
                v[i] += DT * u
            else:
                u = rate[i] + (w[i] - rate[i]) * (1.0 - left) / (ROOT * DT)
                w[i] = rate[i] + (w[i] - rate[i]) * left
                p[i] += DT * u


def bounded(x, speed):
    return x / np.sqrt(1.0 + (x / speed) ** 2)


def test_native_code_and_jax_agree():
    parts = unlike(*CARTS, initial={"position": 1.0})
    native, jax = (run(parts, engine=name) for name in ("native", "jax"))
    np.testing.assert_allclose(native.states, jax.states, atol=1e-13)


def test_agents_in_processes_of_their_own_do_what_the_simulation_does():
    parts = unlike(*CARTS, initial={"position": 1.0})
    result = run(parts, 0.4, engine="jax")
    agents = [ech.Agent(parts, k, dt=DT) for k in range(4)]
    for step in range(10):
        x = result.states[step]
        # Signals are of the moment before a step, the leader's feed-forward of the step.
        hellos = [agent.hello(x[k]) for k, agent in enumerate(agents)]
        for agent in agents:
            for k, message in enumerate(hellos):
                if k != agent.number:
                    agent.receive(message)
        led = None
        for k, agent in enumerate(agents):
            if led is not None:
                agent.receive(led)
            u, message = agent.step(step * DT, x[k])
            np.testing.assert_allclose(u, result.inputs[step][k], atol=1e-9)
            led = led or message


def test_errors_decay_as_the_certificate_of_unlike_agents_says():
    groups = ("cart", 2, integrators(2)), ("walker", 2, integrators(1))
    offsets = {1: (1.0, 0.5), 2: (-1.0, 0.2), 3: (0.0, -1.0)}
    parts = unlike(*groups, offsets=offsets, initial={"position": 1e-3})
    settings = ech.Settings(horizon=6.0, dt=DT, seed=1)
    promise = ech.guarantee(parts, settings)
    assert str(promise.verdict) == "guaranteed"
    lines = promise.as_mapping()["conditions"]
    rate = -next(x["value"] for x in lines if x["name"] == "disagreement decays")
    result = ech.simulate(parts, settings)
    error = np.abs(result.states - result.states[:, :1] - parts.formation.offsets)[..., :2]
    first, last = error[150].max(), error[250].max()
    assert np.log(first / last) / 2.0 == pytest.approx(rate, rel=0.05)


class Ahead(ech.ControlAffine):
    """A single integrator that is seen 0.1 m ahead of where it is."""

    state_names = output_names = position = flat_outputs = ("x", "y")
    state_units, input_names, input_units = ("m", "m"), ("vx", "vy"), ("m/s", "m/s")
    state_groups = {"position": ("x", "y")}  # noqa: RUF012
    flat_order = 1

    def drift(self, x):
        return 0.0 * x

    def input_map(self, x):
        return jnp.eye(2, dtype=x.dtype)

    def output(self, x):
        return x + jnp.array([0.1, 0.0], x.dtype)


def verdict_of(parts, **settings):
    promise = ech.guarantee(parts, ech.Settings(horizon=1.0, dt=DT, **settings))
    return str(promise.verdict)


def test_a_leader_whose_output_is_elsewhere_is_seen_there():
    parts = unlike(("ahead", 1, Ahead()), ("cart", 1, integrators(2)), offsets={1: (1.0, 0.5)})
    assert verdict_of(parts) == "none"
    assert run(parts, 8.0).states[-1][1, 0] == pytest.approx(1.1)


def test_a_leader_that_diverges_by_its_own_law_is_not_guaranteed():
    leader = ech.laws.StoppingLeader(coupling=1000.0, speed=math.inf)
    groups = ("walker", 1, integrators(1)), ("cart", 1, integrators(2))
    rest = {"start_error": {"x": 0.005}, "offsets": {1: (1.0, 0.5)}}
    parts = unlike(*groups, leader=leader, **rest)
    assert verdict_of(parts) == "none"
    assert np.abs(run(parts, 2.0).states[-1]).max() > 1e3
    assert verdict_of(unlike(*groups, **rest)) == "guaranteed"


def test_several_leaders_of_a_group_that_no_follower_has():
    graph = ech.Graph.from_edges([(0, 1), (1, 2)], leaders=(0, 1))
    groups = ("walker", 2, integrators(1)), ("cart", 1, integrators(2))
    parts = unlike(*groups, offsets={1: (1.0, 0.5), 2: (-1.0, 0.2)}, graph=graph)
    assert verdict_of(parts) == "guaranteed"


def test_wind_moves_nothing_that_an_agent_does_not_have():
    parts = unlike(*CARTS, world=ech.World(disturbance=ech.Disturbance(constant={"vx": 1.0})))
    states = run(parts, 1.0).states
    assert (states[:, [0, 3], 2:4] == 0.0).all() and (states[..., -1] == [0, 1, 1, 2]).all()
    for change in ({"constant": {"kind": 1.0}}, {"rms": {"kind": 1.0}}):
        pushed = parts.replace(world=ech.World(disturbance=ech.Disturbance(**change)))
        with pytest.raises(EchelonError, match="of which group"):
            run(pushed, 0.1)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (["follower={law: consensus}", "leader={law: passive}"], "stopping-point"),
        (["graph.agents=5"], "the groups have 4 agents in all, and the graph 5"),
        (["plant={scale: {drag: 2}}"], "under `agents`"),
        (["initial.states={1: [0, 0]}"], "agent 1 has 2 numbers, and `cart` has 4"),
        (["agents.0.model=nothing"], "nothing"),
        (["agents.1.count=0"], "count"),
        (["safety={}"], "are alike"),
        (["agents.0.model={name: bicycle}"], "moves at its trim"),
        (["initial.spread={kind: 1}"], "of which group"),
        (["formation.motion=[{rotate: 0.1}]"], "of agents of one model"),
        (["follower.observer={push: 8, scale: 1}"], "no input of `SingleIntegrator`"),
        (
            [
                "agents.1.model={name: double-integrator, parameters: {dimension: 3}}",
                "formation.offsets={2: [0, 0, 1], 0: [0, 0, 1]}",
            ],
            "agent 0, a `walker`, has no `z`, and its goal there is",
        ),
    ],
)
def test_what_unlike_agents_cannot_be_is_one_sentence(change, said):
    data = {
        "name": "carts",
        "agents": [
            {"count": 1, "model": {"name": "single-integrator"}, "name": "walker"},
            {"count": 3, "model": "double-integrator", "name": "cart"},
        ],
        "graph": {"name": "path", "agents": 4},
        "leader": {"law": "stopping-point"},
        "follower": {"law": "stopping-point"},
        "simulation": {"horizon": 0.2, "dt": DT},
    }
    scenario = ech.scenario_from_mapping(data)
    assert ech.run(scenario).outcome.reached
    with pytest.raises(EchelonError, match=said):
        ech.build(scenario.with_(*change))


def test_groups_have_names_of_their_own():
    model = integrators(1)
    named = UnlikeAgents.of([("a", 1, model), ("a", 1, model)])
    assert named.names == ("a 1", "a 2")
    with pytest.raises(EchelonError, match="groups have the names"):
        UnlikeAgents.of([("a", 1, model), ("a", 1, model), ("a 2", 1, model)])


def test_a_file_has_one_model_or_groups():
    data = {
        "name": "both",
        "graph": {"name": "path", "agents": 2},
        "simulation": {"horizon": 0.2, "dt": DT},
    }
    with pytest.raises(EchelonError, match="got none of `model`, `agents`"):
        ech.scenario_from_mapping(data)
    groups = [{"count": 2, "model": "pendulum"}]
    with pytest.raises(EchelonError, match="got `model`, `agents`, allowed is one"):
        ech.scenario_from_mapping({**data, "model": {"name": "pendulum"}, "agents": groups})
