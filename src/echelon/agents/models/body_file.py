"""Mass, centre and inertia of a vehicle from the files in which robotics describes it."""

import re
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, NamedTuple, NoReturn
from xml.etree.ElementTree import Element

import numpy as np
from jaxtyping import Float

from echelon.core.errors import ModelError, listing
from echelon.core.text_table import number_in, read_xml
from echelon.core.types import Array, PathLike

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

_UNREAD = ("include", "attach", "replicate", "composite", "flexcomp")
"""Elements of MJCF that bring bodies from elsewhere."""
_TURNS = {"quat": 4, "axisangle": 4, "euler": 3, "xyaxes": 6, "zaxis": 3}
"""Orientations of MJCF, with their numbers."""
_COMPILER = {
    "inertiafromgeom": "auto|false",
    "settotalmass": "-1",
    "coordinate": "local",
    "angle": "degree|radian",
    "eulerseq": "[xyz]{3}|[XYZ]{3}",
}
"""Settings of MJCF, with the values that are read."""
_PRINCIPAL = 0.01
"""Of the smallest moment; products of inertia below it are left out."""
_ENDS = ("parent", "child")


class MassProperties(NamedTuple):
    """A vehicle as one rigid body.

    Attributes:
        mass: kg.
        centre: (3,) its centre of mass in the frame of the root link or top body, m.
        inertia: (3, 3) about that centre, along the axes of that frame, kg m^2.
    """

    mass: float
    centre: Float[Array, "3"]
    inertia: Float[Array, "3 3"]


class _Frame(NamedTuple):
    """A frame in that of the root: its axes as columns, and its origin (m)."""

    axes: Float[Array, "3 3"] = np.eye(3)
    origin: Float[Array, "3"] = np.zeros(3)

    def then(self, axes: Array, origin: Array) -> "_Frame":
        return _Frame(self.axes @ axes, self.origin + self.axes @ origin)


def read_mass_properties(file: PathLike) -> MassProperties:
    """Return mass, centre of mass and inertia of a vehicle from a URDF or MJCF file.

    All links count, with every joint at its zero position.

    Args:
        file: path of the file; macros of xacro must have been expanded.

    Raises:
        ModelError: the file cannot be read, states no mass, or a number in it is wrong.
    """
    root = read_xml(file, "model", ModelError, "URDF or MJCF")
    if root.tag not in ("robot", "mujoco"):
        raise ModelError(
            f"the model `{file}` begins with `{root.tag}`, and must begin with `robot` (URDF) or "
            "`mujoco` (MJCF)."
        )
    source = _Source(file, root)
    bodies = [*(source.links() if root.tag == "robot" else source.bodies())]
    mass = sum(body.mass for body in bodies)
    if mass <= 0.0:
        source.fail("states no mass; add `inertial` with a mass to a link")
    centre = np.sum([body.mass * body.centre for body in bodies], axis=0) / mass
    inertia = sum(body.inertia + body.mass * _square(body.centre - centre) for body in bodies)
    return MassProperties(mass, centre, np.asarray(inertia))


def read_principal(file: PathLike, model: str) -> tuple[float, tuple[float, float, float]]:
    """Return mass and moments for a model without products of inertia, else `ModelError`."""
    mass, _, inertia = read_mass_properties(file)
    x, y, z = np.diag(inertia).tolist()
    beside = float(np.abs(inertia - np.diag((x, y, z))).max())
    if beside > _PRINCIPAL * min(x, y, z):
        raise ModelError(
            f"the model `{file}` has a product of inertia of {beside:.3g} kg m^2 beside moments "
            f"of {x:.3g}, {y:.3g} and {z:.3g}; `{model}` needs axes along which it is 0."
        )
    return mass, (x, y, z)


def _square(offset: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Return the inertia of a unit mass at a place, by which axes are moved in parallel."""
    return offset @ offset * np.eye(3) - np.outer(offset, offset)


def _link(joint: Element) -> Callable[[str], str]:
    ends = {end.tag: end.get("link", "") for end in joint}
    return lambda which: ends.get(which, "")


class _Source(NamedTuple):
    file: PathLike
    root: Element

    def fail(self, what: str) -> NoReturn:
        raise ModelError(f"the model `{self.file}` {what}.")

    def numbers(self, of: str, element: Element | None, key: str, count: int) -> Array | None:
        """Return the numbers of an attribute; None without it."""
        text = None if element is None else element.get(key)
        if text is None:
            return None
        found = [None if "," in x or ":" in x else number_in(x) for x in text.split()]
        values = np.array([np.nan if x is None else x for x in found])
        if len(values) != count or not np.isfinite(values).all():
            what = "a finite number" if count == 1 else f"{count} finite numbers"
            hint = "; expand its xacro first" if "$" in text else ""
            self.fail(f"has `{key}` of {of} as `{text[:40]}`, and it must be {what}{hint}")
        return values

    def needed(self, of: str, element: Element | None, key: str, count: int = 1) -> Array:
        values = self.numbers(of, element, key, count)
        return self.fail(f"has no `{key}` of {of}") if values is None else values

    def body(self, of: str, mass: float, inertia: Array, frame: _Frame) -> MassProperties:
        """Return a body whose inertia is given along the axes of its own frame."""
        if mass < 0.0 or np.diag(inertia).min() < 0.0:
            seen = f"a mass of {mass:g} kg" if mass < 0.0 else "a moment of inertia below 0"
            self.fail(f"has {seen} of {of}")
        return MassProperties(mass, frame.origin, frame.axes @ inertia @ frame.axes.T)

    # ---- URDF ------------------------------------------------------------------------------------

    def links(self) -> Iterator[MassProperties]:
        """Yield the links of a URDF file that have a mass."""
        links = {link.get("name", ""): link for link in self.root.findall("link")}
        for name, frame in self._frames(links).items():
            inertial, of = links[name].find("inertial"), f"link `{name}`"
            if inertial is not None:
                mass, moments = inertial.find("mass"), inertial.find("inertia")
                keys = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
                a, b, c, d, e, f = (self.needed(of, moments, key)[0] for key in keys)
                matrix = np.array([[a, b, c], [b, d, e], [c, e, f]])
                place = frame.then(*self._origin(of, inertial))
                yield self.body(of, float(self.needed(of, mass, "value")[0]), matrix, place)

    def _frames(self, links: dict[str, Element]) -> dict[str, _Frame]:
        """Return the frames of all links, which joints must make a tree."""
        joints = [(joint, *map(_link(joint), _ENDS)) for joint in self.root.findall("joint")]
        for name in (name for _, *ends in joints for name in ends if name not in links):
            self.fail(f"has a joint of the link `{name}`, which is not there")
        children = [child for *_, child in joints]
        roots = [name for name in links if name not in children]
        frames = {name: _Frame() for name in roots}
        while ready := [one for one in joints if one[1] in frames and one[2] not in frames]:
            for joint, parent, child in ready:
                of = f"joint `{joint.get('name')}`"
                frames[child] = frames[parent].then(*self._origin(of, joint))
        whole = len(frames) == len(self.root.findall("link")) == len(joints) + 1
        if len(roots) != 1 or not whole:
            seen = listing(roots[:8]) or "none"
            self.fail(f"must have links that joints make a tree; without a parent: {seen}")
        return frames

    def _origin(self, of: str, owner: Element) -> tuple[Array, Array]:
        from scipy.spatial.transform import Rotation

        origin = owner.find("origin")
        turn, place = (self.numbers(of, origin, key, 3) for key in ("rpy", "xyz"))
        axes = np.eye(3) if turn is None else Rotation.from_euler("xyz", turn).as_matrix()
        return axes, np.zeros(3) if place is None else place

    # ---- MJCF ------------------------------------------------------------------------------------

    def bodies(self) -> Iterator[MassProperties]:
        """Yield the bodies of an MJCF file that have a mass, in the frame of the top one."""
        compiler = self._compiler()
        tops = [top for top in self.root.findall("worldbody/body") if self._heavy(top)]
        if len(tops) != 1:
            names = listing(str(top.get("name")) for top in tops[:8]) or "none"
            self.fail(f"must have one body with a mass at the top of `worldbody`, and has {names}")
        waiting = [(tops[0], _Frame())]
        while waiting:
            body, frame = waiting.pop()
            for part in body:
                if part.tag not in ("body", "frame", "inertial"):
                    continue
                of = f"{body.tag} `{body.get('name')}`"
                place = frame.then(*self._placed(of, part, compiler))
                if part.tag != "inertial":
                    waiting.append((part, place))
                else:
                    mass = float(self.needed(of, part, "mass")[0])
                    yield self.body(of, mass, self._moments(of, part), place)

    def _compiler(self) -> dict[str, str]:
        """Return the settings of the compiler; refuse what changes masses or brings others."""
        found = {k: v for part in self.root.findall("compiler") for k, v in part.items()}
        for tag in _UNREAD:
            if self.root.find(f".//{tag}") is not None:
                self.fail(f"has `{tag}`, which is not read; save the compiled model")
        for key, allowed in _COMPILER.items():
            if key in found and not re.fullmatch(allowed, found[key]):
                self.fail(f"has `{key}` of `compiler` as `{found[key]}`, which is not read")
        return found

    def _heavy(self, top: Element) -> bool:
        """Tell whether a body or one on it has a mass; refuse one that states it by its shape."""
        for body in top.iter("body"):
            geoms = body.findall("geom") + body.findall("frame/geom")
            if geoms and body.find("inertial") is None:
                kinds = {x.get("type", "mesh" if x.get("mesh") else "sphere") for x in geoms}
                self.fail(
                    f"has body `{body.get('name')}` with geometry ({listing(sorted(kinds))}) and "
                    "no `inertial`; masses are not computed from shapes"
                )
        return next(top.iter("inertial"), None) is not None

    def _moments(self, of: str, inertial: Element) -> Array:
        full = self.numbers(of, inertial, "fullinertia", 6)
        if full is None:
            return np.diag(self.needed(of, inertial, "diaginertia", 3))
        a, b, c, d, e, f = full
        return np.array([[a, d, e], [d, b, f], [e, f, c]])

    def _placed(self, of: str, part: Element, compiler: dict[str, str]) -> tuple[Array, Array]:
        """Return axes and origin of an element of MJCF in those of its parent."""
        from scipy.spatial.transform import Rotation

        place, turn = self.numbers(of, part, "pos", 3), Rotation.identity()
        turns = [key for key in _TURNS if part.get(key) is not None]
        if len(turns) > 1 or {*turns} & {"xyaxes", "zaxis"}:
            self.fail(f"has {listing(turns)} of {of}; read is one of `quat`, `axisangle`, `euler`")
        for key in turns:
            turn = self._turn(key, self.needed(of, part, key, _TURNS[key]), compiler)
        return turn.as_matrix(), np.zeros(3) if place is None else place

    def _turn(self, key: str, numbers: Array, compiler: dict[str, str]) -> "Rotation":
        from scipy.spatial.transform import Rotation

        degrees = compiler.get("angle", "degree") == "degree"
        if key == "euler":
            # Small letters are axes that turn along, which SciPy writes large.
            return Rotation.from_euler(compiler.get("eulerseq", "xyz").swapcase(), numbers, degrees)
        way = numbers if key == "quat" else numbers[:3]
        if not way.any():
            self.fail(f"has `{key}` as 0, which is no direction")
        if key == "quat":
            return Rotation.from_quat(np.roll(numbers, -1))
        angle = np.radians(numbers[3]) if degrees else numbers[3]
        return Rotation.from_rotvec(angle * way / np.linalg.norm(way))
