"""The motor certificate of `stopping-point`: enclosures by a second computation, and attacks."""

import dataclasses
import json
from fractions import Fraction

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.linalg
from in_words import in_words

import echelon as ech
from echelon.core.digits import at_most
from echelon.core.numerics import precision
from echelon.core.statement import Hypothesis
from echelon.core.words import Kind, Verdict
from echelon.guarantees.promises.promise import guarantee, promises
from echelon.guarantees.stopping.chain_response import Chain, slices_of
from echelon.guarantees.stopping.motor_load import MotorDemand, motors_for
from echelon.guarantees.verifier.verify import verify
from echelon.simulation.engine.prepare import prepare

QUADROTOR = ech.models.Quadrotor()
MIXER = np.asarray(QUADROTOR.input_limits.matrix)


@pytest.mark.parametrize("roots", [(2.0, 2.5, 3.0), (4.0, 4.5, 5.0)])
def test_responses_stay_in_their_slices(roots):
    slices, size = slices_of(Chain.of(roots)), len(roots)
    A = np.eye(size, k=1)
    A[-1] = -np.poly(-np.array(roots))[:0:-1]
    b, times = np.eye(size)[-1] * -np.prod(roots), np.linspace(0.0, 6.0, 3001)
    flow, states = scipy.linalg.expm(A * times[1]), [np.column_stack([np.eye(size), b])]
    for _ in times[1:]:
        states.append(flow @ states[-1])
    # v .. v^(p), of starts 1 in v, v', v'', and of an impulse.
    every = np.stack(states)
    every = np.concatenate([every, (A[-1] @ every)[:, None]], axis=1)
    kernels = np.abs(every[:, :, -1])
    grown = scipy.integrate.cumulative_trapezoid(kernels, times, axis=0, initial=0.0)
    grown[:, -1] += np.prod(roots)
    for piece in slices:
        end = np.inf if piece.end is None else float(piece.end)
        inside = (times >= float(piece.begin)) & (times <= end)
        if inside.any():
            free = np.abs(every[inside][:, :, :-1]).max(axis=0)
            bounds = np.array(piece.whole.free, float)
            assert (free <= bounds + 1e-9).all() and (bounds <= 1.05 * free + 1.0).all()
            driven = np.array(piece.whole.driven, float)
            assert (grown[inside].max(axis=0) <= driven + 1e-4 * driven).all()
    assert float(slices[0].begin) == 0.0 and slices[-1].end is None


def flown(free, bounds):
    """The motors of a motion within bounds, by the model's own inverse, from any numbers (12,)."""
    a, j, s, low, high, jz, sz, turn, turning = bounds

    def ball(v):
        return v / jnp.maximum(1.0, jnp.linalg.norm(v))

    rows = jnp.zeros((5, 4)).at[2, :2].set(a * ball(free[:2])).at[3, :2].set(j * ball(free[2:4]))
    rows = rows.at[4, :2].set(s * ball(free[4:6]))
    rows = rows.at[2, 2].set(low + (high - low) * 0.5 * (1.0 + jnp.tanh(free[6])))
    rows = rows.at[3, 2].set(jz * jnp.tanh(free[7])).at[4, 2].set(sz * jnp.tanh(free[8]))
    rows = rows.at[0, 3].set(free[9]).at[1, 3].set(turn * jnp.tanh(free[10]))
    return MIXER @ QUADROTOR.flat(rows.at[2, 3].set(turning * jnp.tanh(free[11])))[1]


def climbed(bounds, starts):
    """The least and the largest motor that gradients find from starts (K, 12)."""

    def climb(free, sign):
        # The motor that is worst, downward or upward.
        ascent = jax.value_and_grad(lambda f: jnp.max(sign * flown(f, bounds)))

        def step(k, state):
            free, best = state
            value, slope = ascent(free)
            free = free + 0.3 * 0.98**k * slope / (jnp.linalg.norm(slope) + 1e-12)
            return free, jnp.maximum(best, value)

        return jax.lax.fori_loop(0, 150, step, (free, -jnp.inf))[1]

    found = jax.vmap(lambda f: jnp.stack([-climb(f, -1.0), climb(f, 1.0)]))(starts)
    return jnp.nanmin(found[:, 0]), jnp.nanmax(found[:, 1])


@pytest.mark.slow
def test_no_motion_within_bounds_asks_more_of_motors_and_the_worst_nearly_does():
    draw, near, most = np.random.default_rng(0), [], [7, 15, 120, 0, 5, 5, 30, 1, 2]
    with precision("float64"):
        search = jax.jit(climbed)
        for _ in range(8):
            bounds = draw.uniform([0, 0, 0, -3, 0, 0, 0, 0, 0], most)
            x = [Fraction(float(x)) for x in bounds]
            asked = MotorDemand(tuple(x[:3]), x[3], x[4], tuple(x[5:7]), tuple(x[7:]))
            found = motors_for(QUADROTOR.airframe, asked)
            starts = draw.normal(size=(60, 12)) * 2
            least, largest = map(float, search(jnp.asarray(bounds), starts))
            assert float(found.least) <= least and largest <= float(found.largest)
            near.append((largest - least) / float(found.largest - found.least))
    assert np.median(near) > 0.6


GENTLE = (
    "follower.roots=[2, 2.5, 3]",
    "leader.roots=[2, 2.5, 3]",
    "follower.speed=[1.4, 1.4, 0.7, 0.3]",
    "leader.speed=[0.7, 0.7, 0.7, 0.3]",
)


def gentle(*more):
    return ech.build(ech.load_scenario("paper-global", overrides=[*GENTLE, *more]))


@pytest.fixture(scope="module")
def hovering():
    """Parts and settings of a leader that hovers, whose path is one piece, and the promise."""
    parts, settings = gentle("reference={name: hover}", "leader.start_error={x: 5}")
    return parts, settings, guarantee(parts, settings)


def test_a_brief_promise_is_the_same_but_for_arrival(hovering):
    parts, settings, whole = hovering
    # Of other parts, since a promise is kept for those of which it was asked.
    [brief] = promises(parts.replace(), [settings], brief=True)
    assert whole.tube.motor_load is not None and whole.tube.arrival is not None
    assert brief.tube == whole.tube._replace(arrival=None)
    assert "motors 0" in in_words(brief) and "within 1 cm" not in in_words(brief)
    for name in ("promised", "reasons", "kind", "theorem", "rate", "hold", "certified"):
        assert getattr(brief, name) == getattr(whole, name), name
    assert dict(brief.hypotheses) == dict(whole.hypotheses)


def test_motors_that_suffice_are_promised_and_verified(hovering, tmp_path):
    _, _, found = hovering
    load, line = found.tube.motor_load, found.hypotheses[Hypothesis.LIMITS]
    assert line.verdict is Verdict.HOLDS and line.kind is Kind.PROOF
    assert found.promised and not found.conditions
    assert 0.0 < load.least < QUADROTOR.mass * QUADROTOR.gravity / 4.0 < load.largest < 0.15975
    assert f"motors {at_most(load.least)} N to" in in_words(found) and load.alone.rest
    told = found.as_mapping()
    file = tmp_path / "summary.json"

    def check():
        file.write_text(json.dumps({"guarantee": told}))
        return verify(file)

    # What is no part of a tube needs the scenario.
    assert check().verdict == "incomplete", check().sentence
    open_ = [x.claim for x in check().findings if x.open]
    assert open_ == [f"guarantee.{key}" for key in told]
    motors = told["anywhere"]["motors"]
    for place, key, factor in (
        (motors, "least", 1.02),
        (motors, "largest", 0.99),
        (motors["alone"], "tilt", 1.1),
        (motors["alone"], "upward", 1.1),
        (motors["speeds"], 0, 1.1),
        (motors["airframe"], "motor_thrust", 0.98),
        (motors, "most", 1.02),
    ):
        was, place[key] = place[key], place[key] * factor
        assert check().verdict == "refused", key
        place[key] = was


@pytest.mark.slow
def test_motors_that_may_not_suffice_leave_the_tube_to_the_run(hovering):
    parts, settings, _ = hovering
    law = eqx.tree_at(lambda law: law.speed, parts.drive.follower, (4.0, 4.0, 0.7, 0.3))
    found = guarantee(parts.replace(drive=parts.drive.with_follower(law)), settings)
    assert found.tube is not None and found.tube.motor_load is None
    assert found.claimed and not found.promised and "while no input" in in_words(found)
    line = found.hypotheses[Hypothesis.LIMITS]
    assert line.fails and "gentler `roots`" in line.remedy
    free = guarantee(parts, settings._replace(limits=False))
    assert free.hypotheses[Hypothesis.LIMITS].verdict is Verdict.NOT_NEEDED
    # Nor do other motors than the model's.
    weaker = dataclasses.replace(QUADROTOR, motor_thrust=0.08)
    for world in (ech.World(plants={1: weaker}), ech.World(actuator=ech.Actuator(minimum=0.06))):
        other = guarantee(parts.replace(world=world), settings)
        assert other.claimed and not other.promised and "while no input" in in_words(other)


@pytest.mark.slow
def test_starts_at_the_edge_of_the_certificate_are_flown_within_it():
    parts, settings = gentle("simulation.horizon=6")
    load = guarantee(parts, settings).tube.motor_load
    draw, found = np.random.default_rng(0), []
    start = prepare(parts, settings).problem.states
    for kind in ("tilt", "sideways", "upward", "rate", "rest"):
        x = start.copy()
        x[1:] = x[0]
        for agent in x[1:]:
            agent[:3] += draw.uniform(-8.0, 8.0, 3)
            way = draw.uniform(-np.pi, np.pi)
            along = np.array([np.cos(way), np.sin(way)])
            if kind == "tilt":
                # Yaw 0: pitch leans forward, roll to the right.
                lean = np.tan(load.alone.tilt) * along
                agent[6:] = 0.0
                agent[7] = np.arctan(lean[0])
                agent[6] = np.arctan(-lean[1] * np.cos(agent[7]))
            elif kind == "sideways":
                agent[3:5] += load.alone.sideways * along
            elif kind == "upward":
                agent[5] += load.alone.upward * draw.choice([-1.0, 1.0])
            else:
                agent[6:] = 0.0
                agent[8] = way
                agent[9:11] = load.alone.rate * along * (kind == "rate")
                agent[3:6] *= kind == "rate"
        # Off limits, so that what motors would have to give is seen.
        run = ech.simulate(parts.replace(initial=x), settings._replace(dt=0.001, limits=False))
        found.append(run.inputs @ MIXER.T)
    assert min(each.min() for each in found) > 0.0
    assert max(each.max() for each in found) < QUADROTOR.motor_thrust
