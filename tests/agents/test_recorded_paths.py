"""Paths as recorders write them: ends that move, noise, places on the Earth, times of their own."""

import json
import math

import numpy as np
import pytest

import echelon as ech
from echelon.agents.references import Waypoints
from echelon.agents.references.flatness import reference_warnings

TIMES = np.arange(0.0, 2.01, 0.02)
STRAIGHT = np.stack([0.5 * TIMES, 0.0 * TIMES, 1.0 + 0.0 * TIMES], axis=1)


def value(path, t, order=0):
    """A derivative (3,) of the place, by NumPy's polynomials."""
    k = min(np.searchsorted(path.knots, t, "right") - 1, len(path.knots) - 2)
    pieces = (np.poly1d(path.coefficients[:, k, axis]) for axis in range(3))
    return np.array(
        [np.polyder(p, order)(t - path.knots[k]) if order else p(t - path.knots[k]) for p in pieces]
    )


def test_a_path_with_free_ends_moves_there():
    path = Waypoints(TIMES, STRAIGHT, ends="free")
    for t in (0.0, 0.013, 1.1, 2.0):
        assert value(path, t) == pytest.approx([0.5 * t, 0.0, 1.0], abs=1e-9)
        assert value(path, t, 1) == pytest.approx([0.5, 0.0, 0.0], abs=1e-6)
    # Few points have the polynomial through them.
    assert value(Waypoints([0, 2], [[0, 0, 0], [1, 2, 3]], ends="free"), 0.5) == pytest.approx(
        [0.25, 0.5, 0.75]
    )
    three = Waypoints([0, 1, 3], [[0, 0, 1], [1, 0, 1], [9, 0, 1]], ends="free")
    assert value(three, 2.0) == pytest.approx([4.0, 0.0, 1.0])
    # The spline of least square of the fourth derivative: none of its derivatives 4 to 6 at an end.
    bent = Waypoints(TIMES[:20], np.stack([np.sin(3.0 * TIMES[:20])] * 3, axis=1), ends="free")
    assert np.abs(value(bent, 0.0, 4)).max() < 1e-6 * np.abs(value(bent, 0.2, 4)).max()


def test_the_sentence_names_what_forces_the_motion():
    quadrotor = ech.models.Quadrotor.crazyflie()
    [first, *_] = reference_warnings(quadrotor, Waypoints(TIMES, STRAIGHT), 2.0)
    assert "; the path rests at both ends, and with `ends: free` it needs " in first
    assert float(first.partition("`ends: free` it needs ")[2].split()[0]) < 1e-3
    assert reference_warnings(quadrotor, Waypoints(TIMES, STRAIGHT, ends="free"), 2.0) == ()
    noise = 0.004 * np.random.default_rng(1).normal(size=STRAIGHT.shape)
    [first, *_] = reference_warnings(
        quadrotor, Waypoints(TIMES, STRAIGHT + noise, ends="free"), 2.0
    )
    assert "; the path passes through each point, and with `smooth: 0.0" in first


@pytest.mark.parametrize("ends", ["free", "rest"])
def test_a_smooth_path_stays_within_its_tolerance_of_all_points(ends):
    t = np.arange(0.0, 20.0, 0.1)
    # At rest at both ends, so that both kinds suit it.
    turn = math.pi * (1.0 - np.cos(math.pi * t / t[-1]))
    circle = np.stack([np.cos(turn), np.sin(turn), 1.0 + 0.0 * t], axis=1)
    noisy = circle + 0.01 * np.random.default_rng(0).normal(size=circle.shape)
    path = Waypoints(t, noisy, ends=ends, smooth=0.05)
    off = [np.linalg.norm(value(path, s) - p) for s, p in zip(t, noisy, strict=True)]
    assert max(off) <= 0.05 * (1.0 + 1e-9) and len(path.knots) < 12
    # Nearer to the truth than the points are, as least squares are.
    true = [np.linalg.norm(value(path, s) - p) for s, p in zip(t, circle, strict=True)]
    assert np.sqrt(np.mean(np.square(true))) < 0.01
    speeds = [np.linalg.norm(value(path, s, 1)) for s in (t[0], t[-1])]
    assert bool(max(speeds) < 1e-9) is (ends == "rest")
    for order in range(7):
        sides = [value(path, path.knots[1] + s, order) for s in (-1e-9, 1e-9)]
        assert sides[0] == pytest.approx(sides[1], abs=1e-5)


def test_points_are_resampled_on_straight_lines():
    path = Waypoints([0, 1, 4], [[0, 0, 0], [1, 0, 0], [1, 3, 0]], resample=0.5)
    assert path.knots == pytest.approx(np.arange(0.0, 4.1, 0.5))
    assert value(path, 2.5) == pytest.approx([1.0, 1.5, 0.0])


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"ends": "loose"}, "`ends` of `Waypoints` is `loose`, allowed are `rest`, `free`"),
        ({"smooth": 0}, "`smooth` of `Waypoints` is 0, and must be a positive number."),
        ({"resample": math.inf}, "`resample` of `Waypoints` is inf, and must be"),
        ({"smooth": 1e-9}, "`smooth` is 1e-09 m, and no smooth curve stays within it"),
        ({"smooth": 0.1, "resample": 1.0}, "and it needs 16 or more points, and there are 3;"),
    ],
)  # fmt: skip
def test_a_wrong_option_is_refused(options, said):
    noise = np.random.default_rng(0).normal(size=STRAIGHT.shape)
    with pytest.raises(ech.errors.ReferenceError, match=said):
        Waypoints(TIMES, noise, **options)


# ---- on the Earth --------------------------------------------------------------------------------

PLACE = (47.3977, 8.5456, 488.0)


def radii(lat):
    """The radii of curvature (m) of WGS 84 north and east, by their textbook formulas."""
    a, f = 6378137.0, 1.0 / 298.257223563
    e2, s2 = f * (2.0 - f), math.sin(math.radians(lat)) ** 2
    return a * (1.0 - e2) / (1.0 - e2 * s2) ** 1.5, a / math.sqrt(1.0 - e2 * s2)


def test_latitude_and_longitude_become_metres_about_the_first_point(tmp_path):
    lat, lon, alt = PLACE
    rows = [
        (0, lat, lon, alt),
        (5, lat + 1e-4, lon, alt),
        (10, lat, lon + 1e-4, alt),
        (20, lat, lon, alt + 7),
    ]
    text = "time,latitude,longitude,altitude\n" + "\n".join(
        ",".join(map(repr, row)) for row in rows
    )
    (tmp_path / "flight.csv").write_text(text, "utf-8")
    points = "".join(
        f'<trkpt lat="{y}" lon="{x}"><ele>{z}</ele><time>2024-05-01T12:00:{t:02}Z</time></trkpt>'
        for t, y, x, z in rows
    )
    head = '<?xml version="1.0"?><gpx xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>'
    (tmp_path / "flight.gpx").write_text(f"{head}{points}</trkseg></trk></gpx>", "utf-8")
    north, east = radii(lat)
    angle = math.radians(1e-4)
    y, x = (north + alt) * angle, (east + alt) * math.cos(math.radians(lat)) * angle
    for name in ("flight.csv", "flight.gpx"):
        path = Waypoints.read(tmp_path / name)
        assert path.knots == pytest.approx([0.0, 5.0, 10.0, 20.0])
        for t, place in ((0, (0, 0, 0)), (5, (0, y, 0)), (10, (x, 0, 0)), (20, (0, 0, 7))):
            assert value(path, t) == pytest.approx(place, abs=1e-4)


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("p.csv", "t,lat,lon\n0,473977000,8\n1,0,8\n", "`lat` of the path at `.*:2` is 473977000"),
        ("p.gpx", "<gpx><trk/></gpx>", "must have 2 or more points, and has 0."),
        ("p.gpx", "<gpx><wpt lat='1' lon='2'/></gpx>", "point 1 of the path `.*` has the time ``"),
        ("p.gpx", "t,x,y\n0,0,0\n", "is not a GPX file: "),
    ],
)  # fmt: skip
def test_a_wrong_place_is_named(tmp_path, name, text, said):
    (tmp_path / name).write_text(text, "utf-8")
    with pytest.raises(ech.errors.ReferenceError, match=said):
        Waypoints.read(tmp_path / name)


# ---- in a scenario -------------------------------------------------------------------------------

SCENARIO = {
    "name": "recorded",
    "model": {"name": "double-integrator", "parameters": {"dimension": 2}},
    "graph": {"name": "path", "agents": 2},
    "formation": {"offsets": {"1": [1, 0]}},
    "reference": {"name": "waypoints", "file": "path.csv"},
    "simulation": {"horizon": 4.0, "dt": 0.01},
}


def reference(folder, text, **keys):
    """The leader's path of a scenario in JSON, whose keys are all text."""
    (folder / "path.csv").write_text(text, "utf-8")
    scenario = SCENARIO | {"reference": SCENARIO["reference"] | keys}
    (folder / "recorded.json").write_text(json.dumps(scenario), "utf-8")
    parts = ech.build(ech.load_scenario(folder / "recorded.json")).parts
    assert parts.formation.offsets[1, 0] == 1.0
    return parts.drive.leader.reference


def test_the_keys_of_a_scenario_reach_the_path(tmp_path):
    rows = "\n".join(f"{t},{t},0" for t in range(100, 120))
    path = reference(tmp_path, rows, columns=["t", "x", "y"], begin=1.0, smooth=0.01)
    assert path.knots[[0, -1]] == pytest.approx([1.0, 20.0]) and path.ends == "free"
    assert value(path, 2.5, 1) == pytest.approx([1.0, 0.0, 0.0], abs=1e-6)
    stamps = "t,x,y\n1700000000.0,0,0\n1700000003,1,0\n"
    assert reference(tmp_path, stamps).knots == pytest.approx([0.0, 3.0])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("t,x,y\n50,0,0\n51,1,0\n", "the path begins at 50 s, and the run is from 0 to 4 s; "),
        ("t,x,y\n-2,0,0\n-1,1,0\n", "the path ends at -1 s, and the run is from 0 to 4 s; "),
    ],
)
def test_a_path_outside_of_the_run_is_refused(tmp_path, text, said):
    with pytest.raises(ech.EchelonError, match="recorded.json:1: reference: " + said):
        reference(tmp_path, text)
    assert reference(tmp_path, text, begin=0).knots == pytest.approx([0.0, 1.0])


def test_states_are_read_by_their_names_and_units(tmp_path):
    model = ech.models.DoubleIntegrator(1)
    text = "time;vx [mm/s];x [cm];ax;note\n0,0;1000;50;0,25;a\n1,0;1500;150;0,5;b\n"
    (tmp_path / "states.csv").write_text(text, "utf-8")
    path = ech.references.StatePath.read(tmp_path / "states.csv", model)
    assert path.states == pytest.approx(np.array([[0.5, 1.0], [1.5, 1.5]]))
    assert path.inputs == pytest.approx(np.array([[0.25], [0.5]])) and path.span() == (0.0, 1.0)
