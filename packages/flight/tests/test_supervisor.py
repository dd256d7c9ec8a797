"""The supervisor: each fault ends a flight, the first one is told, and nothing takes it back."""

import math

import pytest

from echelon_flight import FlightError
from echelon_flight import __main__ as process
from echelon_flight.links import Reading
from echelon_flight.supervisor import Fault, Fence, Supervisor

FACTS = {"dt": 0.01, "position": [0, 1, 2], "velocity": [3, 4, 5], "tilt": [6, 7]}
FENCE = Fence((-1.0, -1.0, 0.0), (1.0, 1.0, 2.0), 5.0)
NAMES = ["x", "y", "z", "vx", "vy", "vz", "roll", "pitch", "yaw", "p", "q", "r"]


def state(**changes):
    x = dict.fromkeys(NAMES, 0.0) | {"z": 1.0} | changes
    return list(x.values())


def judged(*, battery=None, **changes):
    watch = Supervisor(FACTS, FENCE)
    watch.judge(Reading(0.0, state(**changes), battery), 0.0)
    return watch


STATES = {
    Fault.NONE: [
        *({}, {"x": 1.0, "y": -1.0}, {"roll": math.radians(69)}),
        *({"vx": 3.0, "vy": -4.0}, {"battery": 0.15}),
    ],
    Fault.TILT: [
        *({"roll": math.radians(71)}, {"pitch": -1.3}, {"roll": 0.95, "pitch": 0.95}),
        {"roll": math.pi},
    ],
    Fault.FENCE: [{"x": 1.01}, {"y": -1.5}, {"z": -0.1}, {"z": 9.0}, {"x": math.nan}],
    Fault.SPEED: [{"vz": -5.1}, {"vx": 3.0, "vy": 4.0, "vz": 0.5}, {"vy": math.inf}],
    Fault.BATTERY: [{"battery": 0.14}, {"battery": math.nan}],
}


def test_states_are_judged():
    found = {fault: [judged(**each).fault for each in states] for fault, states in STATES.items()}
    assert found == {fault: [fault] * len(states) for fault, states in STATES.items()}


def test_each_fault_is_a_sentence():
    for fault in Fault:
        sentence = fault.sentence(0.5)
        assert "{" not in sentence and not sentence.endswith(".")
    assert judged(x=1.25).sentence == "the vehicle is 0.25 m outside its fence"
    assert (
        judged(roll=1.4).sentence == "the vehicle is tilted by 80 degrees, more than `tilt` allows"
    )


def test_the_first_fault_stays():
    watch = judged(x=3.0)
    watch.trip(Fault.STOP)
    watch.judge(Reading(0.1, state()), 0.1)
    assert watch.fault is Fault.FENCE and watch.amount == 2.0


def test_a_state_may_be_a_tenth_of_a_second_old():
    watch = Supervisor(FACTS, FENCE)
    watch.look(0.099)
    assert watch.fault is Fault.NONE
    watch.look(0.101)
    assert watch.fault is Fault.STALE


def test_no_input_that_is_not_finite_is_sent():
    for u in ([0.1, math.nan], [math.inf, 0.0]):
        watch = Supervisor(FACTS, FENCE)
        watch.check([0.1, 0.2], True)
        assert watch.fault is Fault.NONE
        watch.check(u, True)
        assert watch.fault is Fault.INPUT


def test_a_law_that_overruns_ten_times_in_a_row_ends_the_flight():
    watch = Supervisor(FACTS, FENCE)
    for seconds in [0.006] * 9 + [0.001] + [0.006] * 9:
        watch.spend(seconds)
    assert watch.fault is Fault.NONE
    watch.spend(0.006)
    assert watch.fault is Fault.OVERRUN and "takes 60% of its period" in watch.sentence


@pytest.mark.parametrize(("step", "fault"), [(0.011, Fault.NONE), (0.02, Fault.PERIOD)])
def test_states_at_half_the_rate_end_the_flight(step, fault):
    watch = Supervisor(FACTS, FENCE)
    for k in range(60):
        # A hiccup now and then is none.
        watch.judge(Reading(0.0, state()), step * k + 0.5 * (k > 30))
    assert watch.fault is fault and abs(watch.step - step) < 1e-9


def test_a_vehicle_that_sends_no_state_is_named_by_its_link():
    with pytest.raises(
        FlightError, match="^no state of the vehicle arrived .* the link `udp`; swi"
    ):
        process._wait_for_state(None, "udp", 0.0)
