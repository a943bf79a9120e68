"""The helper with which rates are tested ends early without letting a wrong rate pass."""

import pytest
from draws import errs_at_most


@pytest.mark.parametrize("true, is_refused", [(0.01, 0), (0.05, 0), (0.15, 100)])
def test_a_rate_that_is_too_large_is_refused(true, is_refused, rng):
    refused = sum(not errs_at_most(0.05, 500, lambda: rng.random() < true) for _ in range(100))
    assert abs(refused - is_refused) <= 2


def test_each_kind_of_error_counts(rng):
    assert not errs_at_most(0.05, 500, lambda: rng.random(2) < (0.01, 0.2))
    assert not errs_at_most(0.05, 500, lambda: (True, False))


def test_it_ends_as_soon_as_nothing_is_doubtful():
    draws = iter([True, *[False] * 99])
    assert errs_at_most(0.05, 500, lambda: next(draws))
    assert next(draws, None) is None
