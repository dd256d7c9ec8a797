"""Paths in files: waypoints and Crazyswarm2's polynomials, read, written, and refused by line."""

import json
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from ruamel.yaml import YAML

import echelon as ech
from echelon.agents.models.chains import chains_of
from echelon.agents.references import FigureEight, Polynomials, Waypoints
from echelon.agents.references.flatness import reference_warnings
from echelon.core.numerics import precision
from echelon.guarantees.stopping.path_bounds import path_fault

TIMES = np.array([0.0, 1.0, 2.5, 4.0])
POINTS = np.array([[0.0, 0.0, 1.0], [1.0, -0.5, 1.5], [2.0, 0.5, 1.0], [2.0, 0.0, 0.5]])
YAWS = np.array([0.0, 90.0, 90.0, -45.0])
HEAD = ",".join(["duration", *(f"{name}^{k}" for name in ("x", "y", "z", "yaw") for k in range(8))])


def at(path, times, order=0):
    """The path and its derivatives (T, order + 1, 4)."""
    with precision("float64"):
        both = jax.vmap(lambda t: path.derivatives(t, order, ("x", "y", "z", "yaw")))
        return np.asarray(both(jnp.asarray(times)))


def write_points(folder, order=("yaw", "t", "z", "x", "y")):
    columns = dict(zip("txyz", np.column_stack([TIMES, POINTS]).T, strict=True)) | {"yaw": YAWS}
    rows = np.column_stack([columns[name] for name in order]).tolist()
    text = "\n".join([", ".join(order), *(",".join(map(repr, row)) for row in rows), ""])
    (folder / "path.csv").write_text("\ufeff" + text, "utf-8")
    return folder / "path.csv"


@pytest.mark.slow
def test_each_yaw_is_passed_on_time_and_is_as_smooth_as_the_place(tmp_path):
    path = Waypoints.read(write_points(tmp_path), degrees=True)
    assert at(path, TIMES)[:, 0] == pytest.approx(np.column_stack([POINTS, np.radians(YAWS)]))
    before, after = at(path, TIMES[1:-1] - 1e-9, 6), at(path, TIMES[1:-1] + 1e-9, 6)
    size = 1.0 + np.abs(after).max(axis=2, keepdims=True)
    assert (np.abs(before - after) / size).max() <= 1e-6
    assert np.abs(at(path, TIMES[[0, -1]], 3)[:, 1:]).max() < 1e-9
    # The same numbers as the same points in Python.
    same = Waypoints(TIMES, POINTS, np.radians(YAWS))
    assert (at(same, [0.7, 3.0]) == at(path, [0.7, 3.0])).all()
    # A proof that needs four derivatives of place and heading has them.
    assert path_fault(path, chains_of(ech.models.Quadrotor()), 10.0) == ""
    assert path.turns(ech.models.Quadrotor()) and not Waypoints(TIMES, POINTS).turns(
        ech.models.Quadrotor()
    )


def test_pieces_are_written_and_read_back_exactly(tmp_path):
    path = Waypoints(TIMES, POINTS, YAWS / 60.0)
    (tmp_path / "pieces.csv").write_text(Polynomials.of(path, 9.0).text(), "utf-8")
    again = Polynomials.read(tmp_path / "pieces.csv")
    times = np.linspace(0.0, 6.0, 41)
    assert at(again, times, 3) == pytest.approx(at(path, times, 3), abs=1e-9)
    assert again.joined == 3
    # From the time 0 on alone, as the vehicle's clock.
    late, early = (Waypoints(TIMES + shift, POINTS) for shift in (2.0, -1.7))
    for moved in (late, early):
        pieces = Polynomials.of(moved, 9.0)
        assert pieces.knots[0] == 0.0 and pieces.joined == 3
        assert at(pieces, times, 2) == pytest.approx(at(moved, times, 2), abs=1e-9)


def test_a_smooth_path_becomes_pieces_within_a_tenth_of_a_millimetre():
    path, times = FigureEight(), np.linspace(0.0, 8.0, 201)
    pieces = Polynomials.of(path, 8.0)
    assert np.abs(at(pieces, times) - at(path, times)).max() < 1e-4
    assert len(pieces.knots) - 1 < 32
    above = pieces.moved(np.array([1.0, 0.0, -0.5, 0.1]))
    assert at(above, times) - at(pieces, times) == pytest.approx(
        np.tile([1.0, 0.0, -0.5, 0.1], (201, 1, 1))
    )


def digits(path, count):
    """The text of pieces with so many digits after the point, as other programs write it."""
    head, *rows = Polynomials.of(path, 9.0).text().splitlines()
    short = [",".join(f"{float(x):.{count}f}" for x in row.split(",")) for row in rows]
    return "\n".join([f"# {head.capitalize()},", *(f"{row}," for row in short), ""])


def test_the_few_digits_of_a_file_do_not_let_pieces_jump(tmp_path):
    file = tmp_path / "rounded.csv"
    file.write_text(digits(Waypoints(TIMES, POINTS), 6), "utf-8")
    path, quadrotor = Polynomials.read(file), chains_of(ech.models.Quadrotor())
    assert path.joined == 3 and path_fault(path, quadrotor, 10.0) == ""
    before, after = at(path, path.knots[1:] - 1e-12, 3), at(path, path.knots[1:] + 1e-12, 3)
    assert np.abs(before - after).max() < 1e-8
    assert np.abs(at(path, TIMES) - at(Waypoints(TIMES, POINTS), TIMES)).max() < 1e-4


def test_pieces_that_do_not_meet_smoothly_fly_without_a_proof():
    # x = t, then at rest: the velocity jumps.
    powers = np.zeros((2, 4, 8))
    powers[0, 0, 1], powers[1, 0, 0] = 1.0, 1.0
    path = Polynomials([1.0, 1.0], powers)
    assert path.joined == 0 and at(path, [0.5, 1.5])[:, 0, 0].tolist() == [0.5, 1.0]
    fault = path_fault(path, chains_of(ech.models.DoubleIntegrator(1)), 3.0)
    assert "its parts meet with 0 continuous derivatives, and 1 are needed" in fault


GOOD = "t,x,y,z,yaw\n0,0,0,1,0\n1,1,0,1,0\n"
FAULTS = [
    ("t,x,z,yaw\n0,0,0,0\n", ":1` lacks `y`: it names `t`, `x`, `z`, `yaw`, separated by commas"),
    ("t,x,x,y\n0,0,0,0\n1,0,0,0\n", ":1` has `x`, `x` for `x`, and must have one column"),
    (GOOD + "2,a lot,0,1,0\n", "`x` of the path at `{}:4` is `a lot`"),
    (GOOD + "\n2,0,0,nan,0\n", "`z` of the path at `{}:5` is `nan`"),
    (GOOD + "2,0,0\n", ":4` has 3 numbers, separated by commas, and must have 5."),
    (GOOD + "1,0,0,1,0\n", "`t` of the path at `{}:4` is 1 s, and must be more"),
    ("", "the path `{}` has no line of numbers."),
    (
        "a;b\n0;0\n",
        "`a`, `b`, separated by semicolons; needed are `t`, `x`, `y` (`z`, `yaw` may be",
    ),
    ("t,x,y,z\n0,0,0,1\n", "must have from 2 to 100000 lines of numbers, and has 1."),
    ("t,x\0", "path"),
    ("t,x,y,z\n" + "0,0,0,1\n" * 100_001, "and has more than 100000."),
    (None, "path.csv` cannot be read: No such file"),
]


@pytest.mark.parametrize(("text", "said"), FAULTS, ids=range(len(FAULTS)))
def test_a_wrong_line_is_named(tmp_path, text, said):
    if text is not None:
        (tmp_path / "path.csv").write_text(text, "utf-8")
    with pytest.raises(ech.errors.ReferenceError) as error:
        Waypoints.read(tmp_path / "path.csv")
    assert said.format(tmp_path / "path.csv") in str(error.value)
    assert str(error.value).count("\n") == 0


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        (["0," + "0," * 31 + "0"], ":2` lasts 0 s, and must last a positive time"),
        (["1,1," + "0," * 30 + "0", "1," * 32 + "1"], ":3` begins 1.41 m and 1 rad from the end"),
    ],
)
def test_a_wrong_piece_is_named(tmp_path, rows, said):
    file = tmp_path / "pieces.csv"
    file.write_text("\n".join([HEAD, *rows]), "utf-8")
    with pytest.raises(ech.errors.ReferenceError, match="the piece of the path at .*" + said):
        Polynomials.read(file)


SCENARIO = {
    "name": "timed",
    "model": {"name": "double-integrator", "parameters": {"dimension": 3}},
    "graph": {"name": "path", "agents": 2},
    "reference": {"name": "waypoints", "file": "path.csv", "degrees": True},
    "simulation": {"horizon": 6.0, "dt": 0.01},
}
OFFSET = "formation.offsets={1: [1, 0.5, 0]}"


def written(folder, **changes):
    file = folder / "timed.yaml"
    file.write_text(json.dumps(SCENARIO | changes), "utf-8")
    return file


def test_a_scenario_flies_the_points_of_its_file(tmp_path):
    write_points(tmp_path)
    parts, settings = ech.build(ech.load_scenario(written(tmp_path)))
    path = parts.drive.leader.reference
    assert at(path, TIMES)[:, 0, 3] == pytest.approx(np.radians(YAWS))
    assert not parts.drive.leader.reference.remarks()
    # 90 rad are meant as degrees; the run says so.
    radians = SCENARIO["reference"] | {"degrees": False}
    parts, settings = ech.build(ech.load_scenario(written(tmp_path, reference=radians)))
    [remark, *_] = parts.drive.warnings(parts.model, parts.graph, settings)
    assert "path.csv` reaches 90 rad, more than a turn" in remark


def test_a_run_folder_contains_the_file_of_its_path(tmp_path, echelon):
    source = write_points(tmp_path)
    file = written(tmp_path, simulation={"horizon": 0.1, "dt": 0.01})
    code, _, _ = echelon("run", file, "--out", tmp_path / "run", "--no-figures")
    assert code == 0
    before = at(ech.build(ech.load_scenario(file)).parts.drive.leader.reference, [0.7, 3.0])
    source.unlink()
    again = ech.build(ech.load_scenario(tmp_path / "run")).parts.drive.leader.reference
    assert (at(again, [0.7, 3.0]) == before).all()


@pytest.mark.slow
def test_verify_computes_the_guarantee_from_the_path_in_the_folder(tmp_path, echelon):
    write_points(tmp_path)
    # The guarantee of a linear agent does not depend on its leader's path.
    planar = {"name": "planar-quadrotor"}
    file = written(tmp_path, model=planar, simulation={"horizon": 2.0, "dt": 0.01})
    assert echelon("run", file, "--out", tmp_path / "run", "--no-figures")[0] == 0
    assert echelon("verify", tmp_path / "run")[0] == 0
    path = tmp_path / "run" / "inputs" / "path.csv"
    path.write_text(path.read_text("utf-8").replace("-0.5", "-0.9"), "utf-8")
    code, said, _ = echelon("verify", tmp_path / "run")
    assert code == 1 and "Refused" in said


def test_all_paths_are_written_with_the_file_of_crazyswarm2_that_lists_them(tmp_path, echelon):
    write_points(tmp_path)
    file, out = written(tmp_path), tmp_path / "swarm"
    code, said, _ = echelon("path", file, "--set", OFFSET, "--all", "--out", out)
    assert code == 0 and f"Written to {out}: 2 paths of 3 pieces, 4 s." in said
    robots = YAML(typ="safe").load(out / "crazyflies.yaml")["robots"]
    begins = [at(Polynomials.read(out / f"{name}.csv"), [0.0])[0, 0] for name in robots]
    assert [*robots] == ["agent0", "agent1"] and begins[1] - begins[0] == pytest.approx(
        [1, 0.5, 0, 0]
    )
    for robot, begin in zip(robots.values(), begins, strict=True):
        assert robot["initial_position"] == pytest.approx([*begin[:2], 0.0], abs=1e-4)
    assert len({robot["uri"] for robot in robots.values()}) == 2
    code, _, errors = echelon("path", file, "--all", "--out", out)
    assert code == 2 and "is not empty" in errors
    code, _, errors = echelon("path", file, "--all", "--agent", 1, "--out", tmp_path / "two")
    assert code == 2 and "`--all` writes the goals of all agents; leave out `--agent`." in errors


def test_the_command_writes_the_leaders_path_and_a_followers_goal(tmp_path, echelon):
    write_points(tmp_path)
    file, out, one = written(tmp_path), tmp_path / "leader.csv", tmp_path / "one.csv"
    code, said, _ = echelon("path", file, "--out", out)
    assert code == 0 and "3 pieces" in said and "4 s" in said
    own = ech.build(ech.load_scenario(file)).parts.drive.leader.reference
    assert at(Polynomials.read(out), TIMES, 2) == pytest.approx(at(own, TIMES, 2), abs=1e-9)
    assert echelon("path", file, "--set", OFFSET, "--agent", 1, "--out", one)[0] == 0
    shift = at(Polynomials.read(one), TIMES)[:, 0] - at(own, TIMES)[:, 0]
    assert shift == pytest.approx(np.tile([1.0, 0.5, 0.0, 0.0], (4, 1)))
    assert echelon("path", file, "--out", out)[0] == 2
    code, _, errors = echelon("path", file, "--agent", 7, "--out", tmp_path / "no.csv")
    assert code == 2 and "agents are numbered from 0 to 1" in errors
    written_pieces = {"reference": {"name": "polynomials", "file": "leader.csv"}}
    parts, _ = ech.build(ech.load_scenario(written(tmp_path, **written_pieces)))
    assert at(parts.drive.leader.reference, [1.3]) == pytest.approx(at(own, [1.3]), abs=1e-9)


def test_a_misspelt_key_beside_a_file_is_named_with_the_right_one(tmp_path):
    write_points(tmp_path)
    wrong = {"name": "waypoints", "file": "path.csv", "degres": 1}
    with pytest.raises(ech.EchelonError, match="did you mean `degrees`"):
        ech.build(ech.load_scenario(written(tmp_path, reference=wrong)))


def test_the_time_at_which_a_path_exceeds_a_limit_is_named():
    fast = Waypoints([0.0, 1.0, 2.0], [[0.0, 0.0, 1.0], [0.0, 0.0, 4.0], [0.0, 0.0, 1.0]])
    quadrotor, times = ech.models.Quadrotor.crazyflie(), np.linspace(0.0, 3.0, 3001)
    thrust, *_, tilt = reference_warnings(quadrotor, fast, 3.0)
    assert "`Waypoints` is too fast for `Quadrotor`: at t = " in thrust
    # The thrust would point downwards where the path falls faster than freely.
    falls = at(fast, times, 2)[:, 2, 2]
    said = re.search(r"at t = (.*) s `z''` is (.*), and must be above -9.81", tilt)
    assert float(said[1]) == pytest.approx(times[falls.argmin()], abs=0.01)
    assert float(said[2]) == pytest.approx(falls.min(), rel=1e-2) and falls.min() < -9.81
