"""Write the page of all scenario keys, docs/scenario.md, from the JSON schema.

Run it with `python docs/scenario_keys.py`.
"""

import inspect
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, TypeAlias

from echelon.experiments.scenario import registry
from echelon.experiments.scenario.named_class import resolve
from echelon.experiments.scenario.scenario import json_schema

_HEAD = """# Scenario keys

All keys of a scenario file ([a first one](start.md)). A *section* is a mapping with the keys of its
list below; a key without a default may be left out. *By state or group* means a mapping from names
of the model, such as `{x: 1.0}` or `{position: 1.0}` for all its coordinates. Numbers are in SI
units and angles in rad; *1* marks a number without a unit. `python: file.py:Class` names a class of
[yours](extending.md). `docs/scenario_keys.py` writes the page.
"""
Schema: TypeAlias = Mapping[str, Any]
"""A part of a JSON schema."""
_NAMES = {"ModelSpec": "Models", "ReferenceSpec": "References"}
"""Sections whose names have a list of their own."""


def keys_page() -> str:
    """Return the page in Markdown."""
    schema = json_schema()
    defs = schema["$defs"]
    inner = {name: _referred(what, defs) for name, what in schema["properties"].items()}
    sections = {"the file": schema} | {f"`{x}`": part for x, part in inner.items() if part}
    sections["an entry of `motion`, of the formation"] = defs["MotionSpec"]
    sections["`gain`, of leader or follower"] = defs["GainSpec"]
    parts, explained = [_HEAD], dict[tuple[str, str], str]()
    for title, part in sections.items():
        parts += _section(title, part, defs, explained)
    parts += [*_named("References", registry.REFERENCES), *_named("Models", registry.MODELS)]
    return "\n".join(parts)


def _section(
    title: str, part: Schema, defs: Schema, explained: dict[tuple[str, str], str]
) -> Iterator[str]:
    """Yield a heading, the section's sentence and the list of its keys."""
    yield f"## {title[0].upper()}{title[1:]}\n"
    yield f"{_line(part['description'])}\n"
    family = next((_NAMES[name] for name in _NAMES if defs[name] is part), "")
    rows, linked = list[str](), list[str]()
    for key, what in part["properties"].items():
        inner = _referred(what, defs)
        meaning = _line(what.get("description") or (inner or {}).get("description", ""))
        if inner is not None and inner is not defs["UserClass"]:
            kind, meaning = _linked(key, inner, defs, meaning)
        elif key == "name" and family:
            kind = f"[name](#{family.lower()})"
        else:
            kind = _unit(_kind(what, defs), what.get("unit", ""), meaning)
        # Keys of several sections are explained where the first one has them.
        first = explained.setdefault((key, meaning), title)
        long = len(meaning.split()) > 8 and first != title
        value = ", ".join(filter(None, (kind, _default(key, what, part))))
        if meaning:
            rows.append(f"- `{key}` ({value}): {f'as in {first}.' if long else meaning}")
        else:
            linked.append(f"[`{key}`](#{key}){' (required)' * ('required' in value)}")
    yield from [f"- Sections: {', '.join(linked)}."] * bool(linked)
    yield from rows
    yield ""


def _linked(key: str, inner: Schema, defs: Schema, meaning: str) -> tuple[str, str]:
    """Return the link to a section, and its meaning where the section does not state it."""
    anchors = {"GainSpec": "gain-of-leader-or-follower"}
    if inner is defs["GainSpec"]:
        return f"[section](#{anchors['GainSpec']})", meaning
    if _line(inner.get("description", "")) == meaning and key != "bursts":
        return f"[section](#{key})", ""
    return "section", meaning


def _unit(kind: str, unit: str, meaning: str) -> str:
    """Return the type with the unit, unless the meaning states it."""
    stated = re.search(rf"(, |in (the )?){re.escape(unit)}( units)?\b", meaning) or not unit
    return kind if stated else f"{kind}; {unit}"


def _referred(what: Schema, defs: Schema) -> Schema | None:
    """Return the section of a key; None where the key has a value."""
    kinds = [kind for kind in what.get("anyOf", [what]) if kind.get("type") != "null"]
    if len(kinds) != 1 or "$ref" not in kinds[0]:
        return None
    return defs[kinds[0]["$ref"].rpartition("/")[2]]


def _default(key: str, what: Schema, part: Schema) -> str:
    if key in part.get("required", ()):
        return "required"
    value = what.get("default")
    if value in (None, {}):
        return ""
    return f"default `{str(value).lower() if isinstance(value, bool) else value}`"


def _kind(what: Schema, defs: Schema) -> str:
    """Return the type of a key in words."""
    if "anyOf" in what:
        kinds = [_kind(kind, defs) for kind in what["anyOf"] if kind.get("type") != "null"]
        return " or ".join(dict.fromkeys(kinds))
    if "$ref" in what:
        return "`{python: file.py:Class, ...}`"
    if "const" in what:
        return f"`{what['const']}`"
    if "enum" in what:
        return ", ".join(f"`{name}`" for name in what["enum"])
    if what.get("type") == "object":
        inner = what.get("additionalProperties")
        # The model determines what an open mapping may contain.
        return f"mapping to {_kind(inner, defs)}" if isinstance(inner, dict) else "mapping"
    if what.get("type") == "array":
        return "list"
    return _scalar(what)


_SCALARS = {"integer": "integer", "number": "number", "boolean": "`true`/`false`"}


def _scalar(what: Schema) -> str:
    kind = what.get("type", "")
    if isinstance(kind, list):
        return " or ".join(_kind({"type": each}, {}) for each in kind)
    name = _SCALARS.get(kind, "text" if kind == "string" else "anything")
    if "exclusiveMinimum" in what:
        return f"{name} > {what['exclusiveMinimum']}"
    return f"{name} >= {what['minimum']}" if "minimum" in what else name


def _named(title: str, entries: Mapping[str, registry.Entry]) -> Iterator[str]:
    """Yield a family's names with the parameters of their classes."""
    yield f"## {title}\n"
    yield "The names and their keys; units are in the [reference](api.md).\n"
    for name, entry in entries.items():
        keys = ", ".join(map(_key, inspect.signature(resolve(entry)).parameters.values()))
        yield f"- `{name}`: {'; '.join(filter(None, (entry.summary, keys)))}"
    yield ""


def _key(key: inspect.Parameter) -> str:
    return f"`{key.name}`" if key.default is key.empty else f"`{key.name}: {_yaml(key.default)}`"


def _yaml(value: object) -> str:
    """Return a default as YAML."""
    if isinstance(value, tuple):
        return f"[{', '.join(map(_yaml, value))}]"
    return str(value).lower() if isinstance(value, bool) or value is None else f"{value}"


def _line(text: str) -> str:
    return " ".join(text.split())


if __name__ == "__main__":
    Path(__file__).with_name("scenario.md").write_text(keys_page(), "utf-8")
