"""The lowest and highest deviation of each state over all steps, whatever frames are stored."""

import h5py
import jax.numpy as jnp
import numpy as np
import pytest

import echelon as ech
from echelon.core.words import Theorem
from echelon.guarantees.promises.coverage import covered
from echelon.simulation.engine.batch import Batch

MODEL, GRAPH = ech.models.DoubleIntegrator(), ech.Graph.path(3)
SETTINGS = ech.Settings(horizon=4.0, dt=0.02, store_every=500)
ENGINES = pytest.mark.parametrize("engine", ["jax", "native"])


def parts_of(domain, model=MODEL, **more):
    gain = ech.synthesize(model, GRAPH, ech.gains.RobustLQR(domain=domain))
    laws = ech.Laws(ech.laws.TrimInput(), ech.laws.Consensus(gain, feedforward="relay"))
    return ech.Parts(model, GRAPH, ech.Formation.line(model, GRAPH), laws, **more)


class Bent(ech.ControlAffine):
    """A model with two slopes at its trim, whose domain no gain names."""

    state_names, input_names, position = ("x",), ("u",), ("x",)

    def drift(self, x):
        return -0.5 * jnp.abs(x) - x

    def input_map(self, x):
        return jnp.ones((1, 1))


class Dragged(ech.ControlAffine):
    """A double integrator with cubic drag, so that a domain bounds its velocities."""

    state_names, input_names, position = ("x", "y", "v", "w"), ("a", "b"), ("x", "y")
    state_groups = {"position": ("x", "y"), "velocity": ("v", "w")}

    def drift(self, x):
        return jnp.concatenate([x[2:], -0.1 * x[2:] ** 3])

    def input_map(self, x):
        return jnp.concatenate([jnp.zeros((2, 2)), jnp.eye(2)])


BOX = {"position": 1.0, "velocity": 4.0}
SLOW, BRIEF = {"velocity": 0.5}, SETTINGS._replace(horizon=1.4)


def thrown(parts, position=0.9, velocity=0.8):
    """All followers start at a deviation in x and move away from their goals."""
    starts = parts.formation.offsets.copy()
    starts[1:, [0, 2]] += [position, velocity]
    return parts.replace(initial=starts)


def extremes(result):
    return np.array([result.sums.lowest, result.sums.highest])


def by_hand(parts, settings):
    """Extremes of x - xi and u over all steps of x' = (v, u), u = -c R^-1 B'P z, by Euler."""
    gain, links = parts.drive.gain, [(0, 1), (1, 2)]
    laplacian = np.zeros((3, 3))
    for i, j in links:
        laplacian[[i, j, i, j], [i, j, j, i]] += [1.0, 1.0, -1.0, -1.0]
    laplacian[0] = 0.0
    B = np.vstack([np.zeros((2, 2)), np.eye(2)])
    K = gain.coupling * np.linalg.solve(gain.R, B.T @ gain.P)
    y, rows = np.array(parts.initial) - parts.formation.offsets, []
    for _ in range(settings.steps):
        u = -laplacian @ y @ K.T
        rows.append(np.concatenate([y, u], axis=1))
        y = y + settings.dt * np.concatenate([y[:, 2:], u], axis=1)
    return np.array([np.min(rows, axis=0), np.max(rows, axis=0)])


@ENGINES
def test_extremes_are_those_of_a_loop_of_our_own(engine):
    parts = thrown(parts_of(BOX))
    settings = SETTINGS._replace(integrator="euler", engine=engine)
    result, expected = ech.simulate(parts, settings), by_hand(parts, settings)
    assert result.engine == engine and len(result.times) == 2
    np.testing.assert_allclose(extremes(result), expected, atol=1e-12)
    # The agents come back, and no stored frame shows how far they were.
    stored = abs(result.states - parts.formation.offsets)[:, 1:, 0]
    assert expected[1, 1:, 0].max() > 1.0 > stored.max()


@ENGINES
@pytest.mark.parametrize(("precision", "digits"), [("float64", 1e-12), ("float32", 1e-5)])
def test_extremes_are_those_of_all_frames(engine, precision, digits):
    parts = thrown(parts_of(BOX, world=ech.World(disturbance=ech.Disturbance({"velocity": 0.3}))))
    settings = SETTINGS._replace(engine=engine, precision=precision)
    every, some = (ech.simulate(parts, settings._replace(store_every=k)) for k in (1, 37))
    v = parts.model.normalized(every.inputs)
    rows = np.concatenate([every.states - parts.formation.offsets, v], axis=2)[:-1]
    expected = np.array([rows.min(axis=0), rows.max(axis=0)])
    np.testing.assert_allclose(extremes(some), expected, rtol=digits, atol=digits)


@ENGINES
def test_a_continued_run_has_the_same_extremes(engine):
    parts = thrown(parts_of(BOX))
    settings = SETTINGS._replace(horizon=2000.0, store_every=5000, engine=engine)
    stretches, whole = [], ech.simulate(parts, settings)

    def stop(run):
        raise KeyboardInterrupt

    part = ech.simulate(parts, settings, progress=stop, keep=stretches.append)
    assert 0 < part.sums.steps[0] < whole.sums.steps[0]
    again = ech.simulate(parts, settings, before=stretches)
    np.testing.assert_array_equal(extremes(again), extremes(whole))


def test_runs_of_a_batch_have_the_extremes_of_each_alone():
    parts = parts_of(BOX, initial={"position": 0.5})
    runs = [(parts, SETTINGS._replace(seed=seed)) for seed in range(9)]
    for one, (parts, settings) in zip(Batch(1).fly(runs), runs, strict=True):
        np.testing.assert_allclose(
            extremes(one), extremes(ech.simulate(parts, settings)), atol=1e-12
        )


def test_steps_in_which_an_agent_is_absent_do_not_count():
    events = [ech.network.Lose(2, 0.5)]
    parts = thrown(parts_of(BOX)).replace(events=events)
    every, some = (ech.simulate(parts, SETTINGS._replace(store_every=k)) for k in (1, 500))
    here = every.presence[:-1, :, None]
    assert here[:25].all() and not here[25:, 2].any()
    rows = np.where(here, (every.states - parts.formation.offsets)[:-1], np.nan)
    low, high = extremes(some)
    np.testing.assert_allclose(low[:, :4], np.nanmin(rows, axis=0), atol=1e-12)
    np.testing.assert_allclose(high[:, :4], np.nanmax(rows, axis=0), atol=1e-12)


@ENGINES
def test_only_runs_that_a_domain_is_asked_of_pay_for_extremes(engine):
    parts, settings = thrown(parts_of(BOX)), SETTINGS._replace(engine=engine)
    gain = ech.synthesize(MODEL, GRAPH, ech.gains.Riccati())
    plain = parts.replace(drive=ech.Laws(ech.laws.TrimInput(), ech.laws.Consensus(gain)))
    frames = settings._replace(store_every=1)
    for run in (ech.simulate(plain, settings), ech.simulate(parts, frames)):
        assert extremes(run).shape == (2, 3, 0)
    assert extremes(ech.simulate(parts, settings)).shape == (2, 3, 6)


@pytest.mark.parametrize("every", [1, 500])
@pytest.mark.parametrize(("position", "kept"), [(-1.2, False), (0.2, True)])
def test_a_run_is_covered_exactly_if_no_step_leaves_the_domain(every, position, kept):
    parts, settings = parts_of(SLOW, Dragged()), BRIEF._replace(store_every=every)
    parts = thrown(parts, position=position, velocity=0.45 if position < 0.0 else 0.0)
    result, promise = ech.simulate(parts, settings), ech.guarantee(parts, settings)
    assert promise.theorem is Theorem.T1 and ech.summary(result)["guarantee"]["covered"] is kept
    said = " ".join(str(ech.report(result)).split())
    if kept:
        assert "covers this run: the starts lie" in said and "in the domain in every step" in said
    else:
        when = "in some step" if every > 1 else "at 0.06 s"
        assert f"does not cover this run: agent 1 left the domain {when} (`v`)." in said


@pytest.mark.parametrize("every", [1, 500])
def test_a_run_that_leaves_the_domain_is_covered_once_it_is_back_in_the_set(every):
    parts = thrown(parts_of(SLOW, Dragged()), position=-1.2, velocity=0.45)
    settings = SETTINGS._replace(store_every=every)
    result = ech.simulate(parts, settings)
    assert extremes(result).shape[2] == 0 or extremes(result)[1, 1:, 2].max() > 0.5
    assert ech.summary(result)["guarantee"]["covered"] is True
    said = " ".join(str(ech.report(result)).split())
    assert "covers this run: all agents were in the certified set at" in said


@pytest.mark.parametrize(("start", "kept"), [(0.5, False), (5e-4, True)])
def test_steps_count_in_the_domain_about_a_kink_too(start, kept):
    gain = ech.synthesize(Bent(), GRAPH, ech.gains.FixedGain([[1.0]], coupling=3.0))
    laws = ech.Laws(ech.laws.TrimInput(), ech.laws.Consensus(gain, feedforward="relay"))
    formation, starts = ech.Formation(np.zeros((3, 1))), start * np.array([[0.0], [1.0], [1.0]])
    parts = ech.Parts(Bent(), GRAPH, formation, laws, starts)
    promise = ech.guarantee(parts, BRIEF)
    assert gain.certificate.region is None and promise.theorem is Theorem.T1
    result = ech.simulate(parts, BRIEF)
    assert extremes(result).shape == (2, 3, 2) and covered(result, promise) is kept


def test_a_run_from_disk_has_its_extremes_and_a_file_without_them_is_refused(tmp_path):
    parts = thrown(parts_of(SLOW, Dragged()), position=-1.2, velocity=0.45)
    result = ech.simulate(parts, BRIEF)
    ech.save_dataset(result, tmp_path / "run.nc")
    again = ech.load(tmp_path / "run.nc", parts)
    np.testing.assert_array_equal(extremes(again), extremes(result))
    assert ech.summary(again)["guarantee"]["covered"] is False
    with h5py.File(tmp_path / "run.nc", "r+") as stored:
        del stored["sums/lowest"]
    old = ech.load(tmp_path / "run.nc", parts)
    np.testing.assert_array_equal(old.states, result.states)
    with pytest.raises(ech.errors.OutputError, match=r"has no sums over all steps.*again\.$"):
        ech.report(old)
