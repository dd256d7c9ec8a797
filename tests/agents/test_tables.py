"""Sixty forms of tables, as people have them: each is read right, or refused with what was seen."""

import math

import numpy as np
import pytest

import echelon as ech
from echelon.agents.references.path_file import read_points

START, END = (0.0, 0.5, -1.25, 1.0, 0.0), (2.5, 1.5, 0.25, 2.0, 0.0)
"""(t, x, y, z, yaw) of the two rows that most forms have."""
PLANAR = (2.5, 1.5, 0.25, 0.0, 0.0)
TURN = math.radians(90.0)
ROWS = "0,0.5,-1.25,1\n2.5,1.5,0.25,2\n"
STAMP = 1_700_000_000


def stamps(unit, name="t"):
    """Unix time stamps in a unit, as whole numbers."""
    rows = [
        f"{(STAMP + t) * unit:.{1 if unit == 1 else 0}f},{x},{y},{z}"
        for t, x, y, z, _ in (START, END)
    ]
    return "\n".join([f"{name},x,y,z", *rows])


READ = {
    # Ten that were refused, or read wrong, by an earlier version.
    "a comment first and between": ("# recorded\nt,x,y,z\n0,0,0,0\n# gap\n2.5,1.5,.25,2", END),
    "semicolons and decimal commas": ("t;x;y;z\n0,0;0,5;-1,25;1,0\n2,5;1,5;0,25;2,0", END),
    "a light show": (
        "Time [msec],x [m],y [m],z [m],Red,Green,Blue\n0,0.5,-1.25,1,0,0,0\n2500,1.5,.25,2,9,9,9",
        END,
    ),
    "more columns": ("t,x,y,z,vx,vy,vz\n0,0,0,1,0,0,0\n2.5,1.5,0.25,2,9,9,9", END),
    "no header, names given": (ROWS, END, {"columns": ("t", "x", "y", "z")}),
    "x and y alone": ("t,x,y\n0,0,0\n2.5,1.5,0.25", PLANAR),
    "semicolons": ("t;x;y;z\n0;0;0;1\n2.5;1.5;0.25;2", END),
    "tabs": ("t\tx\ty\tz\n0\t0\t0\t1\n2.5\t1.5\t0.25\t2", END),
    "units in the header": ("t [s],x [m],y [m],z [m]\n" + ROWS, END),
    "a yaw that is wrapped": (
        "t,x,y,z,yaw\n0,0,0,1,3.1\n2.5,1.5,.25,2,-3.0",
        (*END[:4], 2.0 * math.pi - 3.0),
    ),
    # Delimiters.
    "blanks": ("t x y z\n0 0.5 -1.25 1\n2.5 1.5 0.25 2", END),
    "runs of blanks": ("  t     x    y    z\n  0.0  0.5  -1.25  1\n  2.5  1.5   0.25  2", END),
    "commas and blanks": ("t, x, y, z\n0, 0.5, -1.25, 1\n2.5, 1.5, 0.25, 2", END),
    "bars": ("t|x|y|z\n0|0.5|-1.25|1\n2.5|1.5|0.25|2", END),
    "tabs and decimal commas": ("t\tx\ty\tz\n0\t0,5\t-1,25\t1\n2,5\t1,5\t0,25\t2", END),
    "blanks and decimal commas": ("t x y z\n0,0 0,5 -1,25 1,0\n2,5 1,5 0,25 2,0", END),
    "the delimiter of a spreadsheet": ("sep=;\nt;x;y;z\n0;0;0;1\n2,5;1,5;0,25;2", END),
    "a comma at each end": ("t,x,y,z,\n0,0.5,-1.25,1,\n2.5,1.5,0.25,2,", END),
    "a comma at the end of rows": ("t,x,y,z\n0,0.5,-1.25,1,\n2.5,1.5,0.25,2,", END),
    "quotes": ('"t","x","y","z"\n"0","0","0","1"\n"2.5","1.5","0.25","2"', END),
    "quoted decimal commas": ('t,x,y,z\n"0","0,5","-1,25","1"\n"2,5","1,5","0,25","2"', END),
    "a quoted note with commas": ('t,x,y,z,note\n0,0,0,1,"a, b"\n2.5,1.5,0.25,2,"c"', END),
    # Headers.
    "capitals": ("T,X,Y,Z\n" + ROWS, END),
    "another order": ("z,yaw,y,x,t\n1,0,0,0,0\n2,0,0.25,1.5,2.5", END),
    "a commented header": ("# t x y z\n0 0.5 -1.25 1\n2.5 1.5 0.25 2", END),
    "a header after %": ("%time,x,y,z\n0,0,0,1\n2.5,1.5,0.25,2", END),
    "units after the name": ("time_ms,x_mm,y_cm,z_m\n0,0,0,1\n2500,1500,25,2", END),
    "units in parentheses": ("t (ms),x(mm),y (cm),z(m)\n0,0,0,1\n2500,1500,25,2", END),
    "units after a stroke": ("t/s,x/mm,y/mm,z/m\n0,0,0,1\n2.5,1500,250,2", END),
    "units in a second line": ("t;x;y;z\ns;mm;mm;mm\n0;0;0;0\n2.5;1500;250;2000", END),
    "units with blanks": ("t [s] x [mm] y [mm] z [m]\n0 0 0 1\n2.5 1500 250 2", END),
    "degrees in the header": ("t,x,y,z,yaw [deg]\n0,0,0,1,0\n2.5,1.5,.25,2,90", (*END[:4], TURN)),
    "degrees by the scenario": (
        "t,x,y,z,yaw\n0,0,0,1,0\n2.5,1.5,.25,2,90",
        (*END[:4], TURN),
        {"degrees": True},
    ),
    "both say degrees": (
        "t,x,y,z,yaw_deg\n0,0,0,1,0\n2.5,1.5,.25,2,90",
        (*END[:4], TURN),
        {"degrees": True},
    ),
    "names of a pose": ("timestamp,pos_x,pos_y,pos_z\n" + ROWS, END),
    "names of a message": (
        "%time,field.id,pose.position.x,pose.position.y,pose.position.z\n0,7,0,0,1\n2.5,7,1.5,.25,2",
        END,
    ),
    "a ground robot's theta": ("t,x,y,theta\n0,0,0,0\n2.5,1.5,0.25,0.5", (*PLANAR[:4], 0.5)),
    "lines before the header": ("Recorder 3, site A\nDate: today\nt,x,y,z\n" + ROWS, END),
    "a commented header of commas": ("#stamp [s], p_RS_R_x, p_RS_R_y\n0,0,0\n2.5,1.5,.25", PLANAR),
    "an index without a name": (",t,x,y,z\n0,0,0,0,1\n1,2.5,1.5,0.25,2", END),
    "text beside the numbers": ("mode,t,x,y,z\nidle,0,0,0,1\nfly,2.5,1.5,0.25,2", END),
    "names given instead": ("a,b,c,d\n" + ROWS, END, {"columns": ("t", "x", "y", "z")}),
    # Lines, characters, numbers.
    "lines of Windows": (("t,x,y,z\n" + ROWS).replace("\n", "\r\n"), END),
    "lines of an old Mac": (("t,x,y,z\n" + ROWS).replace("\n", "\r"), END),
    "a byte order mark": ("\ufefft,x,y,z\n" + ROWS, END),
    "cp1252": (
        "# H\u00f6he\nt,x,y,z,yaw [\u00b0]\n0,0,0,1,0\n2.5,1.5,.25,2,90".encode("cp1252"),
        (*END[:4], TURN),
    ),
    "UTF-16": (("t\tx\ty\tz\n" + ROWS.replace(",", "\t")).encode("utf-16"), END),
    "empty lines": ("\n\nt,x,y,z\n\n0,0,0,1\n\n\n2.5,1.5,0.25,2\n\n", END),
    "lines of delimiters alone": ("t,x,y,z\n0,0,0,1\n,,,\n2.5,1.5,0.25,2\n,,,", END),
    "a comment behind numbers": ("t,x,y,z\n0,0,0,1 # begin\n2.5,1.5,0.25,2 # end", END),
    "exponents": ("t,x,y,z\n0,0,0,1\n2.5e0,+1.5E+00,25e-2,2.", END),
    "a printed minus": ("t,x,y,z\n0,0,0,1\n2.5,1.5,0.25,\u22122", (*END[:3], -2.0, 0.0)),
    # Times.
    "Unix time": (stamps(1), END),
    "Unix time in ms": (stamps(1000), END),
    "Unix time in ns": (stamps(1e9), END),
    "Unix time in ms, as its header says": (stamps(1000, "t [ms]"), END),
    "dates": ("time,x,y,z\n2024-05-01T12:00:00Z,0,0,1\n2024-05-01T12:00:02.500Z,1.5,.25,2", END),
    "a beginning by the scenario": (
        "t,x,y,z\n512,0,0,1\n514.5,1.5,0.25,2",
        (3.5, *END[1:]),
        {"begin": 1.0},
    ),
}  # fmt: skip
REFUSED = {
    "an underscore in a number": ("t,x,y,z\n0,0,0,1\n2,1_0,0,1", ":3` is `1_0`, and must be a"),
    "no header": (ROWS, ":1` has 4 columns of numbers, separated by commas, without names"),
    "a column is missing": ("t;x;z\n0;0;1\n1;1;1", ":1` lacks `y`: it names `t`, `x`, `z`, sep"),
    "decimal commas between commas": ("t,x,y\n0,0,0,5,1,0\n2,5,1,5,0,0", ":2` has 6 numbers, sep"),
    "points and commas": ("t;x;y\n0;0;1.5\n1;1,5;0", "`1.5` in line 2 and `1,5` in line 3"),
    "thousands": ('t,x,y\n0,"1,000",0\n1,"2,000",0', "`x` of the path at `{}:2` is `1,000`"),
    "a gap in the numbers": ("t,x,y\n0,0,0\n1,,0", "`x` of the path at `{}:3` is empty"),
    "not a number": ("t,x,y\n0,0,0\n1,nan,0", "`x` of the path at `{}:3` is `nan`"),
    "a unit of something else": ("t [m],x,y\n0,0,0\n1,1,1", "`t` of the path at `{}:1` is `m`"),
    "an unknown unit": ("t,x [furlong],y\n0,0,0\n1,1,1", "is `furlong`, and must be one such as"),
    "a column twice": ("t,x,x,y\n0,0,1,0\n1,1,1,1", "has `x`, `x` for `x`"),
    "time that goes back": ("t,x,y\n0,0,0\n2,1,1\n1,1,1", "`t` of the path at `{}:4` is 1 s, and"),
    "a line too short": ("t,x,y\n0,0,0\n1,1", ":3` has 2 numbers, separated by commas, and must"),
    "one line": ("t,x,y\n0,0,0", "must have from 2 to 100000 lines of numbers, and has 1."),
    "too few names": (ROWS, "`columns` has 2 names, and the path at `{}:1`", {"columns": "tx"}),
    "no text": (b"t,x\x00y\n", "is not a text file."),
    "a date where a place is": ("t,x,y\n0,0,2024-05-01 12:00\n1,1,1", "`y` of the path at `{}:2`"),
}  # fmt: skip


def test_there_are_sixty_forms_and_more():
    assert len(READ) + len(REFUSED) >= 60


def written(folder, content):
    file = folder / "path.csv"
    file.write_bytes(content if isinstance(content, bytes) else content.encode())
    return file


@pytest.mark.parametrize("form", READ)
def test_a_form_is_read(tmp_path, form):
    content, expected, *options = READ[form]
    times, values, _ = read_points(written(tmp_path, content), **dict(*options))
    # Unix time has 1e-7 s in float64.
    assert (times[-1], *values[-1]) == pytest.approx(expected, abs=1e-6)
    assert len(times) == 2 and times[-1] - times[0] == pytest.approx(2.5, abs=1e-6)


@pytest.mark.parametrize("form", REFUSED)
def test_a_form_is_refused_with_what_was_seen(tmp_path, form):
    content, said, *options = REFUSED[form]
    file = written(tmp_path, content)
    with pytest.raises(ech.errors.ReferenceError) as error:
        read_points(file, **dict(*options))
    assert said.format(file) in str(error.value) and str(file) in str(error.value)
    assert "\n" not in str(error.value)


def test_what_is_taken_for_granted_is_said(tmp_path):
    for content, said in (
        (stamps(1000), "are taken as Unix time stamps in ms, and counted from the first."),
        ("t,x,y,yaw\n0,0,0,3.1\n1,1,0,-3", ":3` jumps by -6.1 rad; it is taken as wrapped"),
        ("t,x,y,yaw\n0,0,0,0\n1,1,0,90", "reaches 90 rad, more than a turn; if it is in degrees"),
    ):
        [note] = read_points(written(tmp_path, content)).notes
        assert said in note
    # As somebody writes a turn, and as the header says.
    for content in ("t,x,y,yaw [deg]\n0,0,0,180\n1,1,0,-180", "t,x,y,yaw_deg\n0,0,0,0\n1,0,0,720"):
        rows = read_points(written(tmp_path, content))
        assert rows.notes == () and abs(np.ptp(rows.values[:, 3])) >= 2.0 * math.pi
    lost = np.delete(np.arange(0.0, 10.0, 0.1), slice(40, 55))
    text = "t,x,y\n" + "".join(f"{t},{t},0\n" for t in lost)
    [note] = read_points(written(tmp_path, text)).notes
    assert "has a gap of 1.6 s after line 41, where points are mostly 0.1 s apart" in note
    turned = "timestamp tx ty tz qx qy qz qw\n0 0 0 1 0 0 0 1\n1 1 0 1 0 0 0 1"
    [note] = read_points(written(tmp_path, turned)).notes
    assert "has `qw`, which is not read: the yaw is 0" in note
    [note] = read_points(written(tmp_path, "t,x,y\n0,0,0\n1,1,1"), spatial=True).notes
    assert "has no column `z`, which is 0." in note
