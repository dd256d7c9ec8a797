"""Reader of gain files for the verifier: every entry, type and shape is checked."""

import json
import math
from pathlib import Path
from typing import NamedTuple, NoReturn, TypeGuard, final

import numpy as np

from echelon.core.errors import GainError, listing
from echelon.core.types import Array, JsonObject, PathLike

# ---- strict JSON: what readers take in different ways is refused ---------------------------------

_LARGEST_FILE = 2**28
"""Bytes. The largest gain files have some millions."""


def read_json(file: PathLike) -> JsonObject:
    """Return the mapping in a file, without repeated keys, NaN, or numbers that overflow.

    Raises:
        GainError: it cannot be read, is not such JSON, or holds no mapping.
    """
    try:
        with Path(file).open("rb") as opened:
            content = opened.read(_LARGEST_FILE + 1)
    except OSError as error:
        raise GainError(f"the file `{file}` cannot be read: {error.strerror}.") from error
    if len(content) > _LARGEST_FILE:
        raise GainError(f"the file `{file}` has more than {_LARGEST_FILE} bytes; no such is read.")
    return parse_json(content, file)


def parse_json(content: str | bytes, name: PathLike) -> JsonObject:
    """Return the mapping in a text, as `read_json` does of a file; `name` is for messages."""
    try:
        text = content if isinstance(content, str) else content.decode("utf-8")
        document = json.loads(
            text,
            object_pairs_hook=_mapping,
            parse_constant=_no_number,
            parse_float=_number,
            parse_int=_whole,
        )
    except (ValueError, RecursionError) as error:
        raise GainError(f"the file `{name}` is not valid JSON: {error}.") from error
    if not isinstance(document, dict):
        raise GainError(f"`{name}` must be a mapping.")
    return document


def _mapping(pairs: list[tuple[str, object]]) -> dict[str, object]:
    """Return a mapping; repeated keys are refused, since readers differ in which one they use."""
    mapping = dict(pairs)
    if len(mapping) < len(pairs):
        twice = next(key for k, (key, _) in enumerate(pairs) if key in dict(pairs[:k]))
        raise ValueError(f"`{twice}` occurs twice")
    return mapping


def _no_number(text: str) -> NoReturn:
    raise ValueError(f"`{text}` is not a finite number")


def _number(text: str) -> float:
    value = float(text)
    return value if math.isfinite(value) else _no_number(text[:20])


def _whole(text: str) -> int:
    # A larger one has no float, so that it could not be compared.
    return int(text) if len(text) <= 300 else _no_number(f"{text[:20]}...")


# ---- the gain ------------------------------------------------------------------------------------

FORMAT = "echelon gain 2"
_KINDS = ("proof", "vertices", "samples", "linearization")
_LARGEST = 1e50
"""Largest number in a gain file; products of larger ones may overflow."""
_MOST_EDGES = 2000
_THEOREMS = ("T1", "T2", "A5")


class SavedModel(NamedTuple):
    """The agents' model; `parameters` is None if they could not be stored."""

    path: str
    parameters: JsonObject | None
    state_names: tuple[str, ...]
    input_names: tuple[str, ...]
    state: Array
    input: Array
    scale: Array
    A: Array
    B: Array


class SavedGraph(NamedTuple):
    """The graph: `edges` (E, 3) are i, j and weight, or None if there were too many.

    On a directed edge j receives from i, and the spectrum may be complex; `sums` are the followers'
    weights in the decreasing sum. If the graph `switches`, the edges are those of all its graphs.
    """

    agents: int
    leaders: tuple[int, ...]
    edges: Array | None
    spectrum: Array
    directed: bool = False
    switches: bool = False
    sums: Array | None = None


class SavedRegion(NamedTuple):
    """The guarantee on a domain; `hull` (K, n, p) and `error` (n, p), p = 2n where g varies."""

    kind: str
    theorem: str
    rate: float
    radius: float | None
    strength: float
    lower: Array
    upper: Array
    input_lower: Array
    input_upper: Array
    hull: Array
    error: Array


class SavedGain(NamedTuple):
    """The content of a gain file."""

    method: str
    coupling: float
    P: Array
    R: Array
    inner: Array | None
    model: SavedModel
    graph: SavedGraph
    kind: str
    lambda_min: float
    lambda_max: float
    abscissa: float
    modes: int
    edge: float | None
    observable: int
    region: SavedRegion | None


@final
class _Part:
    """A mapping of the file; each method returns an entry of one type or raises an error."""

    def __init__(
        self, file: PathLike, section: object, name: str = "", above: "_Part | None" = None
    ) -> None:
        self.file, self.name = file, name
        if not isinstance(section, dict):
            raise self.fault(name, "must be a mapping")
        self.entries: JsonObject = section
        self.read_keys = set[str]()
        self.parts: list[_Part] = [] if above is None else above.parts
        self.parts.append(self)

    def fault(self, name: str, must: str) -> GainError:
        return GainError(f"`{self.file}` is not a gain file that can be verified: `{name}` {must}.")

    def entry(self, key: str) -> tuple[object, str]:
        name = f"{self.name}.{key}" if self.name else key
        if key not in self.entries:
            raise self.fault(name, "is missing")
        self.read_keys.add(key)
        return self.entries[key], name

    def later(self, key: str) -> object:
        """Return an entry that older files do not have; None where it is missing."""
        return self.entry(key)[0] if key in self.entries else None

    def flag(self, key: str) -> bool:
        """Return a truth, which is false where older files do not have it."""
        value = self.later(key)
        if not (value is None or isinstance(value, bool)):
            raise self.fault(f"{self.name}.{key}", "must be true or false")
        return value is True

    def parameters(self, key: str) -> JsonObject | None:
        value, name = self.entry(key)
        if value is not None and not isinstance(value, dict):
            raise self.fault(name, "must be a mapping")
        # NumPy reads such a text as a number, and `true` as 1.
        if not all(map(_is_plain, (value or {}).values())):
            raise self.fault(name, "must not hold numbers as text, or truths in lists")
        return value

    def part(self, key: str) -> "_Part":
        value, name = self.entry(key)
        return _Part(self.file, value, name, self)

    def refuse_unread(self) -> None:
        """Refuse an entry of any part that nothing has read: it would claim what is not checked."""
        for part in self.parts:
            for key in part.entries.keys() - part.read_keys:
                # In ASCII, so that a letter that looks like another one is seen.
                name = ascii(f"{part.name}.{key}" if part.name else key)[1:-1]
                raise self.fault(name, "is unknown")

    def optional(self, key: str) -> bool:
        return self.entry(key)[0] is not None

    def number(self, key: str) -> float:
        value, name = self.entry(key)
        if not _is_number(value):
            raise self.fault(name, "must be a finite number (to 1e50)")
        return float(value)

    def maybe(self, key: str) -> float | None:
        return self.number(key) if self.optional(key) else None

    def whole(self, key: str, least: int = 0) -> int:
        value, name = self.entry(key)
        # In Python `true` of JSON is an integer.
        if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= 10**9:
            raise self.fault(name, f"must be a whole number from {least} on (to 1e9)")
        return value

    def text(self, key: str, allowed: tuple[str, ...] = ()) -> str:
        value, name = self.entry(key)
        if not isinstance(value, str) or allowed and value not in allowed:
            must = f"must be one of {listing(allowed)}" if allowed else "must be text"
            raise self.fault(name, must)
        return value

    def names(self, key: str) -> tuple[str, ...]:
        value, name = self.entry(key)
        if not isinstance(value, list) or not value or not all(isinstance(x, str) for x in value):
            raise self.fault(name, "must be a list of names")
        return tuple(value)

    def array(self, key: str, *shape: int) -> Array:
        """Return finite numbers of a shape; -1 allows any length."""
        value, name = self.entry(key)
        result = _array(value)
        fits = result is not None and result.ndim == len(shape)
        if (
            result is None
            or not fits
            or any(target not in (-1, got) for got, target in zip(result.shape, shape, strict=True))
        ):
            target = " x ".join("any" if size < 0 else str(size) for size in shape)
            raise self.fault(name, f"must be {target} finite numbers (to 1e50)")
        return result

    def bounds(self, key: str, size: int, absent: float) -> Array:
        """Return bounds; null in the file is an infinite bound."""
        value, name = self.entry(key)
        # JSON has no infinity, so an absent bound is null.
        entries = value if isinstance(value, list) else []
        if len(entries) != size or not all(x is None or _is_number(x) for x in entries):
            raise self.fault(name, f"must be {size} finite numbers or null")
        return np.array([absent if x is None else x for x in entries], float)


def _is_number(value: object) -> TypeGuard[float]:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return False
    # Python's JSON also reads NaN and Infinity; both fail this comparison.
    return -_LARGEST <= value <= _LARGEST


def _is_plain(value: object) -> bool:
    """Return whether a parameter holds no number as text and no truth in a list."""
    if isinstance(value, list):
        return all(not isinstance(item, bool) and _is_plain(item) for item in value)
    try:
        return not isinstance(value, str) or math.isnan(float(value))
    except ValueError:
        return True


def _array(value: object) -> Array | None:
    """Return nested lists of finite numbers as an array, otherwise None."""

    def plain(x: object) -> bool:
        return all(map(plain, x)) if isinstance(x, list) else _is_number(x)

    try:
        return np.array(value, float) if isinstance(value, list) and plain(value) else None
    except (ValueError, RecursionError):
        return None


def read(document: JsonObject, file: PathLike) -> SavedGain:
    """Return the content of a gain file; `file` is its name in messages.

    Raises:
        GainError: it is not a gain, or a part is missing or unknown (named).
    """
    top = _Part(file, document)
    if top.later("format") != FORMAT:
        raise GainError(
            f"`{file}` is not a gain file that can be verified; its `format` must be `{FORMAT}`."
        )
    saved = _gain(top)
    top.refuse_unread()
    return saved


def _gain(top: _Part) -> SavedGain:
    model = _model(top.part("model"))
    n, m = len(model.state_names), len(model.input_names)
    certificate = top.part("certificate")
    return SavedGain(
        method=top.text("method"),
        coupling=top.number("coupling"),
        P=top.array("P", n, n),
        R=top.array("R", m, m),
        inner=top.array("inner", m, n) if top.optional("inner") else None,
        model=model,
        graph=_graph(top.part("graph")),
        kind=certificate.text("kind", _KINDS),
        lambda_min=certificate.number("lambda_min"),
        lambda_max=certificate.number("lambda_max"),
        abscissa=certificate.number("abscissa"),
        modes=certificate.whole("modes", 1),
        edge=certificate.maybe("edge"),
        observable=certificate.whole("observable"),
        region=_region(certificate.part("region"), n, m)
        if certificate.optional("region")
        else None,
    )


def _model(section: _Part) -> SavedModel:
    states, inputs = section.names("state_names"), section.names("input_names")
    n, m = len(states), len(inputs)
    trim, name = section.entry("trim")
    if not isinstance(trim, list) or len(trim) != 2:
        raise section.fault(name, "must be a state and an input")
    point = _Part(section.file, {"0": trim[0], "1": trim[1]}, name)
    return SavedModel(
        path=section.text("class"),
        parameters=section.parameters("parameters"),
        state_names=states,
        input_names=inputs,
        state=point.array("0", n),
        input=point.array("1", m),
        scale=section.array("input_scale", m, m),
        A=section.array("A", n, n),
        B=section.array("B", n, m),
    )


def _graph(section: _Part) -> SavedGraph:
    agents = section.whole("agents", 2)
    leaders = section.array("leaders", -1)
    edges = section.array("edges", -1, 3) if section.optional("edges") else None
    if edges is not None and len(edges) > _MOST_EDGES:
        raise section.fault("graph.edges", f"must be null for more than {_MOST_EDGES} edges")
    if edges is None and agents * (agents - 1) // 2 <= _MOST_EDGES:
        raise section.fault(
            "graph.edges", f"must not be null: {agents} agents have fewer edges than the limit"
        )
    numbers = leaders if edges is None else np.append(leaders, edges[:, :2])
    if not len(leaders) or not all(x == int(x) and 0 <= x < agents for x in numbers):
        raise section.fault(
            "graph", f"must name agents from 0 to {agents - 1}, with at least one leader"
        )
    spectrum = _spectrum(section)
    if not len(spectrum):
        raise section.fault("graph.spectrum", "must contain a number")
    leader_set = tuple(sorted({int(x) for x in leaders}))
    directed, switches = section.flag("directed"), section.flag("switches")
    sums = (
        section.array("sums", agents - len(leader_set))
        if section.later("sums") is not None
        else None
    )
    if sums is not None and not (sums > 0.0).all():
        raise section.fault("graph.sums", "must be positive")
    return SavedGraph(agents, leader_set, edges, spectrum, directed, switches, sums)


def _spectrum(section: _Part) -> Array:
    """Return eigenvalues; complex ones are stored as pairs."""
    stored = section.entry("spectrum")[0]
    if not (isinstance(stored, list) and stored and isinstance(stored[0], list)):
        return section.array("spectrum", -1)
    pairs = section.array("spectrum", -1, 2)
    return pairs[:, 0] + 1j * pairs[:, 1]


def _region(section: _Part, n: int, m: int) -> SavedRegion:
    domain, theorem = section.part("domain"), section.text("theorem", _THEOREMS)
    # Under T2, each A has its g S R^-1 (g S)' to the right.
    wide = 2 * n if theorem == "T2" else n
    return SavedRegion(
        # A linearization cannot certify a domain.
        kind=section.text("kind", _KINDS[:3]),
        theorem=theorem,
        rate=section.number("rate"),
        radius=section.maybe("radius"),
        strength=section.number("strength"),
        lower=domain.bounds("lower", n, -math.inf),
        upper=domain.bounds("upper", n, math.inf),
        input_lower=domain.array("input_lower", m),
        input_upper=domain.array("input_upper", m),
        hull=_unpack_hull(section.part("hull"), n, wide),
        error=section.array("error", n, wide),
    )


def _unpack_hull(section: _Part, n: int, wide: int) -> Array:
    """Return the matrices; the file stores the first one, and the changed entries of the others."""
    base = section.array("base", n, wide)
    # A single matrix: an empty list has no second axis to check.
    if section.entry("places")[0] == []:
        values, name = section.entry("values")
        if not isinstance(values, list) or any(values):
            raise section.fault(name, "must be empty without `places`")
        return base[None]
    places = section.array("places", -1, 2)
    values = section.array("values", -1, len(places))
    # Places are read as floats and must be valid indices.
    inside = (places == np.floor(places)) & (places >= 0) & (places < [n, wide])
    if not inside.all() or not len(values):
        raise section.fault(f"{section.name}.places", f"must be entries of a {n} x {wide} matrix")
    matrices = np.repeat(base[None], len(values), axis=0)
    rows, columns = places.astype(int).T
    matrices[:, rows, columns] = values
    return matrices
