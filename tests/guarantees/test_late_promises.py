"""Guarantees over networks (T9): what echelon says of its own runs, and what these do."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

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
RADIO = ech.Network(rate=50.0, delay=0.02, jitter=0.02, loss=0.3)
DT = 0.01


def parts_of(network=RADIO, edges=ARROWS, directed=True, model=CART, leaders=(0,), **options):
    """Carts behind a circle over a network; options of the follower, the leader and the world."""
    graph = ech.Graph(edges, directed=directed, leaders=leaders)
    offsets = {k: [0.8 * k, 0.0] for k in range(graph.agents)}
    leader = {"reference": CIRCLE} | options.pop("leader", {})
    world = ech.World(network=network, **options.pop("world", {}))
    start_error = options.pop("start_error", {})
    laws = ech.Laws(ech.laws.StoppingLeader(**leader), ech.laws.StoppingPoint(**options))
    formation = ech.Formation.from_offsets(model, graph, offsets)
    return ech.Parts(
        model, graph, formation, laws, {"position": 1.0}, start_error=start_error, world=world
    )


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


# ---- what runs do --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("network", "options"),
    [
        (RADIO, {}),
        (RADIO, {"edges": TREE, "directed": False}),
        (dataclasses.replace(RADIO, hears="leaderward"), {"edges": TREE, "directed": False}),
    ],
    ids=["one way", "both ways", "leaderward"],
)
@pytest.mark.slow
def test_a_flight_over_a_radio_keeps_what_is_guaranteed(network, options):
    parts, settings = parts_of(network, **options), SETTINGS._replace(horizon=16.0)
    guarantee = said(parts, settings)
    assert guarantee.promised and guarantee.theorem is Theorem.T9 and not guarantee.without
    numbers, arrival = over(guarantee), guarantee.tube.arrival
    result = ech.simulate(parts, settings)
    away = np.abs(stops(result, guarantee))
    # All have a packet in time, and from then on nobody's stopping point moves farther away.
    first = int(np.ceil(numbers["packet_by"] / DT))
    largest = np.maximum.accumulate(away[::-1].max(axis=1))[::-1]
    assert (away[first:].max(axis=1) <= away[: first + 1].max(axis=(0, 1)) * 1.02).all()
    errors = np.linalg.norm(result.errors, axis=-1) if result.errors.ndim == 3 else result.errors
    late = result.times >= arrival
    assert arrival < 15.0 and late.any() and errors[late].max() <= 0.01
    # Eventually at the rate, to what a held step leaves: 1e-5 m here.
    assert largest[-1].max() < 1e-3


@pytest.mark.slow
def test_whatever_is_lost_after_one_packet_errors_converge():
    network = ech.Network(rate=50.0, loss=0.97, forget=0.1)
    parts = parts_of(network, TREE, False)
    guarantee = said(parts, SETTINGS._replace(horizon=60.0))
    assert guarantee.promised and guarantee.rate > 0.0 and over(guarantee)["packet_by"] > 5.0
    result = ech.simulate(parts, SETTINGS._replace(horizon=60.0, store_every=10))
    assert np.abs(stops(result, guarantee)[-1]).max() < 1e-3


def drawn_network(draw):
    """A network of any kind, and a graph of carts in which the leader reaches all."""
    n = int(draw.integers(3, 7))
    directed = bool(draw.random() < 0.5)
    edges = {(int(draw.integers(0, k)), k): draw.uniform(0.5, 2.0) for k in range(1, n)}
    for i, j in draw.integers(1, n, (4, 2)).tolist():
        if i != j and (j, i) not in edges:
            edges[i, j] = draw.uniform(0.5, 2.0)
    rate = float(draw.choice([100.0, 50.0, 20.0]))
    delay, jitter = draw.choice([0.0, 0.02, 0.1]), draw.choice([0.0, 0.013, 0.06])
    network = ech.Network(
        rate=rate,
        delay=float(delay),
        jitter=float(jitter),
        loss=float(draw.choice([0.0, 0.3, 0.7])),
        bursts=ech.Bursts(float(draw.choice([0.0, 0.2])), 0.1),
        forget=float(2.0 / rate + delay + jitter + draw.choice([0.001, 0.5])),
        hears=str(draw.choice(["all", "all", "leaderward"])),
    )
    return network, [(i, j, w) for (i, j), w in edges.items()], directed


@pytest.mark.study
@pytest.mark.parametrize("seed", range(40))
def test_drawn_networks_keep_what_is_guaranteed(seed):
    draw = np.random.default_rng(seed)
    network, edges, directed = drawn_network(draw)
    coupling = float(draw.uniform(2.0, 10.0)) if seed % 2 else None
    parts = parts_of(network, edges, directed, coupling=coupling)
    settings = SETTINGS._replace(horizon=20.0, seed=seed)
    guarantee = said(parts, settings)
    result = ech.simulate(parts, settings)
    away = np.abs(stops(result, guarantee))
    late = guarantee.run.network
    if late is None:
        # Weights that are too small for `leaderward`, or hop counts that may be forgotten.
        assert (
            network.hears.name == "LEADERWARD" and guarantee.hypotheses[Hypothesis.MESSAGES].fails
        )
        return
    arrival = guarantee.tube.arrival
    first = int(np.ceil(late.ages.first_packet / DT))
    assert (away[first:].max() <= away[: first + 1].max() * 1.02).all()
    if arrival is not None and arrival < 20.0:
        errors = np.linalg.norm((result.errors)[result.times >= arrival][:, :, :2], axis=-1)
        assert errors.max() <= 0.0101
    # The slowest decay that is seen, from when it is small to 0.1 mm, is as fast as stated.
    worst = np.maximum.accumulate(away.max(axis=(1, 2))[::-1])[::-1]
    small, tiny = (int(np.argmax(worst < x)) for x in (0.03, 1e-3))
    if 0 < small < tiny:
        rate = np.log(worst[small] / worst[tiny]) / (DT * (tiny - small))
        slack = 1.0 if late.ways is None else 0.4
        assert rate >= slack * 0.9 * late.rate, (rate, late.rate)


# ---- what is covered -----------------------------------------------------------------------------


def test_the_network_is_no_longer_ignored_but_what_else_is_there_is():
    assert "ignores" not in said(parts_of()).sentence()
    wind = {"disturbance": ech.Disturbance(constant={"velocity": 0.1})}
    text = said(parts_of(world=wind)).sentence()
    assert (
        "ignores that wind or noise acts" in text and "late or lost" not in text.split("ignores")[1]
    )


@pytest.mark.parametrize(
    ("network", "options", "words"),
    [
        (dataclasses.replace(RADIO, messages="state"), {}, "messages contain states"),
        (dataclasses.replace(RADIO, prediction="packet"), {}, "followers lag behind it"),
        (dataclasses.replace(RADIO, loss=1.0), {}, "no message arrives"),
        (dataclasses.replace(RADIO, hears="leaderward"), {"coupling": 101.0, "edges":
         [(0, 1, 0.3), (1, 2, 0.3)]}, "weights count as 1"),
    ],
)  # fmt: skip
def test_what_no_formation_survives_has_no_guarantee(network, options, words):
    guarantee = said(parts_of(network, **options))
    assert not guarantee.promised and guarantee.anywhere() is None
    assert words in guarantee.sentence() and guarantee.hypotheses[Hypothesis.MESSAGES].fails


def test_in_a_run_too_short_for_a_first_packet_nobody_is_said_to_arrive():
    with np.errstate(all="raise"):
        guarantee = said(parts_of(), ech.Settings(horizon=0.1, dt=DT))
    assert guarantee.tube.arrival is None and guarantee.tube.network.ages.first_packet is None


def test_the_lag_behind_messages_of_states_is_that_of_a_run():
    network = ech.Network(rate=50.0, delay=0.02, loss=0.2, messages="state")
    parts = parts_of(network, [(0, 1), (1, 2)])
    line = said(parts).hypotheses[Hypothesis.MESSAGES]
    # 30 ms of 1.4 m/s on each of two links.
    assert line.number == pytest.approx(0.084, rel=0.02)
    result = ech.simulate(parts, SETTINGS)
    assert ech.metrics(result).worst_steady == pytest.approx(line.number, rel=0.15)


def test_a_leader_that_stays_needs_no_plan():
    network = dataclasses.replace(RADIO, prediction="packet")
    assert said(parts_of(network, leader={"reference": None})).theorem is Theorem.T9


def test_leaders_that_start_apart_are_not_covered():
    starts = np.zeros((4, 4))
    starts[0, 0] = 0.7
    guarantee = said(parts_of(leaders=(0, 1)).replace(initial=starts))
    assert "leaders start apart" in guarantee.sentence() and "late or lost" in guarantee.without


def test_graphs_that_switch_are_not_covered():
    graph = ech.Graph.switching([(0.0, [(0, 1), (1, 2)]), (1.0, [(0, 1), (0, 2)])], period=2.0)
    parts = parts_of()
    formation = ech.Formation.from_offsets(CART, graph, {1: [1.0, 0.0], 2: [2.0, 0.0]})
    guarantee = said(parts.replace(graph=graph, formation=formation))
    assert "switches" in guarantee.sentence() and "late or lost" in guarantee.without


def test_the_ideal_network_has_no_line_of_it():
    guarantee = said(parts_of(None))
    assert guarantee.theorem is Theorem.T5 and Hypothesis.MESSAGES not in guarantee.hypotheses
    assert "network" not in guarantee.as_mapping()["anywhere"]


class Reversed(ech.laws.StoppingPoint):
    """Its input has the wrong sign."""

    def update(self, model, view, memory):
        u, memory = super().update(model, view, memory)
        return -u, memory


class Elsewhere(ech.laws.StoppingLeader):
    """It is expected where it is not."""

    def expected(self, model, t, deviation, age, period):
        there = super().expected(model, t, deviation, age, period)
        return there._replace(signal=there.signal + 1.0)


class ReversedConsensus(ech.laws.Consensus):
    """Its input has the wrong sign."""

    def update(self, model, view, memory):
        u, memory = super().update(model, view, memory)
        return -u, memory


class Renamed(ech.laws.Consensus):
    """A law with another name."""


@pytest.mark.parametrize("network", [None, RADIO])
def test_what_is_proved_of_a_law_is_not_of_its_subclasses(network):
    parts = parts_of(network)
    leader, follower = parts.drive.leader, parts.drive.follower
    assert said(parts).promised
    for laws in (
        ech.Laws(leader, Reversed()),
        ech.Laws(Elsewhere(reference=CIRCLE), follower),
    ):
        assert "does not know this law" in said(parts.replace(drive=laws)).sentence()
    gain = ech.synthesize(CART, parts.graph, ech.gains.Riccati())
    rest = ech.laws.PathLQR(reference=CIRCLE)
    for law, promised in ((Renamed(gain), True), (ReversedConsensus(gain), False)):
        guarantee = said(parts.replace(drive=ech.Laws(rest, law), world=ech.World()))
        assert guarantee.promised == promised


# ---- 4: the tube ---------------------------------------------------------------------------------


@pytest.mark.slow
def test_no_network_leaves_the_tube():
    # The path is at 1.4 m/s, and agreement may ask .5 + .3: before a packet the path counts.
    network = dataclasses.replace(RADIO, delay=0.3, loss=0.7, bursts=ech.Bursts(0.5, 0.3))
    parts = parts_of(network, TREE, False, speed=0.5, leader={"reference": CIRCLE, "speed": 0.3})
    parts = parts.replace(start_error={"position": 0.6})
    guarantee, result = said(parts), ech.simulate(parts, SETTINGS)
    run, root = guarantee.run, guarantee.run.law.slowest_root
    zeta = result.states[:, 1:, :2] + result.states[:, 1:, 2:] / root
    moved = np.diff(zeta, axis=0) / DT
    path = np.asarray(jax.vmap(lambda t: run.leader.path(CART, t))(jnp.asarray(result.times[1:])))
    rate = path[:, 1] + path[:, 2] / root
    off = np.abs(moved - rate[:, None])
    most = np.array([run.speed(k) + run.own_speed(k) for k in range(2)])
    assert most.max() > 0.5 + 0.3 and (off <= most * 1.02).all()
    # It is nearly reached before the first packet, and later it is agreement's alone.
    assert (off.max(axis=(0, 1)) > 0.7 * most).any()


def test_a_border_is_not_passed_before_the_first_packet():
    unicycle = ech.models.Unicycle()
    graph = ech.Graph([(0, 1)], directed=True)
    laws = ech.Laws(ech.laws.StoppingLeader(reference=CIRCLE), ech.laws.StoppingPoint())
    formation = ech.Formation.from_offsets(unicycle, graph, {1: [1.0, 0.0, 0.0]})
    parts = ech.Parts(unicycle, graph, formation, laws)
    assert said(parts).promised
    radio = said(parts.replace(world=ech.World(network=RADIO)))
    # Without a packet a unicycle stops, where its heading is not known.
    assert not radio.promised and "before their first packet" in radio.sentence()


# ---- 5: own states -------------------------------------------------------------------------------


def delayed_radius(c, root, dt, delay):
    """The spectral radius of carts with late states, y'' = root (zeta' - y'), zeta' = -c zeta."""
    A, B = np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]])
    whole = scipy.linalg.expm(dt * np.block([[A, B], [np.zeros((1, 3))]]))
    K = root * np.array([[c, c / root + 1.0]])
    loop = np.zeros((2 + 2 * delay, 2 + 2 * delay), np.result_type(K))
    loop[:2, :2], loop[:2, -2:] = whole[:2, :2], loop[:2, -2:] - whole[:2, 2:] @ K
    loop[2:, :-2] += np.eye(2 * delay)
    return np.abs(np.linalg.eigvals(loop)).max()


def test_margins_of_own_states_are_those_of_the_delayed_loop():
    world = {"sensing": Sensing(delay=0.01)}
    guarantee = said(parts_of(world=world, observer=False, coupling=8.0))
    line = guarantee.hypotheses[Hypothesis.OWN_STATE]
    most, root = round(line.number / DT), guarantee.run.law.slowest_root
    assert line.verdict is Verdict.HOLDS
    # Followers 1 and 2 hear one other, follower 3 two.
    radii = [[delayed_radius(8.0 * d, root, DT, k) for d in (1, 2)] for k in (most, most + 1)]
    assert max(radii[0]) < 1.0 < max(radii[1])


def cycled(count, weight):
    """Arrows to many followers of different weights, three of which hear each other in a circle."""
    arrows = [(0, k, 0.5 + 3.5 * k / count) for k in range(1, count - 2)]
    circle = count - 2, count - 1, count
    arrows += [(0, k, 0.5) for k in circle]
    arrows += [(i, j, weight) for i, j in zip(circle, circle[1:] + circle[:1], strict=True)]
    return arrows


def test_margins_of_own_states_count_every_eigenvalue_of_a_directed_graph():
    world = {"sensing": Sensing(delay=0.01)}
    parts = parts_of(None, cycled(50, 2.0), world=world, observer=False, coupling=8.0)
    guarantee = said(parts)
    line, root = guarantee.hypotheses[Hypothesis.OWN_STATE], guarantee.run.law.slowest_root
    most, L = round(line.number / DT), parts.graph.grounded_laplacian().toarray()
    values = np.linalg.eigvals(L)
    assert np.iscomplexobj(values)
    radii = [max(delayed_radius(8.0 * d, root, DT, k) for d in values) for k in (most, most + 1)]
    assert radii[0] < 1.0 < radii[1]


def test_turns_along_the_circle_count_as_eigenvalues_do():
    world = {"sensing": Sensing(delay=0.01)}
    ready = prepare(parts_of(None, world=world, coupling=1.5), SETTINGS)
    with jax.enable_x64(True):
        step = late_step(ready.problem, ready.parts.drive.follower, 0.03)
    draw = np.random.default_rng(0)
    seen = set()
    for delay in (0, 2, 4):
        own = draw.uniform(0.01, 6.0, 12) + 1j * draw.uniform(0.0, 4.0, 12) * (
            draw.random(12) < 0.6
        )
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
    world = {"sensing": Sensing(delay=0.01), "plant": ech.models.DoubleIntegrator(2, drag=0.5)}
    line = said(parts_of(None, world=world)).hypotheses[Hypothesis.OWN_STATE]
    assert "for agents as in the model, unlike these plants" in line.text
    line = said(parts_of(None, world={"sensing": Sensing(delay=0.01)}))
    assert "unlike" not in line.hypotheses[Hypothesis.OWN_STATE].text


def test_within_the_margin_late_messages_of_any_age_are_borne_both_ways():
    world, c = {"sensing": Sensing(delay=0.01)}, 4.0
    guarantee = said(parts_of(RADIO, TREE, False, world=world, observer=False, coupling=c))
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
    world = {"sensing": Sensing(delay=0.01)}
    most = said(parts_of(world=world)).hypotheses[Hypothesis.OWN_STATE].number
    for more in (-1, 2):
        late = {"sensing": Sensing(delay=most + more * DT)}
        parts = parts_of(world=late, speed=np.inf)
        guarantee = said(parts)
        result = ech.simulate(parts, SETTINGS)
        swung = np.abs(stops(result, guarantee)[-200:]).max()
        assert (swung > 0.1) == (more > 0)
        assert ("the linearized loop does not decay" in guarantee.sentence()) == (more > 0)


# ---- verification --------------------------------------------------------------------------------


@pytest.mark.slow
def test_no_forged_number_of_a_network_is_verified(tmp_path):
    from typer.testing import CliRunner

    from echelon.apps.cli.app import app

    run = CliRunner().invoke
    found = run(app, ["check", "paper-radio", "--json"])
    stored = json.loads(found.output)
    file = tmp_path / "check.json"

    def verdict(document, *options):
        file.write_text(json.dumps(document))
        return run(app, ["verify", str(file), *options]).exit_code

    assert verdict(stored, "--scenario", "paper-radio") == 0
    # Without its scenario nothing of a network can be computed again.
    assert verdict(stored) == 5
    numbers = stored["promise"]["anywhere"]["network"]
    for key, value in numbers.items():
        forged = json.loads(json.dumps(stored))
        wrong = 1.001 * value if isinstance(value, float) else "T5"
        forged["promise"]["anywhere"]["network"][key] = wrong
        assert verdict(forged, "--scenario", "paper-radio") == 1, key


def test_float32_settings_change_nothing_of_it():
    assert over(said(parts_of(), SETTINGS._replace(precision="float32"))) == over(said(parts_of()))
