"""Formations over networks that are late and lose messages."""

import dataclasses

import numpy as np
import pytest

import echelon as ech

TREE, ONE_WAY = "graph.directed=false", "graph.directed=true"


def worst(result, window):
    """The largest distance (m) of a follower from its goal in the last part of a run."""
    y = (result.states - result.formation.offsets)[:, :, :3]
    error = np.linalg.norm(y[:, 1:] - y[:, :1], axis=2)
    return error[result.times >= result.times[-1] - window].max()


@pytest.mark.slow
def test_a_radio_leaves_the_formation_within_a_tenth_of_a_millimetre():
    parts, settings = ech.build(ech.load_scenario("paper-radio"))
    result = ech.simulate(parts, settings)
    assert result.outcome.reached and worst(result, 4.0) < 1e-4


LATE = ech.Network(delay=0.02, jitter=0.03, loss=0.2)
HELD = ["simulation.dt=0.01", "simulation.substeps=2", "simulation.store_every=5"]
MASSES = (
    "plant={agents: {0: {scale: {mass: 0.9}}, 1: {scale: {mass: 1.2}}, 2: {scale: {mass: 0.8}}}}"
)
SCALES = [f"{role}.observer={{push: 8, scale: 2}}" for role in ("leader", "follower")]
CASES = {
    "0 to 30 ms more and 20 % lost": (LATE, [ONE_WAY], 1e-4),
    "out a third of the time": (ech.Network(bursts=ech.Bursts(0.33, 0.5)), [ONE_WAY], 1e-4),
    "1 s at 10 Hz": (ech.Network(rate=10.0, delay=1.0, forget=1.5), [ONE_WAY], 2e-4),
    "95 % lost": (ech.Network(loss=0.95), [ONE_WAY], 2e-4),
    "leaderward by hops": (dataclasses.replace(LATE, hears="leaderward"), [TREE], 1e-4),
    "lag, held at 100 Hz": (None, [ONE_WAY, "actuator={lag: 0.03}", *HELD], 1e-5),
    "lag, messages late": (ech.Network(delay=0.3), [ONE_WAY, "actuator={lag: 0.03}"], 2e-3),
    "motors of 8 bits": (None, [ONE_WAY, "actuator={levels: 256}"], 5e-3),
    "unlike masses": (None, [ONE_WAY, MASSES, *SCALES], 1e-3),
}


@pytest.mark.study
@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("seed", range(4))
def test_formations_stand_bad_networks_and_plants_that_are_not_ideal(case, seed):
    network, overrides, bound = CASES[case]
    sets = ["simulation.horizon=15", f"seed={seed}", *overrides]
    parts, settings = ech.build(ech.load_scenario("paper-global", sets))
    parts = parts.replace(world=dataclasses.replace(parts.world, network=network))
    result = ech.simulate(parts, settings)
    assert result.outcome.reached and worst(result, 4.0) < bound


CART, ARROWS = ech.models.DoubleIntegrator(), ech.Graph([(0, 1), (1, 2), (1, 3)], directed=True)


def driven(laws, network):
    """The largest error (m) of carts in the last 2 of 12 s."""
    line = ech.Formation.from_offsets(CART, ARROWS, {1: [1.0, 0.0], 2: [2.0, 0.5]})
    world = ech.World(network=network)
    parts = ech.Parts(CART, ARROWS, line, laws, {"position": 0.5}, world=world)
    result = ech.simulate(parts, ech.Settings(horizon=12.0, dt=0.01, engine="jax"))
    return result.formation_errors[result.times >= 10.0].max()


AROUND = ech.references.Circle(radius=1.0, rate=0.5)


def test_carts_that_send_states_agree_over_a_radio():
    gain = ech.synthesize(CART, ARROWS, ech.gains.Riccati())
    assert driven(ech.Laws(ech.laws.Tracking(AROUND), ech.laws.Consensus(gain)), LATE) < 1e-3


@pytest.mark.slow
def test_messages_that_contain_raw_signals_lag_behind_the_leader():
    """The reason for deviations: what is late of a place is the way since then."""
    laws = ech.Laws(ech.laws.StoppingLeader(reference=AROUND), ech.laws.StoppingPoint())
    # At .5 m/s, 30 ms old on average on each of two links.
    assert driven(laws, ech.Network(delay=0.02, messages="state")) > 0.02


ROOT, COUPLING, LEAD, SPEED, LEAD_SPEED, DT = 2.0, 4.0, 3.0, 0.6, 0.9, 0.01


def saturated(x, speed):
    return x / np.sqrt(1.0 + (x / speed) ** 2)


def path(t):
    """Where the leader would come to rest on its circle, and how fast that moves."""
    c, s = np.cos(0.5 * t), np.sin(0.5 * t)
    place, rate, bend = np.array([c, s]), 0.5 * np.array([-s, c]), -0.25 * np.array([c, s])
    return place + rate / ROOT, rate + bend / ROOT


def decayed(away, age):
    """The leader's deviation an age later, by many small steps of Runge-Kutta."""
    h = age / 10

    def slope(x):
        return -saturated(LEAD * x, LEAD_SPEED)

    for _ in range(10):
        a = slope(away)
        b = slope(away + h / 2 * a)
        c = slope(away + h / 2 * b)
        away = away + h / 6 * (a + 2 * b + 2 * c + slope(away + h * c))
    return away


def own_flight(x, offsets, stamps, every, forget):
    """Positions (T, 3, 2) of carts in a row, by plain loops, from the stamps of their messages."""
    p, v = x[:, :2].copy(), x[:, 2:].copy()
    posted, packets, flown = {}, [None] * 3, [p.copy()]
    for k in range(len(stamps)):
        rest, rate = path(k * DT)
        stops = p + v / ROOT - offsets
        deviations, u = [np.zeros(2)] * 3, np.zeros((3, 2))
        packets[0] = k, stops[0] - rest
        u[0] = ROOT * (rate - saturated(LEAD * packets[0][1], LEAD_SPEED) - v[0])
        for i in (1, 2):
            desired, heard = np.zeros(2), stamps[k][i - 1]
            if heard >= 0 and (packets[i] is None or posted[heard][i - 1][1][0] > packets[i][0]):
                packets[i] = posted[heard][i - 1][1]
            if packets[i] is not None:
                away = decayed(packets[i][1], (k - packets[i][0]) * DT)
                deviations[i] = stops[i] - rest - away
                held = posted[heard][i - 1][0] if k - heard <= forget else 0.0
                z = deviations[i] - held
                desired = rate - saturated(LEAD * away, LEAD_SPEED)
                desired = desired - saturated(COUPLING * z, SPEED)
            u[i] = ROOT * (desired - v[i])
        if k % every == 0:
            posted[k] = list(zip(deviations, packets, strict=True))
        p, v = p + DT * v + DT**2 / 2 * u, v + DT * u
        flown.append(p.copy())
    return np.array(flown)


def test_a_lossy_flight_is_that_of_plain_loops():
    """Shares with the library only which messages arrive when."""
    cart, graph = ech.models.DoubleIntegrator(), ech.Graph.path(3, directed=True)
    line = ech.Formation.from_offsets(cart, graph, {1: [1.0, 0.0], 2: [2.0, 0.5]})
    circle = ech.references.Circle(radius=1.0, rate=0.5)
    shared = {"roots": (ROOT,), "observer": False}
    leader = ech.laws.StoppingLeader(reference=circle, coupling=LEAD, speed=LEAD_SPEED, **shared)
    follower = ech.laws.StoppingPoint(coupling=COUPLING, speed=SPEED, **shared)
    radio = ech.Network(rate=20.0, delay=0.03, jitter=0.06, loss=0.6, forget=0.4)
    parts = ech.Parts(
        *(cart, graph, line, ech.Laws(leader, follower), {"position": 1.0}),
        start_error={"x": 0.8, "y": -0.5},
        world=ech.World(network=radio),
    )
    result = ech.simulate(parts, ech.Settings(horizon=8.0, dt=DT, engine="jax", seed=2))
    ages = result.traffic.ages[:-1, :, 1]
    steps = np.arange(len(ages))[:, None]
    stamps = np.where(np.isnan(ages), -1, steps - np.rint(np.nan_to_num(ages) / DT)).astype(int)
    offsets = line.offsets[:, :2]
    flown = own_flight(result.states[0], offsets, stamps.tolist(), 5, 40)
    # Losses matter: somebody is forgotten, and the flight is not the ideal one.
    assert (ages > 0.4).any() and result.traffic.lost > 100
    np.testing.assert_allclose(flown, result.states[:, :, :2], atol=1e-7)
