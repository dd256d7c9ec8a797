"""Output of the command line for people and for programs, and the folder that `init` writes."""

import csv
import dataclasses
import json
import os
import pickle
import re
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from oracles import rotation
from PIL import Image
from recordings import as_file, flown, separated
from runs import made_up

import echelon as ech
from echelon.apps.cli import list_command
from echelon.apps.cli.list_command import names_and_keys
from echelon.core.errors import MissingExtraError, OutputError
from echelon.experiments.results.labelled import Labelled
from echelon.experiments.results.metrics import Ellipsoid
from echelon.experiments.results.recording import read_recording, recording_of
from echelon.experiments.scenario.registry import families
from echelon.experiments.scenario.scenario import key_meanings
from echelon.output.archive.export import export, table
from echelon.output.plots import style as draw
from echelon.output.plots import video
from echelon.output.reports.glossary import explain_term, glossary


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("stored") / "run.nc"
    run = dataclasses.replace(flown(seconds=1.0, rate=25.0), bounds=None)
    path.write_bytes(as_file(run))
    return path


@pytest.fixture(scope="module")
def run(file):
    return read_recording(file)[0]


@pytest.fixture(scope="module")
def backup():
    """Carts whose leader is lost after 1 s, and the first follower leads on."""
    cart, graph = ech.models.DoubleIntegrator(), ech.Graph([(0, 1), (1, 2)])
    laws = ech.Laws(
        ech.laws.StoppingLeader(reference=ech.references.Circle(radius=2.0, rate=0.7)),
        ech.laws.StoppingPoint(),
    )
    places = ech.Formation.from_offsets(cart, graph, {1: [1.0, 0.0], 2: [2.0, 0.0]})
    parts = ech.Parts(
        cart, graph, places, laws, {"position": 0.5},
        events=[ech.network.Lose(0, 1.0)], leadership=ech.Leadership((1,)),
    )  # fmt: skip
    return ech.simulate(parts, ech.Settings(horizon=2.0, dt=0.02))


def test_only_what_a_file_holds_as_it_is_is_written_without_xarray():
    for variables, attributes in (
        ({"a": ("x", [True, False])}, {}),
        ({}, {"a": ["one", "two"]}),
        ({}, {"a": True}),
    ):
        with pytest.raises(AssertionError, match="`a` has type"):
            Labelled(variables, {}, attributes).netcdf()


@pytest.fixture
def frames(monkeypatch):
    """In place of pyarrow, which takes 170 MB: pandas pickles the frame that it would write."""
    import pandas as pd

    def to_parquet(frame, path, index):
        assert not index
        path.write(pickle.dumps(frame))

    monkeypatch.setattr(pd.DataFrame, "to_parquet", to_parquet)


@pytest.mark.usefixtures("frames")
@pytest.mark.parametrize("kind", ["csv", "parquet", "npz", "mat"])
def test_other_programs_read_the_very_numbers(echelon, here, file, run, kind):
    code, told, _ = echelon("export", file, "--to", kind)
    assert code == 0 and told.startswith(f"- Written to run.{kind}: ")
    read = READERS[kind](here / f"run.{kind}")
    for k, name in enumerate(("x", "vz", "yaw")):
        place = run.state_names.index(name)
        np.testing.assert_array_equal(read(name, place), run.states[:, :, place], err_msg=str(k))
    code, _, fault = echelon("export", file, "--to", kind)
    assert code == 2 and "exists; choose another, or `--force`" in fault


def read_csv(path):
    rows = list(csv.DictReader(path.read_text().splitlines()))
    return lambda name, _: np.array([float(row[name]) for row in rows]).reshape(-1, 4)


def read_parquet(path):
    frame = pickle.loads(path.read_bytes())
    return lambda name, _: frame[name].to_numpy().reshape(-1, 4)


def read_npz(path):
    with np.load(path) as data:
        states, names = data["states"], data["state_names"].tolist()
    return lambda name, _: states[:, :, names.index(name)]


def read_mat(path):
    from scipy.io import loadmat

    data = loadmat(path, squeeze_me=True)
    names = [str(name) for name in data["state_names"]]
    return lambda name, _: data["states"][:, :, names.index(name)]


READERS = {"csv": read_csv, "parquet": read_parquet, "npz": read_npz, "mat": read_mat}


def test_a_row_is_of_an_agent_at_a_time(run):
    rows = table(run)
    assert len(rows) == run.states.shape[0] * 4
    row = rows[(rows.agent == 2) & (rows.time == run.times[7])]
    assert float(row.formation_error.iloc[0]) == run.formation_errors[7, 2]
    assert rows[rows.leader].agent.unique().tolist() == [0]


def test_an_agent_that_is_absent_has_no_rows_and_a_backup_leader_is_the_leader(backup):
    rows = table(backup)
    assert rows[rows.time < 1.0].agent.unique().tolist() == [0, 1, 2]
    late = rows[rows.time > 1.5]
    assert late.agent.unique().tolist() == [1, 2]
    assert late[late.leader].agent.unique().tolist() == [1]


def test_a_run_has_the_poles_of_its_own_loop_or_none(backup):
    # Under `stopping-point` the loop of the promise has zeros where the law places roots.
    assert recording_of(backup).modes is None


def test_a_run_without_frames_is_exported_to_no_file(here, run):
    empty = {name: getattr(run, name)[:0] for name in ("times", "states", "inputs")}
    for kind in ("csv", "npz", "html"):
        with pytest.raises(OutputError, match="^the run has no stored frame; an export needs at"):
            export(dataclasses.replace(run, **empty), here / f"run.{kind}")
    assert not list(here.glob("run.*"))


def test_parquet_names_the_extra_that_it_needs(echelon, file, monkeypatch):
    for name in ("pyarrow", "fastparquet"):
        monkeypatch.setitem(sys.modules, name, None)
    assert echelon("export", file, "--to", "parquet")[::2] == (
        4,
        "echelon: Parquet needs pyarrow, which is not installed; `pip install '.[parquet]'` in "
        "echelon's clone, or use `csv`.\n",
    )


def test_the_report_has_numbers_conditions_scenario_versions_and_how_to_cite(echelon, here):
    short = ("--set", "simulation.horizon=1", "--no-figures")
    echelon("run", "integrators", "--out", "first", *short)
    code, text, _ = echelon("report", "first")
    assert code == 0 and (here / "first" / "report.txt").read_text() in text
    assert "\n- leaders agree: not needed; there is one\n" in text
    assert "\nname: integrators\n" in text and f"\nechelon {ech.__version__}" in text
    assert "@inproceedings{enwerem2023consensus," in text
    assert max(map(len, text.splitlines())) <= 100
    told = echelon("report", "first", "--out", "whole.txt")[1]
    assert told.startswith("- Written to whole.txt: ") and (here / "whole.txt").read_text() == text
    pages = ("export", "first", "--out", "a.html"), ("view", "first", "--html", "b.html")
    assert [echelon(*words)[0] for words in pages] == [0, 0]
    assert (here / "a.html").read_bytes() == (here / "b.html").read_bytes()
    code, _, fault = echelon("report", "first", "--out", "whole.txt")
    assert code == 2 and "the file `whole.txt` exists; choose another" in fault


def test_the_report_of_a_file_by_itself_has_what_the_file_has(echelon, file, run):
    text = echelon("report", file)[1]
    assert f"- The run reached its horizon.\n{ech.guarantee_text(run.guarantee)}\n" in text
    assert "Conditions" not in text and "Scenario" not in text and "@software{echelon," in text


def test_a_video_has_the_size_rate_and_part_that_are_asked_for(echelon, here, file, ffmpeg):
    assert echelon("video", file, "run.mp4", "--speed", "5")[1].startswith(
        "- Written to run.mp4: 6 pictures, "
    )
    assert told_of("run.mp4") == ("960x540", 25.0, 6)
    options = ("--size", "400x300", "--fps", "10", "--from", "0.2", "--to", "0.6", "--force")
    code, told, _ = echelon("video", file, "run.mp4", *options)
    assert code == 0 and told.startswith("- Written to run.mp4: 5 pictures, ")
    assert told_of("run.mp4") == ("400x300", 10.0, 5)


FFMPEG = f"""#!{sys.executable}
import sys
words, pixels = sys.argv[1:], sys.stdin.buffer.read()
open(words[-1], "w").write(" ".join([*words, str(len(pixels))]))
"""
"""Writes what it was given: the options, and the number of bytes of all pictures."""


@pytest.fixture
def ffmpeg(tmp_path_factory, monkeypatch):
    """In place of ffmpeg, which a machine need not have."""
    program = tmp_path_factory.mktemp("bin") / "ffmpeg"
    program.write_text(FFMPEG)
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(program.parent), prepend=os.pathsep)


def told_of(name):
    *words, received = Path(name).read_text().split()
    size, rate = words[words.index("-s") + 1], float(words[words.index("-framerate") + 1])
    width, height = map(int, size.split("x"))
    return size, rate, int(received) / (4 * width * height)


def test_a_gif_needs_no_ffmpeg_and_is_small(here, monkeypatch):
    monkeypatch.setattr(video, "encoder", None)
    kept = flown(seconds=1.0, rate=12.0)
    assert video.save_video(kept, here / "run.gif") == 13
    assert (here / "run.gif").stat().st_size < 0.2e6
    with Image.open(here / "run.gif") as picture:
        assert (picture.size, picture.n_frames, picture.info["duration"]) == ((640, 360), 13, 80)


def test_a_failure_of_ffmpeg_is_a_sentence(here, run, monkeypatch):
    monkeypatch.setattr(video, "encoder", lambda: "false")
    with pytest.raises(OutputError, match="^ffmpeg failed: "):
        video.save_video(run, here / "run.mp4", 10.0)
    assert not list(here.iterdir())


def film_of(run):
    return video.Film(run, 0.5625, run.times[[0, -1]])


def test_a_picture_names_the_closest_pair_and_warns_of_those_that_touch(run):
    for radius, warns in ((None, False), (1e3, True)):
        film = film_of(dataclasses.replace(run, radius=radius))
        (text,) = [t for t in film.figure.texts if t.get_text().startswith("smallest distance ")]
        closest = run.closest_pair()
        assert "{} and {} at".format(*closest.agents) in text.get_text()
        assert (text.get_color() == draw.COLOURS[1]) == warns


def test_a_video_of_agents_that_keep_apart_has_their_distance_its_limits_and_rows():
    run = separated(flown(seconds=2.5, rate=20.0))
    film = film_of(run)
    titles = [ax.get_title(loc="left") for ax in film.figure.axes]
    near = film.figure.axes[titles.index("smallest scaled distance (m), active rows")]
    assert {"kept", "touching"} == {text.get_text() for text in near.texts}
    line, *limits = [each.get_xydata() for each in near.get_lines()]
    steps = np.floor(run.times + 1e-9)
    np.testing.assert_allclose(line[:, 1], 0.3 + 0.1 * steps)
    assert [float(each[0, 1]) for each in limits[:2]] == [0.3, 0.25]
    (text,) = [t for t in film.figure.texts if t.get_text().startswith("smallest scaled distance ")]
    assert text.get_color() == draw.COLOURS[1]
    film.show(2.0)
    # An outline of 25 points and a gap for each agent, by how near another is.
    assert sum(np.shape(line.get_data_3d())[1] for line in film.shells) == 4 * 26


def test_an_ellipsoid_tells_who_is_too_near():
    sizes = Ellipsoid(0.125, 0.375, 0.3)
    places = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.7], [0.28, 0.0, 0.7], [5.0, 0.0, 0.0]])
    # Scaled: .233 m overlapping, .28 m below the limit, .364 m, and far away.
    assert sizes.too_near(places, ("x", "y", "z")).tolist() == [2.0, 2.0, 1.0, 0.0]
    assert sizes.too_near(places[:, ::2], ("x", "z")).tolist() == [2.0, 2.0, 1.0, 0.0]
    places[1] = np.nan
    assert sizes.too_near(places, ("x", "y", "z")).tolist() == [0.0] * 4


def test_a_picture_has_agents_links_goals_and_cursors_at_its_time(run):
    film = film_of(run)
    first, second = run.times[10:12]
    film.show(0.25 * first + 0.75 * second)
    now, goals = (
        0.25 * values[0] + 0.75 * values[1]
        for values in (run.states[10:12, :, :3], run.goals([10, 11])[:, :, :3])
    )
    for agent, trail in zip((0, 1, 2, 3), ("black", *draw.COLOURS[:3]), strict=True):
        # The last point is a gap.
        np.testing.assert_allclose(points_of(film.trails[trail])[-2], now[agent])
        angles = 0.25 * run.states[10, agent, 6:9] + 0.75 * run.states[11, agent, 6:9]
        front = now[agent] + 0.34 * film.size * rotation(angles) @ [1.0, 1.0, 0.0]
        rotor = points_of(film.bodies[trail])[1:25].mean(axis=0)
        np.testing.assert_allclose(rotor, front, atol=1e-9)
    links = points_of(film.links).reshape(-1, 3, 3)[:, :2]
    np.testing.assert_allclose(links, now[run.edges])
    rings = points_of(film.goals).reshape(3, 26, 3)[:, :24].mean(axis=1)
    np.testing.assert_allclose(rings, goals[1:])
    assert [line.get_xdata()[0] for line in film.cursors] == [0.25 * first + 0.75 * second] * 2
    ax = film.figure.axes[0]
    limits = np.array([ax.get_xlim(), ax.get_ylim(), ax.get_zlim()])
    assert (now > limits[:, 0]).all() and (now < limits[:, 1]).all()


def points_of(line):
    return np.column_stack(line.get_data_3d() if hasattr(line, "get_data_3d") else line.get_data())


def test_a_backup_leader_is_drawn_as_the_leader_that_it_is(backup):
    film = film_of(recording_of(backup))
    for time, leads in ((0.5, [0]), (1.5, [1])):
        film.show(time)
        assert np.flatnonzero(film.leaders(time)).tolist() == leads
        shown = points_of(film.bodies[draw.LEADER])
        (shown,) = shown[np.isfinite(shown[:, 0])]
        np.testing.assert_allclose(shown, film.run.states[round(time / 0.02), leads[0], :2])


def test_without_ffmpeg_a_sentence_says_how_to_get_it(monkeypatch):
    monkeypatch.setattr(shutil, "which", lambda name: None)
    monkeypatch.setitem(__import__("sys").modules, "imageio_ffmpeg", None)
    with pytest.raises(MissingExtraError, match="an MP4 needs ffmpeg, and none is on the PATH"):
        video.encoder()


@pytest.mark.usefixtures("ffmpeg")
def test_a_video_that_cannot_be_is_refused(echelon, file):
    for words, sentence in (
        ("run.mp4 --speed 0", "`--speed` is 0, and must be from 0.01 to 100."),
        ("run.mp4 --fps 0", "`--fps` is 0, and must be from 1 to 60."),
        (
            "run.mp4 --size 401x300",
            "`--size` is `401x300`, and must be even numbers of pixels as in `960x540`, 320 to "
            "3840 across and a third to 1.5 of that high.",
        ),
        (
            "run.mp4 --from 3",
            "nothing lies between 3 and 1 s; the run is stored from 0 to 1 s.",
        ),
        ("none/run.mp4", "`none` is not a folder; create it first to write `none/run.mp4`."),
    ):
        assert echelon("video", file, *words.split())[::2] == (2, f"echelon: {sentence}\n")


def test_a_starter_names_the_extra_that_its_notebook_needs(echelon, monkeypatch):
    monkeypatch.setattr(list_command, "find_spec", lambda name: None)
    told = echelon("init", "my-swarm")[1]
    assert "The notebook needs JupyterLab: in echelon's clone, pip install '.[notebook]'\n" in told


@pytest.mark.slow
def test_all_that_init_writes_runs(echelon, here, monkeypatch):
    assert echelon("init", "my-swarm")[0] == 0
    monkeypatch.chdir(here / "my-swarm")
    short = ("--set", "simulation.horizon=2", "--no-figures")
    assert echelon("run", "scenario.yaml", "--out", "first", *short)[0] == 0
    own = 'follower={law: {python: "law.py:Spring", stiffness: 2.0}}'
    assert echelon("run", "scenario.yaml", "--out", "second", "--set", own, *short)[0] == 0
    assert json.loads((here / "my-swarm/first/summary.json").read_text())["scenario"] == "my-swarm"
    book = json.loads((here / "my-swarm" / "tour.ipynb").read_text())
    code = ["".join(cell["source"]) for cell in book["cells"] if cell["cell_type"] == "code"]
    exec("\n".join(code), {})  # noqa: S102 - the notebook's own cells


def test_init_takes_a_new_folder_and_no_other(echelon, here):
    (here / "full").mkdir()
    (here / "full" / "mine.txt").write_text("mine")
    code, _, fault = echelon("init", "full")
    assert code == 2 and fault == (
        "echelon: `full` exists and is not empty; choose another name.\n"
    )
    code, _, fault = echelon("init", "my swarm")
    assert code == 2 and "`my swarm` cannot name a scenario" in fault
    assert not (here / "my swarm").exists()


def test_explain_says_what_a_word_means(echelon):
    code, told, _ = echelon("explain", "Gain Margin")
    assert code == 0 and "between which every mode decays" in " ".join(told.split())
    code, told, _ = echelon("explain", "margin", "--json")
    assert {"gain margin", "delay margin"} <= {name.lower() for name in json.loads(told)}
    code, _, fault = echelon("explain", "gain marign")
    assert code == 2 and "(did you mean `gain margin`?)" in fault
    code, told, _ = echelon("explain")
    assert code == 0 and len(told.splitlines()) > 20


WORDS = {
    **dict.fromkeys(
        "actuator age agreement angle bursts certified collision coupling delay directed "
        "disturbance diverged domain error feedforward follower formation gain graph guaranteed "
        "horizon input jitter lag law leader limit linearization loss message mismatch mode motor "
        "network noise offset outage parent plant radio rate reference relay saturated saturation "
        "seed sensing settled speed step switching symmetry tube V wind".split(),
        "",
    ),
    "chain": "integrators",
    "ellipsoid": "keep apart",
    "exact arithmetic": "fractions",
    "float32": "digits",
    "integral action": "constant",
    "Jacobian": "derivatives",
    "SDP": "matrix",
    "zeta": "stopping point",
    "active rows": "pairs",
    "coupling edge": "above which every mode",
    "eigenvalue": "lambda_max",
    "fastest": "largest magnitude",
    "feed-forward": "leader's input",
    "gust": "pushes agents",
    "input range": "beyond the trim input",
    "lyapunov function": "squares of all deviations",
    "metric": "P",
    "observed": "not a proof",
    "row sum": "zero",
    "seconds": "computing time",
    "steady window": "last seconds",
    "trim": "x* and input u*",
    "worst F": "largest error",
}
"""Words of messages and tables, in the words of those who ask, and what an answer says."""


def test_every_word_of_a_message_is_explained():
    terms = names_and_keys()
    texts = {word: " ".join(explain_term(word, terms).values()) for word in WORDS}
    assert [word for word, says in WORDS.items() if says not in texts[word]] == []


def test_the_term_itself_comes_before_keys_and_only_whole_words_match():
    terms = names_and_keys()
    assert next(iter(explain_term("coupling", terms))) == "coupling"
    assert "saturated" not in explain_term("rate", terms)
    assert "geometric" not in explain_term("metric", terms)


def test_messages_use_no_word_of_the_field_that_is_not_tried_here():
    """What the messages say of radios, wind and collisions stands in the list above."""
    text = (Path(__file__).parents[1] / "sentences.txt").read_text("utf-8").lower()
    field = set(
        re.findall(r"\b(?:radio|wind|noise|delay|jitter|loss|collision|outage|mismatch)\b", text)
    )
    assert field and field <= set(WORDS)


def test_every_key_and_name_of_a_scenario_is_explained():
    terms = glossary(names_and_keys())
    for path, text in key_meanings().items():
        assert terms[path] and text, path
        for term in (path, path.rpartition(".")[2]):
            assert path in explain_term(term, terms)
    for names in families().values():
        assert names.keys() <= terms.keys()


def test_quiet_prints_nothing_and_does_the_same(echelon, here, file):
    assert echelon("-q", "export", file) == (0, "", "")
    assert (here / "run.csv").is_file()
    code, told, fault = echelon("-q", "export", file)
    assert code == 2 and told == "" and fault


def test_a_result_is_a_table_in_a_notebook_with_its_pictures():
    model, graph = ech.models.SingleIntegrator(dimension=1), ech.Graph.path(3)
    states = np.array([[[0.0], [2.0], [4.0]], [[0.0], [0.5], [0.25]]])
    page = made_up(states, model, graph)._repr_html_()
    assert page.count("<tr>") == 4 and page.count('src="data:image/png;base64,') == 2
    assert "<td>follower 1</td><td>2</td><td>0.5</td>" in page
    assert "<td>leader 0</td><td></td><td></td>" in page
    assert repr(made_up(states, model, graph)).startswith("Result(3 agents, 2 frames, ")


def test_of_a_flock_a_notebook_shows_the_best_the_median_and_the_worst():
    model, graph = ech.models.SingleIntegrator(dimension=1), ech.Graph.path(30)
    away = np.arange(30.0)[:, None]
    page = made_up(np.stack([away, 3.0 * away]), model, graph)._repr_html_()
    assert page.count("<tr>") == 5 and "<td>worst (follower 29)</td><td>29</td><td>87</td>" in page
    assert "<td>best (follower 1)</td>" in page and "<td>median (follower 15)</td>" in page
    assert "<li>" not in made_up(np.stack([away, away]), model, graph)._repr_html_()
