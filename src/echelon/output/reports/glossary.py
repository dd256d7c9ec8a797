"""The glossary of the documentation for `echelon explain`."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from echelon.core.errors import OutputError, did_you_mean
from echelon.experiments.results.quantity import ERROR
from echelon.experiments.results.run_numbers import AGENT_NUMBERS, RUN_NUMBERS

_PLACES: Final = (
    Path(__file__).with_name("glossary.md"),  # in a wheel
    Path(__file__).resolve().parents[4] / "docs" / "glossary.md",
)
_LINK: Final = re.compile(r"\[([^\]]*)\]\([^)]*\)")


def glossary(more: Mapping[str, str]) -> dict[str, str]:
    """Return every term with its definition, and `more` terms, those of scenarios.

    Raises:
        OutputError: the glossary is missing, as in a copy without `docs/`.
    """
    file = next((place for place in _PLACES if place.is_file()), None)
    if file is None:
        raise OutputError("this copy of echelon has no `docs/glossary.md`; install echelon again.")
    terms: dict[str, str] = {}
    for block in re.split(r"^- (?=\*\*)", file.read_text("utf-8"), flags=re.MULTILINE)[1:]:
        # A term ends where its paragraph does, before a heading or another list.
        name, _, text = block.split("\n\n")[0].partition("**: ")
        plain = _LINK.sub(r"\1", " ".join(text.split()))
        terms[name.strip("* ").replace("**", "")] = plain.replace("*", "")
    return {**_numbers(), **more, **terms}


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
    terms, key = glossary(more), term.strip().lower()
    # A key alone is not all that its last name may mean, as `margin` of `safety` is not.
    exact = key in map(str.lower, terms)
    matches = {
        name: text
        for name, text in terms.items()
        if (key in (name.lower(), name.split(".")[-1]) if exact else key and key in name.lower())
    }
    if not matches:
        close = did_you_mean(key, [name.lower() for name in terms])
        raise OutputError(
            f"the glossary has no term `{term}`{close}; `echelon explain` lists all terms."
        )
    return matches
