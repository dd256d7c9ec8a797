"""The messages of errors and reports are those of sentences.txt, and errors are whole sentences."""

import pytest
from sentences import INDENT, answer, groups

import echelon as ech

GROUPS = {title: body for title, body in groups() if title}


@pytest.mark.parametrize("title", GROUPS)
def test_what_echelon_answers_is_in_the_file(title):
    found = {given: answer(title, given) for given, _ in GROUPS[title]}
    assert found == dict(GROUPS[title]), "`python3 dev.py sentences` writes the file again"


def test_no_input_is_there_twice():
    inputs = [given for body in GROUPS.values() for given, _ in body]
    assert len(inputs) > 250 and len(inputs) == len(set(inputs))


def test_each_error_is_one_sentence_and_that_of_python_is_echelon_s_own():
    faults = []
    for title, body in GROUPS.items():
        for given, text in body if not title.startswith("Command") else ():
            words = text.removeprefix(INDENT)
            whole = words != text and text.endswith((".", ".)")) and "\n" not in text
            whole &= ". " not in text.replace("...", "") and text.count("`") % 2 == 0
            if title.startswith("Python"):
                kind = getattr(ech.core.errors, words.split(":")[0])
                whole &= issubclass(kind, ech.EchelonError) and kind.exit_code == 2
            faults += [] if whole else [given]
    assert faults == []
