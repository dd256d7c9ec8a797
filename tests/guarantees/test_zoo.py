"""Unusual agents: families that aim at one rule each, judged by NumPy."""

import pytest
from zoo import FAMILIES, judge

FEW = {"plants": 1, "paths": 1, "differences": 1, "subclasses": 1, "units": 1, "leaders' inputs": 1}


@pytest.mark.parametrize("family", FAMILIES)
def test_nothing_false_is_guaranteed_of_a_few(family):
    findings = [judge(family, 5, number) for number in range(FEW.get(family, 2))]
    assert [finding.false for finding in findings if finding.false] == []


@pytest.mark.study
@pytest.mark.parametrize("family", FAMILIES)
def test_nothing_false_is_guaranteed_of_many(family):
    findings = [judge(family, 6, number) for number in range(3)]
    assert [finding.false for finding in findings if finding.false] == []
    assert any(finding.guaranteed for finding in findings)
