"""Reads YAML 1.2 into plain data with the line of each value, and applies overrides.

ruamel.yaml composes the text into nodes, interprets words and writes YAML. Its constructor would
stop at the first repeated key and drop the line numbers, so the nodes are traversed here. Values
from the command line (`--set a.b=3`) are read the same way and replace the file's before anything
is checked, so the same rules apply to both.
"""

import io
import re
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple, final

from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.nodes import MappingNode, Node, ScalarNode
from ruamel.yaml.reader import ReaderError
from ruamel.yaml.representer import SafeRepresenter

from echelon.core.errors import ScenarioError, listing

KeyPath = tuple[str | int, ...]
Where = Callable[[int], str]


class ScenarioFault(NamedTuple):
    """One fault of a scenario: its place, its key (joined by dots), and a sentence."""

    place: str
    field: str
    message: str

    def __str__(self) -> str:
        # The place of an override contains its key.
        override = self.place.startswith(f"--set {self.field}=")
        parts = (self.place, "" if override else self.field, self.message)
        return ": ".join(part for part in parts if part)


class Document(NamedTuple):
    """Plain data, the place (`file:line`) of every path read, the faults of reading, the overrides.

    `overrides` are paths that the command line has set, each with its `--set a.b=3`.
    """

    data: Any
    places: dict[KeyPath, str]
    faults: tuple[ScenarioFault, ...] = ()
    overrides: tuple[tuple[KeyPath, str], ...] = ()

    def place(self, path: KeyPath) -> str:
        """Return the place of `path`, or of the nearest part above it that has one.

        If the command line set it, something inside it or something around it, that is the place.
        """
        while path:
            for exact, place in reversed(self.overrides):
                if exact[: len(path)] == path[: len(exact)]:
                    return place
            if path in self.places:
                break
            path = path[:-1]
        return self.places[path]


def joined(path: KeyPath) -> str:
    """Return the keys of a path joined by dots, as in messages and on the command line."""
    return ".".join(map(str, path))


_WORDS = {f"tag:yaml.org,2002:{kind}" for kind in ("null", "bool", "int", "float")}
"""The types of an unquoted word, other than text."""
_ALIASED = 10_000
"""Values that aliases may add. Without aliases there is at most one value for each character of the
text; aliases of aliases multiply without bound."""


@final
class _Reading:
    def __init__(self, where: Where, text: str) -> None:
        self.where, self.most = where, len(text) + _ALIASED
        self.yaml = YAML(typ="safe", pure=True)
        self.places: dict[KeyPath, str] = {}
        self.faults: list[ScenarioFault] = []

    def line(self, node: Node) -> str:
        return self.where(node.start_mark.line + 1)

    def value(self, node: Node, path: KeyPath) -> object:
        self.places.setdefault(path, self.line(node))
        if len(self.places) > self.most:
            text = f"got aliases for more than {_ALIASED} values, allowed is a plain tree."
            raise ScenarioError(f"{self.line(node)}: {text}")
        if node.ctag.handle is not None:
            tag = f"{node.ctag.handle}{node.ctag.suffix}"
            self.add_fault(node, path, f"got the tag `{tag}`, allowed are values without a tag.")
        if isinstance(node, ScalarNode):
            return self.meaning(node)
        if isinstance(node, MappingNode):
            return self.mapping(node, path)
        return [self.value(item, (*path, i)) for i, item in enumerate(node.value)]

    def meaning(self, node: ScalarNode) -> object:
        """Return the value of a word in YAML 1.2; ruamel.yaml differs in two respects."""
        text = str(node.value)
        if not node.style and re.fullmatch(r"[-+]?\.[0-9]+[eE][0-9]+", text):
            return float(text)  # ruamel.yaml needs a sign in the exponent of `.5e3`
        if node.tag not in _WORDS or "_" in text:
            return text  # ruamel.yaml reads `1_000` as a number, dates and `<<` not as text
        try:
            return self.yaml.constructor.construct_object(node)
        except (ValueError, LookupError):  # more digits than Python reads, or an invalid tag
            return text

    def mapping(self, node: MappingNode, path: KeyPath) -> dict[str | int, object]:
        data: dict[str | int, object] = {}
        for key_node, value_node in node.value:
            key = self.key(key_node, path)
            below = (*path, key)
            if key in data:
                sentence = f"got this key twice, the first is at {self.places[below]}."
                self.add_fault(key_node, below, sentence)
                continue
            self.places[below] = self.line(key_node)
            data[key] = self.value(value_node, below)
        return data

    def key(self, node: Node, path: KeyPath) -> str | int:
        if not isinstance(node, ScalarNode):
            text = "got a list or mapping as a key, allowed is a word or a number."
            self.add_fault(node, path, text)
            return "?"
        return key_of(self.meaning(node), str(node.value))

    def add_fault(self, node: Node, path: KeyPath, message: str) -> None:
        self.faults.append(ScenarioFault(self.line(node), joined(path), message))


def _reason(error: Exception, text: str) -> tuple[int, str]:
    """Return the line, counted from 1, at which reading stopped, and the reason."""
    if isinstance(error, ReaderError):
        line = text.count("\n", 0, error.position) + 1
        return line, f"the character {error.character:#x} is not allowed"
    if not isinstance(error, MarkedYAMLError) or error.problem_mark is None:
        # ruamel.yaml raises other errors for a few texts, such as the escape of no character
        return 1, "it cannot be read"
    # some problems begin with "but", and continue their context
    context = f"{error.context}, " if error.problem.startswith("but ") else ""
    return error.problem_mark.line + 1, " ".join(f"{context}{error.problem}".split())


def _read(text: str, where: Where) -> Document:
    reading = _Reading(where, text)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            node = reading.yaml.compose(text)
        data = None if node is None else reading.value(node, ())
    except RecursionError as error:
        text = "got values nested too deep or within themselves, allowed is a plain tree."
        raise ScenarioError(f"{where(1)}: {text}") from error
    except (YAMLError, ValueError, ArithmeticError, LookupError, AssertionError) as error:
        line, reason = _reason(error, text)
        raise ScenarioError(f"{where(line)}: this is not YAML: {reason}.") from error
    reading.places.setdefault((), where(1))
    return Document(data, reading.places, tuple(reading.faults))


def read_yaml(text: str, file: str) -> Document:
    """Read one YAML 1.2 document; `file` is the name in places.

    Mappings become dicts with keys of text or int, sequences lists. A repeated key, a tag, or a key
    that is a list or a mapping becomes a `ScenarioFault`.

    Raises:
        ScenarioError: The text is not YAML; one sentence, `file:line: ...`.
    """
    return _read(text, lambda line: f"{file}:{line}")


def key_of(key: object, text: str) -> str | int:
    """Return a key as a whole number if it is one, or its text, as in JSON; else as text."""
    if type(key) is int:
        return key
    return int(text) if re.fullmatch("0|[1-9][0-9]{0,8}", text) else text


def plain(value: object) -> Any:
    """Return data with lists for tuples and arrays, and Python numbers for NumPy numbers."""
    to_list: Callable[[], object] | None = getattr(value, "tolist", None)
    value = value if to_list is None else to_list()
    if isinstance(value, Mapping):
        keys = ((plain(key), item) for key, item in value.items())
        return {key_of(k, k) if isinstance(k, str) else k: plain(item) for k, item in keys}
    return list(map(plain, value)) if isinstance(value, list | tuple) else value


def _override(text: str) -> tuple[KeyPath, object, str]:
    """Return the path, the value and the place of `a.b=3`."""
    place = "--set " + " ".join(text.split())
    name, equals, value = text.partition("=")
    if not equals:
        raise ScenarioError(f"{place}: got no `=`, allowed is `key=value`, as in `seed=7`.")
    parts = [part.strip() for part in name.split(".")]
    if not all(parts):
        text = "got an empty key, allowed are keys joined by dots, as in `simulation.dt=0.01`."
        raise ScenarioError(f"{place}: {text}")
    document = _read(value, lambda line: place)
    if document.faults:
        raise ScenarioError(f"{place}: {document.faults[0].message}")
    path = tuple(key_of(part, part) for part in parts)
    return path, document.data, place


def _replace(
    at: object, rest: KeyPath, value: object, done: KeyPath, place: str
) -> tuple[object, KeyPath]:
    """Return `at` with `value` set at `rest` below it, and the exact path at which it was set."""
    if not rest:
        return value, done
    copy: Any = dict(at or {}) if at is None or isinstance(at, dict) else at
    key: Any = rest[0]
    if isinstance(copy, dict):
        copy.setdefault(key)
    elif isinstance(copy, list) and isinstance(key, int) and key < len(copy):
        copy = list(copy)
    else:
        field = joined(done) or "the file"
        other = f"a key inside a mapping or a list, but `{field}` is {quoted(at)}"
        allowed = f"an index of a list of {len(copy)}, from 0" if isinstance(at, list) else other
        raise ScenarioError(f"{place}: got `{key}` inside `{field}`, allowed is {allowed}.")
    copy[key], exact = _replace(copy[key], rest[1:], value, (*done, key), place)
    return copy, exact


def apply_overrides(document: Document, overrides: Iterable[str]) -> Document:
    """Replace values of a document by `a.b=3` texts, in order; their place is `--set a.b=3`.

    A whole number in a path indexes a list or is a mapping's int key; missing mappings are created.

    Raises:
        ScenarioError: An override is malformed, or its path leads through a value that is neither a
            mapping nor a list.
    """
    for text in overrides:
        path, value, place = _override(text)
        data, exact = _replace(document.data, path, value, (), place)
        document = document._replace(data=data, overrides=(*document.overrides, (exact, place)))
    return document


@final
class _Representer(SafeRepresenter):
    """Writes every value in full, where ruamel.yaml would write an alias for a repeated one."""

    def ignore_aliases(self, data: object) -> bool:
        return True

    def text(self, data: object) -> ScalarNode:
        text = data if isinstance(data, str) else str(data)
        # Only double quotes keep every character: in the others ruamel.yaml folds U+0085 away.
        style = None if re.fullmatch(r"[A-Za-z_][A-Za-z0-9_./-]*", text) else '"'
        return self.represent_scalar("tag:yaml.org,2002:str", text, style)


# A mapping may contain any object: those unknown to YAML are written as text, and the schema
# refuses them.
for _kind in (str, bytes, set, None):
    _Representer.add_representer(_kind, _Representer.text)


def _written(data: object, flow: bool | None) -> str:
    yaml: Any = YAML(typ="safe", pure=True)
    yaml.Representer, yaml.default_flow_style = _Representer, flow
    yaml.width, yaml.sort_base_mapping_type_on_output = sys.maxsize, False
    stream = io.StringIO()
    yaml.dump(data, stream)
    return stream.getvalue().removesuffix("...\n")


def inline_yaml(value: object) -> str:
    """Write plain data as YAML 1.2 on one line; `read_yaml` reads it back unchanged."""
    return _written(value, True).rstrip("\n")


def dump_yaml(data: object) -> str:
    """Write plain data as YAML 1.2, the innermost lists and mappings on one line each."""
    return _written(data, None)


def rename_files(data: object, rename: Callable[[str], str], path: KeyPath = ()) -> None:
    """Replace the name of every file in a part of plain data."""
    for place, name, rest in list(named_files(part_at(data, path), path)):
        part_at(data, place[:-1])[place[-1]] = rename(name) + rest


def named_files(value: object, path: KeyPath) -> Iterator[tuple[KeyPath, str, str]]:
    """Yield the path of every file name in plain data, the name, and the text after it."""
    if isinstance(value, dict | list):
        for key, item in value.items() if isinstance(value, dict) else enumerate(value):
            yield from named_files(item, (*path, key))
    elif isinstance(value, str) and path and path[-1] == "file":
        yield path, value, ""
    elif isinstance(value, str) and path and path[-1] == "python" and ":" in value:
        file, colon, name = value.rpartition(":")
        yield path, file, colon + name


def part_at(data: Any, path: KeyPath) -> Any:
    """Return what is at a path of plain data; None where there is nothing."""
    for key in path:
        try:
            data = data[key]
        except (LookupError, TypeError):
            # A path through a number or a text leads nowhere; the checks report it.
            return None
    return data


def quoted(value: object) -> str:
    """Return a value for a message: in back-ticks, and short."""
    if value is None:
        return "nothing"
    if isinstance(value, dict):
        return "a mapping"
    text = inline_yaml(value)
    return f"`{text}`" if len(text) <= 60 else f"`{text[:57]}...`"


def is_or_are(names: Sequence[str]) -> str:
    """Return names for a message: ``are `a`, `b```, or ``is `a```."""
    return f"{'is' if len(names) == 1 else 'are'} {listing(names)}"
