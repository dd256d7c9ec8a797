"""The laws along the leader's path: what a gain of the trim does where the reference takes it."""

import pytest

import echelon as ech
from echelon.core.words import Kind
from echelon.promises.statement import Hypothesis


def built(scenario, *changes):
    return ech.build(ech.load_scenario(scenario, list(changes)))


def line_of(found, name=Hypothesis.ALONG):
    return found.hypotheses[name]


@pytest.mark.parametrize("yaw", [1.05, -1.2, 2.0])
def test_a_yaw_that_loses_the_formation_is_not_promised(yaw, echelon, tmp_path):
    found = ech.promise(*built("paper", f"reference.yaw={yaw}"))
    line = line_of(found)
    assert not found.promised and line.fails and line.kind is Kind.SAMPLES
    assert line.number > 0.1 and f"`yaw` {yaw:.3g} rad" in found.sentence()
    assert "`yaw`" in line.remedy


@pytest.mark.parametrize("scenario", sorted(ech.bundled_scenarios()))
def test_no_bundled_scenario_that_flies_is_taken_its_promise(scenario):
    found = ech.promise(*built(scenario))
    assert not line_of(found).fails
