"""Numbers of flight.json: their table, what is refused, and that each one acts."""

import json
import math
from pathlib import Path

import pytest
import two_points
from hypothesis import given
from hypothesis import strategies as st
from test_supervisor import FACTS, FENCE, state

import echelon_flight
from echelon_flight import FlightError
from echelon_flight.links import Reading
from echelon_flight.mission import Mission
from echelon_flight.parameters import DEFAULTS, PARAMETERS, table, values_of
from echelon_flight.supervisor import Fault, Supervisor

SOURCE = Path(echelon_flight.__file__).parent


def test_each_parameter_is_a_row_that_a_person_can_read():
    assert len(DEFAULTS) == len(PARAMETERS)
    for each in PARAMETERS:
        assert each.low <= each.default <= each.high and each.unit
        assert each.sentence.endswith(".") and len(each.sentence.split()) <= 25
        assert f"| `{each.name}` |" in table()


def test_each_parameter_is_used_in_the_code():
    files = [x for x in SOURCE.rglob("*.py") if x.name != "parameters.py"]
    text = "".join(file.read_text("utf-8") for file in files)
    assert not [each.name for each in PARAMETERS if f'"{each.name}"]' not in text]


VALUES = st.none() | st.booleans() | st.text() | st.integers() | st.floats() | st.lists(st.floats())


@given(st.sampled_from(PARAMETERS), VALUES)
def test_a_value_is_used_or_refused_with_what_is_allowed(parameter, value):
    whole = isinstance(parameter.default, int)
    number = isinstance(value, int | float) and not isinstance(value, bool)
    inside = number and parameter.low <= value <= parameter.high
    facts = {"parameters": {parameter.name: value}}
    if inside and (not whole or float(value).is_integer()):
        assert values_of(facts) == DEFAULTS | {parameter.name: value}
        return
    with pytest.raises(FlightError) as refused:
        values_of(facts)
    sentence = str(refused.value)
    assert sentence.startswith(f"`parameters.{parameter.name}` in flight.json is {value!r}, and")
    assert f"from {parameter.low:g} to {parameter.high:g}" in sentence and sentence.endswith(".")


def test_an_unknown_key_is_refused_and_a_missing_one_has_its_default():
    assert values_of({}) == values_of({"parameters": {}}) == DEFAULTS
    with pytest.raises(FlightError, match="has the unknown key `stale`; allowed are `stale_state`"):
        values_of({"parameters": {"stale": 0.1}})
    with pytest.raises(FlightError, match="is 3, and must have keys"):
        values_of({"parameters": 3})


FENCES = {
    "`fence` in flight.json is None": None,
    "must have low, high, speed": {"low": [0.0] * 3, "high": [1.0] * 3},
    "`fence.low` in flight.json is [0.0]": {"low": [0.0], "high": [1.0] * 3, "speed": 1.0},
    "must be 3 numbers, m": {"low": [0.0, "a", 0.0], "high": [1.0] * 3, "speed": 1.0},
    "is empty": {"low": [0.0] * 3, "high": [1.0, 0.0, 1.0], "speed": 1.0},
    "`fence.speed` in flight.json is -1.0": {"low": [0.0] * 3, "high": [1.0] * 3, "speed": -1.0},
    "is nan, and must be above": {"low": [0.0] * 3, "high": [1.0] * 3, "speed": math.nan},
}


@pytest.mark.parametrize("sentence", FENCES)
def test_a_fence_that_is_none_is_refused_before_anything_flies(tmp_path, sentence):
    two_points.write(tmp_path)
    file = tmp_path / "flight.json"
    Mission(tmp_path)
    file.write_text(json.dumps(json.loads(file.read_text()) | {"fence": FENCES[sentence]}))
    with pytest.raises(FlightError) as refused:
        Mission(tmp_path)
    assert sentence in str(refused.value)


def test_a_folder_with_a_wrong_number_flies_nothing(tmp_path):
    two_points.write(tmp_path)
    file = tmp_path / "flight.json"
    facts = json.loads(file.read_text()) | {"parameters": {"tilt": 1}}
    file.write_text(json.dumps(facts))
    told = "`parameters.tilt` in flight.json is 1, and must be a number from 5 to 180 deg."
    with pytest.raises(FlightError) as refused:
        Mission(tmp_path)
    assert str(refused.value) == told


def judged(name, value, act):
    watch = Supervisor(FACTS | {"parameters": {name: value}}, FENCE)
    act(watch)
    return watch.fault


def overrun(watch):
    for _ in range(12):
        watch.spend(0.6 * FACTS["dt"])


def slowly(watch):
    for k in range(60):
        watch.judge(Reading(0.0, state()), 3.0 * FACTS["dt"] * k)


ACTS = {
    "stale_state": (0.1, 0.5, lambda watch: watch.look(0.3), Fault.STALE),
    "tilt": (70.0, 120.0, lambda w: w.judge(Reading(0.0, state(roll=1.4)), 0.0), Fault.TILT),
    "low_battery": (0.15, 0.05, lambda w: w.judge(Reading(0.0, state(), 0.1), 0.0), Fault.BATTERY),
    "overrun_share": (0.5, 0.7, overrun, Fault.OVERRUN),
    "overrun_ticks": (10, 20, overrun, Fault.OVERRUN),
    "slow_states": (2.0, 4.0, slowly, Fault.PERIOD),
}


@pytest.mark.parametrize("name", ACTS)
def test_the_supervisor_keeps_to_the_number_that_a_flight_has(name):
    usual, wider, act, fault = ACTS[name]
    assert DEFAULTS[name] == usual
    assert judged(name, usual, act) is fault
    assert judged(name, wider, act) is Fault.NONE


def test_the_documentation_has_the_table():
    page = (SOURCE.parents[3] / "docs" / "fly.md").read_text("utf-8")
    assert page.split("<!-- parameters -->\n")[1].split("<!-- end -->")[0] == table()
