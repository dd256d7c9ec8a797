"""The messages of errors and reports are those of sentences.txt, and errors are whole sentences."""

import pytest
from sentences import INDENT, answer, groups

import echelon as ech

GROUPS = {title: body for title, body in groups() if title}
ERRORS = [title for title in GROUPS if not title.startswith("Command")]


@pytest.mark.parametrize("title", GROUPS)
def test_what_echelon_answers_is_in_the_file(title):
    found = {given: answer(title, given) for given, _ in GROUPS[title]}
    assert found == dict(GROUPS[title]), "`python3 dev.py sentences` writes the file again"


def test_no_input_is_there_twice():
    inputs = [given for body in GROUPS.values() for given, _ in body]
    assert len(inputs) > 250 and len(inputs) == len(set(inputs))


@pytest.mark.parametrize("title", ERRORS)
def test_each_error_is_one_sentence(title):
    for given, text in GROUPS[title]:
        assert text.startswith(INDENT) and text.endswith((".", ".)")), given
        assert "\n" not in text and ". " not in text.replace("...", ""), given
        assert text.count("`") % 2 == 0, given


@pytest.mark.parametrize("title", [title for title in ERRORS if title.startswith("Python")])
def test_each_error_of_python_is_echelons_own(title):
    for _, text in GROUPS[title]:
        kind = getattr(ech.core.errors, text.split(":")[0].strip())
        assert issubclass(kind, ech.EchelonError) and kind.exit_code == 2
