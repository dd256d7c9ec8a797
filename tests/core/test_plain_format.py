"""Trees as bytes: what comes back is equal, and nothing is called to read it."""

import dataclasses
import json
import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import echelon as ech
from echelon.agents.models.linearization import at_trim
from echelon.core.compiled import _Place
from echelon.core.plain_format import decode, encode
from echelon.core.words import Kind

plain = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats(allow_nan=False)
    | st.text()
    | st.binary(),
    lambda inner: (
        st.lists(inner)
        | st.lists(inner).map(tuple)
        | st.dictionaries(st.text() | st.integers(), inner)
        | st.tuples(inner).map(lambda parts: _Place(*parts))
    ),
)


@given(plain)
def test_plain_trees_come_back_with_their_kinds(value):
    back = decode(encode(value))
    assert back == value and repr(back) == repr(value)


def test_arrays_records_and_words_come_back_and_arrays_are_read_only():
    pendulum = ech.models.Pendulum(damping=0.25)
    value = {
        "array": np.arange(6.0).reshape(2, 3)[:, ::-1],
        "none": np.zeros((0, 3), np.int8),
        "scalar": np.float32(0.1),
        "word": Kind.PROOF,
        "ratio": Fraction(-1, 3),
        "nan": math.nan,
        "record": at_trim(pendulum),
        "model": pendulum,
    }
    back = decode(encode(value))
    np.testing.assert_array_equal(back["array"], value["array"])
    assert back["none"].shape == (0, 3) and back["none"].dtype == np.int8
    assert type(back["scalar"]) is np.float32 and back["scalar"] == value["scalar"]
    assert back["word"] is Kind.PROOF and back["ratio"] == value["ratio"]
    assert math.isnan(back["nan"]) and back["model"] == pendulum
    assert type(back["record"]) is type(value["record"])
    np.testing.assert_array_equal(back["record"][0], value["record"][0])
    assert not back["array"].flags.writeable


@dataclasses.dataclass
class Foreign:
    """A class that is not echelon's."""


@pytest.mark.parametrize("value", [print, Foreign(), Foreign, {1, 2}, np.array([object()]), 1j])
def test_what_is_not_plain_is_not_written(value):
    with pytest.raises(TypeError):
        encode([value])


@pytest.mark.parametrize(
    "text",
    [
        '["r","os:path",["d"]]',
        '["n","subprocess:Popen","ls"]',
        '["e","echelon.core.words:np","x"]',
        '["n","echelon.core.files:os.system","ls"]',
        '["r","echelon.core.disk_cache:threading.Thread",["d"]]',
        '["n","echelon.core.words:Kind","ls"]',
        '["a","|O",[1],0]',
        '["?"]',
    ],
)
def test_a_forged_tree_creates_no_foreign_object_and_calls_nothing(text):
    head = json.dumps([[8], text]).encode()
    with pytest.raises((ValueError, TypeError, LookupError, AttributeError, ImportError)):
        decode(len(head).to_bytes(8, "little") + head + bytes(8))
