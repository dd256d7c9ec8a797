"""A run from disk is the `Result` that it was, whatever state the run is in."""

import dataclasses
import pickle
import shutil
import warnings

import h5netcdf
import numpy as np
import pandas as pd
import pytest
import xarray as xr
from runs import OWN_PENDULUM

import echelon as ech
from echelon.experiments.results.dataset import run_file
from echelon.experiments.results.recording import recording_of
from echelon.experiments.scenario.build import build
from echelon.output.archive import export as exporting
from echelon.output.archive.chunks import Chunks
from echelon.output.reports.run_report import whole_report
from echelon.output.viewer.charts import charts_of

OWN = """
name: mine
model: {python: "models/swing.py:Pendulum"}
graph: {name: path, agents: 3, leaders: [0]}
leader: {law: passive}
initial: {spread: {angle: 0.5}}
simulation: {horizon: 1.0, dt: 0.01, store_every: 4}
"""
SWITCHING = ["graph.schedule=[{at: 0.5, edges: [[0,1],[0,2],[0,3]]}]", "graph.period=1.0"]
SHORT = ["simulation.horizon=1", "simulation.store_every=20"]


def integrators(*changes):
    return ech.load_scenario("integrators", [*SHORT, *changes])


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run in memory, and its folder."""
    result = ech.run(integrators())
    return result, ech.save_run(result, tmp_path_factory.mktemp("runs") / "one", figures=False)


@pytest.fixture
def own(here):
    """A scenario with a class of the user's."""
    (here / "models").mkdir()
    (here / "models" / "swing.py").write_text(OWN_PENDULUM)
    (here / "mine.yaml").write_text(OWN)
    return ech.load_scenario("mine.yaml")


def killed(scenario, folder, chunks=2):
    """The folder of a run that was killed after some chunks, and what was computed by then."""
    own, stretches = Chunks(folder), []
    own.place.mkdir(exist_ok=True)
    own.begin(scenario)
    parts, settings = build(scenario)

    def stop(so_far):
        if so_far.done > settings.steps * chunks / 5:
            raise KeyboardInterrupt

    result = ech.simulate(parts, settings, stop, stretches.append)
    for stretch in stretches:
        own.write(stretch)
    return result


def assert_same(one, other):
    for field in dataclasses.fields(ech.Result):
        if field.name not in ("parts", "sums"):
            np.testing.assert_equal(getattr(other, field.name), getattr(one, field.name))
    for name, total in one.sums._asdict().items():
        np.testing.assert_array_equal(getattr(other.sums, name), total, err_msg=name)
        assert getattr(other.sums, name).dtype == total.dtype
    for name in ("errors", "formation_errors", "saturated", "chatter", "offsets", "nearest"):
        np.testing.assert_array_equal(getattr(other, name), getattr(one, name), err_msg=name)
    assert other.graph == one.graph and other.formation == one.formation
    assert (other.position, other.unit, repr(other)) == (one.position, one.unit, repr(one))


def test_every_field_and_number_of_a_finished_run_comes_back(run):
    result, folder = run
    assert_same(result, ech.load(folder))
    assert_same(dataclasses.replace(result, wall_time=np.nan), ech.load(copied(folder)))


def copied(folder):
    """The file of a run by itself."""
    return shutil.copy(folder / "run.nc", folder.parent / "alone.nc")


def test_every_function_gives_the_same_for_a_run_from_disk(run):
    result, folder = run
    for other in (ech.load(folder), ech.load(folder / "run.nc")):
        assert ech.report(other) == ech.report(result)
        assert ech.metrics(other) == ech.metrics(result)
        assert ech.summary(other) == ech.summary(result)
        assert ech.dataset(other).identical(ech.dataset(result))
        assert run_file(other) == run_file(result) == (folder / "run.nc").read_bytes()
        pd.testing.assert_frame_equal(ech.table(other), ech.table(result))
        promises = (ech.guarantee(x.parts, x.settings).as_mapping() for x in (other, result))
        assert next(promises) == next(promises)
    runs = (ech.load(folder), result)
    charts = map(charts_of, map(recording_of, runs))
    assert len({whole_report(recording_of(each), "numbers") for each in runs}) == 1
    assert next(charts).descriptions == next(charts).descriptions


@pytest.mark.slow
def test_the_lyapunov_function_of_a_run_from_disk_is_computed_to_the_same_bits(tmp_path):
    result = ech.run(ech.load_scenario("planar-quadrotor", ["simulation.horizon=0.1"]))
    folder = ech.save_run(result, tmp_path / "p", figures=False)
    other = ech.load(folder)
    assert_same(result, other)
    assert_no_group_multiplies(folder / "run.nc")
    inputs = xr.open_dataset(folder / "run.nc", group="inputs", engine="h5netcdf").inputs
    np.testing.assert_array_equal(inputs.sel(agent=2).values, result.inputs[:, 2])
    assert inputs.dims == ("time", "agent", "input")
    assert inputs.input_unit.values.tolist() == list(result.model.input_units)
    for one, two in zip(ech.lyapunov(other), ech.lyapunov(result), strict=True):
        np.testing.assert_array_equal(one, two)


def test_a_run_from_disk_can_be_pickled_and_has_a_short_text(run):
    other = pickle.loads(pickle.dumps(ech.load(run[1])))
    assert_same(run[0], other)
    assert ech.report(other) == ech.report(run[0])
    text = "Result('integrators', 4 agents, 6 frames, 'The run reached its horizon.')"
    assert repr(other) == text
    assert repr(recording_of(other)) == "Recording('integrators', 4 agents, 6 frames)"


def test_a_file_by_itself_is_summarized_saved_and_verified(run, here):
    """Its `summary.json` is lost, and with it how long the run took."""
    alone = ech.load(copied(run[1]))
    assert ech.summary(alone)["wall_time_s"] is None
    again = ech.load(ech.save_run(alone, "again", figures=False))
    assert np.isnan(again.wall_time) and ech.verify(alone).holds


def test_python_is_answered_in_its_own_words(run, here, tmp_path):
    ech.save_run(run[0], "o", figures=False)
    ech.export(run[0], "o.csv")
    for write in (lambda: ech.save_run(run[0], "o"), lambda: ech.export(run[0], "o.csv")):
        with pytest.raises(ech.errors.OutputError, match="choose another, or `force=True` to repl"):
            write()
    with pytest.raises(ech.errors.OutputError, match="`place` is 3, and must be the folder of"):
        ech.load(3)
    with pytest.raises(ech.errors.OutputError, match="`run.xls` ends in `xls`, allowed are `csv`"):
        ech.export(run[0], tmp_path / "run.xls")
    with pytest.raises(ech.errors.OutputError, match="`run` has no ending"):
        ech.export(run[0], tmp_path / "run")


def test_a_run_from_python_is_read_and_its_parts_are_to_be_given(run, tmp_path):
    parts, settings = build(integrators())
    result = ech.simulate(parts, settings)
    folder = ech.save_run(result, tmp_path / "o", figures=False)
    other = ech.load(folder)
    assert set(ech.figures(other)) and len(ech.table(other)) == 24
    assert ech.dataset(other).identical(ech.dataset(result))
    with pytest.raises(ech.errors.OutputError, match="made from parts in Python"):
        ech.report(other)
    assert_same(result, ech.load(folder, parts))
    assert ech.report(ech.load(folder, parts)) == ech.report(result)


@pytest.mark.slow
def test_a_run_of_an_own_class_is_saved_with_its_file_and_read_from_anywhere(own, here):
    result = ech.run(own)
    folder = ech.save_run(result, "o", figures=False)
    shutil.rmtree(here / "models")
    other = ech.load(folder)
    assert_same(result, other)
    assert ech.report(other) == ech.report(result)
    again = ech.run(ech.load_scenario(folder))
    assert run_file(again) == run_file(result)


def test_no_code_is_executed_for_the_frames(own, here):
    result = ech.run(own)
    folder = ech.save_run(result, "o", figures=False)
    (folder / "inputs" / "swing.py").write_text("raise SystemExit('executed')\n")
    other = ech.load(folder)
    assert set(ech.figures(other)) and len(ech.table(other)) == 3 * len(result.times)
    assert ech.dataset(other).identical(ech.dataset(result)) and repr(other) == repr(result)
    assert "The run reached its horizon." in other._repr_html_()
    with pytest.raises(ech.errors.OutputError, match="or were changed"):
        other.parts


@pytest.mark.slow
def test_a_run_from_disk_is_verified_as_its_folder_is(own):
    folder = ech.save_run(ech.run(own), "o", figures=False)
    assert ech.verify(folder).verdict == "incomplete"
    assert ech.verify(folder, scenario=folder).holds and ech.verify(ech.load(folder)).holds
    with h5netcdf.File(folder / "run.nc", "r+") as data:
        data.attrs["guarantee"] = data.attrs["guarantee"].replace("linearization", "vertices")
    assert ech.verify(ech.load(folder)).verdict == "refused"


def test_a_killed_run_is_what_was_computed_also_of_its_continuation(tmp_path):
    result = killed(integrators(), tmp_path)
    other = ech.load(tmp_path)
    assert other.outcome is ech.Outcome.STOPPED and 1 < len(other.times) < 6
    for name in ("times", "states", "inputs", "saturated"):
        np.testing.assert_array_equal(getattr(other, name), getattr(result, name))
    assert ech.metrics(other) == ech.metrics(result)
    assert "of 1 s" in ech.report(other) and set(ech.figures(other)) and len(ech.table(other))
    assert run_file(other)


def test_a_run_that_was_stopped_continued_and_killed_is_the_longer_part(tmp_path):
    short = killed(integrators(), tmp_path, 1)
    (tmp_path / "run.nc").write_bytes(run_file(short))
    assert ech.load(tmp_path).outcome is ech.Outcome.INTERRUPTED
    longer = killed(integrators(), tmp_path, 3)
    np.testing.assert_array_equal(ech.load(tmp_path).states, longer.states)


def test_a_run_that_has_just_begun_has_no_frame(tmp_path):
    (tmp_path / "chunks").mkdir()
    Chunks(tmp_path).begin(integrators())
    result = ech.load(tmp_path)
    assert len(result.times) == 0 and ech.figures(result) == {} and ech.table(result).empty


@pytest.mark.parametrize("changes", [[], SWITCHING], ids=["path", "switching"])
def test_no_group_has_more_dimensions_than_one_of_its_variables(tmp_path, changes):
    ech.save_dataset(ech.run(integrators(*changes)), tmp_path / "run.nc")
    assert_no_group_multiplies(tmp_path / "run.nc")


def assert_no_group_multiplies(file):
    with h5netcdf.File(file, "r") as stored:
        groups = [stored, *stored.groups.values(), *stored["sums"].groups.values()]
        for group in groups:
            overs = [set(each.dimensions) for each in group.variables.values()]
            assert not overs or max(overs, key=len) == set().union(*overs), group.name
    frame = xr.open_dataset(file, engine="h5netcdf").to_dataframe()
    assert len(frame) == np.prod(ech.load(file).states.shape)


def test_a_file_that_was_written_from_a_dataset_has_all_but_the_sums(run, here):
    ech.save_dataset(ech.dataset(run[0]), "data.nc")
    result = ech.load("data.nc")
    assert ech.dataset(result).identical(ech.dataset(run[0]))
    pd.testing.assert_frame_equal(ech.table(result), ech.table(run[0]))
    with pytest.raises(ech.errors.OutputError, match="has no sums over all steps"):
        ech.report(result)


def test_a_table_has_a_row_for_each_agent_and_time_with_units(run):
    result, _ = run
    frame = ech.table(result, every=2)
    assert list(frame.columns[:4]) == ["time", "agent", "leader", "x"]
    assert len(frame) == 3 * 4 and frame.attrs["units"]["x"] == "m"
    assert frame.attrs["units"]["formation_error"] == "m" and frame.attrs["units"]["time"] == "s"
    rows = frame[frame.agent == 3]
    np.testing.assert_array_equal(rows.x, result.states[::2, 3, 0])
    np.testing.assert_array_equal(rows.formation_error, result.formation_errors[::2, 3])


def test_a_table_that_does_not_fit_is_refused_with_its_size_before_errors_are_computed(run):
    huge = dataclasses.replace(
        recording_of(run[0]), times=np.arange(3.0), states=np.broadcast_to(0.0, (3, 2**40, 3))
    )
    with pytest.raises(ech.errors.OutputError, match=r"3298534883328 rows of 10 columns need 2.4"):
        ech.table(huge)
    for every in (0, 2.5):
        with pytest.raises(ech.errors.OutputError, match=f"`every` is {every}, and must be"):
            ech.table(run[0], every=every)
    shape = 10**9, *run[0].states.shape[1:]
    huge = {name: np.broadcast_to(0.0, shape) for name in ("states", "inputs")}
    large = dataclasses.replace(run[0], times=np.broadcast_to(0.0, shape[:1]), **huge)
    with pytest.raises(ech.errors.OutputError, match="the table is too large: .* with `every`"):
        ech.table(large)


@pytest.mark.parametrize("kind", sorted({*exporting._WRITERS} - {"parquet"}))
def test_a_run_is_exported_by_the_ending_of_its_file(run, tmp_path, kind):
    file = tmp_path / f"run.{kind}"
    assert ech.export(run[0], file) == file
    with pytest.raises(ech.errors.OutputError, match="exists; choose another"):
        ech.export(run[0], file)
    assert ech.export(ech.load(run[1]), file, force=True).stat().st_size > 500
    if kind == "nc":
        assert_same(dataclasses.replace(run[0], wall_time=np.nan), alone(file))


def alone(file):
    """A run whose file is not in the folder of a run."""
    return ech.load(file.rename(file.with_name("moved.nc")))


@pytest.mark.parametrize(
    "function", [ech.metrics, ech.report, ech.summary, ech.dataset, ech.figures, ech.table]
)
def test_the_name_of_a_folder_is_no_result(function):
    with pytest.raises(ech.EchelonError, match="`result` is a `str`, and must be a `Result`"):
        function("folder")


BAD = {
    "nothing": "does not exist",
    "empty": "holds no run: it has no `run.nc`",
    "half": "cannot be read as a run: it is damaged",
    "text": "cannot be read as a run",
    "other": "cannot be read as a run: it is damaged, or was not written by echelon",
    "sweep": "is a sweep, which holds numbers of many runs",
    "comparison": "is a comparison; give one of its runs",
    "older": "has format 3, of echelon 0.2.0, and this version reads format 5; run it again by "
    "`echelon run FOLDER --out OTHER`.",
    "begun": "ended before any of it was stored",
}


def test_what_is_no_run_is_refused_in_one_sentence(run, here):
    for each in BAD:
        (here / each).mkdir(exist_ok=each != "nothing")
    (here / "nothing").rmdir()
    (here / "begun" / "chunks").mkdir()
    content = (run[1] / "run.nc").read_bytes()
    (here / "half" / "run.nc").write_bytes(content[: len(content) // 2])
    (here / "text" / "run.nc").write_text("times,states\n")
    (here / "sweep" / "sweep.nc").write_bytes(b"")
    (here / "comparison" / "comparison.json").write_text("{}")
    xr.Dataset({"a": ("x", [1.0])}).to_netcdf(here / "other" / "run.nc", engine="h5netcdf")
    shutil.copy(run[1] / "run.nc", here / "older" / "run.nc")
    with h5netcdf.File(here / "older" / "run.nc", "r+") as old:
        old.attrs["format"] = np.atleast_1d(3)
    for name, words in BAD.items():
        with warnings.catch_warnings(), pytest.raises(ech.errors.OutputError) as refusal:
            warnings.simplefilter("error")
            ech.load(name)
        text = str(refusal.value)
        assert words in text and "\n" not in text and text.endswith(".")
