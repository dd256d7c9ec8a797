"""Mass and inertia from URDF and MJCF, beside sums over point masses and a body's own formulas."""

import json
import math

import numpy as np
import pytest

import echelon as ech
from echelon.agents.models import Quadrotor, read_mass_properties

BOX = (
    '<inertia ixx="{0}" ixy="0" ixz="0" iyy="{1}" iyz="0" izz="{2}"/>',
    '<mass value="{}"/>',
)


def link(name, mass, moments, origin=""):
    inertia, weight = BOX[0].format(*moments), BOX[1].format(mass)
    return f'<link name="{name}"><inertial>{origin}{weight}{inertia}</inertial></link>'


def joint(parent, child, xyz, rpy="0 0 0", kind="fixed"):
    return (
        f'<joint name="{parent}-{child}" type="{kind}"><origin xyz="{xyz}" rpy="{rpy}"/>'
        f'<parent link="{parent}"/><child link="{child}"/></joint>'
    )


def urdf(*parts):
    return f'<?xml version="1.0"?><robot name="drone">{"".join(parts)}</robot>'


def mjcf(*bodies, compiler=""):
    return f"<mujoco>{compiler}<worldbody>{''.join(bodies)}</worldbody></mujoco>"


def moments_of(mass, sides):
    """Of a box, by its formula."""
    a, b, c = sides
    return [mass * (b * b + c * c) / 12, mass * (a * a + c * c) / 12, mass * (a * a + b * b) / 12]


def turned(axis, angle):
    """A rotation, written out."""
    c, s = math.cos(angle), math.sin(angle)
    rows = {
        "x": [[1, 0, 0], [0, c, -s], [0, s, c]],
        "y": [[c, 0, s], [0, 1, 0], [-s, 0, c]],
        "z": [[c, -s, 0], [s, c, 0], [0, 0, 1]],
    }
    return np.array(rows[axis])


def points_of(mass, sides, axes, place):
    """Eight equal point masses with the mass, the centre and the inertia of a box."""
    # A box of half side h has int x^2 dm = m h^2 / 3, and so have points at +-h / sqrt 3.
    corners = np.array(np.meshgrid(*[[-1.0, 1.0]] * 3)).reshape(3, -1).T
    corners = corners * np.array(sides) / 2.0 / math.sqrt(3.0)
    return np.full(8, mass / 8.0), corners @ axes.T + place


def summed(*boxes):
    """Mass, centre and inertia of boxes, by their points alone."""
    weights, places = (np.concatenate(x) for x in zip(*(points_of(*box) for box in boxes)))
    centre = weights @ places / weights.sum()
    x, y, z = (places - centre).T
    rows = [[y * y + z * z, -x * y, -x * z], [-x * y, x * x + z * z, -y * z]]
    rows.append([-x * z, -y * z, x * x + y * y])
    return weights.sum(), centre, np.array([[weights @ cell for cell in row] for row in rows])


HULL, ARM, CAMERA = (0.5, (0.2, 0.1, 0.05)), (0.1, (0.3, 0.02, 0.02)), (0.08, (0.04, 0.05, 0.06))
TILT = turned("z", 0.7) @ turned("y", -0.4) @ turned("x", 0.3)
"""Roll 0.3, pitch -0.4 and yaw 0.7 about fixed axes."""
BOXES = (
    (*HULL, np.eye(3), np.array([0.01, -0.02, 0.03])),
    (*ARM, TILT, np.array([0.1, 0.2, 0.0])),
    # On the arm: its place and its turn are in the arm's frame.
    (*CAMERA, TILT @ turned("x", 1.1), np.array([0.1, 0.2, 0.0]) + TILT @ [0.15, 0.0, -0.05]),
)


def test_a_urdf_is_the_sum_of_its_links(tmp_path):
    text = urdf(
        '<link name="world"/>',
        # Joints in another order than links, and of several types.
        joint("arm", "camera", "0.15 0 -0.05", "1.1 0 0", "revolute"),
        joint("hull", "arm", "0.1 0.2 0", "0.3 -0.4 0.7", "continuous"),
        '<joint name="root" type="fixed"><parent link="world"/><child link="hull"/></joint>',
        link("hull", HULL[0], moments_of(*HULL), '<origin xyz="0.01 -0.02 0.03"/>'),
        link("arm", ARM[0], moments_of(*ARM)),
        link("camera", CAMERA[0], moments_of(*CAMERA)),
    )
    check(tmp_path / "drone.urdf", text)


def check(file, text):
    file.write_text(text, "utf-8")
    mass, centre, inertia = read_mass_properties(file)
    expected = summed(*BOXES)
    assert mass == pytest.approx(expected[0]) and centre == pytest.approx(expected[1])
    np.testing.assert_allclose(inertia, expected[2], rtol=1e-12, atol=1e-15)


def inertial(box, more=""):
    mass, sides = box
    diagonal = " ".join(map(str, moments_of(mass, sides)))
    return f'<inertial mass="{mass}" diaginertia="{diagonal}" {more}/>'


TURNS = {
    # The arm's turn and the camera's, of 1.1 about x; small letters turn along, large ones do not.
    "radians": ('angle="radian" eulerseq="zyx"', 'euler="0.7 -0.4 0.3"', 'euler="0 0 1.1"'),
    "about fixed axes": (
        'angle="radian" eulerseq="XYZ"',
        'euler="0.3 -0.4 0.7"',
        'euler="1.1 0 0"',
    ),
    "degrees": (
        'eulerseq="zyx"',
        f'euler="{" ".join(str(math.degrees(x)) for x in (0.7, -0.4, 0.3))}"',
        f'euler="0 0 {math.degrees(1.1)}"',
    ),
    "a quaternion": (
        'angle="radian" eulerseq="zyx"',
        'euler="0.7 -0.4 0.3"',
        f'quat="{2.0 * math.cos(0.55)} {2.0 * math.sin(0.55)} 0 0"',
    ),
    "an axis": (
        'angle="radian" eulerseq="zyx"',
        'euler="0.7 -0.4 0.3"',
        'axisangle="2 0 0 1.1"',
    ),
}


@pytest.mark.parametrize("form", TURNS)
def test_an_mjcf_is_the_sum_of_its_bodies(tmp_path, form):
    settings, arm, camera = TURNS[form]
    place = 'pos="0.01 -0.02 0.03"'
    text = mjcf(
        '<geom type="plane"/>',
        f'<body name="hull" pos="0 0 7" euler="0 0 2">{inertial(HULL, place)}<freejoint/>',
        f'<frame pos="0.1 0 0"><body name="arm" pos="0 0.2 0" {arm}>{inertial(ARM)}',
        f'<body name="camera" pos="0.15 0 -0.05" {camera}>{inertial(CAMERA)}</body>',
        "</body></frame></body>",
        compiler=f"<compiler {settings}/>",
    )
    check(tmp_path / "drone.xml", text)


def test_products_of_inertia_are_read_in_the_order_of_mujoco(tmp_path):
    file = tmp_path / "one.xml"
    full = '<inertial mass="1" fullinertia="3 4 5 0.1 0.2 0.3"/>'
    file.write_text(mjcf(f'<body name="a">{full}</body>'), "utf-8")
    expected = [[3.0, 0.1, 0.2], [0.1, 4.0, 0.3], [0.2, 0.3, 5.0]]
    assert read_mass_properties(file).inertia == pytest.approx(np.array(expected))


ONE, *TWO = (link(name, 1, (1, 1, 1)) for name in "abc")
BODY = '<body name="a"><inertial mass="1" diaginertia="1 1 1"/></body>'
REFUSED = {
    "no inertial": (urdf('<link name="a"/>'), "states no mass; add `inertial` with a mass"),
    "a negative mass": (urdf(link("a", -1, (1, 1, 1))), "has a mass of -1 kg of link `a`."),
    "a negative moment": (urdf(link("a", 1, (1, -1, 1))), "a moment of inertia below 0 of link"),
    "a massless file": (urdf(link("a", 0, (0, 0, 0))), "states no mass"),
    "no inertia": (
        urdf('<link name="a"><inertial><mass value="1"/></inertial></link>'),
        "has no `ixx` of link `a`.",
    ),
    "xacro": (
        urdf(link("a", "${m}", (1, 1, 1))),
        "has `value` of link `a` as `${m}`, and it must be a finite number; expand its xacro",
    ),
    "nan": (urdf(link("a", "nan", (1, 1, 1))), "as `nan`, and it must be a finite number."),
    "1_0": (urdf(link("a", "1_0", (1, 1, 1))), "as `1_0`, and it must be a finite number."),
    "two roots": (urdf(ONE, link("b", 1, (1, 1, 1))), "without a parent: `a`, `b`."),
    "a circle": (urdf(ONE, joint("a", "a", "0 0 0")), "without a parent: none."),
    "a circle beside": (
        urdf(ONE, *TWO, joint("b", "c", "0 0 0"), joint("c", "b", "0 0 0")),
        "must have links that joints make a tree",
    ),
    "two parents": (
        urdf(ONE, *TWO, *(joint(*ends, "0 0 0") for ends in ("ab", "ac", "bc"))),
        "must have links that joints make a tree",
    ),
    "two links of a name": (urdf(ONE, ONE), "must have links that joints make a tree"),
    "an unknown link": (urdf(ONE, joint("a", "x", "0 0 0")), "a joint of the link `x`, which is"),
    "two numbers of a place": (
        urdf(ONE, link("b", 1, (1, 1, 1)), joint("a", "b", "0 0")),
        "has `xyz` of joint `a-b` as `0 0`, and it must be 3 finite numbers.",
    ),
    "another root": ("<sdf/>", "begins with `sdf`, and must begin with `robot` (URDF) or"),
    "no XML": ("t,x,y\n", "is not URDF or MJCF: "),
    "entities": (
        '<!DOCTYPE robot [<!ENTITY a "aaaa">]>' + urdf(ONE),
        "has a `<!DOCTYPE`, which is not read; delete it.",
    ),
    "a mesh alone": (
        mjcf('<body name="a"><geom type="mesh" mesh="hull" density="500"/></body>'),
        "has body `a` with geometry (`mesh`) and no `inertial`; masses are not computed from",
    ),
    "a part by its shape": (
        mjcf(BODY.replace("</body>", '<body name="b"><geom size="1"/></body></body>')),
        "has body `b` with geometry (`sphere`)",
    ),
    "two bodies": (mjcf(BODY, BODY.replace('"a"', '"b"')), "`worldbody`, and has `a`, `b`."),
    "no body": (mjcf(), "one body with a mass at the top of `worldbody`, and has none."),
    "masses of shapes": (
        mjcf(BODY, compiler='<compiler inertiafromgeom="true"/>'),
        "has `inertiafromgeom` of `compiler` as `true`, which is not read.",
    ),
    "another total": (mjcf(BODY, compiler='<compiler settotalmass="2"/>'), "`settotalmass` of"),
    "an include": (mjcf(BODY, '<include file="b.xml"/>'), "has `include`, which is not read"),
    "an order of turns": (mjcf(BODY, compiler='<compiler eulerseq="xyq"/>'), "`eulerseq` of"),
    "no direction": (mjcf(BODY.replace("/>", ' quat="0 0 0 0"/>')), "has `quat` as 0, which is"),
    "two axes": (mjcf(BODY.replace("/>", ' xyaxes="1 0 0 0 1 0"/>')), "has `xyaxes` of body `a`"),
    "no moments": (mjcf(BODY.replace("diag", "")), "has no `diaginertia` of body `a`."),
}  # fmt: skip


@pytest.mark.parametrize("form", REFUSED)
def test_a_wrong_file_is_refused_with_what_was_seen(tmp_path, form):
    content, said = REFUSED[form]
    file = tmp_path / "drone.urdf"
    file.write_text(content, "utf-8")
    with pytest.raises(ech.errors.ModelError) as error:
        read_mass_properties(file)
    assert said in str(error.value) and str(file) in str(error.value)
    assert "\n" not in str(error.value)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(ech.errors.ModelError, match="`.*none.urdf` cannot be read: No such file"):
        read_mass_properties(tmp_path / "none.urdf")


def test_a_quadrotor_has_the_mass_and_the_inertia_of_its_file(tmp_path):
    file = tmp_path / "drone.urdf"
    file.write_text(urdf(link("a", 0.8, (0.004, 0.005, 0.008))), "utf-8")
    model = Quadrotor.read(file, arm=0.12, motor_thrust=5.0)
    numbers = {"arm": 0.12, "motor_thrust": 5.0}
    assert model == Quadrotor(mass=0.8, inertia=(0.004, 0.005, 0.008), **numbers)
    scenario = {
        "name": "own",
        "model": {"name": "quadrotor", "file": "drone.urdf", "parameters": numbers},
        "graph": {"name": "path", "agents": 2},
        "formation": {"offsets": {"1": [1, 0, 0]}},
        "simulation": {"horizon": 0.1, "dt": 0.01},
    }
    (tmp_path / "own.yaml").write_text(json.dumps(scenario), "utf-8")
    assert ech.build(ech.load_scenario(tmp_path / "own.yaml")).parts.model == model
    scenario["model"]["parameters"] = {"mass": 1.0}
    (tmp_path / "own.yaml").write_text(json.dumps(scenario), "utf-8")
    with pytest.raises(ech.EchelonError, match="own.yaml:1: model: got `file` and `mass`"):
        ech.build(ech.load_scenario(tmp_path / "own.yaml"))
    # About its vertical axis by 45 degrees, which makes a product of inertia.
    text = urdf(link("a", 0.8, (0.004, 0.005, 0.008), '<origin rpy="0 0 0.785398"/>'))
    file.write_text(text, "utf-8")
    with pytest.raises(ech.errors.ModelError, match="product of inertia of 0.0005 kg m"):
        Quadrotor.read(file)
