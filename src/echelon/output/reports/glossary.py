"""The glossary of the documentation, term by term, for the terminal."""

import re
from pathlib import Path
from typing import Final

from echelon.core.errors import OutputError, did_you_mean

_PLACES: Final = (
    Path(__file__).with_name("glossary.md"),  # in a wheel
    Path(__file__).resolve().parents[4] / "docs" / "glossary.md",
)
_LINK: Final = re.compile(r"\[([^\]]*)\]\([^)]*\)")


def glossary() -> dict[str, str]:
    """Return every term with what it means.

    Raises:
        OutputError: the glossary is not there, as in a copy without `docs/`.
    """
    found = next((place for place in _PLACES if place.is_file()), None)
    if found is None:
        raise OutputError("this copy of echelon has no glossary; it stands in `docs/glossary.md`.")
    terms: dict[str, str] = {}
    for block in re.split(r"^- (?=\*\*)", found.read_text("utf-8"), flags=re.MULTILINE)[1:]:
        # A term ends where its paragraph does, before a heading or another list.
        name, _, text = block.split("\n\n")[0].partition("**: ")
        plain = _LINK.sub(r"\1", " ".join(text.split()))
        terms[name.strip("* ").replace("**", "")] = plain.replace("*", "")
    return terms


def explain_term(asked: str) -> dict[str, str]:
    """Return the terms that are meant, each with what it means.

    Raises:
        OutputError: there is none.
    """
    terms, wanted = glossary(), asked.strip().lower()
    exact = {name: text for name, text in terms.items() if name.lower() == wanted}
    part = {name: text for name, text in terms.items() if wanted and wanted in name.lower()}
    found = exact or part
    if not found:
        close = did_you_mean(wanted, [name.lower() for name in terms])
        raise OutputError(
            f"`{asked}` is no term of the glossary{close}; `echelon explain` lists them."
        )
    return found
