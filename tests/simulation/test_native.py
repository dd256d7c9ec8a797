"""Native steps against JAX: states, inputs, sums and moments, for every feature of a run."""

import json
import time
from collections.abc import Callable
from concurrent import futures
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import echelon as ech
from echelon.agents.models.model import wrap_angles
from echelon.simulation import codegen as kernels
from echelon.simulation.engine.batch import Batch
from echelon.simulation.engine.prepare import prepare
from echelon.simulation.native import blocks, threads
from echelon.simulation.native import kernel_cache as kernel_code
from echelon.simulation.native import stepper as native_stepper
from echelon.simulation.native.varying import VaryingNumbers
from echelon.simulation.step.assembly import assemble
from echelon.simulation.step.drive import numbers

QUADROTOR = ech.models.Quadrotor()
CART = ech.models.DoubleIntegrator(1)
CIRCLE = ech.laws.Tracking(ech.references.Circle(radius=0.5, rate=0.5))


def ready(parts, chosen, engine):
    """Return what is to be flown and the stepper, by one of the engines."""
    prepared = prepare(parts, chosen._replace(engine=engine))
    return prepared, prepared.parts.drive.stepper(prepared.problem)


def steps_of(prepared, stepper, chosen, counts):
    """Return the chunk of some frames from the start."""
    with jax.enable_x64(chosen.precision == "float64"):
        times = chosen.dt * jnp.arange(int(np.sum(counts)) + 1)
        wanted = prepared.parts.drive.reference_states(prepared.parts.model, times)
        wanted = None if wanted is None else np.asarray(wanted, float)
        return stepper.advance(stepper.start(), np.array(counts), wanted)


def stepped(parts, chosen, counts, engine):
    """Return the chunk of some frames, and the stepper, by one of the engines."""
    prepared, stepper = ready(parts, chosen, engine)
    return steps_of(prepared, stepper, chosen, counts), stepper


def check_alike(parts, chosen, counts=(1, 0, 17, 60, 0), tolerance=1e-13):
    (ours, stepper), (theirs, _) = (
        stepped(parts, chosen, counts, name) for name in ("native", "jax")
    )
    assert stepper.engine == "native"
    for a, b in ((ours.states, theirs.states), (ours.inputs, theirs.inputs)):
        size = np.maximum(np.abs(b).max(axis=(0, 1)), 1.0)
        assert (np.abs(a - b) / size).max() <= tolerance
    for name, a, b in zip(ours.sums._fields, ours.sums, theirs.sums, strict=True):
        size = np.abs(b).max(initial=1e-12)
        np.testing.assert_allclose(a, b, rtol=0, atol=100 * tolerance * size, err_msg=name)
    for a, b in zip(numbers(ours.now), numbers(theirs.now), strict=True):
        assert a.shape == b.shape and np.abs(a.astype(float) - b).max(initial=0.0) <= max(
            1e-10, tolerance
        )
    return ours, theirs


def flock(graph, model=QUADROTOR, leader=CIRCLE, feedforward="relay", **more):
    # Weak enough for the step: what grows makes any rounding large.
    gain = ech.synthesize(model, graph, ech.gains.Riccati(coupling=0.3))
    formation = ech.Formation.circle(model, graph, spacing=1.0)
    follower = ech.laws.Consensus(gain, feedforward=feedforward)
    drive = ech.Laws(leader, follower)
    more = {"initial": {"position": 0.02}} | more
    return ech.Parts(model, graph, formation, drive, **more)


LINE = ech.Graph.path(2)


def led(model, initial=1.0, graph=LINE, follower=None, spacing=0.0):
    """Return agents in a row behind a leader, each with its trim input where no law is given."""
    offsets = np.zeros((graph.agents, len(model.state_names)))
    starts = initial if isinstance(initial, dict) else initial + offsets
    offsets[:, 0] = spacing * np.arange(graph.agents)
    laws = ech.Laws(ech.laws.TrimInput(), follower or ech.laws.TrimInput())
    return ech.Parts(model, graph, ech.Formation(offsets), laws, initial=starts)


def row(graph, coupling, feedforward="relay", spacing=0.0, model=CART, initial=None):
    """Return carts under a consensus law."""
    gain = ech.synthesize(model, graph, ech.gains.Riccati(coupling=coupling))
    follower = ech.laws.Consensus(gain, feedforward=feedforward)
    initial = {"position": 1.0} if initial is None else initial
    return led(model, initial, graph, follower, spacing)


class Scalar(ech.ControlAffine):
    """One state at rest, and one input that moves it."""

    state_names, input_names = ("x",), ("u",)

    def drift(self, x):
        return 0.0 * x

    def input_map(self, x):
        return jnp.ones((1, 1), x.dtype)


def run_settings(**changes):
    return ech.Settings(**{"horizon": 1.0, "dt": 0.005, "steady_window": 0.8, **changes})


# A rotated flight, the law of stopping points and a model without positions; the rest is a study.
DRAWN = {"paper-radio", "line-10", "van-der-pol", "yaw-turn"}
LONG = [
    pytest.param(name, 1000, marks=pytest.mark.slow if name in DRAWN else pytest.mark.study)
    # Two are without native code; the last ends in six steps.
    for name in sorted({*ech.bundled_scenarios()} - {"crossing", "reshape"})
    if name != "paper-literal"
]


@pytest.mark.parametrize(
    ("name", "steps"),
    [("paper", 60), ("unicycle", 60), ("van-der-pol", 60), ("planar-quadrotor", 60), *LONG],
)
def test_a_scenario_steps_as_by_jax(name, steps):
    counts, tolerance = ((1, 0, 17, 60, 0), 1e-13) if steps == 60 else ((1000,), 1e-12)
    check_alike(*ech.build(ech.load_scenario(name)), counts, tolerance)


@pytest.mark.parametrize(
    ("name", "events"),
    [
        ("integrators", [{"at": 0.1, "lose": 3}, {"at": 0.3, "lose": 2}]),
        ("unicycle", [{"at": 0.1, "lose": 3}, {"at": 0.25, "join": 3}]),
        ("planar-quadrotor", [{"at": 0.1, "join": 2}]),
        pytest.param("leader-lost", [{"at": 0.5, "lose": 0}], marks=pytest.mark.slow),
    ],
)
def test_agents_that_are_lost_and_join_step_as_by_jax(name, events):
    parts, chosen = ech.build(ech.load_scenario(name, [f"events={json.dumps(events)}"]))
    steps = round(1.2 / chosen.dt) if name == "leader-lost" else 60
    check_alike(parts, chosen, (7, steps, 0, 1, 13), 1e-13)


WEIGHTED = ech.Graph.from_edges([(0, 1, 0.5), (1, 2, 3.0), (2, 3, 1.0), (0, 4, 2.0)], (0,), 5)
HEAVY = ech.models.Quadrotor(mass=0.031)
NETWORKS = {
    "a ring": (ech.Graph.ring(11), {}),
    "weights": (WEIGHTED, {}),
    "the parent's input": (ech.Graph.path(12), {"feedforward": "parent"}),
    "a relayed velocity": (ech.Graph.path(3), {"feedforward": "relay-velocity"}),
    "nothing fed forward": (ech.Graph.star(10), {"feedforward": "none"}),
    "several leaders": (ech.Graph.ring(9, leaders=(0, 4)), {}),
    "a leader at its trim": (ech.Graph.grid(3, 4), {"leader": ech.laws.TrimInput()}),
    "a leader that reacts": (ech.Graph.path(4), {"feedforward": "none"}),
    "a plant that is not the model": (ech.Graph.ring(5), {"world": ech.World(plant=HEAVY)}),
}


@pytest.mark.parametrize("name", NETWORKS)
def test_all_networks_and_feedforwards_step_as_by_jax(name):
    graph, more = NETWORKS[name]
    if name == "a leader that reacts":
        gain = ech.synthesize(QUADROTOR, graph, ech.gains.Riccati())
        more = more | {"leader": ech.laws.Tracking(CIRCLE.reference, reaction=gain)}
    check_alike(flock(graph, **more), run_settings())


@pytest.mark.slow
@pytest.mark.parametrize("common", [True, False])
def test_wind_and_noise_are_those_that_jax_draws(common):
    rms = {"rms": {"velocity": 0.3}, "input_rms": {"thrust": 0.1}}
    wind = ech.Disturbance(constant={"vx": 0.1}, **rms, hold=0.05, common=common)
    # Normal draws are of single precision, and round by how XLA arranges them.
    world = ech.World(disturbance=wind)
    # Where frames stand at the beginning of a hold, inputs are looked at before any step is taken.
    counts = (0, 10, 0, 1, 0, 17, 60, 0)
    check_alike(flock(ech.Graph.ring(5), world=world), run_settings(), counts, 3e-8)


def test_limits_that_act_and_single_precision_are_those_of_jax():
    parts = flock(ech.Graph.ring(5), initial={"position": 30.0, "attitude": 0.5})
    ours, _ = check_alike(parts, run_settings(), (40,), 1e-11)
    assert ours.sums.limited.max() > 10
    check_alike(flock(ech.Graph.ring(20)), run_settings(precision="float32"), (1, 30), 2e-5)


class Remembers(ech.laws.Law):
    """Feeds back a sum of what it saw, in a memory that is a tree."""

    def init(self):
        return {"sum": jnp.zeros(2), "steps": jnp.zeros(())}

    def update(self, model, view, memory):
        total = memory["sum"] + view.disagreement
        after = {"sum": total, "steps": memory["steps"] + 1.0}
        return -0.3 * total[:1] - view.disagreement[1:] - 0.01 * memory["steps"], after


@pytest.mark.parametrize("integrator", ["euler", "printed"])
def test_other_integrators_and_a_law_with_memory_step_as_by_jax(integrator):
    model, graph = ech.models.DoubleIntegrator(dimension=2), ech.Graph.ring(4)
    chosen = run_settings(integrator=integrator, dt=0.01)
    check_alike(flock(graph, model, ech.laws.TrimInput()), chosen, (3, 4), 1e-12)
    if integrator == "euler":
        parts = led(CART, {"position": 1.0}, ech.Graph.path(4), Remembers())
        check_alike(parts, run_settings(dt=0.01))


@pytest.fixture(scope="module")
def six():
    chosen = run_settings()
    return *ready(flock(ech.Graph.path(6)), chosen, "native"), chosen


@given(cuts=st.lists(st.integers(0, 30), min_size=1, max_size=6))
@settings(max_examples=8)
def test_bits_do_not_depend_on_where_a_run_is_cut(six, cuts):
    _, stepper, _ = six
    whole, cut = (steps_of(*six, counts) for counts in ([sum(cuts)], cuts))
    assert cut.now.states.tobytes() == whole.now.states.tobytes()
    with jax.enable_x64(True):
        kept = stepper.recall(numbers(cut.now))
        more = stepper.advance(kept, np.array([2]), np.zeros((3, 12)))
        again = stepper.advance(cut.now, np.array([2]), np.zeros((3, 12)))
    assert more.now.states.tobytes() == again.now.states.tobytes()


def test_bits_do_not_depend_on_how_wide_a_vector_is(monkeypatch):
    parts, chosen = flock(ech.Graph.ring(13)), run_settings()
    wide, _ = stepped(parts, chosen, (5, 40), "native")
    monkeypatch.setitem(native_stepper.LANES, 64, 4)
    narrow, _ = stepped(parts, chosen, (5, 40), "native")
    assert wide.states.tobytes() == narrow.states.tobytes()
    assert wide.sums.errors.tobytes() == narrow.sums.errors.tobytes()


def test_bits_do_not_depend_on_threads(monkeypatch):
    monkeypatch.setattr(threads, "_SHARED", 1)  # what is read of agents is shared too
    parts = row(ech.Graph.path(40), 1.0, "parent")
    _, stepper = stepped(parts, run_settings(), (1,), "native")
    chunks = []
    with jax.enable_x64(True):
        for count in (1, 3):
            stepper.threads = threads.ThreadPool(stepper.places, None, count)
            chunks.append(stepper.advance(stepper.start(), np.array([5, 40]), None))
    alone, shared = chunks
    assert shared.now.states.tobytes() == alone.now.states.tobytes()
    assert_same_sums(shared, alone)


def assert_same_sums(one, other):
    for name, a, b in zip(one.sums._fields, one.sums, other.sums, strict=True):
        assert a.tobytes() == b.tobytes(), name


@pytest.mark.parametrize("graph", [ech.Graph.ring(200), ech.Graph.ring(200, leaders=(0, 90))])
def test_bits_do_not_depend_on_which_blocks_take_their_steps_first(graph, monkeypatch):
    parts = row(graph, 0.3, "relay", spacing=1.0)
    whole, stepper = stepped(parts, run_settings(), (5, 0, 40), "native")
    reach = stepper.places.reach
    assert reach.reach < 4
    monkeypatch.setattr(threads, "_CACHES", (8 * reach.reach * reach.bytes,))
    for count in (1, 3):
        stepper.threads = threads.ThreadPool(stepper.places, None, count)
        with jax.enable_x64(True):
            tiles = stepper.advance(stepper.start(), np.array([5, 0, 40]), None)
        assert len(stepper.threads._schedule(40, 0)) > 3 * 40
        assert tiles.states.tobytes() == whole.states.tobytes()
        assert tiles.inputs.tobytes() == whole.inputs.tobytes()
        assert_same_sums(tiles, whole)


@given(
    bits=st.sampled_from([64, 32]),
    agents=st.integers(1, 40),
    rows=st.integers(0, 5),
    seed=st.integers(0, 99),
)
def test_numbers_are_where_they_were_put_whoever_stands_where(bits, agents, rows, seed):
    draws, kind = np.random.default_rng(seed), np.dtype(f"f{bits // 8}")
    lanes = native_stepper.LANES[bits]
    stand = np.resize(draws.permutation(agents), -(-agents // lanes) * lanes)
    blocks = kernels.aligned((len(stand) // lanes, rows + 3, lanes), kind)
    wanted = draws.normal(size=(agents, rows)).astype(kind)
    part = blocks[:, 1 : 1 + rows]
    kernels.copy_rows(part, stand, wanted, True, 0, len(blocks))
    np.testing.assert_array_equal(part.transpose(0, 2, 1).reshape(len(stand), rows), wanted[stand])
    assert not blocks[:, 0].any() and not blocks[:, 1 + rows :].any()
    for other in (kind, np.dtype(float)):
        found = np.full((agents, rows), np.nan, other)
        # In pieces, as threads do.
        for first in range(len(blocks)):
            kernels.copy_rows(part, stand, found, False, first, first + 1)
        np.testing.assert_array_equal(found, wanted)


def test_native_code_is_given_arrays_of_its_own_layout_alone():
    lanes = native_stepper.LANES[64]
    blocks = kernels.aligned((2, 3, lanes), np.float64)
    stand, wanted = np.arange(2 * lanes), np.ones((2 * lanes, 3))
    told = {"rows": blocks, "agents": stand, "values": wanted, "first": 0, "last": 2}
    for name, changed in [
        ("rows", {"rows": blocks.transpose(0, 2, 1)}),
        ("agents", {"agents": stand.astype(np.int32)}),
        ("values", {"values": np.asfortranarray(wanted)}),
        ("values", {"values": wanted.astype(int)}),
        ("count", {"values": wanted[:, :2].copy()}),
        ("last", {"last": 3}),
    ]:
        with pytest.raises(ValueError, match=f"`{name}` does not fit"):
            kernels.copy_rows(**told | changed, inward=True)
    assert not blocks.any()


def test_memory_is_taken_again_when_nobody_holds_any_of_it():
    here, shape = native_stepper.BufferPool(), (2**10, 2**8)
    first = here.empty(shape, float)
    first[:] = 1.0
    kept, place = first[3, 5:7], first.ctypes.data
    del first
    second = here.empty(shape, float)
    second[:] = 2.0
    assert second.ctypes.data != place and (kept == 1.0).all()
    del kept
    assert here.empty(shape, float).ctypes.data == place
    # Of another size there is none, and small ones are nothing to keep.
    assert here.empty((2**19,), np.float32).shape == (2**19,)
    assert here.empty((3, 0), float).shape == (3, 0)


@given(keys=st.lists(st.integers(0, 9)))
def test_keys_are_grouped_as_a_stable_sort_would(keys):
    keys = np.array(keys, int)
    starts, places = blocks.grouped(keys, 10)
    np.testing.assert_array_equal(places, np.argsort(keys, kind="stable"))
    np.testing.assert_array_equal(np.diff(starts), np.bincount(keys, minlength=10))


def test_threads_of_which_not_all_were_started_do_not_wait_for_the_others():
    did = []

    class Interrupted(ThreadPoolExecutor):
        def submit(self, *args):
            if self._threads:
                raise KeyboardInterrupt
            return super().submit(*args)

    with Interrupted(2) as pool, pytest.raises(KeyboardInterrupt):
        threads.share(pool, did.append, range(2))
    # The pool has ended, and so has its thread.
    assert did == []


def test_what_threads_write_to_lives_until_they_end(monkeypatch):
    did, calls = [], []

    def wait(begun):
        calls.append(len(begun))
        if len(calls) == 1:
            raise KeyboardInterrupt
        futures.wait(begun)

    def act(part):
        time.sleep(0.05)
        did.append(part)

    monkeypatch.setattr(threads, "wait", wait)
    with ThreadPoolExecutor(2) as pool:
        with pytest.raises(KeyboardInterrupt):
            threads.share(pool, act, range(2))
        assert sorted(did) == [0, 1] and calls == [2, 2]


def test_long_runs_are_native_and_short_ones_are_not():
    model = ech.models.DoubleIntegrator(dimension=2)
    parts = flock(ech.Graph.ring(30), model, ech.laws.TrimInput(), initial={"position": 0.01})
    long = ech.simulate(parts, run_settings(horizon=20.0, dt=0.005, store_every=100))
    assert long.engine == "native" and long.outcome is ech.Outcome.COMPLETED
    short = ech.simulate(parts, run_settings(horizon=0.05, steady_window=0.01))
    assert short.engine == "jax" and not short.warnings


class Bends(ech.laws.Law):
    """Uses what has no native code."""

    def update(self, model, view, memory):
        return jax.scipy.special.erfinv(view.disagreement)[:1] * 0.0, memory


TABLE = np.linspace(-1.0, 1.0, 5)


class Drawn(Scalar):
    """Reads a table of NumPy, converted to the precision of the run or as it is."""

    converted: bool = False

    def drift(self, x):
        table = jnp.asarray(TABLE) if self.converted else TABLE
        return -jnp.interp(x, table, table)


@pytest.mark.parametrize("converted", [False, True])
def test_a_table_of_one_precision_is_explained(converted):
    parts = led(Drawn(converted), 0.5)
    both = [run_settings(precision=name, engine="jax") for name in ("float64", "float32")]
    ech.simulate(parts, both[0])
    if converted:
        assert ech.simulate(parts, both[1]).outcome is ech.Outcome.COMPLETED
    else:
        with pytest.raises(ech.errors.SimulationError, match=r"write `jnp.asarray\(array\)` there"):
            ech.simulate(parts, both[1])


def test_what_has_no_native_code_runs_by_jax_and_says_why():
    parts = led(ech.models.Pendulum(), 0.0, follower=Bends())
    told = r"there is no native code for `erf_inv` in .*test_native\.py, line \d+"
    with pytest.raises(ech.errors.SimulationError, match=rf"^`engine` is `native`, and {told}\.$"):
        ech.simulate(parts, run_settings(engine="native"))
    found = ech.simulate(parts, run_settings(horizon=600.0, dt=0.01, store_every=1000))
    assert found.engine == "jax"
    [warning] = [w for w in found.warnings if w.startswith("JAX steps the agents")]
    assert "`erf_inv`" in warning


class Swings(ech.laws.Law):
    """Reads an angle that is no state, and grows with it."""

    def update(self, model, view, memory):
        return jnp.sin(1e7 * view.x[:1] ** 3), memory


def test_angles_that_are_too_large_are_stepped_by_jax():
    told = "From t = 0 s on, JAX stepped the agents whenever an angle or a whole number "
    told += "was too large for native code."
    for start, agrees in ((2.0, False), (1e3, True)):
        parts = led(ech.models.SingleIntegrator(1), [[0.0], [start]], follower=Swings())
        (ours, stepper), (theirs, _) = (
            stepped(parts, run_settings(), (10,), name) for name in ("native", "jax")
        )
        assert stepper.engine == "native"
        assert (ours.states.tobytes() == theirs.states.tobytes()) or not agrees
        assert stepper.warnings == (told,) * agrees


class Cubic(Scalar):
    def drift(self, x):
        return x**3


class Turned(Scalar):
    """An angle, whose difference somebody writes with sine and cosine."""

    def difference(self, x, y):
        return jnp.arctan2(jnp.sin(x - y), jnp.cos(x - y))


@pytest.mark.parametrize(("size", "left"), [(1.0, False), (1e12, True)])
def test_a_difference_with_sines_has_native_code_and_large_angles_are_left_to_jax(size, left):
    start = size * np.random.default_rng(0).normal(size=(40, 1))
    parts = row(ech.Graph.ring(40), 0.3, model=Turned(), initial=start)
    check_alike(parts, run_settings(), (5, 40, 0))
    _, stepper = stepped(parts, run_settings(), (5, 40, 0), "native")
    assert bool(stepper.warnings) == left


class Compass(Scalar):
    """An angle with the shorter difference."""

    def difference(self, x, y):
        return wrap_angles(x - y, 0)


@pytest.mark.parametrize("size", [0.01, 3.0])
def test_differences_of_angles_are_the_shorter_ones_wherever_neighbours_stand(size):
    # In a ring in any order agents are read as whole vectors, by plain differences if they can be.
    order = np.random.default_rng(1).permutation(120)
    graph = ech.Graph(np.stack([order, np.roll(order, 1)], axis=1))
    start = size * np.random.default_rng(0).normal(size=(120, 1))
    parts = row(graph, 0.3, model=Compass(), initial=start)
    check_alike(parts, run_settings(), (5, 40, 0))


@pytest.mark.parametrize("store_every", [1, 7, 1000])
def test_both_engines_and_batches_say_the_same_time_of_a_divergence(store_every):
    both = [led(Cubic(), [[0.1], [start]]) for start in (3.0, 0.4)]
    chosen = ech.Settings(horizon=9.0, dt=0.01, store_every=store_every, steady_window=1.0)
    messages = list[str]()
    for name in ("native", "jax"):
        alone = [ech.simulate(parts, chosen._replace(engine=name)) for parts in both]
        batch = Batch(1).fly([(parts, chosen._replace(engine=name)) for parts in both])
        messages += ["; ".join(run.message for run in runs) for runs in (alone, batch)]
        assert all(run.outcome is ech.Outcome.DIVERGED for run in alone)
    assert len(set(messages)) == 1, messages
    assert "follower 1" in messages[0] and "t = 0.08 s" in messages[0]


@pytest.mark.parametrize(
    ("graph", "shifts", "spacing"),
    [
        (ech.Graph.ring(203), {-1, 1}, 0.0),
        (ech.Graph.path(90), {-1, 1}, 1.0),
        (ech.Graph.grid(20, 200), {-200, -1, 1, 200}, 1.0),
    ],
)
def test_neighbours_that_are_as_far_in_all_blocks_are_read_without_a_list(
    graph, shifts, spacing, monkeypatch
):
    parts = row(graph, 0.2, spacing=spacing)
    usual, stepper = stepped(parts, run_settings(), (5, 40, 0), "native")
    assert {*stepper.places.shifts[0]} == shifts
    # Without any, the graph's lists are read; and by JAX.
    monkeypatch.setattr(blocks, "mark_shifted", lambda *_: ())
    listed, other = stepped(parts, run_settings(), (5, 40, 0), "native")
    assert other.places.shifts == ((), ())
    assert usual.states.tobytes() == listed.states.tobytes()
    assert_same_sums(usual, listed)
    check_alike(parts, run_settings(), (5, 40, 0))


def test_where_agents_stand_changes_no_bit(monkeypatch):
    line = np.random.default_rng(0).permutation(60)
    graph = ech.Graph.from_edges([(line[k], line[k + 1]) for k in range(59)])
    parts = row(graph, 1.0, spacing=1.0)
    (as_numbered, plain) = stepped(parts, run_settings(), (3, 20, 0), "native")
    monkeypatch.setattr(blocks, "_LARGE", 2)
    (nearby, moved) = stepped(parts, run_settings(), (3, 20, 0), "native")
    assert as_numbered.states.tobytes() == nearby.states.tobytes()
    assert_same_sums(as_numbered, nearby)

    def apart(stepper):
        i, j = stepper.places.position[graph.edges].T
        return np.abs(i - j).mean()

    # On a line each stands beside the next, but for the leader's block.
    assert apart(moved) < 3.0 < 10.0 < apart(plain)


RATE = -1.0


class Decaying(ech.models.SingleIntegrator):
    """Reads a number of its module."""

    def drift(self, x):
        return RATE * x


class Tabled(ech.models.SingleIntegrator):
    """Reads the first row of a table."""

    table: np.ndarray

    def __init__(self, table):
        super().__init__(1)
        self.table = table

    def drift(self, x):
        return x * self.table[0].sum()


class Driven(ech.models.SingleIntegrator):
    """Holds a function."""

    rate: Callable

    def __init__(self, rate):
        super().__init__(1)
        self.rate = rate

    def drift(self, x):
        return self.rate(x)


BRIEF = ech.Settings(0.3, 0.1, integrator="euler", engine="native")


def test_what_a_user_s_class_reads_and_the_shape_of_a_matrix_count_for_each_run(monkeypatch):
    def ended():
        return ech.simulate(led(Decaying(1)), BRIEF).states[-1].ravel()

    assert ended() == pytest.approx(0.9**3)
    monkeypatch.setitem(globals(), "RATE", 5.0)
    assert ended() == pytest.approx(1.5**3)
    monkeypatch.setattr(Decaying, "drift", lambda self, x: 0.0 * x)
    assert ended() == pytest.approx(1.0)
    for shape, total in (((2, 3), 3.0), ((3, 2), 1.0)):
        model = Tabled(np.arange(6.0).reshape(shape))
        found = ech.simulate(led(model), BRIEF).states[-1].ravel()
        assert found == pytest.approx((1.0 + 0.1 * total) ** 3)


def own_of(model):
    prepared = prepare(led(model), BRIEF)
    drive = prepared.parts.drive
    return VaryingNumbers([assemble(prepared.problem, drive.leader, drive.follower)])


def test_a_program_is_known_by_shapes_and_types_and_not_where_nobody_knows_what_is_read(
    monkeypatch,
):
    assert own_of(ech.models.SingleIntegrator(1)).signature is not None
    assert own_of(Decaying(1)).signature is None
    assert own_of(Driven(jnp.sin)).signature is None
    # As of classes that may be trusted.
    for kind in (Driven, Tabled):
        monkeypatch.setattr(kind, "__module__", "echelon.agents.models")
        monkeypatch.setattr(f"echelon.agents.models.{kind.__name__}", kind, raising=False)
    assert own_of(Driven(jnp.sin)).signature is None
    numbers = [np.arange(6.0).reshape(2, 3), np.arange(6.0).reshape(3, 2), np.arange(6.0).view(int)]
    signatures = [own_of(Tabled(each)).signature for each in numbers]
    assert len({*signatures, own_of(Tabled(numbers[0].copy())).signature}) == 3


def test_a_user_s_class_is_traced_anew_and_shares_machine_code(monkeypatch):
    made = list[str]()

    def code(text):
        made.append(text)
        return kernels.Code(text)

    monkeypatch.setattr(kernel_code, "KERNELS", kernel_code.Kernels())
    monkeypatch.setattr(kernel_code, "Code", code)
    of = kernel_code.KERNELS.of
    one, other = (of(own_of(Decaying(1)), 64, False) for _ in range(2))
    assert one is not other and one.code is other.code and len(made) == 1
    plain = [of(own_of(ech.models.SingleIntegrator(1)), 64, False) for _ in range(2)]
    assert plain[0] is plain[1]


# ---- worlds that are not ideal -------------------------------------------------------------------


def drawn_world(seed):
    """Return a world of carts, of which each part is ideal or not."""
    draws = np.random.default_rng(seed)

    def some(value):
        return value if draws.random() < 0.6 else None

    noise = {"noise": {"position": 0.01}} if draws.random() < 0.5 else {}
    gusts = {"time": 0.5} if draws.random() < 0.5 else {"hold": 0.03}
    late = dict(jitter=0.02 * draws.random(), loss=0.3 * draws.random(), messages="state")
    return ech.World(
        network=some(ech.Network(rate=50.0, delay=0.03 * draws.random(), **late)),
        sensing=some(ech.Sensing(delay=0.005 * draws.integers(1, 4), **noise)),
        actuator=some(ech.Actuator(lag=0.02 + 0.05 * draws.random())),
        disturbance=some(ech.Disturbance(rms={"velocity": 0.2}, drag=0.1, air=(1.0,), **gusts)),
    )


@pytest.mark.parametrize("seed", range(4))
def test_drawn_worlds_step_as_by_jax(seed):
    graph = [ech.Graph.path(4), ech.Graph.ring(11)][seed % 2]
    parts = row(graph, 1.0).replace(world=drawn_world(seed))
    # Normal draws are of single precision, and round by how XLA arranges them.
    drawn = parts.world.disturbance or parts.world.sensing and parts.world.sensing.noise
    check_alike(parts, run_settings(substeps=1 + seed % 2), tolerance=3e-8 if drawn else 1e-13)


# ---- who leads, and whom agents use --------------------------------------------------------------

Cut, Join, Lose = ech.network.Cut, ech.network.Join, ech.network.Lose
FLAT = ech.models.DoubleIntegrator()
BOTH, RETURNS = [Lose(0, 0.4), Lose(1, 0.9)], [Lose(0, 0.4), Join(0, 1.0)]
BACKUPS = {"leadership": ech.Leadership((1, 2), timeout=0.2)}
LOSSY = {"rate": 25.0, "delay": 0.02, "jitter": 0.03, "loss": 0.3}
NEARER = ech.Network(hears="leaderward", **LOSSY)
WITHOUT_PLAN = ech.Network(hears="leaderward", messages="state", **LOSSY)


def carts(network=None, coupling=None, reacts=False, **more):
    """Return carts of which the leader may be lost: the coupling is that of a law of states."""
    graph = ech.Graph([(0, 1), (1, 2), (2, 3), (3, 0), (1, 3)])
    places = {1: [1.0, 0.0], 2: [2.0, 0.0], 3: [0.0, 1.0]}
    circle = ech.references.Circle(radius=2.0, rate=0.7)
    drive = ech.Laws(ech.laws.StoppingLeader(reference=circle), ech.laws.StoppingPoint())
    if coupling is not None:
        gain = ech.synthesize(FLAT, graph, ech.gains.Riccati(coupling=coupling))
        feeds = {"feedforward": "none"} if reacts else {}
        leader = ech.laws.Tracking(circle, reaction=gain if reacts else None)
        drive = ech.Laws(leader, ech.laws.Consensus(gain, **feeds))
    formation = ech.Formation.from_offsets(FLAT, graph, places)
    more = {"world": ech.World(network=network), "initial": {"position": 0.5}} | more
    return ech.Parts(FLAT, graph, formation, drive, **more)


def turning(parts):
    moving = parts.formation.moving(FLAT, parts.graph, [ech.network.Rotate(0.8)])
    return parts.replace(formation=moving)


TIRED = ech.World(sensing=ech.Sensing(delay=0.04), actuator=ech.Actuator(lag=0.05))
LATER = [Cut((0, 1), 0.3, 0.5), Lose(2, 0.5), Join(2, 1.0)]
LEADERS = {
    "both leaders are lost": carts(events=BOTH, **BACKUPS),
    "a leader returns": carts(coupling=1.0, events=RETURNS, **BACKUPS),
    "a leader that reacts": carts(coupling=1.0, reacts=True, events=BOTH, **BACKUPS),
    "late sensors": carts(events=BOTH, world=TIRED, **BACKUPS),
    "places that turn": turning(carts(events=BOTH, **BACKUPS)),
    "nearer neighbours": carts(NEARER, events=LATER),
    "nearer neighbours and backups": carts(NEARER, events=[*LATER, Lose(0, 0.4)], **BACKUPS),
    "states of nearer neighbours": carts(WITHOUT_PLAN, events=LATER),
}
QUICK = ("a leader returns", "states of nearer neighbours")


@pytest.mark.parametrize(
    "name",
    [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in LEADERS],
)
def test_backup_leaders_and_chosen_neighbours_step_as_by_jax(name):
    check_alike(LEADERS[name], run_settings(dt=0.02, horizon=3.0), (1, 0, 17, 40, 0, 30, 1))


@pytest.mark.slow
def test_backup_leaders_of_many_blocks_step_as_by_jax():
    graph = ech.Graph([(k, (k + far) % 20) for k in range(20) for far in (1, 3)])
    events = [Lose(0, 0.2), Lose(5, 0.5), Lose(13, 0.8), Join(4, 0.3)]
    ranks = ech.Leadership((5, 13, 7, 12, 9, 3, 2, 1, 19, 18, 17), timeout=0.1)
    parts = flock(graph, FLAT, events=events, leadership=ranks)
    check_alike(parts, run_settings(), (1, 0, 17, 100, 0, 80))
    chunks = []
    _, stepper = ready(parts, run_settings(), "native")
    with jax.enable_x64(True):
        table = np.zeros((90, 4))
        for count in (1, 3):
            stepper.threads = threads.ThreadPool(stepper.places, None, count)
            chunks.append(stepper.advance(stepper.start(), np.array([5, 80]), table))
    assert chunks[0].now.states.tobytes() == chunks[1].now.states.tobytes()


RADIO = {"rate": 50.0, "delay": 0.02, "jitter": 0.02, "loss": 0.2, "messages": "state"}


@pytest.mark.parametrize("hears", ["all", pytest.param("leaderward", marks=pytest.mark.slow)])
def test_formations_over_a_radio_are_those_alone_with_draws_of_their_own(hears):
    radio = ech.Network(**RADIO, hears=hears)
    world = ech.World(network=radio, sensing=ech.Sensing(noise={"position": 0.01}))
    parts = row(ech.Graph.path(4), 1.0).replace(world=world)
    chosen = run_settings(store_every=20, engine="native")
    runs = [(parts, chosen._replace(seed=seed)) for seed in range(9)]
    flown = [*Batch(1).fly(runs)]
    for one, run in zip(flown, runs, strict=True):
        alone = ech.simulate(*run)
        np.testing.assert_array_equal(one.states, alone.states)
    assert np.ptp([one.states[-1, 1:] for one in flown], axis=0).min() > 0.0


@pytest.mark.parametrize("coupling", [1.0, pytest.param(None, marks=pytest.mark.slow)])
def test_formations_whose_backups_wait_for_other_times_are_those_alone(coupling):
    chosen = run_settings(dt=0.02, horizon=3.0, store_every=10, engine="native")
    times = 0.1 + 0.04 * np.arange(9)
    waiting = (ech.Leadership((1, 2), timeout=time) for time in times)
    runs = [(carts(coupling=coupling, events=BOTH, leadership=each), chosen) for each in waiting]
    flown = [*Batch(1).fly(runs)]
    for one, run in zip(flown, runs, strict=True):
        np.testing.assert_array_equal(one.states, ech.simulate(*run).states)
    assert len({one.states.tobytes() for one in flown}) == len(runs)


@pytest.mark.slow
@pytest.mark.parametrize("sets", [(), ("network.prediction=packet",)])
def test_a_flight_has_the_same_bits_beside_others_whose_motors_are_at_their_limits(sets):
    """Of a block of formations all take the steps in full if one of them must."""
    far = "initial={spread: {position: 30.0, attitude: 0.8, velocity: 5.0}}"
    parts, chosen = ech.build(ech.load_scenario("paper-radio", [far, *sets]))
    chosen = chosen._replace(horizon=2.0, steady_window=None, store_every=20, engine="native")
    runs = [(parts, chosen._replace(seed=seed)) for seed in range(9)]
    for one, run in zip(Batch(1).fly(runs), runs, strict=True):
        np.testing.assert_array_equal(one.states, ech.simulate(*run).states)


@pytest.mark.parametrize(
    "name",
    [
        "a radio",
        pytest.param("a leader returns", marks=pytest.mark.slow),
        pytest.param("nearer neighbours and backups", marks=pytest.mark.slow),
    ],
)
def test_a_run_goes_on_with_the_same_bits_from_any_moment(name):
    world = ech.World(network=ech.Network(**RADIO), actuator=ech.Actuator(lag=0.05))
    parts = LEADERS.get(name, row(ech.Graph.path(4), 1.0).replace(world=world))
    chosen = run_settings(dt=0.02, horizon=3.0) if name in LEADERS else run_settings()
    prepared, stepper = ready(parts, chosen, "native")
    whole = steps_of(prepared, stepper, chosen, (150,))
    with jax.enable_x64(True):
        times = chosen.dt * jnp.arange(151)
        wanted = prepared.parts.drive.reference_states(prepared.parts.model, times)
        now, step = stepper.start(), 0
        for count in (7, 23, 67, 53):
            rest = None if wanted is None else np.asarray(wanted)[step:]
            now = stepper.recall(numbers(stepper.advance(now, np.array([count]), rest).now))
            step += count
    for a, b in zip(numbers(whole.now), numbers(now), strict=True):
        np.testing.assert_array_equal(a, b)
