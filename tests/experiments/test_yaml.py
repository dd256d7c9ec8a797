"""Reading YAML 1.2 with the place of every value, and overrides."""

import itertools
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from echelon.core.errors import ScenarioError
from echelon.experiments.scenario.yaml import apply_overrides, dump_yaml, inline_yaml, read_yaml

WORDS = st.sampled_from(
    ["no", "null", "1e-3", "0x1F", ".5e3", "~", "- a", "a: b", "#", "é\x85\u2028"]
)
SCALARS = (
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats(allow_nan=False)
    | st.text(max_size=12)
    | WORDS
)
# The text of a whole number is that number, as in JSON.
KEYS = st.text(max_size=8).filter(lambda text: not text.isdecimal()) | WORDS | st.integers()
DATA = st.recursive(
    SCALARS,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(KEYS, inner, max_size=4),
    max_leaves=20,
)


def read(text):
    document = read_yaml(text, "f.yaml")
    assert not document.faults
    return document.data


def same(one, other):
    """Equality that also tells 1 from 1.0 and True, and looks into containers."""
    if type(one) is not type(other):
        return False
    if isinstance(one, dict):
        return list(one) == list(other) and all(same(one[key], other[key]) for key in one)
    if isinstance(one, list):
        return len(one) == len(other) and all(map(same, one, other))
    return one == other


@given(DATA)
def test_what_is_written_is_read_back(data):
    assert same(read(dump_yaml(data)), data)
    assert same(read(inline_yaml(data)), data)


def lay_out(data, indent, path, lines, places):
    """Write containers over many lines; note where each key and item begins."""
    pairs = data.items() if isinstance(data, dict) else enumerate(data)
    for key, value in pairs:
        start = " " * indent + ("-" if isinstance(data, list) else f"{inline_yaml(key)}:")
        lines.append(
            start if isinstance(value, dict | list) and value else f"{start} {inline_yaml(value)}"
        )
        places[(*path, key)] = f"f.yaml:{len(lines)}"
        if isinstance(value, dict | list) and value:
            if isinstance(data, list):
                # the first line of an item's content is the item's place
                places[(*path, key)] = f"f.yaml:{len(lines) + 1}"
            lay_out(value, indent + 2, (*path, key), lines, places)


@given(st.dictionaries(KEYS, DATA, min_size=1, max_size=4))
def test_every_key_and_item_has_the_line_where_it_begins(data):
    lines, places = ["# a comment", ""], {}
    lay_out(data, 0, (), lines, places)
    document = read_yaml("\n".join(lines), "f.yaml")
    assert same(document.data, data)
    assert document.places == {(): "f.yaml:3"} | places


@given(st.text(alphabet="{}[]:,-?!&*|>%@`'\"#\\ \n\tab01.~<=\x07\u2028", max_size=40))
def test_any_text_is_read_or_refused_in_one_sentence(text):
    try:
        assert read_yaml(text, "f.yaml").places[()].startswith("f.yaml:")
    except ScenarioError as error:
        assert "\n" not in str(error) and str(error).startswith("f.yaml:")


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e-3", 0.001),
        ("-1E+3", -1000.0),
        (".5", 0.5),
        ("-.5e3", -500.0),
        ("2.", 2.0),
        ("012", 12),
        ("0o14", 12),
        ("0x1F", 31),
        ("no", "no"),
        ("on", "on"),
        ("Yes", "Yes"),
        ("True", True),
        ("1_000", "1_000"),
        ("1:30", "1:30"),
        ("2024-01-01", "2024-01-01"),
        ("'1'", "1"),
        ("~", None),
        ("", None),
        ("=", "="),
        ("<<", "<<"),
        ("9" * 5000, "9" * 5000),
        ("-.inf", -math.inf),
        ("inf", "inf"),
    ],
)
def test_words_mean_what_yaml_1_2_says(text, value):
    assert same(read(f"a: {text}"), {"a": value})


def test_not_a_number_is_a_number_and_whole_number_keys_stay():
    assert math.isnan(read(".nan")) and inline_yaml(math.nan) == ".nan"
    keys = {1: "a", 2: "b", "03": "e", "1.5": "c", "true": "d"}
    assert same(read("{1: a, '2': b, '03': e, 1.5: c, true: d}"), keys)


def test_an_alias_stands_for_its_anchor_and_a_missing_path_for_its_parent():
    document = read_yaml("a: &x\n  - 1\nb: *x\n", "f.yaml")
    assert document.data == {"a": [1], "b": [1]}
    assert document.place(("b",)) == "f.yaml:3" and document.place(("b", 0)) == "f.yaml:2"
    assert document.place(("b", "c", 3)) == "f.yaml:3"


def test_repeated_keys_tags_and_keys_that_are_no_words_are_told():
    document = read_yaml(
        "a: 1\nb: {c: 1,\n  c: 2}\na: 3\nd: !!str 3\n? [1]\n: 2\ne: !!int x\n", "f.yaml"
    )
    assert sorted(tuple(fault) for fault in document.faults) == [
        ("f.yaml:3", "b.c", "got this key twice, the first is at f.yaml:2."),
        ("f.yaml:4", "a", "got this key twice, the first is at f.yaml:1."),
        ("f.yaml:5", "d", "got the tag `!!str`, allowed are values without a tag."),
        ("f.yaml:6", "", "got a list or mapping as a key, allowed is a word or a number."),
        ("f.yaml:8", "e", "got the tag `!!int`, allowed are values without a tag."),
    ]


LETTERS = itertools.pairwise("abcdefgh")
BOMB = "".join(f"- &{c} [{', '.join([f'*{b}'] * 9)}]\n" for b, c in LETTERS)
NESTED = "got values nested too deep or within themselves, allowed is a plain tree."
NOT_YAML = {
    "a: 1\nb: [1, 2\nc: 3\n": "3: this is not YAML: expected ',' or ']', but got ':'.",
    "a: 1\nb: c: d\n": "2: this is not YAML: mapping values are not allowed here.",
    "a: 1\nb: \x07\n": "2: this is not YAML: the character 0x7 is not allowed.",
    "a: *b\n": "1: this is not YAML: found undefined alias 'b'.",
    "a: 1\n---\nb: 2\n": "2: this is not YAML: expected a single document in the stream, but found"
    " another document.",
    'a: "\\UFFFFFFFF"': "1: this is not YAML: it cannot be read.",
    "a: &x [*x]\n": f"1: {NESTED}",
    "[" * 5000: f"1: {NESTED}",
    f"- &a [1, 1]\n{BOMB}": "1: got aliases for more than 10000 values, allowed is a plain tree.",
}


def test_what_is_not_yaml_is_refused_with_its_line():
    for text, sentence in NOT_YAML.items():
        with pytest.raises(ScenarioError) as caught:
            read_yaml(text, "f.yaml")
        assert str(caught.value) == f"f.yaml:{sentence}"


@pytest.mark.parametrize(
    ("text", "data"),
    [
        ("a.b=3", {"a": {"b": 3}}),
        ("dt=1e-3", {"dt": 0.001}),
        ("a = no", {"a": "no"}),
        ("a=", {"a": None}),
        ("a=b=c", {"a": "b=c"}),
        ("graph.edges.0=[0, 1]", {"graph": {"edges": {0: [0, 1]}}}),
        ("formation.offsets={1: [1,0,0]}", {"formation": {"offsets": {1: [1, 0, 0]}}}),
    ],
)
def test_an_override_is_a_path_and_a_value(text, data):
    assert same(apply_overrides(read_yaml("", "f.yaml"), [text]).data, data)


NO_KEY = "got an empty key, allowed are keys joined by dots, as in `simulation.dt=0.01`."
NO_INDEX = "allowed is an index of a list of 2, from 0."
MALFORMED = {
    "seed": "got no `=`, allowed is `key=value`, as in `seed=7`.",
    "=3": NO_KEY,
    "a..b=3": NO_KEY,
    "a=[1,": "this is not YAML: expected the node content, but found '<stream end>'.",
    "a={x: 1, x: 2}": "got this key twice, the first is at --set a={x: 1, x: 2}.",
    "s.x=1": "got `x` inside `s`, allowed is a key inside a mapping or a list, but `s` is `0`.",
    "l.2=1": f"got `2` inside `l`, {NO_INDEX}",
    "l.x=1": f"got `x` inside `l`, {NO_INDEX}",
}


def test_a_malformed_override_is_one_sentence():
    for text, sentence in MALFORMED.items():
        with pytest.raises(ScenarioError) as caught:
            apply_overrides(read_yaml("s: 0\nl: [1, 2]\n", "f.yaml"), [text])
        assert str(caught.value) == f"--set {text}: {sentence}"


def test_overrides_replace_and_add_in_their_order():
    document = read_yaml("a: {1: [1, 2], '2': x, b: {c: 3}}\nn:\n", "f.yaml")
    texts = ["a.1.0=9", "a.2=y", "a.b.c=4", "a.3=[0]", "n.m.k=5", "a.b.c=6"]
    done = {"a": {1: [9, 2], 2: "y", "b": {"c": 6}, 3: [0]}, "n": {"m": {"k": 5}}}
    assert same(apply_overrides(document, texts).data, done)
    assert document.data["a"][1] == [1, 2]


def test_the_place_of_an_overridden_value_is_the_override():
    document = read_yaml("a:\n  b: [1, 2]\n  c: 3\n", "f.yaml")
    done = apply_overrides(document, ["a.b=[7]", "x.y=1"])
    first, second = "--set a.b=[7]", "--set x.y=1"
    places = {(): "f.yaml:1", ("a",): first, ("a", "b"): first, ("a", "b", 0): first}
    places |= {("a", "b", 1): first, ("a", "c"): "f.yaml:3", ("x",): second, ("x", "y"): second}
    found = {path: done.place(path) for path in [*document.places, ("x",), ("x", "y")]}
    assert found == places and done.place(("a", "d")) == first


@pytest.mark.slow
@given(st.dictionaries(KEYS, DATA, max_size=3), DATA)
def test_an_override_of_a_new_key_changes_nothing_else(data, value):
    document = read_yaml(dump_yaml(data), "f.yaml")
    done = apply_overrides(document, [f"a-new-key-of-14={inline_yaml(value)}"])
    assert same(done.data, data | {"a-new-key-of-14": value})
