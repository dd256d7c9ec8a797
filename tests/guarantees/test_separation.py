"""What is guaranteed of agents that keep apart (T10), and what is not."""

import copy
import json

import numpy as np
import pytest
from in_words import in_words

import echelon as ech
from echelon.core.statement import Hypothesis
from echelon.core.words import Kind, Theorem
from echelon.guarantees.promises.promise import guarantee
from echelon.guarantees.stopping import separation
from echelon.guarantees.stopping.stopping_run import FlatStates
from echelon.guarantees.verifier.verify import verify

MODEL = ech.models.DoubleIntegrator()
SETTINGS = ech.Settings(horizon=1.0, dt=0.02)


def guaranteed(safety=ech.Safety(radii=(0.1, 0.1, 0.3)), settings=SETTINGS, **world):
    graph = ech.Graph.ring(4)
    offsets = {1: (1.0, 0.0), 2: (1.0, 1.0), 3: (0.0, 1.0)}
    starts = {1: (0.9, 0.8, 0.5, -0.5), 2: (0.4, 0.1, 0.0, 0.0), 3: (0.0, 1.0, 0.0, 0.0)}
    drive = ech.Laws(ech.laws.StoppingLeader(), ech.laws.StoppingPoint(safety=safety))
    formation = ech.Formation.from_offsets(MODEL, graph, offsets)
    parts = ech.Parts(MODEL, graph, formation, drive, initial=starts, world=ech.World(**world))
    return parts, guarantee(parts, settings)


def test_a_position_that_was_seen_at_samples_alone_is_not_called_proved(monkeypatch):
    parts, value = guaranteed()
    assert value.separation.kind is value.tube.kind is Kind.PROOF
    # As of outputs whose equations no trace follows.
    monkeypatch.setattr(separation, "flat_states_of", lambda *_: FlatStates((), ()))
    seen = guarantee(parts, SETTINGS._replace(horizon=2.0))
    assert seen.separation.kind is Kind.SAMPLES and "(seen at samples, T10)" in in_words(seen)


def test_distances_are_guaranteed_and_convergence_is_not():
    _, value = guaranteed()
    assert value.theorem is Theorem.T10 and value.promised and value.rate is None
    text = in_words(value)
    assert "ellipsoids of 0.1 x 0.1 m about the agents never overlap" in text
    assert "convergence is not guaranteed" in text and "converges" not in text
    # The proof is of continuous time and of agents whose actuators deliver what the law asks.
    assert "time is continuous no input is at a limit" in text and "held for" in text
    assert value.hypotheses[Hypothesis.SEPARATION].kind is value.tube.kind
    line = value.hypotheses[Hypothesis.SEPARATION]
    assert not line.fails
    # Agents 0 and 2 rest at the start, so that their hulls are single points.
    np.testing.assert_allclose(line.number, np.hypot(0.4, 0.1), rtol=1e-12)
    _, without = guaranteed(None)
    assert without.theorem is Theorem.T5 and Hypothesis.SEPARATION not in without.hypotheses


@pytest.mark.parametrize(
    "world",
    [
        {"network": ech.Network(rate=25.0)},
        {"disturbance": ech.Disturbance(constant={"velocity": 0.1})},
        {"sensing": ech.Sensing(noise={"position": 0.01})},
        {"plant": ech.models.DoubleIntegrator(drag=0.1)},
    ],
    ids=["network", "wind", "noise", "plant"],
)
def test_in_a_world_that_is_not_ideal_distances_are_observed(world):
    _, value = guaranteed(**world)
    assert value.hypotheses[Hypothesis.SEPARATION].fails
    assert not value.promised and "the world is ideal" in value.conditions
    assert "converges" not in in_words(value)


def test_numbers_in_a_sentence_state_no_more_than_is_guaranteed():
    """Radii are rounded down, and times up."""
    _, value = guaranteed(ech.Safety(radii=(0.123456, 0.123456, 0.3), margin=0.0))
    assert "ellipsoids of 0.1234 x 0.1234 m" in in_words(value)
    slow = ech.laws.StoppingPoint(rate=0.12, coupling=0.12, speed=100.0)
    drive = ech.Laws(ech.laws.StoppingLeader(rate=0.12), slow)
    value = guarantee(guaranteed()[0].replace(drive=drive), SETTINGS)
    shown = float(in_words(value).split("within 1 cm after ")[1].split(" s")[0])
    assert 10.0 < value.tube.arrival <= shown <= value.tube.arrival + 1.0


def test_metres_are_of_positions_in_metres():
    class Far(ech.models.DoubleIntegrator):
        state_units = ("km", "km", "km/s", "km/s")

    parts, value = guaranteed(None)
    assert value.tube.arrival is not None
    far = parts.replace(model=Far())
    assert guarantee(far, SETTINGS).promised and guarantee(far, SETTINGS).tube.arrival is None
    with pytest.raises(ech.EchelonError, match="needs the position in m"):
        guarantee(guaranteed()[0].replace(model=Far()), SETTINGS)


FORGERIES = {
    "least": lambda claim: claim.update(least=1.2 * claim["least"]),
    "gap": lambda claim: claim.update(gap=(0.3 * np.array(claim["gap"])).tolist()),
    "radii": lambda claim: claim.update(radii=[0.3, 0.3, 0.9]),
    "distance": lambda claim: claim.update(distance=0.1),
    "gain": lambda claim: claim.update(gain=60.0),
    "step": lambda claim: claim.update(step=0.3),
    "reach": lambda claim: claim.update(reach=1.0),
    "speeds": lambda claim: claim.update(speeds=[9.0, 9.0]),
}


def test_claims_of_distances_are_checked_by_code_of_its_own(tmp_path):
    document = json.loads(json.dumps({"guarantee": guaranteed()[1].as_mapping()}))
    file = tmp_path / "summary.json"
    file.write_text(json.dumps(document))
    assert verify(file).verdict == "incomplete"
    for name, forge in FORGERIES.items():
        forged = copy.deepcopy(document)
        forge(forged["guarantee"]["anywhere"]["separation"])
        file.write_text(json.dumps(forged))
        assert verify(file).verdict == "refused", name
