"""Test states and pairs of states on a domain."""

import itertools
from typing import NamedTuple

import numpy as np

from echelon.core.types import Array
from echelon.guarantees.verifier.saved_gain import SavedGain, SavedRegion

_COUNT = 128
"""States of each kind: corners of the domain, lattice points and random points."""
_FAR = (-2.0, 3.0)
"""Exponents: an unbounded state is tested from 10^-2 to 10^3 on both sides of the trim."""
_NEAR = -6.0
"""Exponent: pairs of states are as close as 10^-6 of the domain."""


class Points(NamedTuple):
    """Deviations (K, n) and inputs (K, m); the first `corners` are all corners of the domain."""

    states: Array
    inputs: Array
    corners: int


class _Box(NamedTuple):
    """Bounds (n + m,) of deviations and inputs; `used` are the bounded entries that vary."""

    low: Array
    high: Array
    used: Array

    def fill(self, some: Array, random: np.random.Generator) -> Array:
        """Return points (K, n + m) with the values `some` in the entries `used`."""
        size = (len(some), len(self.low))
        far = 10.0 ** random.uniform(*_FAR, size) * random.choice([-1.0, 1.0], size)
        # With a bound on one side, only the other side is unbounded.
        far = np.where(np.isfinite(self.low), self.low + np.abs(far), far)
        far = np.where(np.isfinite(self.high), self.high - np.abs(far), far)
        result = np.where(np.isfinite(self.low) & np.isfinite(self.high), self.low, far)
        result[:, self.used] = some
        return result


def _box(region: SavedRegion) -> _Box:
    low = np.concatenate([region.lower, region.input_lower])
    high = np.concatenate([region.upper, region.input_upper])
    return _Box(low, high, np.flatnonzero(np.isfinite(low) & np.isfinite(high) & (low < high)))


def points(saved: SavedGain, region: SavedRegion) -> Points:
    """Return corners of a domain, lattice points and random points."""
    # Fixed seed: a file must get the same verdict every time.
    random, box = np.random.default_rng(0), _box(region)
    ends = np.stack([box.low[box.used], box.high[box.used]])
    parts = [_corners(ends, random)]
    # Quarters of the ranges hold corners and middles, where symmetric functions are extreme.
    for fractions in (_lattice(box, random), random.uniform(size=(_COUNT, len(box.used)))):
        parts.append(ends[0] + fractions * (ends[1] - ends[0]))
    result, n = box.fill(np.concatenate(parts), random), len(saved.P)
    # The trim, where many slopes are extreme.
    result[-1] = 0.0
    few = 2 ** len(box.used)
    return Points(result[:, :n], result[:, n:], few if few <= _COUNT else 0)


def _lattice(box: _Box, random: np.random.Generator) -> Array:
    return random.integers(0, 5, (_COUNT, len(box.used))) / 4.0


def _corners(ends: Array, random: np.random.Generator) -> Array:
    """Return all corners of a box, or random ones if there are too many."""
    count = ends.shape[1]
    if 2**count <= _COUNT:
        picks = np.array(list(itertools.product((0, 1), repeat=count)), int).reshape(
            2**count, count
        )
    else:
        picks = random.integers(0, 2, (_COUNT, count))
    return np.take_along_axis(ends, picks, axis=0)


class StatePairs(NamedTuple):
    """Pairs of deviations (K, n) in a domain, with one input (K, m) per pair."""

    ones: Array
    others: Array
    inputs: Array


def pairs(saved: SavedGain, region: SavedRegion, known: Points) -> StatePairs:
    """Return pairs of states: arbitrary points, and close pairs at the trim and at the points."""
    random, n = np.random.default_rng(1), len(saved.P)
    box, count = _box(region), len(known.states)
    ones, others = known.states.copy(), known.states[random.permutation(count)]
    close = np.arange(count) % 2 == 1
    centre = np.clip(known.states, -(10.0 ** _FAR[1]), 10.0 ** _FAR[1])
    # Near the trim, where a switch is most likely, and near all other points.
    centre[close & (np.arange(count) % 4 == 1)] = 0.0
    width = np.where(np.isfinite(region.upper - region.lower), region.upper - region.lower, 1.0)
    step = 10.0 ** random.uniform(_NEAR, 0.0, (count, 1)) * random.normal(size=(count, n)) * width
    for result, sign in ((ones, 0.5), (others, -0.5)):
        result[close] = np.clip(centre + sign * step, box.low[:n], box.high[:n])[close]
    return StatePairs(ones, others, known.inputs)
