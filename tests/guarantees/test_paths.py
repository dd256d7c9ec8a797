"""Which paths of a leader have the derivatives that theorem T5 asks of them."""

from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from in_words import in_words

import echelon as ech
from echelon.agents.models.chains import chains_of
from echelon.core.numerics import precision
from echelon.guarantees.promises.promise import guarantee
from echelon.guarantees.stopping.path_bounds import path_fault, pieces_of
from echelon.laws.stopping_point import StoppingLeader, StoppingPoint
from echelon_ranges import enclose_derivatives

MODEL = ech.models.DoubleIntegrator(2)


def along(x):
    """A reference along x at a time."""

    class Along(ech.references.Reference):
        def __call__(self, t):
            return jnp.stack([x(t), 0.0 * t, 1.0 + 0.0 * t, 0.0 * t])

    return Along()


def by_hand(factor):
    """A sine whose derivative is written by hand, right for a factor of 1."""
    sine = jax.custom_jvp(jnp.sin)
    sine.defjvp(lambda at, by: (jnp.sin(at[0]), factor * by[0] * jnp.cos(at[0])))
    return sine


def shifted():
    """A straight line whose derivative by hand is of another speed: a constant, as it should be."""
    line = jax.custom_jvp(lambda t: 1.0 * t)
    line.defjvp(lambda at, by: (1.0 * at[0], 2.0 * by[0]))
    return line


QUADROTOR = ech.models.Quadrotor()


KNOTS = np.arange(5.0)
ROUGH = {
    "where": lambda t: jnp.where(t > 2.0, t, 0.0 * t),
    "floor": jnp.floor,
    "round": jnp.round,
    "sign": lambda t: jnp.sign(jnp.sin(t)),
    "mod": lambda t: jnp.mod(t, 3.0),
    "clip": lambda t: jnp.clip(t, 0.0, 2.0),
    "interp": lambda t: jnp.interp(t, KNOTS, KNOTS**2),
    "piecewise": lambda t: jnp.piecewise(t, [t < 1.0, t >= 1.0], [0.0, 1.0]),
    "cond": lambda t: jax.lax.cond(t > 2.0, lambda s: s, lambda s: 0.0 * s, t),
    "integer": lambda t: t.astype(int).astype(float),
    "atan2": lambda t: jnp.arctan2(jnp.sin(t), jnp.cos(t)),
    "abs": lambda t: jnp.abs(t - 2.003),
    "power": lambda t: t**1.5,
    "maximum": lambda t: jnp.maximum(jnp.sin(t), 0.0),
    "triangle": lambda t: jnp.arcsin(jnp.sin(t)),
    "root": lambda t: jnp.sqrt((t - 2.0) ** 2),
    "root between samples": lambda t: jnp.sqrt((t - 2.003) ** 2),
    "pole": lambda t: 0.01 / (t - 2.003),
    "stopped": lambda t: jax.lax.stop_gradient(jnp.sin(t)),
    "by hand": by_hand(0.5),
    "another line": shifted(),
}
REASONS = {
    "mod": "a path uses `ne` (of `//`, `%` or a comparison), and passes from one branch",
    "interp": "a number that is not finite, as a table does that is read by `interp`",
    "integer": "a path converts time to a whole number, which has no enclosure",
}
SMOOTH = {
    "sine": jnp.sin,
    "lemniscate": lambda t: jnp.cos(t) / (1.0 + jnp.sin(t) ** 2),
    "polynomial": lambda t: jnp.polyval(jnp.array([0.01, 0.1, 1.0]), t),
    "square root": lambda t: jnp.sqrt(1.3 + jnp.sin(t) * jnp.cos(t)),
    "angle": lambda t: jnp.arctan2(jnp.sin(t), 2.0 + jnp.cos(t)),
    "angle above": lambda t: jnp.arctan2(2.0 + jnp.cos(t), jnp.sin(t)),
    "angle below": lambda t: jnp.arctan2(-2.0 - jnp.cos(t), jnp.sin(t)),
    "abs off 0": lambda t: jnp.abs(2.0 + jnp.sin(t)) + jnp.abs(-2.0 - t),
    "one branch": lambda t: jnp.where(t < 100.0, t**2, 0.0) + jnp.where(t < -1.0, 0.0, t),
    "not reached": lambda t: jnp.clip(t, -1.0, 100.0) + jnp.floor(t / 99.0),
    "of the first turn": lambda t: jnp.sin((t + 1.0) % 99.0) + (t + 1.0) // 99.0,
    "softplus": jax.nn.softplus,
    "sinc": lambda t: jnp.sinc(t + 0.1),
    "by hand": by_hand(1.0),
    "inverse": jnp.arcsinh,
}


@pytest.mark.parametrize("name", ROUGH)
def test_a_path_that_jumps_or_bends_is_refused_with_its_reason(name):
    fault = path_fault(along(ROUGH[name]), chains_of(MODEL), 10.0)
    assert "is not known to have 2 bounded derivatives, since" in fault
    assert REASONS.get(name, "") in fault


@pytest.mark.parametrize("name", SMOOTH)
def test_a_smooth_path_is_accepted_and_enclosed_with_its_derivatives(name):
    assert path_fault(along(SMOOTH[name]), chains_of(MODEL), 10.0) == ""
    times = [Fraction(k, 20) for k in (0, 1, 2, 60, 61)]
    with precision("float64"):
        rows = [lambda t: SMOOTH[name](t)[None]]
        for _ in range(3):
            rows.append(jax.jacfwd(rows[-1]))
        for piece, low, high in zip(enclose_derivatives(rows[0], times, 3), times, times[1:]):
            for t in np.linspace(float(low), float(high), 4):
                for row, [x] in zip(rows, piece, strict=True):
                    [value], slack = np.asarray(row(jnp.asarray(t))), 1e-9
                    assert float(x.lo) - slack <= value <= float(x.hi) + slack


@pytest.mark.parametrize("reference", ["Lemniscate", "FigureEight", "Circle", "Hover", "Line"])
def test_bundled_paths_are_smooth_for_any_horizon(reference):
    for horizon in (1e-3, 60.0, 1e6):
        path = getattr(ech.references, reference)()
        assert path_fault(path, chains_of(QUADROTOR), horizon) == ""


def test_waypoints_fit_together_as_their_class_says():
    times, points = [0.0, 2.0, 5.0], [(0.0, 0.0, 1.0), (1.0, 2.0, 1.0), (0.0, 1.0, 2.0)]
    path = ech.references.Waypoints(times, points)
    assert path_fault(path, chains_of(QUADROTOR), 10.0) == ""
    with precision("float64"):
        # On both sides of each knot the derivatives up to the third are the same.
        for t in times:
            before, after = jnp.asarray(t - 1e-9), jnp.asarray(t + 1e-9)
            sides = [path.derivatives(side, 3, ("x", "y", "z")) for side in (before, after)]
            assert np.allclose(*sides, atol=1e-5)
        # Its parts are the path, whatever the run's length.
        for horizon in (1.0, 4.0, 9.0):
            begin, parts = 0.0, path.parts(horizon)
            assert parts[-1][0] == horizon
            for end, part in parts:
                for t in map(jnp.asarray, np.linspace(begin, end, 5)):
                    assert np.allclose(part(t), path(t), rtol=0.0, atol=1e-12)
                begin = end

    class Cut(ech.references.Waypoints):
        def __call__(self, t):
            return jnp.where(t < 1.0, 1.0, 2.0) * super().__call__(t)

    assert "bounded derivatives" in path_fault(Cut(times, points), chains_of(MODEL), 10.0)

    # Nor are derivatives of another making those of the path.
    class Told(ech.references.Circle):
        def derivatives(self, t, order, coordinates):
            return 0.0 * super().derivatives(t, order, coordinates)

    assert "replaces `derivatives`" in path_fault(Told(), chains_of(MODEL), 10.0)


@pytest.mark.parametrize("horizon", [60.0, 1e5])
def test_the_bounds_of_a_path_hold_between_samples_however_long_it_is(horizon):
    # A moment in a long rest, which no sample of a run of a day would meet.
    times, heights = [0.0, 20.0, 20.7, 21.4, 22.1, 40.0], [1.0, 1.0, 1.2, 1.0, 1.1, 1.0]
    path = ech.references.Waypoints(times, [(0.0, 0.0, z) for z in heights])
    leader = StoppingLeader(reference=path).prepared(QUADROTOR, ech.Graph([(0, 1)]))
    pieces = pieces_of(leader, QUADROTOR, horizon, ("z",), 2)
    with precision("float64"):
        clock = jnp.linspace(0.0, 40.0, 4001)
        every = np.asarray(jax.vmap(lambda t: path.derivatives(t, 2, ("z",)))(clock))[:, :, 0]
    for order in range(3):
        low = float(min(rows[order][0].lo for rows in pieces.values))
        high = float(max(rows[order][0].hi for rows in pieces.values))
        size = np.ptp(every[:, order])
        assert low <= every[:, order].min() <= low + 0.1 * size
        assert high - 0.1 * size <= every[:, order].max() <= high
    assert float(pieces.times[-1]) == horizon


@pytest.mark.parametrize("name", ["where", "root", "sine"])
def test_behind_a_rough_path_nothing_is_guaranteed(name):
    drive = ech.Laws(StoppingLeader(reference=along((ROUGH | SMOOTH)[name])), StoppingPoint())
    graph = ech.Graph([(0, 1), (1, 2)])
    parts = ech.Parts(MODEL, graph, ech.Formation(np.zeros((3, 4))), drive, initial={"x": 1.0})
    found = guarantee(parts, ech.Settings(horizon=10.0, dt=0.01))
    assert found.promised == (name == "sine")
    if not found.promised:
        assert "`Along` is not known to have 2 bounded derivatives" in in_words(found)
