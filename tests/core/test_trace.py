"""One public call traces each function of a model once, and the next call traces anew."""

import itertools

import jax.numpy as jnp
import numpy as np
import pytest

import echelon as ech
from echelon.core.trace import call_once_traced, shared_traces

DRIFTS, MAPS = itertools.count(), itertools.count()
GRAPH = ech.Graph.path(3, leaders=[0])


class Counted(ech.ControlAffine):
    """Counts in C, since what code reads in Python is part of a model's identity."""

    pull: float | np.ndarray
    state_names, input_names = ("a", "b"), ("u",)

    def drift(self, x):
        next(DRIFTS)
        return jnp.stack([x[1], -jnp.asarray(self.pull, x.dtype).sum() * jnp.sin(x[0])])

    def input_map(self, x):
        next(MAPS)
        return jnp.array([[0.0], [1.0]])


def so_far(calls):
    return int(repr(calls)[6:-1])


def calls_of(do):
    before = so_far(DRIFTS), so_far(MAPS)
    result = do()
    return result, (so_far(DRIFTS) - before[0], so_far(MAPS) - before[1])


def parts_of(agent, gain):
    formation = ech.Formation.from_offsets(agent, GRAPH, {})
    drive = ech.Laws(ech.laws.TrimInput(), ech.laws.Consensus(gain, feedforward="relay"))
    return ech.Parts(agent, GRAPH, formation, drive, initial={"a": 0.5})


@pytest.mark.parametrize("bits", ["float64", "float32"])
def test_a_public_call_traces_a_model_once_and_a_second_time_to_find_clocks(bits):
    agent = Counted(1.5 if bits == "float64" else 1.25)
    gain, calls = calls_of(lambda: ech.synthesize(agent, GRAPH, ech.gains.Riccati()))
    assert calls == (2, 2)
    settings = ech.Settings(horizon=0.1, dt=0.01, engine="native", precision=bits)
    parts = parts_of(agent, gain)
    # In single precision the checks of a law are in double, and so are theorems.
    traces = 1 if bits == "float64" else 2
    assert max(calls_of(lambda: ech.simulate(parts, settings))[1]) <= traces
    assert max(calls_of(lambda: ech.guarantee(parts, settings))[1]) <= 2


def test_shared_traces_are_those_of_what_the_code_reads_now():
    from jax import make_jaxpr

    now = np.array([2.0])
    agent, x = Counted(now), jnp.zeros(2)
    with shared_traces():
        texts = []
        for pull in (2.0, 5.0, 2.0):
            now[0] = pull
            make = make_jaxpr(lambda x: call_once_traced(agent.drift, x))
            texts.append(make(x).jaxpr.pretty_print() + str(make(x).consts))
    assert texts[0] == texts[2] != texts[1]
