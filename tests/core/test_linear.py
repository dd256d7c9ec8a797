"""Whether a matrix is definite does not depend on the units in which its states are measured."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import echelon as ech
from echelon.core.errors import GainError
from echelon.core.linear import check_definite, with_unit_diagonal
from echelon.guarantees.verifier.algebra import is_positive_definite
from echelon.synthesis.certificates.lmi import rate_of
from echelon.synthesis.gains.riccati import weights_of

SEEDS = st.integers(0, 10**6)


def accepts(matrix):
    try:
        check_definite("P", matrix)
    except GainError:
        return False
    return True


def accepts_weight(Q):
    model = ech.models.Linear(-np.eye(len(Q)), np.eye(len(Q)))
    try:
        weights_of(model, Q)
    except GainError as error:
        assert "`Q` is not positive semidefinite" in str(error)
        return False
    return True


def rotated(rng, values):
    turn = np.linalg.qr(rng.normal(size=(len(values), len(values))))[0]
    matrix = turn @ np.diag(values) @ turn.T
    return 0.5 * (matrix + matrix.T)


def in_units(rng, matrix, decades=13):
    """Return a matrix in other units, powers of two, so that no number of it is rounded."""
    units = 2.0 ** rng.integers(-3 * decades, 3 * decades, len(matrix))
    return matrix * units[:, None] * units


@settings(max_examples=100, deadline=None)
@given(seed=SEEDS, n=st.integers(1, 6), lost=st.booleans())
def test_a_matrix_is_definite_in_all_units_or_in_none(seed, n, lost):
    rng = np.random.default_rng(seed)
    values = 10.0 ** rng.uniform(-3, 3, n)
    values[0] *= -1.0 if lost else 1.0
    matrix = rotated(rng, values)
    other = in_units(rng, matrix)
    exact = is_positive_definite([[Fraction(float(x)) for x in row] for row in other])
    assert accepts(matrix) is accepts(other) is exact is not lost


@settings(max_examples=30, deadline=None)
@given(seed=SEEDS, n=st.integers(1, 6))
def test_scaling_rounds_nothing(seed, n):
    rng = np.random.default_rng(seed)
    matrix = in_units(rng, rotated(rng, 10.0 ** rng.uniform(-3, 3, n)))
    scaled = with_unit_diagonal(matrix)
    assert ((0.5 <= np.diag(scaled)) & (np.diag(scaled) <= 2.0)).all()
    powers = np.frexp(matrix / scaled)[0]
    assert (np.abs(powers) == 0.5).all()


def test_a_weight_is_semidefinite_in_all_units_or_in_none():
    weights = [
        (np.diag([1e12, 0.0]), True),
        (np.outer([1e-8, 1.0], [1e-8, 1.0]), True),
        (np.diag([1e12, -0.5]), False),
        (np.diag([1.0, -1e-13]), False),
        (1e-13 * np.array([[1.0, 2.0], [2.0, 1.0]]), False),
    ]
    assert [accepts_weight(Q) for Q, _ in weights] == [fine for _, fine in weights]


def test_the_rate_of_a_metric_is_that_of_its_loop_in_all_units():
    units = np.array([1e-8, 1.0, 1e8])
    A = np.array([[-1.0, 2.0, 0.0], [0.0, -2.0, 1.0], [0.0, 0.0, -3.0]])
    P = rotated(np.random.default_rng(3), [1.0, 40.0, 90.0])
    rate = rate_of(P, A[None])
    other = rate_of(P * units[:, None] * units, (A * units / units[:, None])[None])
    assert other == pytest.approx(rate, rel=1e-9)
