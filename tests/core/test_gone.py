"""What earlier versions had answers with one sentence that says what to use instead."""

import functools

import pytest

import echelon as ech
from echelon.core import gone
from echelon.experiments.scenario.scenario import Scenario

KEYS = Scenario.model_json_schema()["properties"]


@pytest.mark.parametrize("command", gone.COMMANDS)
def test_a_command_that_is_gone_says_what_to_use(echelon, command):
    code, out, err = echelon(command, "paper")
    assert (code, out) == (2, "")
    assert err == f"echelon: the command `{command}` is gone; {gone.COMMANDS[command]}.\n"


@pytest.mark.parametrize("name", gone.NAMES)
def test_a_name_that_is_gone_says_what_to_use(name):
    *modules, last = name.split(".")
    family = functools.reduce(getattr, modules, ech)
    assert last not in family.__all__
    with pytest.raises(AttributeError, match=f"^`echelon.{name}` is gone; "):
        getattr(family, last)
    with pytest.raises(AttributeError, match=r"^`echelon\.formation` does not exist\.$"):
        ech.formation  # noqa: B018


def test_a_key_and_a_value_that_are_gone_say_what_to_use(monkeypatch):
    monkeypatch.setitem(gone.KEYS, "simulation.stride", "use `simulation.store_every`")
    monkeypatch.setitem(gone.VALUES, "engine: c", "use `native`")
    with pytest.raises(ech.errors.ScenarioError) as error:
        ech.load_scenario("paper", ["simulation.stride=2", "simulation.engine=c"])
    assert "simulation.stride=2: the key is gone; use `simulation.store_every`." in str(error.value)
    assert "simulation.engine=c: the value `c` is gone; use `native`." in str(error.value)
    assert not {key.rpartition(".")[2] for key in gone.KEYS} & {*KEYS}
