"""Reads YAML 1.2 into plain data, and remembers on which line each value stands.

The text is only composed into nodes; what a plain word means is decided here, by the core schema
of YAML 1.2: `1e-3` is a number, `no` is text. Values given on the command line (`--set a.b=3`) are
read the same way and laid over the file's before anything is checked, so both meet the same rules.
"""

import re
import warnings
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple, final

from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.nodes import MappingNode, Node, ScalarNode
from ruamel.yaml.reader import ReaderError

from echelon.core.errors import ScenarioError, listing

KeyPath = tuple[str | int, ...]
Where = Callable[[int], str]


class Problem(NamedTuple):
    """Something that YAML permits and echelon does not, at a path and a place."""

    path: KeyPath
    place: str
    message: str


class Document(NamedTuple):
    """Plain data, the place (`file:line`) of every path in it, and what was wrong in reading it."""

    data: Any
    places: dict[KeyPath, str]
    problems: tuple[Problem, ...] = ()

    def place(self, path: KeyPath) -> str:
        """Return the place of `path`, or of the nearest part above it that stands somewhere.

        Where the command line changed something inside, that is the place.
        """
        while path and path not in self.places:
            path = path[:-1]
        changed = [
            place
            for inside, place in self.places.items()
            if path and inside[: len(path)] == path and place.startswith("--set ")
        ]
        return changed[-1] if changed else self.places[path]


def _infinite(text: str) -> float:
    return float(text.replace(".", ""))


# The core schema of YAML 1.2 (section 10.3.2), in the order in which it is tried. Whole numbers of
# more than 4000 digits are read as floats: Python refuses to convert them.
_CORE: tuple[tuple[re.Pattern[str], Callable[[str], object]], ...] = (
    (re.compile(r"|~|null|Null|NULL"), lambda text: None),
    (re.compile(r"true|True|TRUE|false|False|FALSE"), lambda text: text.lower() == "true"),
    (re.compile(r"[-+]?[0-9]{1,4000}"), int),
    (re.compile(r"0o[0-7]+|0x[0-9a-fA-F]+"), lambda text: int(text, 0)),
    (re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?"), float),
    (re.compile(r"[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)"), _infinite),
)


def _plain(text: str) -> object:
    """Return what an unquoted word means."""
    for pattern, convert in _CORE:
        if pattern.fullmatch(text):
            return convert(text)
    return text


def _meaning(node: ScalarNode) -> object:
    return node.value if node.style else _plain(node.value)


@final
class _Reading:
    """One walk over the composed nodes; collects places and problems on its way."""

    def __init__(self, where: Where) -> None:
        self.where = where
        self.places: dict[KeyPath, str] = {}
        self.problems: list[Problem] = []

    def line(self, node: Node) -> str:
        return self.where(node.start_mark.line + 1)

    def value(self, node: Node, path: KeyPath) -> object:
        self.places.setdefault(path, self.line(node))
        if node.ctag.handle is not None:
            tag = f"{node.ctag.handle}{node.ctag.suffix}"
            self.blame(node, path, f"got the tag `{tag}`, allowed are values without a tag.")
        if isinstance(node, ScalarNode):
            return _meaning(node)
        if isinstance(node, MappingNode):
            return self.mapping(node, path)
        return [self.value(item, (*path, i)) for i, item in enumerate(node.value)]

    def mapping(self, node: MappingNode, path: KeyPath) -> dict[str | int, object]:
        data: dict[str | int, object] = {}
        first: dict[str | int, str] = {}
        for key_node, value_node in node.value:
            key = self.key(key_node, path)
            if key in data:
                sentence = f"got this key twice, it stands at {first[key]} already."
                self.blame(key_node, (*path, key), sentence)
                continue
            first[key] = self.places[(*path, key)] = self.line(key_node)
            data[key] = self.value(value_node, (*path, key))
        return data

    def key(self, node: Node, path: KeyPath) -> str | int:
        if not isinstance(node, ScalarNode):
            self.blame(node, path, "got a list or mapping as a key, allowed is a word or a number.")
            return "?"
        key = _meaning(node)
        return key if type(key) is int else str(node.value)

    def blame(self, node: Node, path: KeyPath, message: str) -> None:
        self.problems.append(Problem(path, self.line(node), message))


def _line_of(error: YAMLError, text: str) -> int:
    """Return the line, counted from 1, at which reading stopped."""
    if isinstance(error, MarkedYAMLError):
        mark = error.problem_mark or error.context_mark
        return 1 if mark is None else mark.line + 1
    return text.count("\n", 0, error.position) + 1 if isinstance(error, ReaderError) else 1


def _reason(error: YAMLError) -> str:
    if isinstance(error, MarkedYAMLError):
        # some reasons of the reader begin with "but", as the second half of their context
        said = str(error.problem or error.context)
        said = f"{error.context}, {said}" if said.startswith("but ") else said
        return " ".join(said.split())
    if isinstance(error, ReaderError):
        return f"the character {error.character:#x} is not allowed"
    return " ".join(str(error).split())


def _compose(text: str, where: Where) -> Node | None:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return YAML(typ="safe", pure=True).compose(text)
    except YAMLError as error:
        sentence = f"{where(_line_of(error, text))}: this is not YAML: {_reason(error)}."
        raise ScenarioError(sentence) from error
    except (ValueError, ArithmeticError, LookupError, AssertionError) as error:
        # ruamel.yaml stumbles over a few texts, such as the escape of an impossible character
        raise ScenarioError(f"{where(1)}: this is not YAML: it cannot be read.") from error


def _read(text: str, where: Where) -> Document:
    reading = _Reading(where)
    try:
        node = _compose(text, where)
        data = None if node is None else reading.value(node, ())
    except RecursionError as error:
        said = "got values nested too deep or within themselves, allowed is a plain tree."
        raise ScenarioError(f"{where(1)}: {said}") from error
    reading.places.setdefault((), where(1))
    return Document(data, reading.places, tuple(reading.problems))


def read_yaml(text: str, file: str) -> Document:
    """Read one YAML 1.2 document; `file` is the name that places show.

    Mappings become dicts with keys of text or int, sequences lists. A repeated key, a tag, or a key
    that is a list or a mapping becomes a `Problem`.

    Raises:
        ScenarioError: The text is no YAML; one sentence, `file:line: ...`.
    """
    return _read(text, lambda line: f"{file}:{line}")


def _override_place(text: str) -> str:
    return "--set " + " ".join(text.split())


def _override(text: str) -> tuple[KeyPath, Document]:
    place = _override_place(text)
    name, equals, value = text.partition("=")
    if not equals:
        raise ScenarioError(f"{place}: got no `=`, allowed is `key=value`, as in `seed=7`.")
    parts = [part.strip() for part in name.split(".")]
    if not all(parts):
        said = "got an empty key, allowed are keys joined by dots, as in `simulation.dt=0.01`."
        raise ScenarioError(f"{place}: {said}")
    document = _read(value, lambda line: place)
    if document.problems:
        raise ScenarioError(f"{place}: {document.problems[0].message}")
    return tuple(int(p) if re.fullmatch("[0-9]{1,9}", p) else p for p in parts), document


def parse_override(text: str) -> tuple[KeyPath, object]:
    """Split `a.b=3` into its path and its value; the value is read as YAML 1.2.

    Raises:
        ScenarioError: There is no `=`, a key is empty, or the value is no YAML; one sentence.
    """
    path, document = _override(text)
    return path, document.data


def _entered(
    at: object, part: str | int, path: KeyPath, place: str
) -> tuple[dict[Any, object] | list[object], Any]:
    """Return a copy of the container `at`, found at `path`, and the key that `part` means."""
    if at is None:
        return {}, part
    if isinstance(at, dict):
        # a whole number means an int key (an agent), unless the mapping has it as text already
        return dict(at), str(part) if str(part) in at else part
    field = ".".join(map(str, path)) or "the file"
    if not isinstance(at, list):
        said = f"got `{part}` inside `{field}`, allowed is a key inside a mapping or a list, but"
        raise ScenarioError(f"{place}: {said} `{field}` is `{inline_yaml(at)}`.")
    if not isinstance(part, int) or part >= len(at):
        said = f"got `{part}` inside `{field}`, allowed is an index of a list of {len(at)}, from 0."
        raise ScenarioError(f"{place}: {said}")
    return list(at), part


def _replaced(
    at: object, rest: KeyPath, value: object, done: KeyPath, place: str
) -> tuple[object, KeyPath]:
    """Return `at` with `value` set at `rest` below it, and the exact path at which it was set."""
    if not rest:
        return value, done
    copy, key = _entered(at, rest[0], done, place)
    old = copy.get(key) if isinstance(copy, dict) else copy[key]
    copy[key], exact = _replaced(old, rest[1:], value, (*done, key), place)
    return copy, exact


def apply_overrides(document: Document, overrides: Iterable[str]) -> Document:
    """Lay `a.b=3` texts over a document, in their order; such a value's place is `--set a.b=3`.

    A whole number in a path indexes a list or is a mapping's int key; missing mappings are made.

    Raises:
        ScenarioError: An override is malformed, or leads into something that is no mapping or list.
    """
    data, places = document.data, dict(document.places)
    for text in overrides:
        place = _override_place(text)
        path, given = _override(text)
        data, exact = _replaced(data, path, given.data, (), place)
        places = {at: old for at, old in places.items() if at[: len(exact)] != exact}
        places.update({exact + below: place for below in given.places})
        for depth in range(len(exact)):
            places.setdefault(exact[:depth], place)
    return Document(data, places, document.problems)


def _quoted(text: str) -> str:
    if re.fullmatch(r"[A-Za-z_][A-Za-z0-9_./-]*", text) and _plain(text) is text:
        return text
    plain = {char: char for char in map(chr, range(32, 127))} | {'"': '\\"', "\\": "\\\\"}
    return '"' + "".join(plain.get(char, f"\\U{ord(char):08x}") for char in text) + '"'


def inline_yaml(value: object) -> str:
    """Write plain data as YAML 1.2 on one line; `read_yaml` reads it back unchanged."""
    if isinstance(value, dict):
        pairs = (f"{inline_yaml(key)}: {inline_yaml(item)}" for key, item in value.items())
        return "{" + ", ".join(pairs) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(inline_yaml, value)) + "]"
    if isinstance(value, str):
        return _quoted(value)
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    return repr(value).replace("inf", ".inf").replace("nan", ".nan")


def dump_yaml(data: object) -> str:
    """Write plain data as YAML 1.2, a line for each key of the outermost mapping."""
    if not isinstance(data, dict) or not data:
        return inline_yaml(data) + "\n"
    return "".join(f"{inline_yaml(key)}: {inline_yaml(value)}\n" for key, value in data.items())


def shown(value: object) -> str:
    """Return a value as a message shows it: in back-ticks, and short."""
    if value is None:
        return "nothing"
    if isinstance(value, dict):
        return "a mapping"
    text = inline_yaml(value)
    return f"`{text}`" if len(text) <= 60 else f"`{text[:57]}...`"


def are(names: Sequence[str]) -> str:
    """Return names as a message lists them: ``are `a`, `b```, or ``is `a```."""
    return f"{'is' if len(names) == 1 else 'are'} {listing(names)}"
