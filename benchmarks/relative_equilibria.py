"""Trims that move, of drawn models: verdicts, ranges of speeds and turns against own matrices.

    python benchmarks/relative_equilibria.py

It repeats tests of `test_relative_equilibria.py`: verdicts of 40 models, speeds and Floquet
multipliers of 30, and 20 that only look like one.
"""

import sys
import traceback
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "guarantees"))
import test_relative_equilibria as tests

LOOKS = [(kind, seed) for kind in tests.LOOKS_LIKE_ONE for seed in range(4)][:20]
CASES = (
    (tests.test_verdicts_are_those_of_own_matrices, [(seed,) for seed in range(40)]),
    (
        tests.test_the_range_of_speeds_ends_where_floquet_multipliers_pass_one,
        [(seed,) for seed in range(30)],
    ),
    (
        tests.test_a_gain_that_turns_decays_as_the_floquet_multipliers_do,
        [(seed,) for seed in range(30)],
    ),
    (tests.test_what_only_looks_like_one_is_no_equilibrium, LOOKS),
)


def main() -> None:
    """Print how many of each agree."""
    for test, cases in CASES:
        wrong = 0
        for case in cases:
            try:
                test(*case)
            except Exception:
                wrong += 1
                print(test.__name__, case)
                traceback.print_exc(limit=1)
        print(f"{test.__name__}: {len(cases) - wrong} of {len(cases)} agree", flush=True)


if __name__ == "__main__":
    main()
