"""The steps of all worlds are those of the version that stored them, but for rounding."""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))
from same_steps import PARTS, STORED, WORLDS, arrays_of  # noqa: E402

QUICK = {"integrators", "van-der-pol"}
# Normal draws have single precision, and their last digits depend on how they are compiled.
DRAWN = ("windy", "everything", "noisy", "noise", "gusts")


@pytest.mark.parametrize(
    "name", [pytest.param(k, marks=() if k in QUICK else pytest.mark.slow) for k in WORLDS]
)
def test_the_last_states_and_inputs_are_those_that_were_stored(name):
    found, stored = arrays_of(name), np.load(STORED)
    rtol, atol = (1e-6, 1e-6) if any(word in name for word in DRAWN) else (1e-10, 1e-12)
    rtol, atol = (2e-4, 2e-5) if "single" in name else (rtol, atol)
    for part in PARTS:
        last, before = found[part][-1], stored[f"{name} {part}"]
        # Single precision has 7 digits; what grows has rounding in proportion.
        np.testing.assert_allclose(last, before, rtol=rtol, atol=atol)
