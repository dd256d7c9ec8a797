"""Gains in axes that turn with the leader's heading: the law is the same at any heading."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from in_words import in_words

import echelon as ech
from echelon.agents.models.heading_symmetry import (
    heading_gap,
    input_turn,
    rotate_state,
    state_turn,
)
from echelon.agents.models.model import Heading
from echelon.core.errors import LawError, ModelError
from echelon.experiments.results.lyapunov import lyapunov
from echelon.guarantees.promises.modes import steady_turn
from echelon.laws.law import LocalView

QUADROTOR, PAIR = ech.models.Quadrotor.crazyflie(), ech.Graph.path(2)


class Hovercraft(ech.ControlAffine):
    """Pushed along its own axes, with more drag sideways, so that no gain of it ignores turns."""

    drag: tuple[float, float] = (0.1, 2.0)

    state_names = ("x", "y", "vx", "vy", "yaw", "r")
    input_names = ("ahead", "left", "torque")
    position = ("x", "y")
    flat_outputs = ("x", "y", "yaw")
    flat_order = 2
    heading = Heading("yaw", (("x", "y"), ("vx", "vy")))

    def axes(self, yaw):
        c, s = jnp.cos(yaw), jnp.sin(yaw)
        return jnp.stack([jnp.stack([c, -s]), jnp.stack([s, c])])

    def dragged(self, yaw, v):
        R = self.axes(yaw)
        return -R @ (jnp.asarray(self.drag, v.dtype) * (R.T @ v))

    def drift(self, x):
        rest = jnp.zeros(1, x.dtype)
        return jnp.concatenate([x[2:4], self.dragged(x[4], x[2:4]), x[5:6], rest])

    def input_map(self, x):
        push = jnp.pad(self.axes(x[4]), ((0, 0), (0, 1)))
        turn = jnp.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]], x.dtype)
        return jnp.concatenate([jnp.zeros((2, 3), x.dtype), push, turn])

    def flat(self, d):
        force = self.axes(d[0, 2]).T @ (d[2, :2] - self.dragged(d[0, 2], d[1, :2]))
        x = jnp.concatenate([d[0, :2], d[1, :2], d[0, 2:], d[1, 2:]])
        return x, jnp.append(force, d[2, 2])

    def difference(self, x, y):
        apart = x - y
        return apart.at[4].add(-2.0 * jnp.pi * jnp.round(apart[4] / (2.0 * jnp.pi)))


class Tug(Hovercraft):
    """The same pushed along the world's axes, so that its inputs turn."""

    input_names = ("east", "north", "torque")
    heading = Heading("yaw", (("x", "y"), ("vx", "vy")), (("east", "north"),))

    def input_map(self, x):
        push = jnp.eye(4, 3, -2, x.dtype).at[2:, 2].set(0.0)
        return jnp.concatenate([push, jnp.eye(2, 3, 1, x.dtype).at[0].set(0.0)])


def flown(reference, initial, horizon, engine="jax"):
    model = Hovercraft()
    graph = ech.Graph.path(3)
    formation = ech.Formation.from_offsets(model, graph, {1: (-1.0, 0.3), 2: (-2.0, -0.4)})
    gain = ech.synthesize(model, graph, ech.gains.Riccati())
    drive = ech.Laws(ech.laws.Tracking(reference), ech.laws.Consensus(gain))
    parts = ech.Parts(model, graph, formation, drive, initial=initial)
    return ech.simulate(parts, ech.Settings(horizon=horizon, dt=0.02, engine=engine))


TURNING = ech.references.Circle(radius=2.0, rate=0.4, yaw=0.5, yaw_rate=1.0)


@pytest.fixture(scope="module")
def run():
    """A run behind a leader that turns, from a metre off."""
    return flown(TURNING, {"x": 0.5, "y": 0.5, "yaw": 0.2}, horizon=30.0)


VEHICLES = "QuadrotorEuler", "QuadrotorThrust", "CrazyflieAttitude", "Unicycle", "UnicyclePoint"
BUNDLED = [QUADROTOR, *(getattr(ech.models, name)() for name in VEHICLES)]


@pytest.mark.parametrize("model", [*BUNDLED, Hovercraft(), Tug()], ids=lambda m: type(m).__name__)
def test_models_turn_as_they_say(model):
    assert heading_gap(model) < 1e-12


def test_a_heading_that_is_none_is_refused():
    class Anchored(Hovercraft):
        heading = Heading("yaw", (("x", "y"),))

    class Misnamed(Hovercraft):
        heading = Heading("yaw", (("x", "z"),))

    for model, why in ((Anchored(), "the motion turns with `yaw`"), (Misnamed(), "names `z`")):
        with pytest.raises(ModelError, match=why):
            ech.synthesize(model, PAIR, ech.gains.Riccati())
    gain = ech.synthesize(Hovercraft(), PAIR, ech.gains.Riccati())
    with pytest.raises(LawError, match="`frame` is `north`, allowed are `world`, `heading`"):
        ech.laws.Consensus(gain, frame="north")


def law_of(name, model):
    """A law whose gain is that of Riccati, of an inner loop, or weighs inputs differently."""
    if name == "inner":
        return ech.laws.Consensus(ech.synthesize(model, PAIR, ech.gains.InnerLoop()))
    R = np.diag([1.0, 5.0, 2.0]) if isinstance(model, Tug) else None
    gain = ech.synthesize(model, PAIR, ech.gains.Riccati(R=R))
    return ech.laws.Consensus(gain, feedforward="relay-velocity" if name == "velocity" else "relay")


@pytest.mark.parametrize(
    ("name", "model"),
    [("riccati", QUADROTOR), ("inner", QUADROTOR), ("velocity", Tug()), ("inputs", Tug())],
)
def test_a_law_does_at_any_heading_what_it_does_at_the_trim(name, model):
    law, draw, n = law_of(name, model), np.random.default_rng(1), len(model.state_names)
    D, E = state_turn(model), input_turn(model)
    with jax.enable_x64(True):
        x, z = (jnp.asarray(draw.uniform(-0.4, 0.4, n)) for _ in range(2))
        sent = jnp.asarray(draw.uniform(-1.0, 1.0, len(model.input_names)))
        if name == "velocity":
            sent = law.broadcast(model, x, sent)
        view = LocalView(jnp.zeros(()), x, jnp.zeros(n), z, sent)
        for angle in map(jnp.asarray, (0.0, 1.0, -2.5, 7.0)):
            told = D(sent, angle) if name == "velocity" else E(sent, angle)
            there = rotate_state(model, x, angle)
            there = LocalView(jnp.zeros(()), there, jnp.zeros(n), D(z, angle), told)
            wanted = model.normalized(law.update(model, view, None)[0])
            found = model.normalized(law.facing(angle).update(model, there, None)[0])
            assert np.abs(E(wanted, angle) - found).max() < 1e-10 * np.abs(found).max()
        at_rest = law.facing(jnp.zeros(())).update(model, view, None)[0]
        assert np.array_equal(at_rest, law.update(model, view, None)[0])


def test_a_formation_is_held_behind_a_leader_that_turns(run):
    assert np.abs(run.errors[0]).max() > 0.3
    assert np.abs(run.errors[-1]).max() < 1e-8


def test_both_engines_turn_alike_and_a_whole_turn_is_no_error(run):
    starts = {k: run.states[0, k] + 2.0 * np.pi * k * np.eye(6)[4] for k in (1, 2)}
    other = flown(TURNING, starts, horizon=6.0, engine="native")
    apart = other.states - run.states[: len(other.states)]
    apart[..., 4] -= 2.0 * np.pi * np.arange(3)
    assert np.abs(apart).max() < 1e-11


def test_v_is_measured_in_the_axes_that_turn(run):
    found, model, short = lyapunov(run), run.model, 1e-6
    P, L = run.drive.metric(model), run.graph.grounded_laplacian().toarray()
    assert found is not None

    def v(states, heading):
        delta = states[1:] - run.formation.offsets[1:] - states[0]
        c, s = np.cos(heading), np.sin(heading)
        D = np.eye(6)
        D[:2, :2] = D[2:4, 2:4] = [[c, -s], [s, c]]
        return 0.5 * np.einsum("ij,ia,ab,jb->", L, delta @ D, P, delta @ D)

    for k in (0, 7, 40):
        x, heading = run.states[k], 0.5 + run.times[k]
        with jax.enable_x64(True):
            pairs = zip(jnp.asarray(x), jnp.asarray(run.inputs[k]))
            moved = np.array([model.velocity(*each) for each in pairs])
        both = (v(x + e * moved, heading + e) for e in (short, -short))
        assert found.value[k] == pytest.approx(v(x, heading), rel=1e-12)
        assert found.rate[k] == pytest.approx(np.subtract(*both) / (2.0 * short), rel=1e-6)
    assert not found.forbidden().any()


def test_what_is_promised_of_a_turn_is_the_rate_at_which_errors_shrink():
    spin = ech.references.Hover(position=(0.0, 0.0, 0.0), yaw_rate=1.0)
    # Along the eigenvector of the line's larger eigenvalue, whose slowest mode is the slowest.
    apart = np.array([1e-3, 1e-3, 0.0, 0.0, 1e-3, 0.0])
    rest = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    offsets, shares = ([-1.0, 0.3], [-2.0, -0.4]), (1.0, 0.5 - 0.5 * np.sqrt(5.0))
    starts = {
        k + 1: rest + share * apart + np.pad(place, (0, 4))
        for k, (place, share) in enumerate(zip(offsets, shares, strict=True))
    }
    run = flown(spin, starts, horizon=14.0)
    found = ech.guarantee(run.parts, run.settings)
    [line] = (x for x in found.hypotheses.values() if x.name == "law turns with the heading")
    sizes = np.linalg.norm(run.errors[:, 1:], axis=(1, 2))
    early, late = sizes[[400, 650]]
    assert np.log(late / early) / 5.0 == pytest.approx(line.number, rel=0.02)
    assert "or to a steady turn at 1 rad/s, at any `yaw`" in in_words(found)
    assert found.rate == -max(line.number, found.slowest)


def test_a_steady_turn_moves_nothing_in_axes_that_turn():
    with jax.enable_x64(True):
        x, v = steady_turn(QUADROTOR, 2.0)
        moved = np.asarray(QUADROTOR.velocity(jnp.asarray(x), QUADROTOR.physical(jnp.asarray(v))))
    assert np.allclose(moved, 2.0 * np.eye(12)[8], atol=1e-9)
    assert np.allclose(x, 2.0 * np.eye(12)[11], atol=1e-9)


def test_behind_a_leader_that_keeps_its_heading_nothing_is_told():
    law = law_of("riccati", QUADROTOR)

    def prepared(law, **yaw):
        path = ech.references.Lemniscate(**yaw)
        return ech.Laws(ech.laws.Tracking(path), law).prepare(QUADROTOR, PAIR)

    turning = prepared(law, yaw=0.1)
    assert turning.follower.turning and not prepared(law).follower.turning
    assert "the heading that the leader follows" in turning.information.follower
    world = ech.laws.Consensus(law.gain, frame="world")
    # A gain that no turn changes needs no heading.
    even = eqx.tree_at(lambda each: each.gain.P, law, np.eye(12))
    for other in (world, even):
        assert not prepared(other, yaw=0.1).follower.turning


@pytest.mark.slow
def test_the_formation_of_yaw_turn_is_held_to_rounding():
    parts, settings = ech.build(ech.load_scenario("yaw-turn"))
    assert np.abs(ech.simulate(parts, settings).errors[-1]).max() < 1e-14
    promise = ech.guarantee(parts, settings)
    assert promise.promised and promise.rate > 1.0
    parts, settings = ech.build(ech.load_scenario("yaw-turn", ["follower.frame=world"]))
    assert "`yaw`" in in_words(ech.guarantee(parts, settings))
