"""Trims that move, against matrices, Floquet multipliers and runs of these tests' own."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

import echelon as ech
from echelon.agents.models.model import wrap_angles
from echelon.agents.models.model_check import check_model
from echelon.agents.models.relative_equilibrium import trim_velocity
from echelon.agents.network.formation_motion import Rotate
from echelon.core.errors import LawError, ModelError, SimulationError
from echelon.core.words import GuaranteeVerdict
from echelon.guarantees.promises.closed_loop import loop_of
from echelon.guarantees.promises.speeds import speed_range
from echelon.simulation.engine.prepare import prepare

SHORT = ech.Settings(horizon=1.0, dt=0.1)
PATH = ech.Graph.path(4)
Q, R = np.diag([1.0, 1.0, 1.0, 0.5, 0.5, 0.5]), np.eye(2)


def array(*numbers):
    return eqx.field(default_factory=lambda: np.array(numbers))


class Skiff(ech.ControlAffine):
    """A boat in surge, sway and yaw, with drags and a coupling that are drawn."""

    speed: float = 2.0
    drags: np.ndarray = array(1.0, 2.0, 1.0)
    coupling: np.ndarray = array(1.0, -1.0, 0.0)

    state_names = ("x", "y", "psi", "u", "v", "r")
    state_units = ("m", "m", "rad", "m/s", "m/s", "rad/s")
    input_names = ("thrust", "moment")
    position = ("x", "y")
    heading = ech.models.Heading("psi", (("x", "y"),))

    @property
    def trim(self):
        return (0.0, 0.0, 0.0, self.speed, 0.0, 0.0), (0.0, 0.0)

    def drift(self, x):
        _, _, psi, u, v, r = x
        c, s = jnp.cos(psi), jnp.sin(psi)
        a, b, k = self.coupling
        du, dv, dr = self.drags
        surge, sway = a * v * r - du * (u - self.speed), b * u * r - dv * v
        return jnp.stack([u * c - v * s, u * s + v * c, r, surge, sway, k * u * v - dr * r])

    def input_map(self, x):
        return jnp.zeros((6, 2)).at[3, 0].set(1.0).at[5, 1].set(1.0)

    def difference(self, x, y):
        return wrap_angles(x - y, 2)


def drawn(seed):
    draw = np.random.default_rng(seed)
    drags, coupling = draw.uniform(0.3, 3.0, 3), draw.uniform([0.5, -2.0, -1.0], [2.0, -0.5, 1.0])
    # Few speeds, since each is compiled anew.
    return Skiff((0.8, 2.0, 3.5)[seed % 3], drags, coupling)


def own_motion(model, x, w):
    """f + g w without JAX."""
    psi, u, v, r = x[2:]
    a, b, k = model.coupling
    du, dv, dr = model.drags
    surge, sway = a * v * r - du * (u - model.speed) + w[0], b * u * r - dv * v
    moved = [u * np.cos(psi) - v * np.sin(psi), u * np.sin(psi) + v * np.cos(psi), r]
    return np.array([*moved, surge, sway, k * u * v - dr * r + w[1]])


def own_slopes(model, x, w=(0.0, 0.0)):
    near, one = 1e-6, np.eye(6)
    columns = [own_motion(model, x + near * e, w) - own_motion(model, x - near * e, w) for e in one]
    return np.array(columns).T / (2.0 * near)


B = np.zeros((6, 2))
B[3, 0] = B[5, 1] = 1.0
GROUNDED = PATH.grounded_laplacian().toarray()
STRENGTHS = np.linalg.eigvalsh(GROUNDED)


def own_gain(model, speed=None):
    """R^-1 B'P of the Riccati equation at the trim."""
    x = np.array([0.0, 0.0, 0.0, model.speed, 0.0, 0.0])
    return B.T @ scipy.linalg.solve_continuous_are(own_slopes(model, x), B, Q, R)


def own_growth(model, K, coupling, x, w=(0.0, 0.0), rate=0.0):
    """The slowest mode about a steady motion, in axes that turn at a rate."""
    spin = np.zeros((6, 6))
    spin[0, 1], spin[1, 0] = -1.0, 1.0
    A = own_slopes(model, x, w) - rate * spin
    loops = A - coupling * STRENGTHS[:, None, None] * (B @ K)
    return float(np.linalg.eigvals(loops).real.max())


def parts_of(model, follower, leader=None, formation=None, **more):
    formation = ech.Formation.line(model, PATH, spacing=2.0) if formation is None else formation
    return ech.Parts(
        model, PATH, formation, ech.Laws(leader or ech.laws.TrimInput(), follower), **more
    )


def consensus(model, coupling=None, **more):
    gain = ech.synthesize(model, PATH, ech.gains.Riccati(np.diag(Q), np.diag(R), coupling=coupling))
    return ech.laws.Consensus(gain, feedforward="relay", **more)


def line_of(parts, name, settings=None):
    found = ech.check(parts, settings or ech.Settings(horizon=20.0, dt=0.02))
    return found, next((line for line in found.lines if line.name == name), None)


# ---- what counts as a trim that moves ------------------------------------------------------------


class Braked(Skiff):
    """Its drag grows along x, so that no place is like another."""

    def drift(self, x):
        return super().drift(x).at[3].add(-0.01 * x[0])


class Shallow(Skiff):
    """Beyond 300 m the water is shallow."""

    def drift(self, x):
        return super().drift(x).at[3].add(-0.1 * jnp.maximum(x[0] - 300.0, 0.0))


class Pulled(Skiff):
    """Its thrust weakens with the distance."""

    def input_map(self, x):
        return super().input_map(x) / (1.0 + 1e-4 * x[0] ** 2)


class Ringed(Skiff):
    """Its x is a place on a ring, of which it measures the sine."""

    def output(self, x):
        return jnp.sin(x[:1])

    output_names = ("place",)


class Drifting(Skiff):
    """It does not hold its speed."""

    def drift(self, x):
        return super().drift(x).at[3].add(-0.5)


class Circling(Skiff):
    """It turns at its trim."""

    @property
    def trim(self):
        return (0.0, 0.0, 0.0, self.speed, 0.0, 0.1), (0.0, 0.0)


LOOKS_LIKE_ONE = {Braked: "x", Shallow: "x", Pulled: "x", Ringed: "x", Drifting: "u", Circling: ""}


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("kind", LOOKS_LIKE_ONE)
def test_what_only_looks_like_one_is_no_equilibrium(kind, seed):
    model = drawn(seed)
    with pytest.raises(ModelError, match=f"is no equilibrium.*`{LOOKS_LIKE_ONE[kind]}"):
        check_model(kind(model.speed, model.drags, model.coupling))


@pytest.mark.parametrize("seed", range(5))
def test_the_velocity_of_the_trim_is_along_positions(seed):
    model = drawn(seed)
    assert check_model(model) == ()
    assert trim_velocity(model) == pytest.approx(model.speed * np.eye(6)[0], abs=1e-12)


OFFSETS = {"psi": (2, 0.3, "0.598 m/s"), "u": (3, 0.5, "0.5 m/s"), "r": (5, 0.2, "per second")}


@pytest.mark.parametrize("name", OFFSETS)
def test_offsets_that_separate_agents_are_refused_with_the_number(name):
    index, size, told = OFFSETS[name]
    formation = ech.Formation.from_offsets(Skiff(), PATH, {2: size * np.eye(6)[index]})
    with pytest.raises(SimulationError, match=f"in `{name}` separates .*{told}"):
        prepare(parts_of(Skiff(), consensus(Skiff()), formation=formation), SHORT)


# ---- the local certificate -----------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(8))
def test_verdicts_are_those_of_own_matrices(seed):
    model = drawn(seed)
    draw = np.random.default_rng(100 + seed)
    coupling = float(10.0 ** draw.uniform(-2.0, 2.0))
    parts = parts_of(model, consensus(model, coupling))
    settings = ech.Settings(horizon=20.0, dt=0.05, limits=False)
    promise = ech.check(parts, settings).promise
    x = np.array(model.trim[0])
    A, K = own_slopes(model, x), coupling * own_gain(model)
    # The whole formation in one matrix, under inputs that are held.
    whole = np.kron(np.eye(3), A), np.kron(np.eye(3), B)
    flow = scipy.linalg.expm(0.05 * np.block([[*whole], [np.zeros((6, 24))]]))
    step = flow[:18, :18] - flow[:18, 18:] @ np.kron(GROUNDED, K)
    radius = float(np.abs(np.linalg.eigvals(step)).max())
    assert (promise.verdict is GuaranteeVerdict.NONE) == (radius >= 1.0)
    assert promise.case.local.exact == pytest.approx(radius, abs=1e-6)


class Fixed(ech.Law):
    """u = -K z, and what it adds at a place."""

    gain: np.ndarray
    pull: np.ndarray = array(*[0.0] * 6)

    def update(self, model, view, memory):
        v = -self.gain @ view.disagreement - jnp.stack([self.pull @ jnp.sin(view.x), 0.0])
        return model.physical(v), memory


class Announcing(ech.laws.Consensus):
    """What followers are sent depends on where the leader is."""

    def broadcast(self, model, x, v):
        return super().broadcast(model, x, v) + 0.01 * jnp.sin(x[:2])


def test_laws_that_use_positions_are_refused_and_others_are_not():
    model = Skiff()
    K = 5.0 * own_gain(model)
    fine = ech.check(parts_of(model, Fixed(K)), ech.Settings(horizon=10.0, dt=0.02)).promise
    assert fine.promised
    for law in (Fixed(K, 0.01 * np.eye(6)[0]), Announcing(consensus(model).gain)):
        found, line = line_of(parts_of(model, law), "rest at the goals")
        assert found.promise.verdict is GuaranteeVerdict.NONE
        assert line.fails and "depends on where agents are" in line.text
    # A law that reads its own heading is the same everywhere.
    along = Fixed(K, 0.01 * np.eye(6)[2])
    assert line_of(parts_of(model, along), "rest at the goals")[1].verdict.name == "HOLDS"


def test_late_messages_of_states_leave_what_the_speed_makes_of_them():
    world = ech.World(network=ech.Network(rate=50.0, messages="state"))
    found, line = line_of(parts_of(Skiff(), consensus(Skiff()), world=world), "rest at the goals")
    degrees = np.diag(np.diag(GROUNDED))
    off = 0.02 * 2.0 * np.linalg.solve(GROUNDED, degrees @ np.ones(3)).max()
    assert line.number == pytest.approx(off, rel=1e-6)
    assert found.promise.verdict is GuaranteeVerdict.NONE


def test_a_run_is_the_same_elsewhere_and_ends_at_its_goals():
    parts = parts_of(Skiff(), consensus(Skiff()))
    start = np.tile(Skiff().trim[0], (4, 1)) + parts.formation.offsets
    start[1:, :3] += np.array([[1.5, -1.0, 0.4], [-1.9, 0.5, -0.4], [1.0, 1.9, 0.3]])
    settings = ech.Settings(horizon=60.0, dt=0.02)
    shift = np.array([700.0, -300.0, 0.0, 0.0, 0.0, 0.0])
    here, there = (
        ech.simulate(parts.replace(initial=start + by), settings) for by in (0.0 * shift, shift)
    )
    assert np.abs(there.states - shift - here.states).max() < 1e-9
    assert np.abs(here.errors[-1]).max() < 1e-9


def test_boats_come_together_behind_a_leader_at_two_metres_a_second():
    boat = ech.models.Boat()
    gain = ech.synthesize(boat, PATH, ech.gains.Riccati())
    formation = ech.Formation.line(boat, PATH, spacing=3.0)
    drive = ech.Laws(ech.laws.TrimInput(), ech.laws.Consensus(gain))
    parts = ech.Parts(boat, PATH, formation, drive, initial={"position": 2.0, "heading": 0.4})
    result = ech.simulate(parts, ech.Settings(horizon=60.0, dt=0.02, seed=1))
    away = np.linalg.norm(result.errors[..., :2], axis=2).max(axis=1)
    assert away[0] > 1.0 and (away[600:] < 0.01).all() and away[-1] < 1e-9


# ---- turns and speeds ----------------------------------------------------------------------------


def steady(model, speed, rate):
    """The state and the input of a steady turn at a heading of 0, by own equations."""
    a, b, k = model.coupling
    du, dv, dr = model.drags
    sway = b * speed * rate / dv
    thrust = du * (speed - model.speed) - a * sway * rate
    return np.array([0.0, 0.0, 0.0, speed, sway, rate]), (thrust, dr * rate - k * speed * sway)


@pytest.mark.parametrize("seed", range(4))
def test_the_range_of_speeds_ends_where_floquet_multipliers_pass_one(seed):
    model = drawn(seed)
    parts = parts_of(model, consensus(model))
    found = ech.check(parts, ech.Settings(horizon=20.0, dt=0.02)).promise
    limits = speed_range(found.case)
    c, K = parts.drive.follower.gain.coupling, own_gain(model)

    def grows(speed):
        return own_growth(model, K, c, *steady(model, speed, 0.0)) >= 0.0

    assert not grows(model.speed)
    for edge, inside in ((limits.low, 1.0), (limits.high, -1.0)):
        near = 1e-3 * model.speed * inside
        assert not grows(edge + near)
        tried = 49.9 * model.speed
        assert grows(edge - near) or edge >= tried or edge <= -model.speed


def multiplier(model, K, coupling, speed, rate, turning):
    """The growth rate over one turn of a gain that turns or does not, from the monodromy matrix."""
    state, w = steady(model, speed, rate)
    period, count = 2.0 * np.pi / rate, 400
    worst = -np.inf
    for strength in coupling * STRENGTHS:
        monodromy = np.eye(6)
        for k in range(count):
            angle = rate * period * (k + 0.5) / count
            turn = np.eye(6)
            turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
            gain = K @ turn.T if turning else K
            x = state + angle * np.eye(6)[2]
            J = own_slopes(model, x, w) - strength * B @ gain
            monodromy = scipy.linalg.expm(J * period / count) @ monodromy
        radius = np.abs(np.linalg.eigvals(monodromy)).max()
        worst = max(worst, float(np.log(radius)) / period)
    return worst


@pytest.mark.parametrize("seed", range(3))
def test_a_gain_that_turns_decays_as_the_floquet_multipliers_do(seed):
    model, rate = drawn(seed), 0.3
    K, c = own_gain(model), 1.0 / STRENGTHS[0]
    state, w = steady(model, model.speed, rate)
    turned = own_growth(model, K, c, state, w, rate)
    assert multiplier(model, K, c, model.speed, rate, True) == pytest.approx(turned, abs=2e-3)
    assert turned < multiplier(model, K, c, model.speed, rate, False)


def vehicles():
    refs = ech.references
    yield ech.models.Bicycle(), refs.Circle(radius=10.0, rate=0.2), 1.0
    yield ech.models.Unicycle(speed=1.0), refs.FigureEight(amplitude=(5.0, 2.5), rate=0.15), 0.5
    yield ech.models.FixedWing(), refs.Circle(radius=70.0, rate=0.2), 5.0


@pytest.mark.parametrize(("model", "path", "spacing"), [*vehicles()])
def test_vehicles_follow_curves_without_a_lag(model, path, spacing):
    formation = ech.Formation.line(model, PATH, spacing=spacing)
    gain = ech.synthesize(model, PATH, ech.gains.Riccati())
    drive = ech.Laws(ech.laws.Tracking(path), ech.laws.Consensus(gain))
    parts = ech.Parts(model, PATH, formation, drive, initial={"position": 0.2, "heading": 0.1})
    settings = ech.Settings(horizon=80.0, dt=0.02)
    found, line = line_of(parts, "speeds of the path", settings)
    assert found.promised and line.verdict.name == "HOLDS"
    result = ech.simulate(parts, settings)
    assert np.abs(result.errors[-1]).max() < 1e-6


def test_a_formation_that_turns_lags_as_stated():
    model, graph = ech.models.Bicycle(), PATH
    wedge = ech.Formation.wedge(model, graph, spacing=1.0)
    formation = wedge.moving(model, graph, [Rotate(0.2)])
    gain = ech.synthesize(model, graph, ech.gains.Riccati())
    leader = ech.laws.Tracking(ech.references.Circle(radius=10.0, rate=0.2))
    drive = ech.Laws(leader, ech.laws.Consensus(gain))
    parts = ech.Parts(model, graph, formation, drive)
    settings = ech.Settings(horizon=60.0, dt=0.02)
    found, line = line_of(parts, "offsets are symmetries", settings)
    result = ech.simulate(parts, settings)
    away = np.linalg.norm(result.errors[-1, :, :2], axis=1).max()
    assert line.number == pytest.approx(away, rel=1e-6)
    assert found.promise.verdict is GuaranteeVerdict.NONE


class Stopping(ech.Reference):
    """A straight path at 1 + cos(.2 t) m/s, which stops at 15.7 s."""

    def __call__(self, t):
        return jnp.stack([t + jnp.sin(0.2 * t) / 0.2, 0.0 * t, 0.0 * t, 0.0 * t])


def test_a_path_that_stops_is_told_with_its_time():
    model = ech.models.Unicycle(speed=1.0)
    gain = ech.synthesize(model, PATH, ech.gains.Riccati())
    parts = parts_of(model, ech.laws.Consensus(gain), ech.laws.Tracking(Stopping()))
    for horizon, fails in ((15.0, False), (40.0, True)):
        _, line = line_of(parts, "speeds of the path", ech.Settings(horizon=horizon, dt=0.05))
        assert line.fails == fails
    assert "and stops at 15.7 s" in line.text


def test_a_gain_for_the_world_is_refused_on_turns_and_not_straight_on():
    model = ech.models.Unicycle(speed=1.0)
    gain = ech.synthesize(model, PATH, ech.gains.Riccati())
    law = ech.laws.Consensus(gain, frame="world")
    refs = ech.references
    straight = ech.laws.Tracking(refs.Line(velocity=(1.0, 0.0, 0.0)))
    prepare(parts_of(model, law, straight), SHORT)
    for path in (refs.Circle(radius=5.0, rate=0.2), refs.Line(velocity=(0.0, 1.0, 0.0))):
        with pytest.raises(LawError, match="off the trim's at 0 s"):
            prepare(parts_of(model, law, ech.laws.Tracking(path)), SHORT)


def test_a_linear_state_space_is_of_axes_that_move():
    parts = parts_of(Skiff(), consensus(Skiff()))
    slowest = np.sort(np.linalg.eigvals(ech.state_space(parts).A).real)
    loop = loop_of(prepare(parts, SHORT).parts)
    assert np.abs(slowest - loop.slowest).min() < 1e-9
