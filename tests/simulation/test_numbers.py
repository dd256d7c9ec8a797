"""Integers and NumPy's numbers are numbers wherever one is meant; truth values are not."""

import jax
import numpy as np
import pytest

import echelon as ech
from echelon.synthesis.certificates import Domain

KINDS = {"int": int, "int64": np.int64, "int32": np.int32, "float32": np.float32}
PARTS = {
    "horizon": lambda x: ech.Settings(horizon=x, dt=1.0),
    "dt": lambda x: ech.Settings(horizon=2.0, dt=x),
    "steady": lambda x: ech.Settings(horizon=2.0, dt=1.0, steady_window=x),
    "rate": lambda x: ech.Network(rate=x, forget=9.0),
    "delay": lambda x: ech.Network(delay=x, forget=9.0),
    "outage": lambda x: ech.Network(bursts=ech.Bursts(0.1, x)),
    "lag": lambda x: ech.Actuator(lag=x),
    "least": lambda x: ech.Actuator(minimum=x),
    "age": lambda x: ech.Sensing(delay=x),
    "noise": lambda x: ech.Sensing(noise={"position": x}),
    "wind": lambda x: ech.Disturbance(constant={"position": x}),
    "gusts": lambda x: ech.Disturbance(rms={"position": x}, time=x),
    "hold": lambda x: ech.Disturbance(rms={"position": 1.0}, hold=x),
    "air": lambda x: ech.Disturbance(air=(x, x), drag=x),
    "stiffness": lambda x: ech.models.Pendulum(stiffness=x),
    "damping": lambda x: ech.models.VanDerPol(damping=x),
    "radius": lambda x: ech.references.Circle(radius=x),
    "gain": lambda x: ech.Safety(gain=x),
    "timeout": lambda x: ech.Leadership(backups=(1,), timeout=x),
    "spacing": lambda x: ech.Formation.line(MODEL, GRAPH, spacing=x),
    "domain": lambda x: Domain.about(PENDULUM, {"angle": x}),
}
PENDULUM = ech.models.Pendulum()
MODEL, GRAPH = ech.models.SingleIntegrator(dimension=2), ech.Graph.path(3)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("what", PARTS)
def test_whole_numbers_of_any_kind_are_numbers(what, kind):
    whole, same = (PARTS[what](number) for number in (KINDS[kind](1), 1.0))
    fields = [each._asdict() if isinstance(each, tuple) else vars(each) for each in (whole, same)]
    np.testing.assert_equal(*fields)


@pytest.mark.parametrize("what", PARTS)
def test_truth_values_and_texts_are_no_numbers(what):
    for value in (True, "1"):
        with pytest.raises(ech.EchelonError, match=r"[^.]\.$") as caught:
            PARTS[what](value)
        assert str(value) in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("kind", KINDS)
def test_a_run_in_whole_seconds_is_that_in_floats_to_the_bit(kind):
    number = KINDS[kind]
    line = ech.references.Line(velocity=(0.01, 0.0, 0.0))
    laws = ech.Laws(ech.laws.Tracking(line), ech.laws.Agreement())
    formation = ech.Formation.line(MODEL, GRAPH)
    parts = ech.Parts(MODEL, GRAPH, formation, laws, initial={"position": 1.0})
    whole = ech.Settings(number(4), number(1))
    run, same = ech.simulate(parts, whole), ech.simulate(parts, ech.Settings(4.0, 1.0))
    assert whole == ech.Settings(4.0, 1.0) and type(whole.dt) is type(whole.horizon) is float
    assert np.array_equal(run.states, same.states)


def test_counts_are_plain_integers_and_settings_are_kept_through_trees():
    counts = ech.Settings(2.0, 1.0, store_every=np.int32(2), seed=np.uint64(3), substeps=np.int8(2))
    assert [type(x) for x in (counts.store_every, counts.seed, counts.substeps)] == [int] * 3
    for name in ("store_every", "seed", "substeps", "devices"):
        with pytest.raises(ech.EchelonError, match=f"`{name}` is True"):
            ech.Settings(2.0, 1.0, **{name: True})
    leaves, tree = jax.tree.flatten(ech.Settings(4, 1))
    assert jax.tree.unflatten(tree, leaves) == ech.Settings(4.0, 1.0)


@pytest.mark.parametrize("value", [10**400, float("inf"), float("nan"), -1, 0])
def test_times_beyond_all_floats_are_told(value):
    for name in ("horizon", "dt"):
        with pytest.raises(ech.EchelonError, match=f"`{name}` is .*must be a positive finite"):
            ech.Settings(**{"horizon": 2.0, "dt": 1.0, name: value})
