"""The glossary of the documentation for `echelon explain`."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from echelon.core.errors import OutputError, did_you_mean
from echelon.experiments.results.run_numbers import AGENT_NUMBERS, ERROR, RUN_NUMBERS

_PLACES: Final = (
    Path(__file__).with_name("glossary.md"),  # in a wheel
    Path(__file__).resolve().parents[4] / "docs" / "glossary.md",
)
_LINK: Final = re.compile(r"\[([^\]]*)\]\([^)]*\)")
_BOLD: Final = re.compile(r"\*\*(.+?)\*\*")
_SLANTED: Final = re.compile(r"(?<![\w*])\*(\w[^*]*)\*")


def glossary(more: Mapping[str, str]) -> dict[str, str]:
    """Return every term with its definition, and `more` terms, those of scenarios.

    Raises:
        OutputError: the glossary is missing, as in a copy without `docs/`.
    """
    file = next((place for place in _PLACES if place.is_file()), None)
    if file is None:
        raise OutputError("this copy of echelon has no `docs/glossary.md`; install echelon again.")
    terms: dict[str, str] = {}
    others: dict[str, str] = {}
    for block in re.split(r"^- (?=\*\*)", file.read_text("utf-8"), flags=re.MULTILINE)[1:]:
        # A term ends where its paragraph does, before a heading or another list.
        names, _, text = " ".join(block.split("\n\n")[0].split()).partition("**: ")
        first, *more_names = (name.strip("* ") for name in names.split("**, **"))
        terms[first] = _SLANTED.sub(r"\1", _BOLD.sub(r"\1", _LINK.sub(r"\1", text)))
        others |= dict.fromkeys([*more_names, *_BOLD.findall(text)], terms[first])
    # The definition of a term comes before the keys of its name.
    return {**others, **terms, **_numbers(), **more, **others, **terms}


def _numbers() -> dict[str, str]:
    """Return the meanings of the numbers in data sets and JSON, by name, with their units."""
    return {
        name: quantity.meaning + (f", {quantity.unit.replace(ERROR, 'm')}" if quantity.unit else "")
        for name, quantity in {**AGENT_NUMBERS, **RUN_NUMBERS}.items()
    }


def explain_term(term: str, more: Mapping[str, str]) -> dict[str, str]:
    """Return the definitions of a term with those of its keys; else of all that contain it.

    Raises:
        OutputError: there is none.
    """
    terms, key = glossary(more), _plain(term)
    matches = _named(key, terms) or _containing(key, terms)
    by_word = [_named(word, terms) for word in key.split()]
    if not matches and all(by_word):
        matches = {name: text for terms_of in by_word for name, text in terms_of.items()}
    if not matches:
        close = did_you_mean(term.strip().lower(), [name.lower() for name in terms])
        raise OutputError(
            f"the glossary has no term `{term}`{close}; `echelon explain` lists all terms."
        )
    return matches


def _plain(term: str) -> str:
    return " ".join(re.findall(r"[^\s_.,-]+", term.lower()))


def _named(key: str, terms: Mapping[str, str]) -> dict[str, str]:
    """Return the terms of this name with the keys that end in it; none without such a term."""
    joined = key.replace(" ", "")
    names = {name: _plain(name).replace(" ", "") for name in terms}
    # A key alone is not all that its last name may mean, as `margin` of `safety` is not.
    if joined not in names.values():
        return {}
    ends = {name: name.lower().split(".")[-1].replace("_", "") for name in terms}
    return {name: terms[name] for name in terms if joined in (names[name], ends[name])}


def _containing(key: str, terms: Mapping[str, str]) -> dict[str, str]:
    """Return the terms in which words begin as those of a key, or a key's last name is it."""
    start = re.compile(rf"(?<!\w){re.escape(key)}") if key else None
    return {
        name: text
        for name, text in terms.items()
        if start
        and (
            start.search(_plain(name))
            or key.replace(" ", "") == name.lower().split(".")[-1].replace("_", "")
        )
    }
