"""Agents distributed over devices and processes: the same bits as on one device."""

import os
import socket
import subprocess
import sys

import numpy as np
import pytest

import echelon as ech
from echelon.core.errors import SimulationError

FLY = """
import sys, os
import jax
process, processes, port, devices, out = *map(int, sys.argv[1:5]), sys.argv[5]
if processes > 1:
    jax.distributed.initialize(f"127.0.0.1:{port}", processes, process)
import numpy as np
import echelon as ech
changes = ["simulation.horizon=0.5", "simulation.dt=0.01", "simulation.store_every=20", "seed=1"]
changes += ["disturbance={rms: {x: 0.5}}", "simulation.engine=jax"]
parts, settings = ech.build(ech.load_scenario("integrators", changes))
result = ech.simulate(parts, settings._replace(devices=devices))
if process == 0:
    np.savez(out, states=result.states, inputs=result.inputs, **result.sums._asdict())
"""


def fly(out, processes, each):
    """Let processes with so many devices each fly together, and return the file they leave."""
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        port = found.getsockname()[1]
    environment = {**os.environ, "JAX_NUM_CPU_DEVICES": str(each), "JAX_PLATFORMS": "cpu"}
    # The bits are those of programs as users compile them, not of those compiled quickly for tests.
    environment.pop("XLA_FLAGS", None)
    words = [str(processes), str(port), str(processes * each), str(out)]
    started = [
        subprocess.Popen([sys.executable, "-c", FLY, str(k), *words], env=environment)
        for k in range(processes)
    ]
    try:
        assert [process.wait(timeout=300) for process in started] == [0] * processes
    finally:
        for process in started:
            process.kill()
    return out


@pytest.mark.slow
def test_two_devices_and_two_processes_have_the_bits_of_one(tmp_path):
    cases = {"one": (1, 1), "devices": (1, 2), "processes": (2, 1)}
    # One case after the other: those that compute together wait half a minute for each other.
    flown = [fly(tmp_path / f"{name}.npz", p, d) for name, (p, d) in cases.items()]
    one, *others = map(np.load, flown)
    assert set(one.files) > {"states", "inputs", "errors"}
    for other in others:
        for name in one.files:
            np.testing.assert_array_equal(one[name], other[name])


@pytest.mark.parametrize(
    ("more", "told"),
    [
        ({"devices": 0}, "`devices` is 0, and must be a whole number from 1 on"),
        ({"devices": 1000}, "`devices` is 1000, and JAX has 1 "),
        ({"devices": 2, "engine": "native"}, "must be 1 where `engine` is `native`"),
    ],
)
def test_devices_that_there_are_not_are_refused(more, told):
    parts, settings = ech.build(ech.load_scenario("integrators"))
    with pytest.raises(SimulationError, match=told):
        ech.simulate(parts, settings._replace(**more))
