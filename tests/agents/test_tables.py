"""Forms of tables, as people have them: each is read right, or refused with what was seen."""

import math
import time

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
    "dates of two zones": (
        "t,x,y\n2024-05-01T12:00:00+02:00,0,0\n2024-05-01T10:00:02.5Z,1.5,.25",
        PLANAR,
    ),
    "dates with blanks": (
        "t,x,y\n2024-05-01 12:00:00,0,0\n2024-05-01 12:00:02.500,1.5,.25",
        PLANAR,
    ),
    "microseconds": ("Time [\u00b5s],x,y\n0,0,0\n2500000,1.5,.25", PLANAR),
    "nanoseconds": ("t_ns,x,y\n0,0,0\n2500000000,1.5,.25", PLANAR),
    "hours": ("Time (hours);x;y\n0;0;0\n0,000694444444444;1,5;0,25", PLANAR),
    "seconds and nanoseconds": (
        "sec,nanosec,x,y\n0,500000000,0,0\n3,0,1.5,.25",
        (3.0, *PLANAR[1:]),
    ),
    "a stamp in two columns": (
        "header.stamp.sec,header.stamp.nanosec,pose.pose.position.x,pose.pose.position.y\n"
        "1700000000,900000000,0,0\n1700000003,400000000,1.5,.25",
        PLANAR,
    ),
    # Programs.
    "rostopic of a pose in a frame": (
        "%time,field.header.seq,field.header.stamp,field.header.frame_id,field.pose.position.x,"
        "field.pose.position.y,field.pose.position.z\n"
        f"{STAMP}000000000,1,{STAMP}000000000,map,.5,-1.25,1\n"
        f"{STAMP + 2}500000000,2,{STAMP + 2}500000000,map,1.5,.25,2",
        END,
    ),
    "a stamp of ROS alone": (
        "field.header.stamp,field.pose.position.x,field.pose.position.y\n"
        f"{STAMP}000000000,0,0\n{STAMP + 2}500000000,1.5,.25",
        PLANAR,
    ),
    "a log of a Crazyflie": (
        "timestamp,stateEstimate.x,stateEstimate.y,stateEstimate.z\n0,.5,-1.25,1\n2500,1.5,.25,2",
        END,
    ),
    "a log of a Crazyflie in seconds": (
        "timestamp,stateEstimate.x,stateEstimate.y\n0.0,0,0\n2.5,1.5,.25",
        PLANAR,
    ),
    "TUM": (
        f"# timestamp tx ty tz\n{STAMP}.0 0 0 1\n{STAMP + 2}.5 1.5 .25 2",
        END,
    ),
    "EuRoC": (
        "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w []\n"
        f"{STAMP}000000000,0,0,1,1\n{STAMP + 2}500000000,1.5,.25,2,1",
        END,
    ),
    "a marker of Vicon with its time": ("Time,X,Y,Z\ns,mm,mm,mm\n0,0,0,0\n2.5,1500,250,2000", END),
    "pandas with two levels": ("cf1,cf1,cf1\nt,x,y\n0,0,0\n2.5,1.5,.25", PLANAR),
    "pandas with a second x": ("t,x,y,x.1\n0,0,0,5\n2.5,1.5,.25,5", PLANAR),
    "numbers of MATLAB, names given": (
        "   0.0000000e+00   5.0e-01  -1.2e+00\n   2.5000000e+00   1.5e+00   2.5e-01",
        PLANAR,
        {"columns": ("t", "x", "y")},
    ),
    "names given with units": (
        "0,0,0\n2500,1500,250",
        PLANAR,
        {"columns": ("t [ms]", "x [mm]", "y [mm]")},
    ),
    "names given for some": ("7,0,0,0\n7,2.5,1.5,.25", PLANAR, {"columns": ("", "t", "x", "y")}),
    # More characters and lines.
    "a first line after a semicolon": ("; recorded\nt,x,y\n0,0,0\n2.5,1.5,.25", PLANAR),
    "comments behind two strokes": ("t,x,y\n0,0,0 // begin\n2.5,1.5,.25 // end", PLANAR),
    "comments of all kinds": ("% a\n// b\nt,x,y\n# c\n0,0,0\n% d\n2.5,1.5,.25\n// e", PLANAR),
    "three delimiters at each end": ("t,x,y,,,\n0,0,0,,,\n2.5,1.5,.25,,,", PLANAR),
    "blanks around commas": ("t   ,  x  ,  y\n0   ,  0  ,  0\n2.5 ,  1.5,  .25", PLANAR),
    "blanks that do not break": ("t\u00a0[s];x\u00a0[mm];y\u00a0[mm]\n0;0;0\n2,5;1500;250", PLANAR),
    "units without blanks": (
        "t[s];x[mm];y[mm];yaw[\u00b0]\n0;0;0;0\n2,5;1500;250;90",
        (*PLANAR[:4], TURN),
    ),
    "units of a second line in parentheses": ("t,x,y\n(s),(mm),(mm)\n0,0,0\n2.5,1500,250", PLANAR),
    "UTF-16, the larger byte first": (
        b"\xfe\xff" + "t\tx\ty\n0\t0\t0\n2.5\t1.5\t.25".encode("utf-16-be"),
        PLANAR,
    ),
    "a byte order mark, quotes and lines of Windows": (
        '\ufeff"t","x","y"\r\n"0","0","0"\r\n"2.5","1.5","0.25"\r\n',
        PLANAR,
    ),
    "a quote within a note": ('t,x,y,note\n0,0,0,a "b\n2.5,1.5,.25,c', PLANAR),
    "plus signs": ("t,x,y\n+0,+0,+0\n+2.5,+1.5,+.25", PLANAR),
    "three decimals": ("t;x;y\n0,000;1,500;0,250\n2,500;1,500;0,250", PLANAR),
    "the time of two names": ("time,t,x,y\n9,0,0,0\n10,2.5,1.5,.25", PLANAR),
    "psi in degrees": ("t,x,y,psi_deg\n0,0,0,0\n2.5,1.5,.25,90", (*PLANAR[:4], TURN)),
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
    "two letters for one name": ("Time,time,x,y\n0,0,0,0\n1,1,1,1", "has `Time`, `time` for `t`"),
    "thousands between tabs": (
        "t\tx\ty\n0\t1,000\t0\n1\t2,000\t0",
        "has `1,000`, which may be 1000 or 1.000",
    ),
    "European thousands": (
        "t;x;y\n0;1.000,5;0\n1;2.000,5;0",
        "`x` of the path at `{}:2` is `1.000,5`",
    ),
    "thousands after blanks": ("t;x;y\n0;1 000,5;0\n1;2 000,5;0", ":2` is `1 000,5`"),
    "Swiss thousands": ("t;x;y\n0;1'000.5;0\n1;2'000.5;0", ":2` is `1'000.5`"),
    "hexadecimal": ("t,x,y\n0,0x10,0\n1,0x20,0", "`x` of the path at `{}:2` is `0x10`"),
    "an exponent of Fortran": ("t,x,y\n0,0,0\n1,1.5D0,0", ":3` is `1.5D0`"),
    "digits of another script": ("t,x,y\n0,0,0\n\uff11,1,1", ":3` is `\uff11`"),
    "a unit behind each number": (
        "t,x,y\n0 s,0 m,0 m\n1 s,1 m,1 m",
        "`t` of the path at `{}:2` is `0 s`",
    ),
    "null": ("t,x,y\n0,0,0\n1,null,0", ":3` is `null`"),
    "an error of a spreadsheet": ("t,x,y\n0,0,0\n1,#N/A,0", ":3` is `#N/A`"),
    "infinity": ("t,x,y\n0,0,0\n1,inf,0", ":3` is `inf`"),
    "a negative number in parentheses": ("t,x,y\n0,0,0\n1,(1.5),0", ":3` is `(1.5)`"),
    "a clock": ("time,x,y\n12:00:00.0,0,0\n12:00:02.5,1,1", ":2` is `12:00:00.0`"),
    "a date of the USA": (
        "time,x,y\n5/1/2024 12:00:00,0,0\n5/1/2024 12:00:03,1,1",
        "is `5/1/2024 12:00:00`",
    ),
    "a date of Germany": (
        "time;x;y\n01.05.2024 12:00;0;0\n01.05.2024 13:00;1;1",
        "is `01.05.2024 12:00`",
    ),
    "equal times": (
        "t,x,y\n0,0,0\n0,1,1",
        "`t` of the path at `{}:3` is 0 s, and must be more than the 0 s",
    ),
    "blocks": (
        "t,x,y\n0,0,0\n1,1,1\n\n\n0,2,2\n1,3,3",
        "`t` of the path at `{}:6` is 0 s, and must be",
    ),
    "a header that repeats": ("t,x,y\n0,0,0\nt,x,y\n1,1,1", "`t` of the path at `{}:3` is `t`"),
    "another delimiter in the header": (
        "t;x;y\n0,0,0\n1,1,1\n2,2,2",
        "names `t;x;y`, separated by commas",
    ),
    "Markdown": (
        "| t | x | y |\n|---|---|---|\n| 0 | 0 | 0 |\n| 1 | 1 | 1 |",
        "at `{}:2` is `---`",
    ),
    "JSON": ('[{"t":0,"x":0,"y":0},{"t":1,"x":1,"y":1}]', "lacks `t`, `x`, `y`"),
    "UTF-16 without its mark": ("t,x,y\n0,0,0\n1,1,1".encode("utf-16-be"), "is not a text file."),
    "trajectories of Vicon": (
        "Trajectories\n100\n,,cf1,,\nFrame,Sub Frame,X,Y,Z\n,,mm,mm,mm\n1,0,0,0,0",
        "names `Trajectories`",
    ),
    "an export of Motive": (
        "Format Version,1.23\n\nFrame,Time (Seconds),X,Y,Z\n0,0,0,1,0\n1,1,0,1,0",
        "has `Format Version`: it is an export of Motive, whose y axis may point up",
    ),
    "a log of PX4": (
        "timestamp,ref_lat,x,y,z,xy_valid\n1000000,47,0,0,-1,1\n3500000,47,1,0,-2,1",
        "has `xy_valid`: it is a log of PX4, whose axes point north, east and down",
    ),
    "a log of ArduPilot": (
        "TimeUS,Lat,Lng,Alt\n0,47,8,400\n1,47,8,401",
        "lacks `t`: it names `TimeUS`, `Lat`",
    ),
    "poses of KITTI": (
        "1 0 0 0 0 1 0 0 0 0 1 0\n" * 2,
        "has 12 columns of numbers, separated by blanks",
    ),
    "a receiver without a fix": (
        "t,lat,lon\n0,0,0\n1,47.1,8.1",
        "`lat` and `lon` of the path at `{}:2` are 0",
    ),
    "a latitude with its hemisphere": ("t,lat,lon\n0,47.1N,8.1E\n1,47.2N,8.1E", ":2` is `47.1N`"),
    "places on a grid": (
        "t,easting,northing\n0,465000,5248000\n1,465001,5248000",
        "lacks `x`, `y`: it names",
    ),
    "axes of north and down": (
        "t,x_ned,y_ned,z_ned\n0,0,0,0\n1,1,0,-1",
        "lacks `x`, `y`: it names `t`, `x_ned`",
    ),
    "a frame, and no time": ("frame,x,y\n0,0,0\n1,1,1", "lacks `t`: it names `frame`"),
    "arc minutes": (
        "t,x,y,yaw [arcmin]\n0,0,0,0\n1,1,1,1",
        "the unit of `yaw` of the path at `{}:1` is `arcmin`",
    ),
    "a comment after %": (
        "t,x,y\n0,0,0 % begin\n1,1,1",
        "`y` of the path at `{}:2` is `0 % begin`",
    ),
    "a quote that does not end": ('t,x,y\n0,"0,0\n1,1,1', ":2` has 2 numbers, separated by commas"),
    "a date where a place is": ("t,x,y\n0,0,2024-05-01 12:00\n1,1,1", "`y` of the path at `{}:2`"),
}  # fmt: skip


def test_there_are_sixty_forms_and_more():
    assert len(READ) >= 60 and len(REFUSED) >= 40


@pytest.mark.skipif(not hasattr(time, "tzset"), reason="its clock has the zone of the machine")
def test_dates_without_a_zone_do_not_depend_on_the_clock_of_the_machine(tmp_path, monkeypatch):
    # In the night in which Berlin's clocks go from 2 to 3 h.
    rows = "time,x,y\n2024-03-31T01:59:58,0,0\n2024-03-31T03:00:00.5,1,1"
    for zone in ("Europe/Berlin", "Asia/Kolkata"):
        monkeypatch.setenv("TZ", zone)
        time.tzset()
        assert read_points(written(tmp_path, rows)).times[-1] == pytest.approx(3602.5)
    monkeypatch.undo()
    time.tzset()


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
    rows = "".join(f"\n{20 * k},{k},0" for k in range(40))
    [note] = read_points(written(tmp_path, "timestamp,x,y" + rows)).notes
    assert "mostly 20 s apart; if its times have another unit, state it" in note
    assert read_points(written(tmp_path, "timestamp [s],x,y" + rows)).notes == ()
    turned = "timestamp tx ty tz qx qy qz qw\n0 0 0 1 0 0 0 1\n1 1 0 1 0 0 0 1"
    [note] = read_points(written(tmp_path, turned)).notes
    assert "has `qw`, which is not read: the yaw is 0" in note
    [note] = read_points(written(tmp_path, "t,x,y\n0,0,0\n1,1,1"), spatial=True).notes
    assert "has no column `z`, which is 0." in note
