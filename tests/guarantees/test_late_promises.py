"""Guarantees over networks (T9): what echelon says of its own runs, and what these do."""

import dataclasses
import itertools
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from in_words import in_words

import echelon as ech
from echelon.agents.world.sensing import Sensing
from echelon.core.statement import Hypothesis
from echelon.core.words import Theorem, Verdict
from echelon.guarantees.messages.own_delay import all_decay, late_step
from echelon.guarantees.promises.promise import guarantee
from echelon.simulation.engine.prepare import prepare

CART = ech.models.DoubleIntegrator(2)
CIRCLE = ech.references.Circle(radius=2.0, rate=0.7)
TREE, ARROWS = [(0, 1), (1, 2), (1, 3)], [(0, 1), (1, 2), (1, 3), (2, 3)]
UNDIRECTED = {"edges": TREE, "directed": False}
RADIO = ech.Network(rate=50.0, delay=0.02, jitter=0.02, loss=0.3)
DT = 0.01


def parts_of(network=RADIO, edges=ARROWS, directed=True, leaders=(0,), **options):
    """Carts behind a circle over a network; options of the follower, the leader and the world."""
    graph = ech.Graph(edges, directed=directed, leaders=leaders)
    offsets = {k: [0.8 * k, 0.0] for k in range(graph.agents)}
    formation = ech.Formation.from_offsets(CART, graph, offsets)
    leader = {"reference": CIRCLE} | options.pop("leader", {})
    world = ech.World(network=network, **options.pop("world", {}))
    laws = ech.Laws(ech.laws.StoppingLeader(**leader), ech.laws.StoppingPoint(**options))
    return ech.Parts(CART, graph, formation, laws, {"position": 1.0}, world=world)


SETTINGS = ech.Settings(horizon=10.0, dt=DT)


def said(parts, settings=SETTINGS):
    return guarantee(parts, settings)


def over(guarantee):
    """What the JSON says of the network."""
    return guarantee.as_mapping()["anywhere"]["network"]


def stops(result, guarantee):
    """Zeta~ of the followers in echelon's own run, (T, F, m), from positions and speeds."""
    y = result.states - result.formation.offsets
    root = guarantee.run.law.slowest_root
    zeta = y[:, :, :2] + y[:, :, 2:] / root
    return zeta[:, 1:] - zeta[:, :1]


@pytest.mark.parametrize(
    ("hears", "options"),
    [("all", {}), ("all", UNDIRECTED), ("leaderward", UNDIRECTED)],
    ids=["one way", "both ways", "leaderward"],
)
@pytest.mark.slow
def test_a_flight_over_a_radio_keeps_what_is_guaranteed(hears, options):
    parts = parts_of(dataclasses.replace(RADIO, hears=hears), **options)
    settings = SETTINGS._replace(horizon=16.0)
    guarantee = said(parts, settings)
    assert guarantee.promised and guarantee.theorem is Theorem.T9 and not guarantee.ignores
    numbers, arrival = over(guarantee), guarantee.tube.arrival
    result = ech.simulate(parts, settings)
    away = np.abs(stops(result, guarantee))
    # All have a packet in time, and from then on nobody's stopping point moves farther away.
    first = int(np.ceil(numbers["packet_by"] / DT))
    assert (away[first:].max(axis=1) <= away[: first + 1].max(axis=(0, 1)) * 1.02).all()
    errors = np.linalg.norm(result.errors, axis=-1) if result.errors.ndim == 3 else result.errors
    late = result.times >= arrival
    assert arrival < 15.0 and late.any() and errors[late].max() <= 0.01
    # Eventually at the rate, to what a held step leaves: 1e-5 m here.
    assert away[-1].max() < 1e-3


@pytest.mark.slow
def test_whatever_is_lost_after_one_packet_errors_converge():
    parts = parts_of(ech.Network(rate=50.0, loss=0.97, forget=0.1), **UNDIRECTED)
    settings = SETTINGS._replace(horizon=60.0, store_every=10)
    guarantee = said(parts, settings)
    assert guarantee.promised and guarantee.rate > 0.0 and over(guarantee)["packet_by"] > 5.0
    assert np.abs(stops(ech.simulate(parts, settings), guarantee)[-1]).max() < 1e-3


@pytest.mark.study
@pytest.mark.parametrize("seed", range(40))
def test_drawn_networks_keep_what_is_guaranteed(seed):
    draw = np.random.default_rng(seed)
    n, rate = int(draw.integers(3, 7)), float(draw.choice([100.0, 50.0, 20.0]))
    edges = {(int(draw.integers(0, k)), k): draw.uniform(0.5, 2.0) for k in range(1, n)}
    for i, j in draw.integers(1, n, (4, 2)).tolist():
        if i != j and (j, i) not in edges:
            edges[i, j] = draw.uniform(0.5, 2.0)
    delay, jitter = float(draw.choice([0.0, 0.02, 0.1])), float(draw.choice([0.0, 0.013, 0.06]))
    loss, out = float(draw.choice([0.0, 0.3, 0.7])), float(draw.choice([0.0, 0.2]))
    forget = float(2.0 / rate + delay + jitter + draw.choice([0.001, 0.5]))
    network = ech.Network(rate, delay, jitter, loss, ech.Bursts(out, 0.1), forget=forget)
    coupling = float(draw.uniform(2.0, 10.0)) if seed % 2 else None
    links = [(*pair, weight) for pair, weight in edges.items()]
    parts = parts_of(network, links, bool(draw.random() < 0.5), coupling=coupling)
    settings = SETTINGS._replace(horizon=20.0, seed=seed)
    guarantee, result = said(parts, settings), ech.simulate(parts, settings)
    away, arrival = np.abs(stops(result, guarantee)), guarantee.tube.arrival
    first = int(np.ceil(guarantee.run.network.ages.first_packet / DT))
    assert (away[first:].max() <= away[: first + 1].max() * 1.02).all()
    if arrival is not None and arrival < 20.0:
        errors = np.linalg.norm((result.errors)[result.times >= arrival][:, :, :2], axis=-1)
        assert errors.max() <= 0.0101


@pytest.mark.slow
def test_the_network_is_no_longer_ignored_but_what_else_is_there_is():
    assert "ignores" not in in_words(said(parts_of()))
    wind = {"disturbance": ech.Disturbance(constant={"velocity": 0.1})}
    text = in_words(said(parts_of(world=wind)))
    assert "ignores wind or noise acts" in text and "late or lost" not in text.split("ignores")[1]


LINKS = [(0, 1, 0.3), (1, 2, 0.3)]


@pytest.mark.parametrize(
    ("change", "options", "words"),
    [
        ({"messages": "state"}, {}, "messages contain states"),
        ({"prediction": "packet"}, {}, "followers lag behind it"),
        ({"loss": 1.0}, {}, "no message arrives"),
        ({"hears": "leaderward"}, {"coupling": 101.0, "edges": LINKS}, "weights count as 1"),
    ],
)
def test_what_no_formation_survives_has_no_guarantee(change, options, words):
    guarantee = said(parts_of(dataclasses.replace(RADIO, **change), **options))
    assert not guarantee.promised and guarantee.anywhere() is None
    assert words in in_words(guarantee) and guarantee.hypotheses[Hypothesis.MESSAGES].fails


def test_in_a_run_too_short_for_a_first_packet_nobody_is_said_to_arrive():
    with np.errstate(all="raise"):
        guarantee = said(parts_of(), ech.Settings(horizon=0.1, dt=DT))
    assert guarantee.tube.arrival is None and guarantee.tube.network.ages.first_packet is None
    single, double = (SETTINGS._replace(precision=x) for x in ("float32", "float64"))
    assert over(said(parts_of(), single)) == over(said(parts_of(), double))


@pytest.mark.slow
def test_the_lag_behind_messages_of_states_is_that_of_a_run():
    network = ech.Network(rate=50.0, delay=0.02, loss=0.2, messages="state")
    parts = parts_of(network, [(0, 1), (1, 2)])
    line = said(parts).hypotheses[Hypothesis.MESSAGES]
    # 30 ms of 1.4 m/s on each of two links.
    assert line.number == pytest.approx(0.084, rel=0.02)
    result = ech.simulate(parts, SETTINGS)
    assert ech.metrics(result).worst_steady == pytest.approx(line.number, rel=0.15)


def test_leaders_that_start_apart_and_graphs_that_switch_are_not_covered():
    starts = np.zeros((4, 4))
    starts[0, 0] = 0.7
    apart = parts_of(leaders=(0, 1)).replace(initial=starts)
    rows = [(0.0, [(0, 1), (1, 2), (1, 3)]), (1.0, [(0, 1), (0, 2), (0, 3)])]
    switching = parts_of().replace(graph=ech.Graph.switching(rows, period=2.0))
    for parts, words in ((apart, "leaders start apart"), (switching, "switches")):
        guarantee = said(parts)
        assert words in in_words(guarantee) and "messages are late or lost" in guarantee.ignores


def test_the_ideal_network_has_no_line_of_it_and_a_leader_that_stays_needs_no_plan():
    guarantee = said(parts_of(None))
    assert guarantee.theorem is Theorem.T5 and Hypothesis.MESSAGES not in guarantee.hypotheses
    assert "network" not in guarantee.as_mapping()["anywhere"]
    network = dataclasses.replace(RADIO, prediction="packet")
    assert said(parts_of(network, leader={"reference": None})).theorem is Theorem.T9


@pytest.mark.slow
def test_no_network_leaves_the_tube():
    # The path is at 1.4 m/s, and agreement may ask .5 + .3: before a packet the path counts.
    network = dataclasses.replace(RADIO, delay=0.3, loss=0.7, bursts=ech.Bursts(0.5, 0.3))
    parts = parts_of(network, speed=0.5, leader={"speed": 0.3}, **UNDIRECTED)
    parts = parts.replace(start_error={"position": 0.6})
    guarantee, result = said(parts), ech.simulate(parts, SETTINGS)
    run, root = guarantee.run, guarantee.run.law.slowest_root
    zeta = result.states[:, 1:, :2] + result.states[:, 1:, 2:] / root
    moved = np.diff(zeta, axis=0) / DT
    path = np.asarray(jax.vmap(lambda t: run.leader.path(CART, t))(jnp.asarray(result.times[1:])))
    off = np.abs(moved - (path[:, 1] + path[:, 2] / root)[:, None])
    most = np.array([run.speed(k) + run.own_speed(k) for k in range(2)])
    assert most.max() > 0.5 + 0.3 and (off <= most * 1.02).all()
    # It is nearly reached before the first packet, and later it is agreement's alone.
    assert (off.max(axis=(0, 1)) > 0.7 * most).any()


@pytest.mark.slow
def test_a_border_is_not_passed_before_the_first_packet():
    unicycle = ech.models.Unicycle()
    graph = ech.Graph([(0, 1)], directed=True)
    laws = ech.Laws(ech.laws.StoppingLeader(reference=CIRCLE), ech.laws.StoppingPoint())
    formation = ech.Formation.from_offsets(unicycle, graph, {1: [1.0, 0.0, 0.0]})
    parts = ech.Parts(unicycle, graph, formation, laws)
    assert said(parts).promised
    radio = said(parts.replace(world=ech.World(network=RADIO)))
    # Without a packet a unicycle stops, where its heading is not known.
    assert not radio.promised and "before their first packet" in in_words(radio)


def delayed_radius(c, root, dt, delay):
    """The spectral radius of carts with late states, y'' = root (zeta' - y'), zeta' = -c zeta."""
    A, B = np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]])
    whole = scipy.linalg.expm(dt * np.block([[A, B], [np.zeros((1, 3))]]))
    K = root * np.array([[c, c / root + 1.0]])
    loop = np.zeros((2 + 2 * delay, 2 + 2 * delay), np.result_type(K))
    loop[:2, :2], loop[:2, -2:] = whole[:2, :2], loop[:2, -2:] - whole[:2, 2:] @ K
    loop[2:, :-2] += np.eye(2 * delay)
    return np.abs(np.linalg.eigvals(loop)).max()


MEASURED_LATE = {"sensing": Sensing(delay=0.01)}


def cycled(count, weight):
    """Arrows to many followers of different weights, three of which hear each other in a circle."""
    circle = count - 2, count - 1, count
    arrows = [(0, k, 0.5 + 3.5 * k / count) for k in range(1, count - 2)]
    arrows += [(0, k, 0.5) for k in circle]
    return [*arrows, *((i, j, weight) for i, j in itertools.pairwise((*circle, circle[0])))]


@pytest.mark.parametrize(
    ("network", "edges"), [(RADIO, ARROWS), (None, cycled(50, 2.0))], ids=["few", "a circle"]
)
def test_margins_of_own_states_are_those_of_the_delayed_loop(network, edges):
    parts = parts_of(network, edges, world=MEASURED_LATE, observer=False, coupling=8.0)
    guarantee = said(parts)
    line, root = guarantee.hypotheses[Hypothesis.OWN_STATE], guarantee.run.law.slowest_root
    assert line.verdict is Verdict.HOLDS or network is None
    most, L = round(line.number / DT), parts.graph.grounded_laplacian().toarray()
    values = np.linalg.eigvals(L)
    assert np.iscomplexobj(values) == (network is None)
    radii = [max(delayed_radius(8.0 * d, root, DT, k) for d in values) for k in (most, most + 1)]
    assert radii[0] < 1.0 < radii[1]


@pytest.mark.slow
def test_turns_along_the_circle_count_as_eigenvalues_do():
    ready = prepare(parts_of(None, world=MEASURED_LATE, coupling=1.5), SETTINGS)
    with jax.enable_x64(True):
        step = late_step(ready.problem, ready.parts.drive.follower, 0.03)
    draw, seen = np.random.default_rng(0), set()
    for delay in (0, 2, 4):
        turning = draw.uniform(0.0, 4.0, 12) * (draw.random(12) < 0.6)
        own = draw.uniform(0.01, 6.0, 12) + 1j * turning
        stable = [step.radius(each, delay) < 1.0 for each in own]
        assert [all_decay(step, each[None], False, delay) for each in own] == stable
        few = np.sort_complex(own[stable])
        assert len(few) > 1 and all_decay(step, few, False, delay)
        seen |= set(stable)
        # An interval decays as far as all that is in it.
        ends = np.geomspace(0.05, 8.0, 128)
        radii = np.array([step.radius(each, delay) for each in ends])
        last = int((radii < 1.0).argmin()) if (radii >= 1.0).any() else len(ends)
        assert all_decay(step, ends[: last - 8], True, delay)
        assert last == len(ends) or not all_decay(step, ends[: last + 1], True, delay)
    assert seen == {True, False}


def test_margins_of_own_states_of_a_plant_are_said_to_be_those_of_the_model():
    unlike = "for agents as in the model, unlike these plants"
    for plant in ({}, {"plant": ech.models.DoubleIntegrator(2, drag=0.5)}):
        found = said(parts_of(None, world=MEASURED_LATE | plant))
        assert (unlike in found.hypotheses[Hypothesis.OWN_STATE].text) == bool(plant)


def test_within_the_margin_late_messages_of_any_age_are_borne_both_ways():
    c = 4.0
    guarantee = said(parts_of(world=MEASURED_LATE, observer=False, coupling=c, **UNDIRECTED))
    line, root = guarantee.hypotheses[Hypothesis.OWN_STATE], guarantee.run.law.slowest_root
    delay, draw = round(line.number / DT), np.random.default_rng(0)
    assert line.verdict is Verdict.HOLDS and delay >= 2
    heard = np.array([[0.0, 1.0, 1.0], [1.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    d, steps, oldest = np.array([3.0, 1.0, 1.0]), 4000, 40
    begin = oldest + delay
    y, v, zeta = (np.zeros((begin + steps + 1, 3)) for _ in range(3))
    y[: begin + 1] = zeta[:begin] = draw.normal(size=3)
    for k in range(begin, begin + steps):
        late = k - delay
        zeta[k] = y[late] + v[late] / root
        ages = draw.integers(0, oldest + 1, (3, 3))
        z = d * zeta[k] - (heard * zeta[k - ages, np.arange(3)[None]]).sum(axis=1)
        push = root * (-c * z - v[late])
        y[k + 1] = y[k] + DT * v[k] + 0.5 * DT**2 * push
        v[k + 1] = v[k] + DT * push
    assert np.abs(y[-1]).max() < 1e-3 * np.abs(y[0]).max()


@pytest.mark.slow
def test_beyond_the_margin_a_run_swings_and_is_warned_of():
    most = said(parts_of(world=MEASURED_LATE)).hypotheses[Hypothesis.OWN_STATE].number
    for more in (-1, 2):
        parts = parts_of(world={"sensing": Sensing(delay=most + more * DT)}, speed=np.inf)
        guarantee, result = said(parts), ech.simulate(parts, SETTINGS)
        swung = np.abs(stops(result, guarantee)[-200:]).max()
        assert (swung > 0.1) == (more > 0)
        assert ("the linearized loop does not decay" in in_words(guarantee)) == (more > 0)


@pytest.mark.slow
def test_no_forged_number_of_a_network_is_verified(echelon, tmp_path):
    stored, file = json.loads(echelon("check", "paper-radio", "--json")[1]), tmp_path / "check.json"

    def verdict(*options):
        file.write_text(json.dumps(stored))
        return echelon("verify", file, *options)[0]

    assert verdict("--scenario", "paper-radio") == 0
    # Without its scenario nothing of a network can be computed again.
    assert verdict() == 5
    numbers = stored["guarantee"]["anywhere"]["network"]
    for key, value in numbers.items():
        numbers[key] = 1.001 * value if isinstance(value, float) else "T5"
        assert verdict("--scenario", "paper-radio") == 1, key
        numbers[key] = value
