"""Laws linearized along the leader's path: whether a gain of the trim works away from it."""

import numpy as np
import pytest
from in_words import in_words

import echelon as ech
from echelon.core.statement import Hypothesis
from echelon.core.words import Kind
from echelon.guarantees.promises.frozen_laws import ModeMatrices


def built(scenario, *changes):
    return ech.build(ech.load_scenario(scenario, list(changes)))


def line_of(found, name=Hypothesis.ALONG_PATH):
    return found.hypotheses[name]


@pytest.mark.slow
@pytest.mark.parametrize("yaw", [1.05, -1.2])
def test_a_yaw_that_loses_the_formation_is_not_promised_unless_the_law_turns(yaw):
    turning = ech.guarantee(*built("paper", f"reference.yaw={yaw}"))
    assert turning.promised and not line_of(turning).fails
    found = ech.guarantee(*built("paper", f"reference.yaw={yaw}", "follower.frame=world"))
    line = line_of(found)
    assert not found.promised and line.fails and line.kind is Kind.SAMPLES
    assert line.number > 0.1 and f"`yaw` {yaw:.3g} rad" in in_words(found)
    assert "`yaw`" in line.remedy


@pytest.mark.parametrize("scenario", ["paper", "van-der-pol"])
def test_no_bundled_scenario_that_flies_is_taken_its_promise(scenario):
    assert not line_of(ech.guarantee(*built(scenario))).fails


@pytest.mark.parametrize("horizon", [0.1, 60.0, 6e4, 1e6, 1e9])
def test_the_rate_along_a_path_is_known_however_long_a_run_is(horizon):
    # A turned frame that moves no mode: the exponent of the whole path is the slowest one's.
    draw = np.random.default_rng(0)
    turn = np.linalg.qr(draw.normal(size=(3, 3)))[0]
    A = turn @ np.diag([-95.0, -1.25, -7.0]) @ turn.T
    laws = ModeMatrices(np.stack([A] * 192), np.zeros((192, 3, 1)), np.zeros((192, 2, 1, 3)))
    growth = laws.along(np.linspace(0.0, horizon, 192), "followers'")
    assert growth.rate == pytest.approx(-1.25, rel=1e-6) and not growth.lost
