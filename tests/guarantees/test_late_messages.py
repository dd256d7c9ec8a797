"""Theorem T9: what is guaranteed over a network, against simulations of deviations in NumPy.

They share nothing with echelon but the graph: zeta~ of all followers by Euler's step, messages of
any age that were sent at some step and are held, or forgotten.
"""

import itertools
from fractions import Fraction

import numpy as np
import pytest
import scipy.optimize
import scipy.sparse as sp

from echelon.agents.network.channel import Bursts, Network
from echelon.guarantees.messages import late_messages as t9
from echelon.guarantees.stopping.tube import _falling

TREE = np.array([[3.0, -1.0, -1.0], [-1.0, 1.0, 0.0], [-1.0, 0.0, 1.0]])
"""Of the paper's tree: the leader is heard by the first follower."""


def sigma(x, s):
    return x / np.sqrt(1.0 + (x / s) ** 2)


def random_graph(draw, n, one_way=False):
    """Weights (n, n) of what followers hear of each other, and (n,) of leaders, all reached."""
    heard = draw.uniform(0.3, 3.0, (n, n)) * (draw.random((n, n)) < 0.4)
    parents = np.array([draw.integers(0, i) if i else 0 for i in range(n)])
    heard[np.arange(1, n), parents[1:]] = draw.uniform(0.3, 3.0, n - 1)
    heard = np.tril(heard, -1) if one_way else heard * (1.0 - np.eye(n))
    led = draw.uniform(0.3, 3.0, n) * (draw.random(n) < 0.3)
    led[0] = draw.uniform(0.3, 3.0)
    return heard, led


def laplacian(heard, led):
    return np.diag(heard.sum(axis=1) + led) - heard


def agreeing(draw, heard, led, c, s, dt, steps, oldest, how):
    """|zeta~| (steps + 1, n) where each link's age is at most `oldest` steps.

    `how` is `random`, `fixed`, `adversarial` (the worst value within reach) or `forgetful` (values
    are 0 at times).
    """
    n, d = len(led), heard.sum(axis=1) + led
    past = np.tile(draw.uniform(-3.0, 3.0, n), (steps + 1 + oldest, 1))
    for k in range(oldest, oldest + steps):
        if how == "adversarial":
            # Away from 0, as far as anybody was within reach.
            sign = np.where(past[k] == 0.0, 1.0, np.sign(past[k]))[:, None]
            values = (sign[None] * past[k - oldest : k + 1, None, :]).max(axis=0) * sign
        else:
            fixed = how == "fixed"
            ages = np.full((n, n), oldest) if fixed else draw.integers(0, oldest + 1, (n, n))
            values = past[k - ages, np.arange(n)[None]]
            if how == "forgetful":
                values = values * (draw.random((n, n)) < 0.7)
        z = d * past[k] - (heard * values).sum(axis=1)
        past[k + 1] = past[k] - dt * sigma(c * z, s)
    return np.abs(past[oldest:])


WAYS = ("random", "fixed", "adversarial", "forgetful")


def worst(ratio, count, seed, one_way=False):
    """The largest ratio of drawn cases to what is proved of them."""
    draw, ratios = np.random.default_rng(seed), []
    for _ in range(count):
        heard, led = random_graph(draw, int(draw.integers(2, 7)), one_way)
        d = (heard.sum(axis=1) + led).max()
        dt, s = 0.01, draw.uniform(0.3, 3.0)
        c = draw.uniform(0.1, 1.0) / (d * dt) * draw.choice([1.0, 0.1])
        oldest, how = int(draw.integers(0, 40)), WAYS[draw.integers(4)]
        ratios.append(ratio(draw, heard, led, c, s, dt, oldest, how))
    return max(ratios)


def growth(draw, heard, led, c, s, dt, oldest, how):
    flown = agreeing(draw, heard, led, c, s, dt, 300, oldest, how)
    return flown.max() / flown[0].max()


def test_no_stopping_point_passes_the_farthest_one():
    assert worst(growth, 60, 0) <= 1.0 + 1e-12


def test_longer_steps_than_the_condition_allows_let_it_grow():
    # One follower of weight .3 whose message counts as 1 where none is fresh: c dt is 3.3.
    c, dt = 0.99 / (0.3 * 0.01), 0.01
    held = np.array([1.0])
    for _ in range(20):
        held = held - dt * sigma(c * held, 1e9)
    assert abs(held[0]) > 1.0


def off_plan_ratio(seed):
    """How far agents end off a leader that leaves its plan by at most d, over the bound."""
    draw = np.random.default_rng(seed)
    n, dt, c0, d = int(draw.integers(1, 6)), 0.002, 0.5, 0.3
    heard, led = random_graph(draw, n)
    L, own = laplacian(heard, led), heard.sum(axis=1) + led
    c, s, oldest, most = draw.uniform(1.0, 20.0), draw.uniform(0.4, 3.0), 60, 150
    kept, steps = 1.0 - c0 * dt, 6000
    lead, zeta, stamps = np.zeros(steps + 1), draw.normal(size=n), np.zeros(n, int)
    past, worst = np.zeros((steps, n)), 0.0
    for k in range(steps):
        # Packets that are as old as allowed, or drawn; a push that lasts, or turns.
        fresh = draw.random(n) < 0.01 * (seed % 3 == 0)
        stamps = np.where((k - stamps >= most) | fresh, k, stamps)
        hat = lead[stamps] * kept ** (k - stamps)
        past[k] = zeta - hat
        ages = draw.integers(0, min(oldest, k) + 1, (n, n))
        z = own * past[k] - (heard * past[k - ages, np.arange(n)[None]]).sum(axis=1)
        if k > steps // 2:
            w = np.linalg.solve(L, np.ones(n))
            pull = d / np.sqrt(1.0 - (d / s) ** 2) / c
            bound = w * (pull + own.max() * d * (most + 1) * dt)
            worst = max(worst, (np.abs(zeta - lead[k]) / bound).max())
        zeta = zeta + dt * (-c0 * hat - sigma(c * z, s))
        push = d if seed % 2 else d * np.sign(np.sin(0.7 * k * dt))
        lead[k + 1] = kept * lead[k] + dt * push
    return worst


def test_a_leader_off_its_plan_costs_no_more_than_stated():
    worst = max(map(off_plan_ratio, range(4)))
    assert 0.2 < worst <= 1.0


def rate_ratio(draw, heard, led, c, s, dt, oldest, how):
    """The largest |zeta~_i| over its bound v_i m(t), of each proved rate."""
    L = sp.csr_array(laplacian(heard, led))
    flown = agreeing(draw, heard, led, c, s, dt, 400, oldest, how)
    times = dt * np.arange(len(flown))
    ratios = []
    for late in t9.late_rates(L, c, oldest * Fraction(dt)):
        start, heaviest = (flown[0] / late.weights).max(), late.weights.max()
        m = _falling(start, late.rate * heaviest, heaviest, s, times)
        ratios.append((flown / (late.weights * m[:, None])).max())
    assert ratios
    return max(ratios)


def test_deviations_shrink_at_the_rate_of_their_ages():
    assert 0.9 < worst(rate_ratio, 40, 1) <= 1.0 + 1e-9


def test_the_rates_of_the_papers_tree():
    # c D v = (rho + c e^(rho tau) A) v: the rate by a search of its own.
    c, own = 29.8564, np.diag(np.diag(TREE))

    def short(rho, age):
        late = own + np.exp(rho * age) * (TREE - own)
        return rho - c * np.linalg.eigvalsh(late)[0]

    for age, about in ((0, 8.0), (20, 4.6), (50, 2.75), (100, 1.65), (300, 0.63), (500, 0.39)):
        best = scipy.optimize.brentq(short, 0.0, c, args=(age / 1000.0,))
        [late, *_] = t9.late_rates(sp.csr_array(TREE), c, Fraction(age, 1000))
        # The search ends within 1e-5 of the best one, below it.
        assert (1.0 - 1e-5) * 0.999 * best <= late.rate <= 0.999 * best
        assert late.rate == pytest.approx(about, rel=0.02)


LED = np.eye(3)[0]
HEARD = np.diag(np.diag(TREE)) - TREE


def test_a_faster_rate_is_neither_proved_nor_true():
    # All messages as old as allowed, near rest: the root of the delayed loop is the best rate.
    c, dt, oldest, L = 10.0, 0.002, 50, sp.csr_array(TREE)
    age = oldest * Fraction(dt)
    [best, *_] = t9.late_rates(L, c, age)
    assert t9.is_proved(best, L, c, age)
    assert not t9.is_proved(t9.LateRate(1.01 * best.rate, best.weights), L, c, age)
    flown = agreeing(np.random.default_rng(0), HEARD, LED, c, 1e9, dt, 3000, oldest, "fixed")
    seen = -np.log(flown[-1] / flown[-501]) / (500 * dt)
    assert best.rate <= seen.min() and seen.max() <= 1.02 * best.rate / 0.999
    # Weights that break the inequality prove nothing.
    assert not t9.is_proved(best._replace(weights=np.ones(3)), L, c, age)
    assert not t9.is_proved(best._replace(weights=-best.weights), L, c, age)
    assert not t9.is_proved(best, L, c, 2 * age)


def arrival_ratio(draw, heard, led, c, s, dt, oldest, how, ways=None):
    L = laplacian(heard, led)
    ways = t9.longest_ways(sp.csr_array(L)) if ways is None else ways
    w = np.linalg.solve(L, np.ones(len(led)))
    flown = agreeing(draw, heard, led, c, s, dt, 400, oldest, how)
    times = np.maximum(dt * (np.arange(len(flown))[:, None] - (ways - 1) * oldest), 0.0)
    start = (flown[0] / w).max()
    bounds = [w[i] * _falling(start, c, w.max(), s, times[:, i]) for i in range(len(w))]
    return (flown / np.stack(bounds, axis=1)).max()


def test_one_way_messages_delay_the_arrival_by_their_age_on_each_link():
    assert 0.9 < worst(arrival_ratio, 60, 2, one_way=True) <= 1.0 + 1e-9


def test_longest_ways_are_those_of_the_graph():
    heard = np.array([[0, 0, 0, 0], [1, 0, 0, 0], [1, 1, 0, 0], [0, 0, 1, 0]], float)
    assert t9.longest_ways(sp.csr_array(laplacian(heard, np.ones(4)))).tolist() == [1, 2, 3, 4]
    assert t9.longest_ways(sp.csr_array(TREE)) is None


def test_where_followers_hear_each_other_the_arrival_is_later_than_that():
    draw, ways = np.random.default_rng(0), np.array([1, 2, 2])
    assert arrival_ratio(draw, HEARD, LED, 29.86, 1e9, 0.01, 30, "fixed", ways) > 1.5


def leaderward(draw, hops, weights, c, s, dt, steps, oldest, heard_by):
    """|zeta~| where the mean over those heard with fewer hops is taken; `heard_by` says of whom."""
    n = len(hops)
    past = np.tile(draw.uniform(-3.0, 3.0, n), (steps + 1 + oldest, 1))
    for k in range(oldest, oldest + steps):
        ages = draw.integers(0, oldest + 1, (n, n))
        values = past[k - ages, np.arange(n)[None]]
        used = heard_by(k) * weights
        total = used.sum(axis=1)
        mean = (used * values).sum(axis=1) / np.where(total > 0.0, total, 1.0)
        past[k + 1] = past[k] - dt * sigma(c * (past[k] - mean), s)
    return np.abs(past[oldest:])


def leaderward_ratio(flown, hops, c, s, dt, oldest):
    ways = hops[None] - 1
    times = np.maximum(dt * (np.arange(len(flown))[:, None] - ways * oldest), 0.0)
    start = (flown[0] / hops).max()
    bounds = [h * _falling(start, c, hops.max(), s, times[:, i]) for i, h in enumerate(hops)]
    return (flown / np.stack(bounds, axis=1)).max()


def test_leaderward_any_part_of_the_nearer_neighbours_may_be_heard():
    worst, dt = 0.0, 0.01
    for seed in range(30):
        draw = np.random.default_rng(seed)
        n, oldest = int(draw.integers(2, 7)), int(draw.integers(0, 30))
        hops = np.sort(draw.integers(1, 4, n)).astype(float)
        hops[0] = 1.0
        c, s = draw.uniform(1.0, 99.0), draw.uniform(0.3, 3.0)
        nearer, weights = hops[:, None] > hops[None], draw.uniform(0.3, 3.0, (n, n))

        def part(_, draw=draw, nearer=nearer):
            return nearer & (draw.random(nearer.shape) < 0.5)

        flown = leaderward(draw, hops, weights, c, s, dt, 300, oldest, part)
        worst = max(worst, leaderward_ratio(flown, hops, c, s, dt, oldest))
    assert 0.5 < worst <= 1.0 + 1e-9


def test_while_hops_change_the_bound_is_false():
    # Three hear each other, and the first the leader every .32 s, which it forgets after .185 s:
    # in between everybody may be the nearer one of another, and they wait for each other.
    draw, dt, c, oldest = np.random.default_rng(0), 0.005, 8.0, 37
    hops = np.array([1.0, 2.0, 2.0])

    def heard_by(k):
        ring = np.roll(np.eye(3), k // 5 % 2 + 1, axis=1)
        led = (k - oldest) % 64 < 37
        return np.array([[0, 0, 0], [1, 0, 0], [1, 0, 0]]) if led else ring

    flown = leaderward(draw, hops, np.ones((3, 3)), c, 1e9, dt, 600, oldest, heard_by)
    assert leaderward_ratio(flown, hops, c, 1e9, dt, oldest) > 1.5


def channel(**numbers):
    return Network(rate=50.0, **numbers).prepared(0.005, 60.0, 0)


def lost_by_links(net, draw, links):
    """Of how many links each message in turn is lost, as booleans (links,), again and again."""
    out = draw.random(links) < float(net.share)
    while True:
        yield out | (draw.random(links) < float(net.loss))
        out = draw.random(links) < np.where(out, 1.0 - float(net.ends), float(net.begins))


@pytest.mark.parametrize(
    "numbers",
    [{"loss": 0.2}, {"loss": 0.7}, {"loss": 0.1, "bursts": Bursts(0.3, 0.2)},
     {"bursts": Bursts(0.05, 0.1)}, {"bursts": Bursts(0.9, 0.05)}],
)  # fmt: skip
def test_losses_in_a_row_are_those_of_many_links(numbers, monkeypatch):
    # As rare as one message in 2,000, which can be counted.
    monkeypatch.setattr("echelon.guarantees.messages.late_messages.RARE", 1.0)
    net, whole, shares = channel(**numbers), True, []
    lost = t9.losses_in_a_row(net, 1, 2000)
    links = lost_by_links(net, np.random.default_rng(3), 200_000)
    for gone in itertools.islice(links, lost + 1):
        whole &= gone
        shares.append(whole.mean())
    # That so many and one more are lost in a row has a chance below 1/2000, that so many has not.
    assert shares[lost] <= 1.2 / 2000
    assert shares[lost - 1] >= 0.8 / 2000


def test_the_mean_age_is_that_of_many_links():
    net, lost = channel(loss=0.2, bursts=Bursts(0.3, 0.2)), np.zeros(50_000)
    for gone in itertools.islice(lost_by_links(net, np.random.default_rng(4), len(lost)), 200):
        lost = np.where(gone, lost + 1, 0)
    # A step of delay, half a period of four steps, and what was lost.
    seen = 0.005 * (1 + 1.5 + 4 * lost.mean())
    assert t9.ages_of(net, 0.005, 12000, 6, 2).mean == pytest.approx(seen, rel=0.02)
    # Without losses: 4 steps of delay, 2 of jitter, 4 between two messages.
    ages = t9.ages_of(channel(delay=0.02, jitter=0.012), 0.005, 12000, 6, 2)
    assert (ages.lost, ages.arrived, ages.oldest) == (0, 10, 10)
    assert ages.first_packet == pytest.approx(2 * 0.05)
    assert t9.ages_of(channel(loss=1.0), 0.005, 12000, 6, 2).first_packet is None


@pytest.mark.parametrize("share", [0.0, 0.1])
def test_outages_that_never_end_have_an_age(share):
    network = Network(rate=25.0, bursts=Bursts(share, 2.0**63), loss=0.1, forget=1.0)
    ages = t9.ages_of(network.prepared(0.02, 100.0, 0), 0.02, 5000, 6, 2)
    # The whole run, and the delay.
    assert np.isfinite(ages.mean) and ages.mean < 101.0
    assert (ages.mean < 0.1) == (share == 0.0)


@pytest.mark.parametrize("jitter", [0.0, 0.06])
def test_the_newest_message_is_never_older_than_stated(jitter):
    draw, net = np.random.default_rng(5), channel(delay=0.02, jitter=jitter, loss=0.5)
    every, steps = int(net.every), 40_000
    sent = np.arange(0, steps, every)
    gone = draw.random(len(sent)) < 0.5
    comes = sent + int(net.delay) + draw.integers(0, int(net.jitter) + 1, len(sent))
    newest = np.full(steps, -(10**9))
    for stamp, at in zip(sent[~gone], comes[~gone]):
        if at < steps:
            newest[at] = max(newest[at], stamp)
    newest = np.maximum.accumulate(newest)
    rows = np.diff(np.flatnonzero(np.concatenate([[True], ~gone, [True]]))).max() - 1
    ages = np.arange(steps) - newest
    stated = int(net.delay) + int(net.jitter) + every * (rows + 1)
    # An input is held for one more step. Messages that overtake a late one make it less.
    oldest = ages[stated:].max() + 1
    assert oldest <= stated and (jitter or oldest == stated)


@pytest.mark.study
def test_a_thousand_networks():
    assert worst(growth, 1000, 10) <= 1.0 + 1e-12
    assert worst(rate_ratio, 1000, 11) <= 1.0 + 1e-9
    assert worst(arrival_ratio, 1000, 12, one_way=True) <= 1.0 + 1e-9
